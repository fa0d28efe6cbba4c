"""Ends motion at once, as a program of your own does it: ``python examples/stop.py [SOCKET]``."""

import sys

from graderd.client import Client, ClientError


def main(socket: str | None = None) -> None:
    """Stop, and say what came of it."""
    try:
        reply = Client(socket, name="example").stop("example")
    except ClientError as error:
        sys.exit(f"NOT STOPPED, use the emergency stop: {error}")
    sys.stdout.write(f"{reply.message}\n")


if __name__ == "__main__":
    main(*sys.argv[1:2])
