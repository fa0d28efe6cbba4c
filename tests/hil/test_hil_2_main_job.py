"""The main job, end to end, commanded as a person would: soil in front of the camera turns the blade."""

from __future__ import annotations

import json

import pytest

from hil.bus import RawBus
from hil.service import Grader, Rig, faults, measured, new_pass, turn

AFTER_S = 30.0

pytestmark = pytest.mark.timeout(240)


def test_soil_turns_the_blade(ready: Grader, rig: Rig) -> None:
    ready.cli("arm")
    ready.cli("manual")
    for zone, angle_deg in (("left", 30.0), ("center", 15.0), ("right", -30.0), ("even", 45.0)):
        new_pass(ready, rig, zone, 3)
        ready.wait(
            f"soil {zone}: blade at {angle_deg:+g} deg",
            lambda s, goal=angle_deg: (  # type: ignore[misc]  # a lambda's default has no annotation
                abs(measured(s, "rotation") - goal) <= 0.5
                and s["axes"]["rotation"]["requested"] == goal
                and not s["axes"]["rotation"]["moving"]
            ),
            AFTER_S,
        )
        # What the daemon believes is what the machine does.
        assert rig.ask("state")["blade_deg"] == pytest.approx(angle_deg, abs=0.6)
    said = json.loads(ready.cli("status", "--json").stdout)
    assert said["mode"] == "auto"
    assert not faults(said)
    assert "disarmed" in ready.cli("disarm").stdout


def test_the_lifts_move_together_by_the_cli(ready: Grader, rig: Rig, listener: RawBus) -> None:
    ready.arm("manual")
    listener.drain()
    out = ready.cli("jog", "height", "30mm").stdout
    assert "arrived" in out
    state = ready.status()
    left, right = (state["axes"][name]["measured"] for name in ("lift_left", "lift_right"))
    assert left == pytest.approx(130.0, abs=2.5)
    assert abs(left - right) <= 3.0
    enabled = {f.can_id & 0xFFFF00 for f in listener.drain() if f.pgn == 0xEF00 and f.data[3] & 0x10}
    assert enabled == {0xEF1300, 0xEF1400}, "motion was enabled for the two lifts and nothing else"


def test_a_jog_is_refused_when_not_in_manual(ready: Grader) -> None:
    done = ready.cli("jog", "rotate", "+5deg", check=False)
    assert done.returncode == 1
    assert "manual" in done.stderr


def test_stop_on_the_command_line_latches(ready: Grader, rig: Rig) -> None:
    turn(ready, rig)
    ready.cli("stop", "--reason", "person near the blade")
    state = ready.wait("standing", lambda s: not s["axes"]["rotation"]["moving"], 3.0)
    assert state["mode"] == "stopped"
    assert ready.cli("arm", check=False).returncode == 1
    ready.cli("reset")
