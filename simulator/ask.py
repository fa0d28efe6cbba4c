"""``graderd rig scene | drive | halt``: tells the rig of a running daemon what to do."""

from __future__ import annotations

import argparse
import json
import sys

from graderd.hal.errors import DeviceError
from graderd.simulator.control_client import rig_request
from graderd.simulator.grader.piles import SceneZone


def main(arguments: list[str] | None = None) -> int:
    """One request. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="graderd rig", description=__doc__)
    parser.add_argument("control", help=argparse.SUPPRESS)
    commands = parser.add_subparsers(dest="cmd", required=True)
    scene = commands.add_parser("scene", help="empty the bed and lay soil before the blade where it stands")
    scene.add_argument("zone", choices=[str(zone) for zone in SceneZone])
    scene.add_argument("--seed", type=int, default=0, help="of the heap's form")
    drive = commands.add_parser("drive", help="drive so far; ends by itself")
    drive.add_argument("--distance-m", type=float, default=3.0)
    drive.add_argument("--speed-m-per-s", type=float, default=0.5, help="negative: back")
    commands.add_parser("halt", help="brake")
    given = vars(parser.parse_args(arguments))
    try:
        answer = rig_request(given.pop("control"), given.pop("cmd"), **given)
    except DeviceError as error:
        sys.stderr.write(f"graderd: rig: {error}\n")
        return 1
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
