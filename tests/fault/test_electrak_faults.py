"""Every fault of an actuator: named, in time, ending in no motion, and recoverable. In simulated time."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
from dataclasses import dataclass, field

import pytest

from graderd.drivers.electrak import ElectrakActuator
from graderd.drivers.electrak.profile import load_profile
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceRefusedError, DeviceTimeoutError
from graderd.hal.settings import CanSettings
from graderd.simulator.actuators import VirtualElectrak
from harness.electrak_sim import Machine, SimulatedLoop, run_simulated

LEFT = ("lift_left",)


def conditions(axis: ElectrakActuator) -> set[str]:
    return {fault.condition for fault in axis.faults()}


def state(axis: ElectrakActuator) -> Lifecycle:
    return axis.lifecycle


async def keep_asking(axis: ElectrakActuator, target_mm: float, seconds: float) -> None:
    """Renew a target as the control tick does, also while the axis refuses."""
    for _ in range(round(seconds * 50)):
        if axis.lifecycle is Lifecycle.ACTIVE:
            axis.set_target_mm(target_mm)
        await asyncio.sleep(0.02)


async def time_until(machine: Machine, condition: str, target_mm: float | None) -> float:
    """Seconds until the condition of the left lift is reported; fails after five."""
    axis, loop = machine.axes["lift_left"], machine.clock
    start_s = loop.now_s()
    while loop.now_s() - start_s < 5.0:
        if condition in machine.conditions("lift_left"):
            return loop.now_s() - start_s
        await keep_asking(axis, target_mm, 0.02) if target_mm is not None else await asyncio.sleep(0.02)
    raise AssertionError(f"{condition} was not reported; present: {machine.conditions('lift_left')}")


@dataclass(frozen=True)
class Case:
    """``within_s``: the longest time to detection. ``ends``: lifecycle afterwards. ``moving``: injected in mid-move."""

    fault: str
    condition: str
    within_s: float
    ends: Lifecycle
    moving: bool = True
    params: dict[str, float] = field(default_factory=dict)


CASES = [
    Case("silence", "no_feedback", 0.5, Lifecycle.FAILED),
    Case("power_cut", "no_feedback", 0.5, Lifecycle.FAILED),
    Case("wrong_address", "wrong_address", 0.5, Lifecycle.FAILED, params={"to_address": 33}),
    Case("garbage", "implausible_feedback", 0.6, Lifecycle.FAILED),
    Case("babble", "feedback_flood", 0.3, Lifecycle.FAILED),
    Case("stuck", "not_moving", 1.2, Lifecycle.STANDBY, params={"quiet": 1.0}),
    Case("stuck", "overload", 0.5, Lifecycle.STANDBY),
    Case("frozen_feedback", "not_moving", 1.2, Lifecycle.STANDBY),
    Case("overload", "overload", 0.4, Lifecycle.STANDBY),
    Case("fatal", "fatal", 0.3, Lifecycle.STANDBY),
    Case("manual_override", "uncommanded_motion", 0.8, Lifecycle.STANDBY, moving=False),
    Case("drift", "uncommanded_motion", 1.3, Lifecycle.STANDBY, moving=False),
    Case("manual_override", "uncommanded_motion", 0.8, Lifecycle.STANDBY, params={"direction": -1.0}),
    Case("restart", "restarted", 0.3, Lifecycle.STANDBY),
    Case("voltage_low", "voltage", 0.3, Lifecycle.ACTIVE),
    Case("voltage_high", "voltage", 0.3, Lifecycle.ACTIVE),
    Case("temperature_high", "temperature", 0.3, Lifecycle.ACTIVE),
    Case("temperature_low", "temperature", 0.3, Lifecycle.ACTIVE),
    Case("backdrive", "backdrive", 0.3, Lifecycle.ACTIVE),
    Case("saturation", "saturation", 0.3, Lifecycle.ACTIVE),
    Case("parameter", "parameter", 0.3, Lifecycle.ACTIVE),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c.fault}-{'moving' if c.moving else 'resting'}-{c.condition}")
def test_fault_is_named_in_time_ends_motion_and_goes_away(case: Case) -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT, watched=True) as machine:
            axis, unit = machine.axes["lift_left"], machine.units["lift_left"]
            await axis.arm()
            target_mm = 280.0 if case.moving else None
            await machine.drive({"lift_left": 280.0 if case.moving else 100.0}, 1.0)
            params = dict(case.params)
            if params.pop("quiet", 0):
                unit.behaviour.speed_factor = 0.0  # a broken screw: the motor turns freely, nothing moves
            else:
                machine.bus.inject(case.fault, address=None, **params)
            took_s = await time_until(machine, case.condition, target_mm)
            assert took_s <= case.within_s
            assert state(axis) is case.ends
            if case.ends is not Lifecycle.ACTIVE:
                await asyncio.sleep(0.5)
                if case.fault != "wrong_address":  # it hears nothing more, and ends its short look-ahead move
                    assert not unit.awake or not unit.received_control[-1].motion_enable
                if not unit.manual_override and not unit.faults.drift_mm_per_s:
                    assert unit.velocity_mm_per_s == 0.0, "standstill"
            machine.bus.clear_faults()
            await asyncio.sleep(2.5)
            if state(axis) is Lifecycle.STANDBY:
                await axis.arm()
            assert machine.conditions("lift_left") == set()
            assert state(axis) is Lifecycle.ACTIVE
            await machine.drive({"lift_left": 150.0}, 8.0)
            assert unit.position_mm == pytest.approx(150.0, abs=1.2)

    run_simulated(main)


def test_a_dead_controller_leaves_a_bounded_move() -> None:
    """The daemon dies in mid-move, without a word: at most speed x 0.3 s + dead zone are travelled afterwards."""

    async def travel_mm(loop: SimulatedLoop, profile: str, speed_percent: int, wait_s: float, aim_mm: float) -> float:
        axis_name = "tilt" if "md" in profile else "lift_left"
        async with Machine(loop, names=(axis_name,), speed_percent=speed_percent) as machine:
            unit = machine.units[axis_name]
            await machine.axes[axis_name].arm()
            await machine.drive({axis_name: aim_mm}, wait_s)
            for task in machine.link._tasks:
                task.cancel()
            machine.bus.connect()  # nobody reads or sends any more
            at_mm = unit.position_mm
            await asyncio.sleep(4.9)
            return abs(unit.position_mm - at_mm)

    for profile, aim_mm in (("electrak_hd_b017", 290.0), ("electrak_hd_b017", 6.0), ("electrak_md_a050", 94.0)):
        figures = load_profile(profile).figures
        for speed_percent in (100, 80, 25):
            allowed_mm = figures.speed_mm_per_s(speed_percent) * 0.3 + figures.dead_zone_mm
            for wait_s in (0.1, 0.32, 0.7, 1.03, 1.37):
                case = functools.partial(
                    travel_mm, profile=profile, speed_percent=speed_percent, wait_s=wait_s, aim_mm=aim_mm
                )
                assert run_simulated(case) <= allowed_mm, f"{profile} at {speed_percent} %, died after {wait_s} s"


def test_the_mean_resting_error_is_half_a_millimetre_at_most() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, seed=11) as machine:
            for axis in machine.axes.values():
                await axis.arm()
            errors_mm = []
            for lift_mm, tilt_mm in (
                (150, 70),
                (90, 20),
                (91.5, 60),
                (240, 58.5),
                (230, 90),
                (10, 6),
                (290, 94),
                (120, 40),
            ):
                targets = {"lift_left": float(lift_mm), "lift_right": float(lift_mm), "tilt": float(tilt_mm)}
                await machine.drive(targets, 8.0)
                errors_mm += [abs(machine.units[name].position_mm - target) for name, target in targets.items()]
            assert sum(errors_mm) / len(errors_mm) <= 0.5
            assert max(errors_mm) <= 1.3

    run_simulated(main)


def test_the_bias_is_learned_where_a_unit_rests_shorter_than_the_profile_says() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            unit = machine.units["lift_left"]
            await machine.axes["lift_left"].arm()
            short = dataclasses.replace(unit.figures, dead_zone_mm=1.5)
            unit.figures = short
            errors_mm = []
            for index in range(16):
                target_mm = 100.0 if index % 2 else 160.0
                await machine.drive({"lift_left": target_mm}, 6.0)
                errors_mm.append(abs(unit.position_mm - target_mm))
            assert sum(errors_mm[-4:]) / 4 < 0.35

    run_simulated(main)


def test_an_overload_is_retried_as_often_as_configured_and_then_ends_active() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT, overload_retries_n=2, current_limit_a=10.0) as machine:
            axis, unit = machine.axes["lift_left"], machine.units["lift_left"]
            await axis.arm()
            await machine.drive({"lift_left": 280.0}, 0.5)
            unit.load_n = 1600.0
            await keep_asking(axis, 280.0, 1.0)
            assert state(axis) is Lifecycle.ACTIVE
            unit.load_n = 0.0  # the stone gives way: the retry succeeds
            await keep_asking(axis, 280.0, 2.0)
            assert axis.telemetry().counters["overloads_n"] == 1
            assert state(axis) is Lifecycle.ACTIVE
            unit.load_n = 1600.0
            await time_until(machine, "overload", 280.0)
            assert axis.telemetry().counters["overloads_n"] == 3
            assert state(axis) is Lifecycle.STANDBY
            (fault,) = axis.faults()
            assert fault.name == "lift_left.overload"
            assert "2 retries used up" in fault.detail
            await asyncio.sleep(3.0)
            assert axis.faults() == (), "the driver says what is; that it was is the fault catalogue's to remember"
            assert state(axis) is Lifecycle.STANDBY
            unit.load_n = 0.0
            await axis.arm()
            assert axis.faults() == ()

    run_simulated(main)


def test_heat_brings_rests_before_the_limit_and_the_limit_is_not_reached() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT, current_limit_a=25.0) as machine:
            axis, unit = machine.axes["lift_left"], machine.units["lift_left"]
            await axis.arm()
            unit.behaviour.speed_factor = 0.05  # a long way, so that the motor runs on and on
            unit.load_n = 1700.0
            seen: set[str] = set()
            for _ in range(300):
                await keep_asking(axis, 285.0 if unit.position_mm < 150.0 else 6.0, 1.0)
                unit.position_mm = 60.0
                seen |= conditions(axis)
                axis._monitor.reset()
                if state(axis) is Lifecycle.STANDBY:
                    await axis.arm()
            assert "thermal_derating" in seen
            assert "thermal_limit" not in seen
            assert 0.8 < axis.telemetry().thermal_load < 1.0

    run_simulated(main)


def test_two_units_on_one_address_are_told() -> None:
    """No select wire connected: equal NAMEs, equal addresses, twice the feedback with other positions."""

    async def main(loop: SimulatedLoop) -> None:
        machine = Machine(loop, names=LEFT, open_axes=False)
        machine.bus.actuators = (*machine.bus.actuators, VirtualElectrak(address=19, position_mm=100.0, seed=9))
        async with machine:
            axis = machine.axes["lift_left"]
            await axis.open()
            await asyncio.sleep(3.0)
            (fault,) = axis.faults()
            assert fault.condition == "feedback_flood"
            assert "address-select" in fault.detail

    run_simulated(main)


def test_a_unit_that_lost_its_address_is_named_with_the_address_it_is_heard_at() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT, open_axes=False) as machine:
            machine.units["lift_left"].address = 21
            machine.units["lift_left"]._awake = True
            with pytest.raises(DeviceTimeoutError):
                await machine.axes["lift_left"].open()
        async with Machine(loop, names=LEFT) as machine:
            machine.bus.inject("wrong_address", to_address=22)
            machine.units["lift_left"].behaviour.only_own_control_keeps_awake = False
            await asyncio.sleep(1.0)
            (fault,) = machine.axes["lift_left"].faults()
            assert fault.condition == "wrong_address"
            assert "address 22" in fault.detail

    run_simulated(main)


def test_a_power_cut_in_mid_move_never_resumes_the_move() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis, unit = machine.axes["lift_left"], machine.units["lift_left"]
            await axis.arm()
            await machine.drive({"lift_left": 280.0}, 1.0)
            machine.bus.inject("power_cut")
            await asyncio.sleep(1.0)
            machine.bus.clear_faults()
            stood_mm = unit.position_mm
            await keep_asking(axis, 280.0, 3.0)
            assert state(axis) is Lifecycle.STANDBY
            assert unit.position_mm == stood_mm
            await axis.arm()
            await asyncio.sleep(1.0)
            assert unit.position_mm == stood_mm, "arming forgets the old target"

    run_simulated(main)


def test_hold_leaves_at_once_and_targets_never_jump_on_arming() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis, unit = machine.axes["lift_left"], machine.units["lift_left"]
            await axis.arm()
            await machine.drive({"lift_left": 280.0}, 0.93)
            before_n = len(machine.frames)
            axis.hold()
            sent = [f for _, f in machine.frames[before_n:] if f.can_id & 0xFFFF00 == 0xEF1300]
            assert len(sent) == 1, "the hold is on the wire before the call returns"
            assert not unit.received_control[-1].motion_enable
            axis.hold()
            assert len(machine.frames) == before_n + 1, "and is not repeated out of turn"

    run_simulated(main)


def test_a_start_and_a_slower_speed_leave_at_once_and_what_can_wait_does() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis = machine.axes["lift_left"]

            def sent_by(share: float) -> int:
                before_n = len(machine.frames)
                axis.set_target_mm(280.0, share)
                return len(machine.frames) - before_n

            await axis.arm()
            while loop.now_s() - machine.frames[-1][0] < 0.03:  # between two messages of the period
                await asyncio.sleep(0.005)
            assert sent_by(1.0) == 1, "the start"
            await machine.drive({"lift_left": 280.0}, 0.53)
            for share, expected_n in ((1.0, 0), (0.95, 0), (0.8, 1), (0.8, 0), (1.0, 0), (0.5, 0)):
                assert sent_by(share) == expected_n, f"{share}; the last is too close on the heels of the one before"
            await asyncio.sleep(0.02)
            assert sent_by(0.5) == 1

    run_simulated(main)


def test_a_start_that_has_to_wait_floods_no_bus() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis = machine.axes["lift_left"]
            await axis.arm()
            axis._thermal.load = 2.0  # too warm: it rests
            before_n = axis.telemetry().counters["control_n"]
            await machine.drive({"lift_left": 280.0}, 1.0)
            assert axis.telemetry().counters["control_n"] - before_n <= 11

    run_simulated(main)


def test_arming_is_refused_while_the_overload_flag_is_still_set() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis, unit = machine.axes["lift_left"], machine.units["lift_left"]
            unit.faults.forced_flags = frozenset({"overload"})
            await asyncio.sleep(0.3)
            with pytest.raises(DeviceRefusedError, match="overload"):
                await axis.arm()

    run_simulated(main)


def test_a_unit_still_awake_is_ready_only_once_we_may_speak() -> None:
    """As after a restart of the daemon: feedback is heard at once, our address is ours a quarter of a second later."""

    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis = machine.axes["lift_left"]
            await axis.close()
            await machine.link.close()
            await axis.open()
            assert machine.link.address is not None
            await axis.arm()

    run_simulated(main)


def test_opening_without_an_address_says_so() -> None:
    async def main(loop: SimulatedLoop) -> None:
        settings = CanSettings(interface="virtual", name_arbitrary_address=False)
        async with Machine(loop, names=LEFT, can=settings) as machine:
            axis = machine.axes["lift_left"]
            await axis.close()
            machine.bus.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, settings.source_address_n), bytes(8)))
            await asyncio.sleep(0.01)
            with pytest.raises(DeviceTimeoutError, match="no J1939 address"):
                await axis.open()
            assert state(axis) is Lifecycle.CLOSED

    run_simulated(main)


def test_after_a_lost_bus_an_axis_is_back_only_once_we_may_speak() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis = machine.axes["lift_left"]
            machine.bus.unplug()
            await asyncio.sleep(0.001)
            assert state(axis) is Lifecycle.FAILED
            while state(axis) is Lifecycle.FAILED:
                await asyncio.sleep(0.005)
            assert machine.link.address is not None
            await axis.arm()

    run_simulated(main)


def test_a_unit_that_fell_asleep_while_the_bus_was_away_has_not_restarted() -> None:
    """It sleeps five seconds after our last message; whatever it was about to do, armed is armed afterwards."""

    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=LEFT) as machine:
            axis = machine.axes["lift_left"]
            for away_s in (4.65 + 0.002 * n for n in range(75)):
                await machine.link.close()
                await asyncio.sleep(away_s)
                await machine.link.open()
                machine.link.node.claim_requested_at_s = -1e9  # as where the answer comes late
                while state(axis) is not Lifecycle.STANDBY:
                    await asyncio.sleep(0.005)
                await axis.arm()
                await machine.drive({"lift_left": 100.0}, 1.0)
                assert state(axis) is Lifecycle.ACTIVE, f"away {away_s:.3f} s: {conditions(axis)}"
                await axis.disarm()

    run_simulated(main)
