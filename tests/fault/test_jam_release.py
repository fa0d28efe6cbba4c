"""A blade that jams in mid-turn and comes free: control loop, tick, driver and virtual servo, in real time."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import Devices
from graderd.runtime.state_file import StateFile
from harness.fakes import FakeActuator, FakeEyes, FakeLink
from tests.dynamixel_sim import bench, until

JAM_S = 0.65
"""When the servo's own set point would be furthest ahead, were it not led back. Every other time:
tests/unit/test_dynamixel_following.py."""
NOT_MOVING_S = 5.0
"""So that the turn is not ended as jammed meanwhile: then there would be nothing to see."""
LOOK_S = 0.002


@pytest.mark.whole_machine
@pytest.mark.xdist_group("a line")
async def test_a_jam_that_frees_does_not_leap(tmp_path: Path) -> None:
    config = Config.model_validate({"rotation": {"not_moving_s": NOT_MOVING_S}})
    speed = config.rotation.speed_deg_per_s
    turning = config.rotation.model_dump(include={"speed_deg_per_s", "acceleration_deg_per_s2", "not_moving_s"})
    async with bench(tmp_path, **turning) as rig:
        log: list[str] = []
        actuators = {
            name: FakeActuator(name, rig.clock, position, log)
            for name, position in (("lift_left", 100.0), ("lift_right", 100.0), ("tilt", 50.0))
        }
        devices = Devices(rotation=rig.rotator, link=FakeLink(), actuators=actuators)  # type: ignore[arg-type]
        loop = ControlLoop(config, devices, FakeEyes(), rig.clock, StateFile(""))
        tasks = [asyncio.create_task(loop.run(), name="control")]
        try:
            await until(lambda: loop.tick.axes and (loop.sensed.axes["rotation"].telemetry.position), "no angle")
            assert (await loop.command(cmd.Arm())).accepted
            await until(lambda: loop.tick.state.mode is Mode.MANUAL, "not armed")
            assert (await loop.command(cmd.Jog(axis="rotate", value=55.0))).accepted
            tasks.append(asyncio.create_task(renew(loop), name="renew"))
            await until(lambda: rig.servo.shaft_deg > 8.0, "it does not turn")
            rig.bus.inject("jam")
            jammed_s, leads_deg = rig.clock.now_s(), [0.0]
            while rig.clock.now_s() - jammed_s < JAM_S:
                leads_deg.append((loop.tick.axes["rotation"].limited or 0.0) - rig.servo.shaft_deg)
                await asyncio.sleep(LOOK_S)
            assert loop.tick.state.lease is not None, loop.tick.state.reason
            from_deg, freed_s, fastest = rig.servo.shaft_deg, rig.clock.now_s(), 0.0
            rig.bus.clear_faults()
            while rig.clock.now_s() - freed_s < 0.1:
                fastest = max(fastest, rig.servo.shaft_velocity_deg_per_s)
                await asyncio.sleep(LOOK_S)
            sprang_deg = rig.servo.shaft_deg - from_deg
            said = (
                f"sprang {sprang_deg:.1f}° at {fastest:.0f} °/s, led by {max(leads_deg):.1f}° at most, "
                f"{leads_deg[-1]:.1f}° at last"
            )
            assert leads_deg[-1] <= 0.2 * config.rotation.lead_deg + 0.2, said
            assert 0.0 < sprang_deg <= 0.2 * config.rotation.lead_deg + 1.2 * speed * 0.1, said
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def renew(loop: ControlLoop) -> None:
    """A client that holds the key down."""
    while True:
        await loop.command(cmd.Renew())
        await asyncio.sleep(0.1)
