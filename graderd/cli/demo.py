"""``graderd demo``: the whole loop on the simulated grader."""

from __future__ import annotations

import typer

from graderd.cli.console import Json
from graderd.cli.epilog import example


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(epilog=example("graderd demo", "graderd demo --json"))
    def demo(json: Json = False) -> None:
        """Show the whole loop on a simulated grader.

        It is armed and drives over soil left, center, right and even; the command ends by itself.
        """
        from graderd.runtime.app import run_demo

        raise typer.Exit(run_demo(json))
