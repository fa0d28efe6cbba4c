"""What a wire of the running daemon carries, decoded: for ``graderd can dump`` and ``graderd rotation dump``."""

from __future__ import annotations

import subprocess
import sys

import typer

from graderd.client import Client
from graderd.hal.text import printable


def decode_through(client: Client, bus: str, module: str, options: list[str]) -> None:
    """Pipe what the daemon hears and sends on ``bus`` to ``module`` as standard input, until the daemon, the decoder's
    reader or the user ends it."""
    command = [sys.executable, "-P", "-m", module, "-", *options]
    with (
        client.bus_text(bus) as texts,
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
