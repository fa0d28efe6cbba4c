"""Maneuvers of the daemon go through machine and gate like any operator's, and leave the machine disarmed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.hal.errors import DeviceLostError, DeviceRefusedError
from graderd.hal.lifecycle import Lifecycle
from graderd.runtime.control import ControlLoop
from graderd.runtime.maneuver import Maneuver
from graderd.runtime.state_file import StateFile
from harness.awake_clock import AwakeClock
from tests.fakes import FakeMachine


@asynccontextmanager
async def running(tmp_path: Path) -> AsyncIterator[tuple[FakeMachine, ControlLoop]]:
    """A control loop ticking in real time over fake devices."""
    machine = FakeMachine()
    clock = AwakeClock()
    for device in (machine.rotation, machine.lift_left, machine.lift_right, machine.tilt):
        device.clock = clock  # type: ignore[assignment]  # the fakes only read it
    loop = ControlLoop(Config(), machine.devices, machine.eyes, clock, StateFile(str(tmp_path)))
    task = asyncio.create_task(loop.run(), name="control-tick")
    try:
        yield machine, loop
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def turn(loop: ControlLoop, angle_deg: float) -> None:
    """One maneuver to an angle."""
    async with Maneuver(loop) as blade:
        await blade.rotate_to(angle_deg, 30.0)


async def test_it_arms_turns_and_disarms(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        seen: list[float] = []
        async with Maneuver(loop) as blade:
            await blade.rotate_to(5.0, 5.0, lambda: seen.append(machine.rotation.position))
        assert machine.rotation.position == pytest.approx(5.0)
        assert len(seen) > 10
        assert seen == sorted(seen)
        assert loop.tick.state.mode is Mode.DISARMED


async def test_stop_ends_it_under_way(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):

        def step_in() -> None:
            if machine.rotation.position > 2.0:
                loop.stop_now(cmd.Stop(reason="person near the blade"))

        with pytest.raises(DeviceLostError, match="person near the blade"):
            async with Maneuver(loop) as blade:
                await blade.rotate_to(40.0, 30.0, step_in)
        assert loop.tick.state.mode is Mode.STOPPED


async def test_it_refuses_what_an_operator_would_be_refused(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        with pytest.raises(DeviceRefusedError, match=r"90\.0 deg"):
            await turn(loop, 90.0)
        assert loop.tick.state.mode is Mode.DISARMED
        machine.tilt.lifecycle = Lifecycle.FAILED
        with pytest.raises(DeviceRefusedError, match="tilt"):
            await turn(loop, 5.0)


async def test_an_arming_that_fails_says_why(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        machine.rotation.refuse_arm = DeviceRefusedError("rotation", "limits did not read back")
        with pytest.raises(DeviceRefusedError, match="limits did not read back"):
            await turn(loop, 5.0)
        assert machine.rotation.position == 0.0
