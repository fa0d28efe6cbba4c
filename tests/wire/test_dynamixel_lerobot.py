"""lerobot's Dynamixel bus with the PH54 added, on the virtual servo.

Collected where ``make peers`` made its environment: lerobot wants Python 3.12 and packages that this one cannot hold.
"""

from __future__ import annotations

import json
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest

from graderd import firmware_profiles
from harness.peers import lerobot_ph54
from tests.dynamixel_sim import servo_process

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / "var" / "peers" / "lerobot" / "bin" / "python"
PROFILE = str(files(firmware_profiles) / "ph54_200_s500.toml")

if PYTHON.exists():

    def test_lerobot_finds_the_servo_turns_it_and_reads_signed_registers(tmp_path: Path) -> None:
        with servo_process(tmp_path / "servo", "--baud", "1000000") as servo:
            told = subprocess.run(
                [PYTHON, lerobot_ph54.__file__, str(tmp_path / "servo"), PROFILE],
                capture_output=True, text=True, timeout=60,
            )  # fmt: skip
            assert told.returncode == 0, told.stderr
            state = servo.tell("status")["servos"][0]
        found = json.loads(told.stdout.splitlines()[-1])
        assert found["ping"] == {"1": 2020}
        assert (found["return_delay"], found["mode"]) == (0, "POSITION")
        assert found["range"] == [-501_433, 501_433]
        assert found["position"] == pytest.approx(-27_885, abs=50)
        # lerobot counts degrees from the middle of the range of motion over resolution minus one.
        assert found["degrees"] == pytest.approx(-10.0, abs=0.1)
        assert state["shaft_deg"] == pytest.approx(-10.0, abs=0.2)
        assert not state["torque_on"]
