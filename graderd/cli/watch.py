"""``graderd watch``: the machine in a terminal, as it changes, with a hand on it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graderd.cli.console import CliError, ExitCode, example, for_people


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example(
            "graderd watch",
            "graderd watch --pad /dev/input/by-id/usb-Some_Pad-event-joystick",
        )
    )
    def watch(
        context: typer.Context,
        pad: Annotated[
            Path | None,
            typer.Option(metavar="DEVICE", help="Jog by this gamepad or joystick too (Linux event device)."),
        ] = None,
    ) -> None:
        """Show the machine in the terminal, faults first, and jog it by held keys.

        SPACE stops, whatever else is on the screen. An arrow moves while the terminal repeats it: let go, frozen or cut
        off, the blade holds within 0.3 s. A pad moves while its dead-man button (a shoulder button) is held and its
        stick is out. Needs the extra 'terminal'.
        """
        if not for_people():
            raise CliError(
                "watch", "standard output is no terminal", "'graderd status --watch' needs none", ExitCode.USAGE
            )
        try:
            from graderd.cli.watch_app import WatchApp
        except ImportError as error:
            cause = f"Textual is not installed ({error})"
            raise CliError("watch", cause, "Install it: pip install 'graderd[terminal]'", ExitCode.USAGE) from None
        named = context.find_root().obj
        application = WatchApp(named if isinstance(named, Path) else None, pad)
        application.run()
        if application.interrupted:
            raise KeyboardInterrupt
