"""The guard, the last of the dead men: what it does to both wires when nobody else does anything any more.

``graderd guard`` runs as the service runs it after the daemon ended. First alone, against devices that nobody stops:
no watchdog in the servo, far targets in the actuators. Then after a daemon that was killed in the middle of a lift.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from graderd.config import load
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.electrak.codec import Control, ElectrakCodec
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.hal.settings import Ph54Settings
from graderd.runtime.app.last_run import remember
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from graderd.simulator.servo import VirtualServo, VirtualServoBus
from harness.campaign.conduct import EVERYTHING, come_to
from harness.campaign.model import Phase
from harness.campaign.stack import Stack

ADDRESSES = {"lift_left": 19, "lift_right": 20, "tilt": 27}
FAR = {"lift_left": 290.0, "lift_right": 290.0, "tilt": 95.0}
STILL_S = 0.5
"""From the guard's word on a wire to standstill there: a blade without torque runs out, an actuator brakes."""
ENDS_S = 15.0
"""The guard's process on an idle machine needs a second, most of it to start; here it shares what there is."""
SLOW_PERCENT = 20.0
"""No axis is at its end before 17 s: what ends its motion before that is the guard."""
GUARD_TOML = """\
[rotation]
port = "{servo}"
torque_at_exit = "{at_exit}"
[can]
interface = "slcan"
channel = "{can}"
"""


def configure(directory: Path, at_exit: str = "off", *, lost: bool = False) -> None:
    """Write the guard's configuration for the wires in ``directory``. ``lost``: and spoil it after a daemon's start."""
    path = directory / "guard.toml"
    text = GUARD_TOML.format(servo=directory / "servo", can=directory / "can", at_exit=at_exit)
    path.write_text(text, encoding="utf-8")
    if lost:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("STATE_DIRECTORY", str(directory))
            remember(load(path), path)
        path.write_text("[rotation\n", encoding="utf-8")


async def run_guard(directory: Path, *mistakes: str) -> tuple[int, float]:
    """The guard as the service calls it; its status and how long it took."""
    began_s = time.monotonic()
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "guard", "--config", str(directory / "guard.toml"), *mistakes),
        env=os.environ | {"STATE_DIRECTORY": str(directory)},
    )
    return await process.wait(), time.monotonic() - began_s


def tell(took_s: float, times_s: dict[str, float]) -> None:
    """What was measured, for ``pytest -rP``."""
    figures = ", ".join(f"{name} {time_s:.2f} s" for name, time_s in times_s.items())
    sys.stdout.write(f"the guard took {took_s:.2f} s; {figures}\n")


@pytest.mark.parametrize(("at_exit", "lost"), [("off", False), ("on", False), ("on", True)])
@pytest.mark.timeout(60)
async def test_the_guard_alone_ends_motion_on_both_wires(tmp_path: Path, at_exit: str, lost: bool) -> None:
    servo = VirtualServo()
    units = {
        name: VirtualElectrak("electrak_md_a050" if name == "tilt" else "electrak_hd_b017", address, 5.0)
        for name, address in ADDRESSES.items()
    }
    for unit in units.values():
        unit.behaviour.only_own_control_keeps_awake = False  # they keep each other awake: none falls asleep and rests
    servo_wire = VirtualServoBus([servo], tmp_path / "servo")
    can_wire = VirtualActuatorBus(tuple(units.values()), link=tmp_path / "can")
    await servo_wire.start()
    await can_wire.start()
    ended: dict[str, float] = {}

    async def watch() -> None:
        """Note when each axis was last told to stop and when it stood."""
        while True:
            now_s = time.monotonic()
            moving = {name: abs(unit.velocity_mm_per_s) > 1.0 for name, unit in units.items()}
            moving["rotation"] = abs(servo.shaft_velocity_deg_per_s) > 0.5
            told = {name: unit.motion_enabled for name, unit in units.items()}
            ended.update({f"{name} still": now_s for name, moves in moving.items() if moves})
            ended.update({f"{name} told": now_s for name, enabled in told.items() if enabled})
            await asyncio.sleep(0.005)

    watching = asyncio.create_task(watch(), name="watch")
    configure(tmp_path, at_exit, lost=lost)
    try:
        await _set_off(servo, units, can_wire)
        await asyncio.sleep(0.5)
        assert abs(servo.shaft_velocity_deg_per_s) > 1.0
        assert all(abs(unit.velocity_mm_per_s) > 1.0 for unit in units.values())
        from_s = time.monotonic()
        status, took_s = await run_guard(tmp_path, *(["--no-such-option"] if lost else []))
        await asyncio.sleep(STILL_S)
        stopped = {name: unit.position_mm for name, unit in units.items()} | {"rotation": servo.shaft_deg}
        await asyncio.sleep(0.5)
        for name, unit in units.items():
            assert not unit.motion_enabled
            assert unit.position_mm == pytest.approx(stopped[name], abs=0.05)
            assert unit.position_mm < FAR[name] - 5.0, "it must be the guard that ended the motion"
            assert ended[f"{name} still"] - ended[f"{name} told"] < STILL_S
        assert servo.torque_enabled is (at_exit == "on")
        assert servo.shaft_deg == pytest.approx(stopped["rotation"], abs=0.3)
        assert servo.shaft_deg < 170.0
        assert ended["rotation still"] < from_s + took_s + STILL_S
        assert status == 0
        assert took_s < ENDS_S
        tell(took_s, {axis: ended[f"{axis} still"] - from_s for axis in (*units, "rotation")})
    finally:
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        await can_wire.close()
        await servo_wire.close()


async def _set_off(servo: VirtualServo, units: dict[str, VirtualElectrak], can_wire: VirtualActuatorBus) -> None:
    """Every axis on a long way, and nothing that would end it: no watchdog, no message after this one."""
    for enable in (False, False, True):  # the first message wakes the unit, the second shows it the edge to the third
        for name, unit in units.items():
            _send(can_wire, name, unit.address, enable=enable)
        await asyncio.sleep(0.3)
    table, calibration = servo.table, Calibration.of(Ph54Settings(), servo.table)
    servo.write(table["torque_enable"].address, b"\x01")
    servo.write(table["profile_velocity"].address, round(10.0 / 0.06).to_bytes(4, "little"))
    servo.write(table["profile_acceleration"].address, round(60.0 / 0.1).to_bytes(4, "little"))
    servo.write(table["goal_position"].address, calibration.counts(175.0).to_bytes(4, "little", signed=True))
    assert servo.memory["bus_watchdog"] == 0


def _send(can_wire: VirtualActuatorBus, name: str, address: int, *, enable: bool) -> None:
    codec = ElectrakCodec("electrak_md" if name == "tilt" else "electrak_hd")
    data = codec.encode_control(Control(FAR[name], 5.0, SLOW_PERCENT, motion_enable=enable))
    can_wire.send(Frame(make_id(3, Pgn.PROPRIETARY_A, 0xE7, address), data))


@pytest.mark.whole_machine
@pytest.mark.timeout(180)
async def test_the_guard_after_a_daemon_that_was_killed_in_mid_lift(tmp_path: Path) -> None:
    configure(tmp_path)
    async with Stack(tmp_path) as stack:
        await come_to(stack, Phase.LIFTING)
        from_s = time.monotonic()
        stack.daemon.send_signal(signal.SIGKILL)
        await stack.daemon.wait()
        status, took_s = await run_guard(tmp_path)
        assert status == 0
        assert took_s < ENDS_S
        assert await stack.watch.until_still(EVERYTHING, 0.3, 3.0)
        state = stack.watch.newest().state
        assert not state["servo_torque_enabled"]
        for name in ADDRESSES:
            assert not state[f"{name}_enabled"]
            assert state[f"{name}_disabled_s"] > state[f"{name}_enabled_s"]
        disabled = {f"{name} disabled": state[f"{name}_disabled_s"] - from_s for name in ADDRESSES}
        tell(took_s, {"standstill": stack.watch.standstill_s(EVERYTHING, from_s)} | disabled)
