"""Arms, turns the blade by some degrees and disarms: ``python examples/jog_with_lease.py [SOCKET] [DEGREES]``.

The blade moves! Nobody may be near it, and a hand belongs on the emergency stop.
"""

import sys

from graderd.client import Client, ClientError

ARRIVED_DEG = 0.5


def main(socket: str | None = None, by_deg: float = 5.0) -> None:
    """One jog.

    Raises:
        ClientError: not armed, refused, or the lease ended on the way (a stop, a fault).
    """
    grader = Client(socket, name="example")
    grader.command("arm")
    grader.until(lambda status: status.mode == "manual", 10.0, "armed")
    start_deg = grader.status().axes["rotation"].measured or 0.0
    with grader.lease() as lease:  # the blade holds when the block ends, however it ends
        lease.jog("rotate", by_deg, relative=True)
        for status in lease.statuses():  # each step renews the lease; stop asking, and the blade holds 0.3 s later
            angle_deg = status.axes["rotation"].measured
            if angle_deg is not None and abs(angle_deg - start_deg - by_deg) < ARRIVED_DEG:
                sys.stdout.write(f"arrived at {angle_deg:+.1f} deg\n")
                break
    grader.command("disarm")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2], *(float(degrees) for degrees in sys.argv[2:3]))
    except ClientError as error:
        sys.exit(str(error))
