"""``graderd report``: a recording as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graderd.cli.console import CliError, ExitCode, Json, example, print_json, print_text
from graderd.cli.record import lacking, path_of, tell_lacking


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(epilog=example("graderd report graderd-20260102T030405Z-000.mcap --to monday"))
    def report(
        context: typer.Context,
        file: Annotated[Path, typer.Argument(help="A recording, by its path or its name in `graderd record list`.")],
        to: Annotated[Path, typer.Option("--to", help="Folder to make.")],
        json: Json = False,
    ) -> None:
        """Write a page of a recording, and tables for spreadsheets beside it.

        Time in automatic, decisions with picture, litres and depth at that moment, angles and loads against time,
        faults, stops and why. index.html needs nothing else; ticks.csv, decisions.csv and faults.csv lie beside it.
        Exit status 1 where something in it is not as graderd writes it: told, and left out.
        """
        # Heavy imports wait until the command really runs.
        from graderd.record.reader import Recording
        from graderd.record.report import write

        try:
            story = write(Recording(path_of(context, file, None)), to)
        except FileExistsError:
            raise CliError(str(to), "is there already", "name a folder that is not", ExitCode.USAGE) from None
        told = {
            "folder": str(to),
            "duration_s": round(story.duration_s, 3),
            "automatic_s": round(story.time_in("auto"), 3),
            "ticks_n": story.ticks_n,
            "decisions_n": len(story.decisions),
            "faults_n": len(story.faults),
            "stops_n": len(story.stops),
            "missing_s": round(story.missing_s, 3),
            **lacking(story.gaps, story.unreadable),
        }
        tell_lacking(story.gaps, story.unreadable)
        if json:
            print_json({"event": "reported", **told})
        else:
            print_text(
                f"{to}/index.html: {told['duration_s']:.0f} s, {told['automatic_s']:.0f} s of it automatic, "
                f"{told['decisions_n']} decisions, {told['faults_n']} faults, {told['stops_n']} stops and disarms"
            )
        if story.unreadable:
            raise typer.Exit(ExitCode.FAILED)
