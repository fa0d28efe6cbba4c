"""``graderd run``: the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graderd.cli.console import CliError, ExitCode, Json
from graderd.cli.epilog import example


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(epilog=example("graderd run --config /etc/graderd/graderd.toml", "graderd run --sim"))
    def run(
        config: Annotated[
            Path | None, typer.Option(help="Configuration file. Default: /etc/graderd/graderd.toml if it exists.")
        ] = None,
        sim: Annotated[bool, typer.Option("--sim", help="Start a simulated grader and run on that.")] = False,
        rig_dir: Annotated[
            Path | None, typer.Option(help="Run on the simulated grader that serves this directory.")
        ] = None,
        json: Json = False,
    ) -> None:
        """Run the daemon until SIGINT or SIGTERM.

        It starts disarmed. With --json it logs one object a line.
        """
        if sim and rig_dir is not None:
            raise CliError("run", "--sim and --rig-dir exclude each other", "give one of the two", ExitCode.USAGE)
        from graderd.runtime.app import run_daemon

        raise typer.Exit(run_daemon(config, sim, rig_dir, json))
