"""``graderd can dump``: the bus, decoded. ``graderd can database``: its messages, for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from graderd.cli.console import TAKES_ANYTHING, client_of, decode_through, example, hand_over
from graderd.client import Client, NoDaemonError

_MODULE = "graderd.drivers.electrak.dump"
_DATABASE_MODULE = "graderd.runtime.app.can_database"


def register(app: typer.Typer) -> None:
    """Add the command."""
    can = typer.Typer(help="Look at the CAN bus.", no_args_is_help=True)
    app.add_typer(can, name="can")

    @can.command(
        context_settings=TAKES_ANYTHING,
        epilog=example(
            "graderd can dump            (the running daemon's bus)",
            "graderd can dump can0",
            "graderd can dump candump.log --json",
            "graderd can dump -- --help     (all its options)",
        ),
    )
    def dump(context: typer.Context) -> None:
        """Print the bus decoded, live or from a log file.

        Without a source, or with the serial port that the running daemon has open, the frames come through the daemon.
        Log files are candump, ASC, BLF, MF4, TRC or CSV, also packed (.gz). With --json one object a frame; its kind
        is data, remote, error or fd.
        """
        arguments = [argument for argument in context.args if argument != "--"]
        sources = [argument for argument in arguments if not argument.startswith("-")]
        asks_for_help = bool({"-h", "--help"} & set(arguments))
        if not asks_for_help and is_the_daemons(client := client_of(context), sources):
            decode_through(client, "can", _MODULE, [argument for argument in arguments if argument not in sources])
        else:
            hand_over(_MODULE, arguments)

    @can.command(
        context_settings=TAKES_ANYTHING,
        epilog=example(
            "graderd can database > machine.dbc          (SavvyCAN, cantools, BUSMASTER)",
            "graderd can database --kcd > machine.kcd    (Kayak)",
            "graderd can database -- --help              (all its options)",
        ),
    )
    def database(context: typer.Context) -> None:
        """Print a DBC file with one message for each actuator as it is configured."""
        hand_over(_DATABASE_MODULE, [argument for argument in context.args if argument != "--"])


def is_the_daemons(client: Client, sources: list[str]) -> bool:
    """Whether the bus that is asked for is one that only the running daemon can read."""
    if sources and not Path(sources[0]).is_char_device():
        return False
    try:
        bus: dict[str, Any] = client.config()["can"]
    except NoDaemonError as error:
        if isinstance(error.__cause__, PermissionError):
            raise
        return False
    return not sources or (bus["interface"] == "slcan" and Path(bus["channel"]).resolve() == Path(sources[0]).resolve())
