"""``graderd can dump``: the bus, decoded."""

from __future__ import annotations

import typer

from graderd.cli.epilog import example
from graderd.cli.passthrough import TAKES_ANYTHING, hand_over


def register(app: typer.Typer) -> None:
    """Add the command."""
    can = typer.Typer(help="Look at the CAN bus.", no_args_is_help=True)
    app.add_typer(can, name="can")

    @can.command(
        context_settings=TAKES_ANYTHING,
        epilog=example(
            "graderd can dump can0",
            "graderd can dump candump.log --json",
            "graderd can dump -- --help     (all its options)",
        ),
    )
    def dump(context: typer.Context) -> None:
        """Print the bus decoded, live or from a log file.

        Log files are candump, ASC, BLF or MF4. With --json one object a frame.
        """
        hand_over("drivers.electrak.dump", context.args)
