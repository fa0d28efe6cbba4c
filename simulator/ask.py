"""``graderd rig scene | drive | halt | turn | press | release | unplug | plug``: what a person does at a machine, done
at a simulated grader: lay soil, drive, turn the blade by hand, press the stop, pull a plug."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, Final

from graderd.hal.errors import DeviceError
from graderd.simulator.control_client import rig_request
from graderd.simulator.grader.piles import SceneZone

PLUGS: Final = {
    "servo": ("servo", "servo_fault"),
    "can": ("actuators", "actuator_fault"),
    "camera": ("camera", "camera_fault"),
}
"""By plug: the rig's part, and the command that takes its faults."""


HAND_DEG: Final = 0.4
HAND_S: Final = 0.02
"""As quickly as a person turns a blade: 20 degrees a second. One that leaps is a fault."""


def turn_by_hand(control: Path | str, angle_deg: float) -> None:
    """Turn the unpowered blade to an angle.

    Raises:
        DeviceError: the rig says no, or is not there.
    """
    here_deg = float(rig_request(control, "state")["blade_deg"])
    steps_n = max(1, round(abs(angle_deg - here_deg) / HAND_DEG))
    for step_n in range(1, steps_n + 1):
        rig_request(control, "turn_blade", angle_deg=here_deg + (angle_deg - here_deg) * step_n / steps_n)
        time.sleep(HAND_S)
    rig_request(control, "turn_blade", angle_deg=angle_deg)  # it rests there


def _request(given: dict[str, Any]) -> dict[str, Any]:
    """The rig's own command for what a person does; most are called the same."""
    match given["cmd"]:
        case "press" | "release":
            return {"command": "stop_loop", "state": "open" if given["cmd"] == "press" else "closed"}
        case "unplug":
            return {"command": PLUGS[given["what"]][1], "name": "unplug"}
        case "plug":
            return {"command": "clear_faults", "part": PLUGS[given["what"]][0]}
    return {"command": given.pop("cmd"), **given}


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
    turn = commands.add_parser("turn", help="turn the unpowered blade by hand")
    turn.add_argument("angle_deg", type=float)
    commands.add_parser("press", help="press the button in the stop loop")
    commands.add_parser("release", help="release it")
    for name, what in (("unplug", "pull a plug: an adapter's, or the camera's"), ("plug", "plug it in again")):
        commands.add_parser(name, help=what).add_argument("what", choices=list(PLUGS))
    given = vars(parser.parse_args(arguments))
    try:
        if given["cmd"] == "turn":
            turn_by_hand(given["control"], given["angle_deg"])
            return 0
        control, request = given.pop("control"), _request(given)
        answer = rig_request(control, request.pop("command"), **request)
    except DeviceError as error:
        sys.stderr.write(f"graderd: rig: {error}\n")
        return 1
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
