"""``graderd can dump``: the bus, decoded."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import typer

from graderd.cli.console import TAKES_ANYTHING, client_of, example, hand_over
from graderd.client import Client, NoDaemonError
from graderd.hal.text import printable

_MODULE = "graderd.drivers.electrak.dump"


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
            through(client, [argument for argument in arguments if argument not in sources])
        else:
            hand_over(_MODULE, arguments)


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


def through(client: Client, options: list[str]) -> None:
    """Decode what the daemon hears and sends, until the daemon, the decoder's reader or the user ends it."""
    command = [sys.executable, "-P", "-m", _MODULE, "-", *options]
    with (
        client.bus_text() as texts,
        subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0) as decoder,
    ):
        assert decoder.stdin is not None
        try:
            for text in texts:
                if decoder.poll() is not None:
                    return
                if text.startswith("#"):
                    typer.echo(printable(text.partition("\n")[0]), err=True)
                decoder.stdin.write(text.encode())
        except (BrokenPipeError, KeyboardInterrupt):
            return  # nobody reads on: that is how a live view ends
        finally:
            decoder.terminate()
