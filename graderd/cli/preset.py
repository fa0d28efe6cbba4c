"""``graderd preset NAME``: go to a named pose."""

from __future__ import annotations

from typing import Annotated

import typer

from graderd.cli.client import daemon_of
from graderd.cli.console import CliError, Json, print_json, print_table
from graderd.cli.epilog import example
from graderd.cli.jog import ALL_AXES, move


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(epilog=example("graderd preset", "graderd preset transport"))
    def preset(
        context: typer.Context,
        name: Annotated[str | None, typer.Argument(help="The pose; without it, the poses are listed.")] = None,
        timeout_s: Annotated[float, typer.Option(min=0.1, help="Fail if it has not arrived by then.")] = 120.0,
        json: Json = False,
    ) -> None:
        """Move to a named pose, in manual mode.

        The poses are the configuration's. The blade holds when the command ends.
        """
        daemon = daemon_of(context)
        names = daemon.get("/v1/status")["presets"]
        if name is None:
            if json:
                print_json({"presets": names})
            else:
                print_table("", ("preset",), [(known,) for known in names])
            return
        if name not in names:
            raise CliError("preset", f"there is no preset {name!r}", f"there are: {', '.join(names) or 'none'}")
        move(daemon, {"command": "preset", "name": name}, ALL_AXES, None, timeout_s, json)
