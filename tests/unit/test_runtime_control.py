"""The control loop over fake devices, tick by tick on a manual clock."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.faults.catalogue import find_rows
from graderd.core.machine import Mode
from graderd.core.soil import SoilObservation, Zone
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceRefusedError
from graderd.hal.fault import DeviceFault
from graderd.runtime.app.journal import fields_of
from graderd.runtime.control import ControlLoop, Queued
from graderd.runtime.control import log as control_log
from graderd.runtime.health import SleepWatch
from graderd.runtime.state_file import StateFile
from harness.fakes import FakeMachine

TICK_S = 0.02


class Bench:
    """A control loop on a fake machine, ticked by hand."""

    def __init__(self, directory: Path) -> None:
        self.machine = FakeMachine()
        self.state_file = StateFile(str(directory))
        self.loop = ControlLoop(Config(), self.machine.devices, self.machine.eyes, self.machine.clock, self.state_file)

    async def ticks(self, count_n: int = 1, zone: Zone | None = None, **shares: Any) -> None:
        """Tick ``count_n`` times; with ``zone``, a new observation of it every third tick."""
        for index in range(count_n):
            self.machine.clock.advance(TICK_S)
            if zone is not None and index % 3 == 0:
                now_s = self.machine.clock.now_s()
                self.machine.eyes.next = SoilObservation(now_s, zone, 0.9, "", **shares)
            self.loop.run_tick()
            for _ in range(4):
                await asyncio.sleep(0)  # the power sequencer's task goes on

    async def do(self, command: cmd.Command) -> cmd.Reply:
        """Send a command and tick until it is answered."""
        task = asyncio.create_task(self.loop.command(command))
        for _ in range(5):
            await asyncio.sleep(0)
            if task.done():
                break
            await self.ticks()
        return await task

    async def arm(self) -> None:
        assert (await self.do(cmd.Arm(client="t"))).accepted
        await self.ticks(4)
        assert self.loop.tick.state.mode is Mode.MANUAL


def queued(command: cmd.Command, bench: Bench) -> Queued:
    return Queued(command, bench.machine.clock.now_s(), asyncio.get_running_loop().create_future())


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    made = Bench(tmp_path)
    yield made
    await made.loop._power.close()


async def test_nothing_is_commanded_before_arming(bench: Bench) -> None:
    await bench.ticks(50, Zone.LEFT, share_left=1.0)
    assert bench.machine.log == []


async def test_arming_powers_everything_and_moves_nothing(bench: Bench) -> None:
    await bench.arm()
    assert sorted(bench.machine.log) == ["lift_left arm", "lift_right arm", "rotation arm", "tilt arm"]
    await bench.ticks(50)
    assert not any("goal" in line for line in bench.machine.log)


async def test_auto_turns_to_the_rules_angle_within_the_gates_lead(bench: Bench) -> None:
    await bench.arm()
    assert (await bench.do(cmd.Auto(client="t"))).accepted
    await bench.ticks(200, Zone.LEFT, share_left=0.9, share_center=0.1)
    assert bench.machine.rotation.position == pytest.approx(30.0)
    goals = [float(line.split()[-1]) for line in bench.machine.log if line.startswith("rotation goal")]
    assert goals[0] == pytest.approx(10.0, abs=0.5)  # rotation.lead_deg ahead of where it stands
    steps = [b - a for a, b in pairwise(goals)]
    assert max(steps) <= 25.0 * TICK_S + 1e-6  # no faster than the blade itself turns
    assert not any("lift" in line and "goal" in line for line in bench.machine.log)


async def test_unknown_holds(bench: Bench) -> None:
    await bench.arm()
    await bench.do(cmd.Auto(client="t"))
    await bench.ticks(100, Zone.UNKNOWN)
    assert not any("goal" in line for line in bench.machine.log)


async def test_stop_holds_every_axis_before_it_returns_and_latches(bench: Bench, tmp_path: Path) -> None:
    await bench.arm()
    await bench.do(cmd.Jog(axis="rotate", value=20.0, client="t"))
    await bench.ticks(5)
    bench.machine.log.clear()
    reply = bench.loop.stop_now(cmd.Stop(reason="test", client="t"))
    assert reply.accepted
    assert {line for line in bench.machine.log if "hold" in line} == {
        "rotation hold", "lift_left hold", "lift_right hold", "tilt hold"
    }  # fmt: skip
    assert bench.loop.tick.state.mode is Mode.STOPPED
    bench.machine.log.clear()
    await bench.ticks(20)
    assert not any("goal" in line for line in bench.machine.log)
    assert all(d.lifecycle is Lifecycle.STANDBY for d in bench.machine.devices.all().values())
    refused = await bench.do(cmd.Arm(client="t"))
    assert not refused.accepted
    assert bench.state_file.settle()
    last = StateFile(str(tmp_path)).load()
    assert last is not None
    assert last.reason == "test (by t)"


async def test_an_ordinary_restart_keeps_the_last_stop(bench: Bench, tmp_path: Path) -> None:
    bench.loop.stop_now(cmd.Stop(reason="dog on the site", client="cab"))
    assert (await bench.do(cmd.Reset(client="cab", stop_n=1))).accepted
    assert bench.loop.end("SIGTERM received") is False
    assert bench.loop.tick.state.mode is Mode.STOPPED
    assert bench.state_file.settle()
    last = StateFile(str(tmp_path)).load()
    assert last is not None
    assert last.reason == "dog on the site (by cab)"
    assert Bench(tmp_path).loop.last_stop == last


async def test_a_stop_while_the_daemon_ends_needs_its_reset_after_the_restart(bench: Bench, tmp_path: Path) -> None:
    assert bench.loop.end("SIGTERM received") is False  # not armed: the restart itself asks for no reset
    bench.loop.stop_now(cmd.Stop(reason="dog on the site", client="cab"))
    assert bench.state_file.settle()
    again = Bench(tmp_path)
    assert again.loop.tick.state.mode is Mode.STOPPED
    assert "dog on the site (by cab)" in again.loop.tick.state.reason


async def test_after_a_stop_and_a_restart_reset_comes_first(bench: Bench, tmp_path: Path) -> None:
    await bench.arm()
    bench.loop.stop_now(cmd.Stop(reason="dog on the site", client="cab"))
    bench.loop.end("SIGTERM received")
    assert bench.state_file.settle()
    again = Bench(tmp_path)
    await again.ticks(5)
    assert again.loop.tick.state.mode is Mode.STOPPED
    assert "dog on the site (by cab)" in again.loop.tick.state.reason
    refused = await again.do(cmd.Arm(client="t"))
    assert (refused.accepted, refused.remedy) == (False, "reset first, then arm")
    assert (await again.do(cmd.Reset(client="t", stop_n=again.loop.tick.state.stop_n))).accepted
    await again.arm()
    assert again.state_file.settle()
    # The reset is remembered too: neither this restart nor one after a clean end needs another.
    once_more = Bench(tmp_path)
    assert once_more.loop.tick.state.mode is Mode.DISARMED
    assert once_more.loop.end("SIGTERM received") is False
    assert once_more.state_file.settle()
    assert Bench(tmp_path).loop.tick.state.mode is Mode.DISARMED


async def test_a_restart_knows_every_reason_and_counts_on(bench: Bench, tmp_path: Path) -> None:
    for reason in ("dog on the site", "dog on the site", "child on the site"):
        bench.loop.stop_now(cmd.Stop(reason=reason))
    assert bench.state_file.settle()
    again = Bench(tmp_path)
    assert again.loop.tick.state.stop_n == 3
    assert "dog on the site; also: child on the site" in again.loop.tick.state.reason
    again.loop.stop_now(cmd.Stop(reason="man on the site"))
    again.loop.stop_now(cmd.Stop(reason="man on the site"))
    assert again.state_file.settle()
    third = Bench(tmp_path)
    assert third.loop.tick.state.reason.count("before the daemon was started") == 1
    assert (await again.do(cmd.Reset(stop_n=5))).accepted
    assert again.state_file.settle()
    # Who read the number of a stop of yesterday clears none of today's.
    today = Bench(tmp_path)
    today.loop.stop_now(cmd.Stop(reason="boar on the site"))
    assert not (await today.do(cmd.Reset(stop_n=1))).accepted
    assert (await today.do(cmd.Reset(stop_n=6))).accepted
    assert today.state_file.settle()


async def test_after_a_freeze_the_reason_is_the_freeze(bench: Bench) -> None:
    await bench.arm()
    bench.machine.clock.advance(1.5)
    bench.machine.rotation.lose()
    bench.loop.run_tick(late_s=1.5)
    assert bench.loop.tick.state.mode is Mode.DISARMED
    assert bench.loop.tick.state.reason.startswith("daemon.loop_blocked: ")
    assert {"daemon.loop_blocked", "rotation.no_reply"} <= {fault.name for fault in bench.loop.tick.faults}


@pytest.mark.parametrize("late_s", [0.0, 0.4])
async def test_after_a_late_tick_the_reason_names_it_beside_the_loss(bench: Bench, late_s: float) -> None:
    """Longer than a feedback may fail to come, and no standstill yet: the daemon was deaf, or the device is lost."""
    await bench.arm()
    bench.machine.clock.advance(late_s)
    bench.machine.rotation.lose()
    bench.loop.run_tick(late_s)
    assert bench.loop.tick.state.mode is Mode.DISARMED
    lost, _, late = bench.loop.tick.state.reason.partition("; also: ")
    assert lost.startswith("rotation.no_reply: ")
    assert late == ("daemon.tick_overrun: the control tick came late" if late_s else "")


async def test_a_lease_counts_from_when_the_command_was_heard(bench: Bench) -> None:
    await bench.arm()
    asked = asyncio.create_task(bench.loop.command(cmd.Jog(axis="rotate", value=20.0, client="a"), waited_s=0.1))
    await asyncio.sleep(0)
    await bench.ticks()
    assert (await asked).accepted
    state = bench.loop.tick.state
    assert state.lease is not None
    assert state.lease.expires_s == pytest.approx(bench.loop.tick.now_s - TICK_S - 0.1 + 0.3)
    assert list(bench.loop.sensed.waited_s) == pytest.approx([TICK_S + 0.1])


@pytest.mark.parametrize(
    ("command", "obeyed"),
    [
        (cmd.Jog(axis="rotate", value=20.0, client="a"), False),
        (cmd.Auto(client="a"), False),
        (cmd.Disarm(client="a"), True),
    ],
)
async def test_nothing_is_begun_for_who_has_gone_and_what_ends_something_counts(
    bench: Bench, command: cmd.Command, obeyed: bool
) -> None:
    """Its connection ended, or it was told that the tick did not answer, while the command waited for its tick."""
    await bench.arm()
    asked = asyncio.create_task(bench.loop.command(command))
    await asyncio.sleep(0)
    asked.cancel()
    with suppress(asyncio.CancelledError):
        await asked
    bench.machine.log.clear()
    await bench.ticks(3)
    state = bench.loop.tick.state
    assert (state.mode is Mode.DISARMED) is obeyed
    assert state.lease is None
    assert state.mode is not Mode.AUTO
    assert not any("goal" in line for line in bench.machine.log)


@pytest.mark.parametrize("at_work", ["jog", "auto", "arming"])
async def test_after_a_sleep_of_the_computer_nothing_goes_on(bench: Bench, at_work: str) -> None:
    """No time went by on the clock by which all goes: readings and leases from before it were taken for fresh."""
    slept_s = 100.0
    bench.loop.fault_sources.append(SleepWatch(lambda: slept_s).faults)
    if at_work == "arming":
        bench.loop._queue.append(queued(cmd.Arm(client="a"), bench))
        bench.loop.run_tick()
        assert bench.loop.tick.state.arming_since_s is not None
    else:
        await bench.arm()
        command = cmd.Jog(axis="rotate", value=20.0, client="a") if at_work == "jog" else cmd.Auto(client="a")
        bench.loop._queue.append(queued(command, bench))
        bench.loop.run_tick()
        assert bench.loop.tick.state.mode is (Mode.MANUAL if at_work == "jog" else Mode.AUTO)
    slept_s += 3600.0
    bench.machine.rotation.lose()
    renewal = queued(cmd.Renew(client="a"), bench)
    bench.loop._queue.append(renewal)
    bench.loop.run_tick()
    state = bench.loop.tick.state
    assert (state.mode, state.arming_since_s, state.lease) == (Mode.DISARMED, None, None)
    assert state.reason.startswith("daemon.suspended: ")
    assert bench.loop.tick.intents.goals.empty
    assert not (await renewal.reply).accepted
    (fault,) = (fault for fault in bench.loop.tick.faults if fault.name == "daemon.suspended")
    assert fault.detail == "it slept for 3600.0 s"
    bench.machine.rotation.restore()
    for _ in range(120):
        bench.machine.clock.advance(0.02)
        bench.loop.run_tick()
        assert bench.loop.tick.state.mode is Mode.DISARMED
    assert "daemon.suspended" not in {fault.name for fault in bench.loop.tick.faults}


async def test_the_wires_come_before_the_log_and_the_state_file(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    await bench.arm()
    order = bench.machine.log
    order.clear()
    monkeypatch.setattr(bench.state_file, "save", lambda reason, _: order.append(f"state file: {reason}"))
    monkeypatch.setattr(control_log, "info", lambda *_, **__: order.append("log"))
    bench.loop.stop_now(cmd.Stop(reason="test"))
    assert [line for line in order if "hold" not in line] == ["state file: test", "log"]
    assert order[-2:] == ["state file: test", "log"]


async def test_an_end_that_interrupts_work_is_the_last_stop(bench: Bench, tmp_path: Path) -> None:
    await bench.arm()
    assert bench.loop.end("SIGTERM received") is True
    assert bench.state_file.settle()
    last = StateFile(str(tmp_path)).load()
    assert last is not None
    assert last.reason == "SIGTERM received"


async def test_a_change_of_mode_says_who_and_why_in_fields(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="graderd"):
        bench.loop.stop_now(cmd.Stop(reason="forged\n2026 INFO stopped -> auto\x1b[2J", client="\x9bcab"))
    (record,) = [record for record in caplog.records if "stopped" in record.getMessage()]
    assert record.__dict__["mode"] == "stopped"
    assert record.__dict__["client"] == "\\x9bcab"
    assert record.getMessage() == "disarmed -> stopped: forged\\n2026 INFO stopped -> auto\\x1b[2J (by \\x9bcab)"


async def test_one_driver_that_fails_to_hold_does_not_keep_the_others_from_it(bench: Bench) -> None:
    await bench.arm()
    bench.machine.rotation.hold_raises = True
    bench.loop.stop_now(cmd.Stop())
    assert bench.machine.tilt.held_n > 0
    assert bench.machine.lift_left.held_n > 0


async def test_a_jog_stops_when_its_lease_is_not_renewed(bench: Bench) -> None:
    await bench.arm()
    await bench.do(cmd.Jog(axis="rotate", value=20.0, client="t"))
    await bench.ticks(30)
    assert 0.0 < bench.machine.rotation.position < 20.0
    reached = bench.machine.rotation.position
    assert bench.machine.rotation.held_n == 1
    await bench.ticks(30)
    assert bench.machine.rotation.position == reached


async def test_a_renewed_jog_arrives(bench: Bench) -> None:
    await bench.arm()
    await bench.do(cmd.Jog(axis="height", value=30.0, client="t"))
    for _ in range(20):
        await bench.do(cmd.Renew(client="t"))
        await bench.ticks(5)
    assert bench.machine.lift_left.position == pytest.approx(130.0)
    assert bench.machine.lift_right.position == pytest.approx(130.0)


async def test_a_jog_beyond_a_limit_is_refused_and_nothing_moves(bench: Bench) -> None:
    await bench.arm()
    reply = await bench.do(cmd.Jog(axis="rotate", value=61.0, client="t"))
    assert not reply.accepted
    assert "61.0 deg" in reply.message
    assert "-60 to 60" in reply.message
    await bench.ticks(10)
    assert not any("goal" in line for line in bench.machine.log)


async def test_a_stale_axis_holds_and_the_others_go_on(bench: Bench) -> None:
    await bench.arm()
    await bench.do(cmd.Preset(name="cast_left", client="t"))
    bench.machine.lift_left.silent_since_s = bench.machine.clock.now_s() - 1.0
    bench.machine.log.clear()
    await bench.ticks(5)
    assert any(line.startswith("rotation goal") for line in bench.machine.log)
    assert not any(line.startswith("lift") and "goal" in line for line in bench.machine.log)


async def test_arming_is_refused_with_the_list_of_what_is_unmet(bench: Bench) -> None:
    bench.machine.tilt.lifecycle = Lifecycle.FAILED
    bench.machine.clock.advance(1.0)
    bench.machine.rotation.position = 75.0  # turned by hand while nobody looked
    reply = await bench.do(cmd.Arm(client="t"))
    assert not reply.accepted
    assert "tilt: failed" in reply.message
    assert "rotation position: 75.0 deg is outside -60 to 60 deg" in reply.message
    assert bench.machine.log == []


async def test_a_device_that_refuses_arming_leaves_the_machine_disarmed_with_the_reason(bench: Bench) -> None:
    bench.machine.tilt.refuse_arm = DeviceRefusedError("tilt", "limits did not read back", "check the profile")
    await bench.do(cmd.Arm(client="t"))
    await bench.ticks(10)
    assert bench.loop.tick.state.mode is Mode.DISARMED
    assert "limits did not read back" in bench.loop.tick.state.reason
    assert all(d.lifecycle is Lifecycle.STANDBY for d in bench.machine.devices.all().values())


async def test_a_lost_device_disarms_and_needs_a_new_arm(bench: Bench) -> None:
    await bench.arm()
    bench.machine.rotation.lifecycle = Lifecycle.FAILED
    await bench.ticks(3)
    assert bench.loop.tick.state.mode is Mode.DISARMED
    bench.machine.rotation.lifecycle = Lifecycle.STANDBY
    await bench.ticks(50)
    assert bench.loop.tick.state.mode is Mode.DISARMED


async def test_a_driver_that_refuses_a_goal_makes_the_axis_hold_and_says_why(bench: Bench) -> None:
    await bench.arm()
    bench.machine.rotation.refuse_goal = DeviceRefusedError("rotation", "soft limit")
    await bench.do(cmd.Jog(axis="rotate", value=10.0, client="t"))
    await bench.ticks(2)
    assert bench.loop.tick.axes["rotation"].limited is None
    assert "soft limit" in bench.loop.tick.axes["rotation"].because


async def test_a_refused_goal_ends_the_former_one_in_the_same_tick(bench: Bench) -> None:
    await bench.arm()
    bench.machine.rotation.stuck = True  # on its way to the first goal
    await bench.do(cmd.Jog(axis="rotate", value=10.0, client="t"))
    assert bench.machine.rotation.goal is not None
    bench.machine.rotation.refuse_goal = DeviceRefusedError("rotation", "soft limit")
    await bench.ticks(1)
    assert bench.machine.rotation.goal is None


async def test_an_unknown_condition_of_a_driver_stops_the_machine(bench: Bench) -> None:
    await bench.arm()
    fault = DeviceFault("rotation", "something_new", "42", bench.machine.clock.now_s())
    bench.machine.rotation.present.append(fault)
    await bench.ticks(2)
    assert bench.loop.tick.state.mode is Mode.STOPPED
    refused = await bench.do(cmd.Reset(client="t", stop_n=1))
    assert not refused.accepted
    bench.machine.rotation.present.clear()
    await bench.ticks(1)
    assert (await bench.do(cmd.Reset(client="t", stop_n=1))).accepted
    assert bench.loop.tick.faults == ()


async def test_the_measured_angle_goes_to_perception_every_tick(bench: Bench) -> None:
    bench.machine.rotation.position = 12.5
    await bench.ticks(3)
    assert [angle for angle, _ in bench.machine.eyes.angles] == [12.5] * 3


async def test_commands_of_one_tick_get_their_own_replies_with_stop_first(bench: Bench) -> None:
    await bench.arm()
    jog = asyncio.create_task(bench.loop.command(cmd.Jog(axis="rotate", value=5.0, client="t")))
    auto = asyncio.create_task(bench.loop.command(cmd.Auto(client="u")))
    await asyncio.sleep(0)
    await bench.ticks()
    assert (await jog).command == "jog"
    assert (await jog).accepted
    assert not (await auto).accepted


async def test_a_stop_is_on_every_wire_before_anything_else_is_asked(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mistake in what decides must not stand between the button and the wires."""
    await bench.arm()
    bench.machine.log.clear()
    monkeypatch.setattr(bench.loop.controller, "step", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        bench.loop.stop_now(cmd.Stop(reason="person near"))
    assert bench.machine.log == ["rotation hold", "lift_left hold", "lift_right hold", "tilt hold"]


async def test_what_was_asked_before_a_stop_is_void(bench: Bench) -> None:
    """A reset or a jog that was under way when somebody pressed stop must not undo it."""
    await bench.arm()
    asked: list[cmd.Command] = [
        cmd.Jog(axis="rotate", value=5.0, client="t"),
        cmd.Reset(stop_n=1, client="t"),
        cmd.Arm(client="t"),
    ]
    tasks = [asyncio.create_task(bench.loop.command(command)) for command in asked]
    await asyncio.sleep(0)
    assert bench.loop.stop_now(cmd.Stop(reason="person near", client="u")).accepted
    await bench.ticks(2)
    replies = [await task for task in tasks]
    assert [(reply.accepted, reply.message) for reply in replies] == [(False, "a stop came first")] * 3
    assert bench.loop.tick.state.mode is Mode.STOPPED


async def test_a_device_that_is_active_while_it_should_not_be_is_disarmed(bench: Bench) -> None:
    await bench.ticks(2)
    bench.machine.tilt.lifecycle = Lifecycle.ACTIVE
    await bench.ticks(2)
    assert bench.machine.tilt.lifecycle is Lifecycle.STANDBY


async def test_a_flood_of_commands_is_worked_off_in_portions(bench: Bench) -> None:
    tasks = [asyncio.create_task(bench.loop.command(cmd.Renew(client=f"c{n}"))) for n in range(100)]
    await asyncio.sleep(0)
    await bench.ticks()
    assert sum(task.done() for task in tasks) == 32
    await bench.ticks(3)
    assert all(task.done() for task in tasks)


async def moving(bench: Bench, speeds: dict[str, float], until_mode: Mode, most_n: int = 100) -> dict[str, float]:
    """Push axes along until the mode is reached; how far each went."""
    axes = {name: bench.machine.devices.all()[name] for name in speeds}
    start = {name: axis.position for name, axis in axes.items()}  # type: ignore[union-attr]
    for _ in range(most_n):
        for name, axis in axes.items():
            axis.position += speeds[name] * TICK_S  # type: ignore[union-attr]
        await bench.ticks()
        if bench.loop.tick.state.mode is until_mode:
            return {name: abs(axis.position - start[name]) for name, axis in axes.items()}  # type: ignore[union-attr]
    raise AssertionError(f"still {bench.loop.tick.state.mode}: {bench.loop.tick.faults}")


@pytest.mark.parametrize("speed_deg_per_s", [0.4, 30.0])
async def test_a_blade_that_turns_uncommanded_stops_the_machine(bench: Bench, speed_deg_per_s: float) -> None:
    await bench.arm()
    await bench.ticks(100)
    went = await moving(bench, {"rotation": speed_deg_per_s}, Mode.STOPPED)
    assert went["rotation"] <= 0.5 + 2 * TICK_S * speed_deg_per_s
    assert bench.machine.rotation.held_n > 0
    assert "rotation.moving_uncommanded" in bench.loop.tick.state.reason


async def test_an_actuator_that_moves_uncommanded_is_disarmed_in_the_tick_that_reads_it(bench: Bench) -> None:
    await bench.arm()
    await bench.ticks(100)
    went = await moving(bench, {"tilt": -20.0}, Mode.DISARMED)
    assert went["tilt"] <= 2.0 + 20.0 * TICK_S
    assert bench.loop.tick.faults[0].name == "tilt.uncommanded_motion"
    await bench.ticks(2)
    assert bench.machine.tilt.lifecycle is Lifecycle.STANDBY
    await bench.ticks(60)
    (fault,) = bench.loop.tick.faults
    assert not fault.present, "over; the catalogue's latch keeps it until armed again"
    await bench.arm()
    assert bench.loop.tick.faults == ()


async def test_a_stuck_blade_holds_until_armed_again(bench: Bench) -> None:
    await bench.arm()
    bench.machine.rotation.stuck = True
    await bench.do(cmd.Auto(client="t"))
    await bench.ticks(150, Zone.LEFT, share_left=0.9, share_center=0.1)
    (fault,) = bench.loop.tick.faults
    assert fault.name == "rotation.not_moving"
    assert "no movement for 0.7" in fault.detail
    bench.machine.log.clear()
    bench.machine.rotation.stuck = False
    await bench.ticks(150, Zone.LEFT, share_left=0.9, share_center=0.1)
    assert not any("rotation goal" in line for line in bench.machine.log)


async def test_a_stuck_lift_is_disarmed(bench: Bench) -> None:
    await bench.arm()
    bench.machine.lift_left.stuck = bench.machine.lift_right.stuck = True
    await bench.do(cmd.Jog(axis="lift", value=150.0, relative=False, client="t"))
    for _ in range(12):
        await bench.ticks(4)
        await bench.do(cmd.Renew(client="t"))
    assert bench.loop.tick.state.mode is Mode.DISARMED
    assert "not_moving" in bench.loop.tick.state.reason


async def test_a_late_tick_is_told_for_a_second_and_a_long_one_beside_it(bench: Bench) -> None:
    for late_s in (0.7, 0.15):
        bench.loop.run_tick(late_s)
    await bench.ticks(2)
    assert {f.name for f in bench.loop.tick.faults} == {"daemon.loop_blocked", "daemon.tick_overrun"}
    await bench.ticks(50)
    assert bench.loop.tick.faults == ()


@pytest.mark.parametrize(
    ("in_tick_s", "after_s", "told"),
    [
        (0.7, 0.0, {"daemon.loop_blocked"}),
        (0.0, 0.7, {"daemon.loop_blocked"}),
        (0.15, 0.0, {"daemon.tick_overrun"}),
        (0.06, 0.0, set()),
    ],
)
async def test_a_pause_is_told_wherever_it_meets_the_loop(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, in_tick_s: float, after_s: float, told: set[str]
) -> None:
    """A process that is stopped in the middle of a tick is as late as one that is stopped between two."""
    clock, seen = bench.machine.clock, list[set[str]]()
    now_in_s, now_after_s = [in_tick_s], [after_s]

    async def sleep(seconds: float) -> None:
        clock.advance(seconds)
        if len(seen) == 4:
            raise asyncio.CancelledError
        clock.advance(now_after_s.pop() if now_after_s else 0.0)

    def on_tick() -> None:
        seen.append({fault.name for fault in bench.loop.tick.faults})
        clock.advance(now_in_s.pop() if now_in_s else 0.0)

    bench.loop.on_tick = on_tick
    monkeypatch.setattr("graderd.runtime.control.asyncio.sleep", sleep)
    with pytest.raises(asyncio.CancelledError):
        await bench.loop.run()
    assert seen[1:] == [told] * 3
    assert max(bench.loop.lateness_s) == pytest.approx(max(in_tick_s - TICK_S, after_s, 0.0))
    assert [late_s < TICK_S for late_s in bench.loop.lateness_s][2:] == [True] * 2, "a late tick is not made up for"


async def test_the_journal_has_mode_client_and_a_fault_that_explain_knows(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "graderd")
    await bench.arm()
    bench.machine.rotation.lose()
    await bench.ticks(100)
    told = [fields_of(record) for record in caplog.records if getattr(record, "event", False)]
    assert told[0] == {"mode": "manual", "client": "t"}
    (ended,) = [fields for fields in told if "fault" in fields]
    assert ended["mode"] == bench.loop.tick.state.mode
    assert ended["fault"].startswith("rotation.")
    assert find_rows(ended["fault"]) != ()
