"""Maneuvers of the daemon go through machine and gate like any operator's, and leave the machine disarmed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from graderd.api.port import ServiceError
from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.machine import Lease, Mode
from graderd.hal.device import DeviceService, Lifecycle, NoArguments
from graderd.hal.errors import DeviceLostError, DeviceRefusedError
from graderd.hal.fault import DeviceFault
from graderd.runtime.control import ControlLoop, Queued
from graderd.runtime.maneuver import Maneuver
from graderd.runtime.port import Port
from graderd.runtime.state_file import StateFile
from graderd.runtime.step_response import SHARES, analyse, step_samples
from harness.electrak_sim import SimulatedLoop, run_simulated
from harness.fakes import FakeMachine


def in_simulated_time(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test to its end without waiting."""

    @wraps(test)
    def run(**fixtures: Any) -> None:
        run_simulated(lambda _: test(**fixtures))

    return run


@asynccontextmanager
async def running(tmp_path: Path, config: Config | None = None) -> AsyncIterator[tuple[FakeMachine, ControlLoop]]:
    """A control loop ticking over fake devices, in the time of the event loop it runs on."""
    machine = FakeMachine()
    clock = asyncio.get_running_loop()
    assert isinstance(clock, SimulatedLoop)
    for device in (machine.rotation, machine.lift_left, machine.lift_right, machine.tilt):
        device.clock = clock
    loop = ControlLoop(config or Config(), machine.devices, machine.eyes, clock, StateFile(str(tmp_path)))
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


@in_simulated_time
async def test_it_arms_turns_and_disarms(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        seen: list[float] = []
        async with Maneuver(loop) as blade:
            await blade.rotate_to(5.0, 5.0, lambda: seen.append(machine.rotation.position))
        assert machine.rotation.position == pytest.approx(5.0)
        assert len(seen) > 10
        assert seen == sorted(seen)
        assert loop.tick.state.mode is Mode.DISARMED


@in_simulated_time
async def test_a_step_response_goes_half_way_from_both_sides_and_comes_back(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        recording = analyse(await step_samples(loop, machine.rotation, 6.0, 1.0), 0.5, {})
        assert [step.to_deg for step in recording.steps] == pytest.approx([6.0 * share for share in SHARES[1:]])
        assert all(step.settling_s is not None and abs(step.error_deg) < 0.2 for step in recording.steps)
        assert recording.backlash_from == "encoder"
        assert machine.rotation.position == pytest.approx(0.0, abs=0.1)
        assert loop.tick.state.mode is Mode.DISARMED


@pytest.mark.parametrize("sample", [22, 23])
@in_simulated_time
async def test_stop_ends_it_under_way(tmp_path: Path, sample: int) -> None:
    """At once, wherever between two renewals of its lease the stop comes: not when the next one is refused."""
    async with running(tmp_path) as (machine, loop):
        samples_n = after_n = 0

        def step_in() -> None:
            nonlocal samples_n, after_n
            samples_n += 1
            after_n += loop.tick.state.mode is Mode.STOPPED
            if samples_n == sample:
                assert machine.rotation.position > 2.0
                loop.stop_now(cmd.Stop(reason="person near the blade"))

        with pytest.raises(DeviceLostError, match="person near the blade"):
            async with Maneuver(loop) as blade:
                await blade.rotate_to(40.0, 30.0, step_in)
        assert loop.tick.state.mode is Mode.STOPPED
        assert after_n == 0


@pytest.mark.parametrize("when", ["under way", "between two turns", "while it arms"])
@pytest.mark.parametrize("how", ["stop", "disarm"])
@in_simulated_time
async def test_what_another_has_ended_and_armed_again_is_anothers(tmp_path: Path, when: str, how: str) -> None:
    """A calibration that waited for its picture turned the blade on after a stop, a reset and somebody's arm."""
    async with running(tmp_path) as (machine, loop):
        machine.rotation.arm_takes_s = 0.1
        stood_deg: list[float] = []

        async def arm_it_anew() -> None:
            if how == "stop":
                loop.stop_now(cmd.Stop(reason="person near the blade"))
                await loop.command(cmd.Reset(stop_n=1, client="cab"))
            else:
                await loop.command(cmd.Disarm(client="cab"))
            while not (await loop.command(cmd.Arm(client="cab"))).accepted:
                pass
            if when != "while it arms":
                await until(lambda: loop.tick.state.mode is Mode.MANUAL)
            stood_deg.append(machine.rotation.position)

        async def work() -> None:
            async with Maneuver(loop) as blade:
                if when == "under way":
                    turning = asyncio.create_task(blade.rotate_to(40.0, 30.0))
                    await until(lambda: machine.rotation.position > 2.0)
                    await arm_it_anew()
                    await turning
                await blade.rotate_to(4.0, 2.0)
                await arm_it_anew()
                await blade.rotate_to(40.0, 30.0)

        working = asyncio.create_task(work())
        if when == "while it arms":
            await until(lambda: loop.tick.state.arming_since_s is not None)
            await arm_it_anew()
        with pytest.raises((DeviceLostError, DeviceRefusedError)):
            await working
        # And it does not disarm what it did not arm.
        await until(lambda: loop.tick.state.mode is Mode.MANUAL)
        over_s = loop.tick.now_s + 3.0
        await until(lambda: loop.tick.now_s > over_s)
        assert loop.tick.state.mode is Mode.MANUAL
        assert machine.rotation.position == pytest.approx(stood_deg[0], abs=0.5)


@in_simulated_time
async def test_a_machine_that_another_arms_in_the_same_tick_is_anothers(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        theirs = asyncio.create_task(loop.command(cmd.Arm(client="cab")))
        await asyncio.sleep(0)
        with pytest.raises(DeviceLostError, match="cab has armed"):
            await turn(loop, 40.0)
        assert (await theirs).accepted
        await until(lambda: loop.tick.state.mode is Mode.MANUAL)
        assert machine.rotation.position == 0.0


@pytest.mark.parametrize("why", ["a fault", "no measurement"])
@in_simulated_time
async def test_what_was_held_under_way_does_not_go_on_by_itself(tmp_path: Path, why: str) -> None:
    async with running(tmp_path) as (machine, loop):
        held_s: list[float] = []

        def hold_for_a_moment() -> None:
            now_s = loop.tick.now_s
            if machine.rotation.position > 2.0 and not held_s:
                held_s.append(now_s)
                if why == "a fault":
                    machine.rotation.present.append(DeviceFault("daemon", "perception_nonsense", "", now_s))
                else:
                    machine.rotation.silent_since_s = now_s - 1.0
            elif held_s and now_s > held_s[0] + 0.08:
                machine.rotation.present.clear()
                machine.rotation.silent_since_s = None

        with pytest.raises(DeviceLostError, match="rotation was held"):
            async with Maneuver(loop) as blade:
                await blade.rotate_to(40.0, 30.0, hold_for_a_moment)
        assert held_s
        assert machine.rotation.position < 6.0
        assert loop.tick.state.mode is Mode.DISARMED


@in_simulated_time
async def test_a_renewal_that_came_too_late_is_no_reason_to_end(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        late: list[float] = []

        def stand_still_once() -> None:
            if machine.rotation.position > 2.0 and not late:
                late.append(loop.tick.now_s)
                loop.run_tick()
                loop.controller._state = replace(
                    loop.controller._state, lease=Lease("maneuver", loop.tick.now_s - 0.001)
                )

        async with Maneuver(loop) as blade:
            await blade.rotate_to(10.0, 5.0, stand_still_once)
        assert late
        assert machine.rotation.position == pytest.approx(10.0, abs=0.1)


@in_simulated_time
async def test_it_refuses_what_an_operator_would_be_refused(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        with pytest.raises(DeviceRefusedError, match=r"90\.0 deg"):
            await turn(loop, 90.0)
        assert loop.tick.state.mode is Mode.DISARMED
        machine.tilt.lifecycle = Lifecycle.FAILED
        with pytest.raises(DeviceRefusedError, match="tilt"):
            await turn(loop, 5.0)


@in_simulated_time
async def test_an_arming_that_fails_says_why(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        machine.rotation.refuse_arm = DeviceRefusedError("rotation", "limits did not read back")
        with pytest.raises(DeviceRefusedError, match="limits did not read back"):
            await turn(loop, 5.0)
        assert machine.rotation.position == 0.0


@pytest.mark.parametrize(("takes_s", "armed"), [(12.0, True), (29.0, True), (40.0, False)])
@in_simulated_time
async def test_it_waits_for_as_long_as_arming_may_take(tmp_path: Path, takes_s: float, armed: bool) -> None:
    """It gave up after 10 s, and the machine was armed two seconds later with nobody there."""
    config = Config.model_validate({"machine": {"arm_timeout_s": 30.0}})
    async with running(tmp_path, config) as (machine, loop):
        machine.rotation.arm_takes_s = takes_s
        if armed:
            await turn(loop, 5.0)
            assert machine.rotation.position == pytest.approx(5.0)
        else:
            with pytest.raises(DeviceRefusedError, match="longer than 30 s"):
                await turn(loop, 5.0)
        over_s = loop.tick.now_s + 40.0
        while loop.tick.now_s < over_s:
            assert loop.tick.state.mode is Mode.DISARMED
            assert loop.tick.state.arming_since_s is None
            await asyncio.sleep(0.1)
        assert machine.rotation.lifecycle is Lifecycle.STANDBY


@in_simulated_time
async def test_automatic_operation_that_somebody_asks_for_while_it_arms_is_not_what_was_armed_for(
    tmp_path: Path,
) -> None:
    async with running(tmp_path) as (_, loop):
        asked: list[asyncio.Future[cmd.Reply]] = []

        def ask_in_the_tick_that_armed() -> None:
            """Before the maneuver sees that it is armed."""
            if loop.tick.state.mode is Mode.MANUAL and not asked:
                asked.append(asyncio.get_running_loop().create_future())
                loop._queue.append(Queued(cmd.Auto(client="cab"), loop.tick.now_s, asked[0]))
                loop.run_tick()

        loop.on_tick = ask_in_the_tick_that_armed
        with pytest.raises(DeviceRefusedError, match="automatic operation"):
            await turn(loop, 5.0)
        assert (await asked[0]).accepted
        assert loop.tick.state.mode is Mode.DISARMED


def port_of(machine: FakeMachine, loop: ControlLoop) -> Port:
    """A port with one service, which turns to 40 degrees."""

    async def turn_far(_: NoArguments) -> dict[str, Any]:
        await turn(loop, 40.0)
        return {}

    services = {"rotation.turn": DeviceService(turn_far, moves=True), "rotation.other": DeviceService(turn_far)}
    return Port(Config(), loop, machine.devices, machine.eyes, services)  # type: ignore[arg-type]  # eyes: not looked at


async def until(reached: Callable[[], bool]) -> None:
    async with asyncio.timeout(10.0):
        while not reached():
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("begun", ["while it arms", "under way"])
@in_simulated_time
async def test_it_ends_with_the_client_that_asked(tmp_path: Path, begun: str) -> None:
    async with running(tmp_path) as (machine, loop):
        task = asyncio.create_task(port_of(machine, loop).service("rotation.turn", {"consent": True}))
        if begun == "under way":
            await until(lambda: machine.rotation.position > 2.0)
        else:
            await until(lambda: loop.tick.state.arming_since_s is not None)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        # It has said so to the machine before it ends: one tick.
        assert loop.tick.state.mode is Mode.DISARMED
        assert loop.tick.state.arming_since_s is None
        stood_deg, since_s = machine.rotation.position, loop.tick.now_s
        await until(lambda: loop.tick.now_s > since_s + 0.5)
        assert machine.rotation.position == pytest.approx(stood_deg, abs=0.2)
        assert loop.tick.state.mode is Mode.DISARMED


@in_simulated_time
async def test_one_at_a_time(tmp_path: Path) -> None:
    async with running(tmp_path) as (machine, loop):
        port = port_of(machine, loop)
        first = asyncio.create_task(port.service("rotation.turn", {"consent": True}))
        await asyncio.sleep(0)  # taken, and not armed yet: the machine's mode does not tell yet
        for name in ("rotation.turn", "rotation.other"):
            with pytest.raises(ServiceError, match=r"rotation\.turn is under way"):
                await port.service(name, {"consent": True})
        loop.stop_now(cmd.Stop(reason="enough"))
        with pytest.raises(ServiceError):
            await first
        assert machine.rotation.position < 5.0


@pytest.mark.parametrize("name", ["rotation.turn", "rotation.other"])
@in_simulated_time
async def test_a_machine_that_somebody_arms_is_not_his(tmp_path: Path, name: str) -> None:
    """What may unpower a device, or takes the machine for itself, comes neither between a person's arm and its end."""
    async with running(tmp_path) as (machine, loop):
        assert (await loop.command(cmd.Arm(client="cab"))).accepted
        assert loop.tick.state.arming_since_s is not None
        with pytest.raises(ServiceError, match="being armed"):
            await port_of(machine, loop).service(name, {"consent": True})
        await until(lambda: loop.tick.state.mode is Mode.MANUAL)


@pytest.mark.parametrize("consent", ["false", "no", [0], -1, 1, 1.0, None])
@in_simulated_time
async def test_consent_is_true(tmp_path: Path, consent: Any) -> None:
    async with running(tmp_path) as (machine, loop):
        with pytest.raises(ServiceError, match="may move"):
            await port_of(machine, loop).service("rotation.turn", {"consent": consent})
        assert loop.tick.state.reason == "started disarmed"
