"""lerobot's Dynamixel bus on a PH54, unmodified but for the model: ``lerobot_ph54.py PORT PROFILE``. One JSON line.

Runs in lerobot's own environment (Python 3.12), where nothing of graderd is installed: the model's tables come from the
firmware profile, a TOML file. lerobot imports torch at its door, and its motors use nothing of it; a placeholder stands
there, instead of a gigabyte.
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
import types
from pathlib import Path
from typing import Any

MODEL = "ph54-200-s500"
DEADLINE_S = 10.0


def main(port: str, profile_path: str) -> None:
    """What lerobot reads and does, and what it found."""
    torch = types.ModuleType("torch")
    torch.device = torch.Tensor = torch.dtype = object  # type: ignore[attr-defined]
    sys.modules["torch"] = torch
    from lerobot.motors.dynamixel import DynamixelMotorsBus
    from lerobot.motors.dynamixel.dynamixel import OperatingMode
    from lerobot.motors.motors_bus import Motor, MotorNormMode

    profile = tomllib.loads(Path(profile_path).read_text(encoding="utf-8"))
    rows = [row for row in profile["table"]["register"] if "count" not in row]
    name = {row["name"]: row["label"].replace(" ", "_") for row in rows}

    tables = {  # lerobot has the X series alone; a table more is all that another model takes
        "model_ctrl_table": {MODEL: {name[row["name"]]: (row["address"], row["size"]) for row in rows}},
        "model_baudrate_table": {MODEL: {baud_n: code for code, baud_n in enumerate(profile["bus"]["baud_n"])}},
        "model_encoding_table": {MODEL: {name[row["name"]]: row["size"] for row in rows if row.get("signed")}},
        "model_number_table": {MODEL: profile["model_number"]},
        "model_resolution_table": {MODEL: profile["motion"]["pulses_per_turn"]},
    }
    bus = type("Ph54Bus", (DynamixelMotorsBus,), tables)(port, {"blade": Motor(1, MODEL, MotorNormMode.DEGREES)})
    bus.connect(handshake=False)  # the SDK under it gives up after some milliseconds; here it is asked again
    found: dict[str, Any] = {"ping": bus.broadcast_ping(num_retry=20)}
    bus.write("Return_Delay_Time", "blade", 0, num_retry=5, normalize=False)  # as its configure_motors does
    found["return_delay"] = bus.read("Return_Delay_Time", "blade", num_retry=5, normalize=False)
    found["mode"] = OperatingMode(bus.read("Operating_Mode", "blade", num_retry=5, normalize=False)).name
    bus.calibration = bus.read_calibration()
    found["range"] = [bus.calibration["blade"].range_min, bus.calibration["blade"].range_max]
    bus.write("Profile_Velocity", "blade", 500, num_retry=5, normalize=False)
    bus.write("Profile_Acceleration", "blade", 5000, num_retry=5, normalize=False)
    bus.enable_torque(num_retry=5)
    goal = -27_885  # -10 degrees
    bus.sync_write("Goal_Position", {"blade": goal}, num_retry=5, normalize=False)
    until_s = time.monotonic() + DEADLINE_S
    at = 0
    while time.monotonic() < until_s:
        at = bus.sync_read("Present_Position", num_retry=5, normalize=False)["blade"]
        if abs(at - goal) < 50:
            break
    found["position"] = at
    found["degrees"] = bus.sync_read("Present_Position", num_retry=5)["blade"]
    found["current_ma"] = bus.read("Present_Current", "blade", num_retry=5, normalize=False)
    bus.disconnect()  # torque off
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:3])
