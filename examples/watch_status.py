"""Prints mode, soil and blade angle as they change: ``python examples/watch_status.py [SOCKET] [N]``."""

import sys

from graderd.client import Client


def main(socket: str | None = None, statuses_n: int = 0) -> None:
    """Print so many statuses, 0: until Ctrl-C."""
    with Client(socket).statuses(rate_hz=5.0) as statuses:
        for number, status in enumerate(statuses, 1):
            angle_deg = status.axes["rotation"].measured
            shown = "unknown" if angle_deg is None else f"{angle_deg:+.1f} deg"
            sys.stdout.write(f"{status.mode} ({status.reason}), soil {status.soil.zone}, blade {shown}\n")
            if number == statuses_n:
                return


if __name__ == "__main__":
    main(*sys.argv[1:2], *(int(n) for n in sys.argv[2:3]))
