"""Blade attitude: extensions to height, slope and pitch and back; and the pair of lifts kept together."""

from __future__ import annotations

import asyncio
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graderd.core.attitude import (
    Attitude,
    AttitudeGeometry,
    Preset,
    lift_attitude,
    lift_extensions,
    pitch_deg,
    tilt_extension,
)
from graderd.core.lift_pair import LiftPair, LiftPairSettings, SideReading
from graderd.drivers.electrak import ElectrakActuator
from tests.electrak_sim import Machine, SimulatedLoop, run_simulated

GEOMETRY = AttitudeGeometry()


def test_the_quarter_scale_machine() -> None:
    assert lift_attitude(GEOMETRY, 100.0, 100.0) == Attitude(0.0, 0.0)
    assert lift_attitude(GEOMETRY, 150.0, 150.0) == Attitude(50.0, 0.0)
    raised_left = lift_attitude(GEOMETRY, 114.0, 100.0)
    assert raised_left.height_mm == pytest.approx(7.0)
    assert raised_left.slope_deg == pytest.approx(1.0026, abs=1e-3)
    assert pitch_deg(GEOMETRY, 60.0) == pytest.approx(3.0)


geometries = st.builds(
    AttitudeGeometry,
    lift_ground_mm=st.floats(0, 200),
    lift_spacing_mm=st.floats(200, 4000),
    lift_raises_by_extending=st.booleans(),
    lift_height_ratio=st.floats(0.2, 5.0),
    tilt_deg_per_mm=st.floats(0.05, 2.0) | st.floats(-2.0, -0.05),
)


@given(geometries, st.floats(-200, 200), st.floats(-30, 30), st.floats(-30, 30))
def test_every_attitude_survives_the_round_trip(
    geometry: AttitudeGeometry, height: float, slope: float, pitch: float
) -> None:
    left_mm, right_mm = lift_extensions(geometry, Attitude(height, slope))
    back = lift_attitude(geometry, left_mm, right_mm)
    assert back.height_mm == pytest.approx(height, abs=1e-6)
    assert back.slope_deg == pytest.approx(slope, abs=1e-6)
    assert pitch_deg(geometry, tilt_extension(geometry, pitch)) == pytest.approx(pitch, abs=1e-9)


def test_a_positive_slope_is_the_left_end_up_whichever_way_the_lifts_act() -> None:
    for extends in (True, False):
        geometry = AttitudeGeometry(lift_raises_by_extending=extends)
        left_mm, right_mm = lift_extensions(geometry, Attitude(0.0, 5.0))
        assert (left_mm > right_mm) == extends


def test_a_preset_names_only_what_it_means() -> None:
    preset = Preset(height_mm=150.0, lift_before_rotation=True)
    assert preset.rotation_deg is None
    with pytest.raises(ValidationError):
        Preset.model_validate({"hight_mm": 1.0})


# -- the pair, pure ---------------------------------------------------------------------------------------------------


def reading(position_mm: float, time_s: float) -> SideReading:
    return SideReading(position_mm, time_s)


def test_a_side_that_is_not_measured_stops_the_other_until_the_pair_is_released() -> None:
    pair = LiftPair()
    moving = pair.step(1.0, reading(100.0, 1.0), reading(100.0, 1.0), 150.0, 150.0)
    assert moving.left.target_mm == moving.right.target_mm == 150.0
    for left, right, lost in (
        (None, reading(100.0, 1.1), "lift_left"),
        (reading(100.0, 1.1), reading(100.0, 0.5), "lift_right"),
    ):
        stopped = pair.step(1.1, left, right, 150.0, 150.0)
        assert stopped.left.target_mm is stopped.right.target_mm is None
        assert lost in stopped.stopped
        again = pair.step(1.2, reading(100.0, 1.2), reading(100.0, 1.2), 150.0, 150.0)
        assert again.stopped, "it does not start again by itself"
        pair.release()
        assert not pair.step(1.3, reading(100.0, 1.3), reading(100.0, 1.3), 150.0, 150.0).stopped
        pair.release()


def test_a_side_that_does_not_move_stops_the_other() -> None:
    pair = LiftPair()
    left_mm, now_s = 100.0, 0.0
    command = pair.step(0.0, reading(100, 0), reading(100, 0), 150.0, 150.0)
    while not command.stopped and now_s < 5.0:
        now_s += 0.02
        if command.left.target_mm is not None:
            left_mm += 0.02 * 15.0
        command = pair.step(now_s, reading(left_mm, now_s), reading(100.0, now_s), 150.0, 150.0)
    assert "lift_right does not move" in command.stopped
    assert now_s < 1.5
    assert left_mm - 100.0 < 4.0, "the side that moved was held before it got away"


def test_sides_far_apart_are_reported_and_then_stopped() -> None:
    pair = LiftPair()
    pair.step(0.0, reading(100, 0), reading(100, 0), 200.0, 200.0)
    command = pair.step(0.1, reading(104.0, 0.1), reading(100.0, 0.1), 200.0, 200.0)
    assert command.condition == "sides_apart"
    assert command.apart_mm == pytest.approx(4.0)
    command = pair.step(0.2, reading(107.0, 0.2), reading(100.0, 0.2), 200.0, 200.0)
    assert command.stopped


def test_a_slope_move_keeps_to_its_line() -> None:
    """Left 40 mm up, right 20 mm down: the left has twice the way and may go twice as fast."""
    pair = LiftPair()
    command = pair.step(0.0, reading(100, 0), reading(100, 0), 140.0, 80.0)
    assert command.left.speed_share == pytest.approx(2 * command.right.speed_share)
    assert command.apart_mm == 0.0
    one_behind = pair.step(0.1, reading(104.0, 0.1), reading(100.0, 0.1), 140.0, 80.0)
    assert one_behind.apart_mm > 1.0
    pair = LiftPair()
    pair.step(0.0, reading(100, 0), reading(100, 0), 140.0, 80.0)
    on_line = pair.step(0.2, reading(110.0, 0.2), reading(95.0, 0.2), 140.0, 80.0)
    assert on_line.apart_mm < 0.5


def test_only_one_side_moving_is_a_move_as_well() -> None:
    pair = LiftPair()
    command = pair.step(0.0, reading(100, 0), reading(100, 0), 140.0, 100.0)
    assert command.left.target_mm == 140.0
    assert command.right.target_mm == 100.0
    assert command.left.speed_share == 1.0


@given(
    st.lists(
        st.tuples(st.floats(0, 300), st.floats(0, 300), st.floats(5, 295), st.floats(5, 295), st.floats(0, 0.5)),
        max_size=40,
    )
)
def test_whatever_it_is_shown_its_commands_are_in_range(steps: list[tuple[float, float, float, float, float]]) -> None:
    pair, now_s = LiftPair(LiftPairSettings(stop_apart_mm=1e9)), 0.0
    for left_mm, right_mm, left_target_mm, right_target_mm, wait_s in steps:
        now_s += wait_s
        command = pair.step(now_s, reading(left_mm, now_s), reading(right_mm, now_s), left_target_mm, right_target_mm)
        for side in (command.left, command.right):
            assert 0.0 < side.speed_share <= 1.0
            assert side.target_mm is None or abs(side.target_mm) < 1e6


# -- the pair with the real driver and virtual actuators --------------------------------------------------------------


class Lift:
    """Drives the pair as the control tick does and watches the true positions."""

    def __init__(self, machine: Machine, loop: SimulatedLoop) -> None:
        self.machine, self.loop, self.pair = machine, loop, LiftPair()
        self.worst_apart_mm = 0.0
        self.stopped = ""

    async def arm(self) -> None:
        for axis in self.machine.axes.values():
            await axis.arm()

    async def go(self, left_mm: float, right_mm: float | None = None, *, timeout_s: float = 15.0) -> float:
        """Seconds until both stand at their targets (the right one's is the left one's where not given)."""
        self.pair.release()
        self.worst_apart_mm, start_s = 0.0, self.loop.now_s()
        targets_mm = (left_mm, left_mm if right_mm is None else right_mm)
        left, right = (self.machine.units[name] for name in ("lift_left", "lift_right"))
        axes = [self.machine.axes[name] for name in ("lift_left", "lift_right")]
        while self.loop.now_s() - start_s < timeout_s:
            now_s, (left_seen, right_seen) = self.loop.now_s(), (self._reading(axis) for axis in axes)
            command = self.pair.step(now_s, left_seen, right_seen, *targets_mm)
            self.stopped = command.stopped
            for axis, side in zip(axes, (command.left, command.right), strict=True):
                if side.target_mm is None:
                    axis.hold()
                else:
                    axis.set_target_mm(side.target_mm, side.speed_share)
            await asyncio.sleep(0.02)
            self.worst_apart_mm = max(self.worst_apart_mm, abs(left.position_mm - right.position_mm))
            there = (abs(u.position_mm - t) < 1.6 for u, t in zip((left, right), targets_mm, strict=True))
            if self.stopped or (all(there) and not left.velocity_mm_per_s and not right.velocity_mm_per_s):
                break
        return self.loop.now_s() - start_s

    @staticmethod
    def _reading(axis: ElectrakActuator) -> SideReading | None:
        position = axis.telemetry().position_mm
        return None if position is None else SideReading(position.value, position.time_s)


async def alone(machine: Machine, loop: SimulatedLoop, name: str, target_mm: float) -> float:
    """Seconds one side takes by itself."""
    start_s, unit = loop.now_s(), machine.units[name]
    while loop.now_s() - start_s < 15.0:
        machine.axes[name].set_target_mm(target_mm)
        await asyncio.sleep(0.02)
        if abs(unit.position_mm - target_mm) < 1.6 and not unit.velocity_mm_per_s:
            break
    return loop.now_s() - start_s


@pytest.mark.parametrize(
    ("slow", "load_n", "seed"),
    [
        *itertools.product(("lift_left", "lift_right"), (0.0, 800.0), (1, 2)),
        # here the first messages of a move fell so that its start-up was taken for a slow side
        ("lift_left", 400.0, 16), ("lift_left", 800.0, 4), ("lift_left", 800.0, 23),
        ("lift_right", 0.0, 27), ("lift_right", 0.0, 36), ("lift_right", 400.0, 22), ("lift_left", 0.0, 51),
    ],
)  # fmt: skip
def test_a_100_mm_lift_with_one_side_30_percent_slower(slow: str, load_n: float, seed: int) -> None:
    """Never more than 3 mm apart, within 15 % of the slow side's own time: the first lift, and a later one."""

    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=("lift_left", "lift_right"), seed=seed) as machine:
            for unit in machine.units.values():
                unit.load_n = load_n
            machine.units[slow].behaviour.speed_factor = 0.7
            lift = Lift(machine, loop)
            await asyncio.sleep(0.037 * seed)
            await lift.arm()
            own_s = {200.0: await alone(machine, loop, slow, 200.0), 100.0: await alone(machine, loop, slow, 100.0)}
            for unit in machine.units.values():
                unit.position_mm = 100.0
            await asyncio.sleep(0.6)
            await machine.axes["lift_left"].disarm()
            await machine.axes["lift_right"].disarm()
            await lift.arm()
            for target_mm in (200.0, 100.0, 200.0):
                took_s = await lift.go(target_mm)
                assert lift.stopped == ""
                assert lift.worst_apart_mm <= 3.0
                assert took_s <= 1.15 * own_s[target_mm]

    run_simulated(main)


@pytest.mark.parametrize("fault", ["stuck", "silence", "power_cut"])
def test_a_stuck_or_lost_side_stops_the_other_in_mid_lift(fault: str) -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=("lift_left", "lift_right")) as machine:
            lift = Lift(machine, loop)
            await lift.arm()
            going = asyncio.create_task(lift.go(250.0), name="lift")
            await asyncio.sleep(1.2)
            if fault == "stuck":
                machine.units["lift_right"].behaviour.speed_factor = 0.0
            else:
                machine.bus.inject(fault, address=20)
            await going
            assert lift.stopped
            left = machine.units["lift_left"]
            await asyncio.sleep(0.3)
            assert left.velocity_mm_per_s == 0.0
            assert left.position_mm < 250.0

    run_simulated(main)


@pytest.mark.parametrize("slow", [None, "lift_left", "lift_right"])
def test_level_and_slope_moves_in_a_row_all_arrive(slow: str | None) -> None:
    """Ways of 6:1, against each other, one side only: every one ends at its targets, none is stopped."""

    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=("lift_left", "lift_right")) as machine:
            if slow:
                machine.units[slow].behaviour.speed_factor = 0.7
            lift = Lift(machine, loop)
            await lift.arm()
            errors_mm = []
            for left_mm, right_mm in (
                (160, 110), (100, 100), (130, 70), (100, 100), (200, 195), (100, 104), (100, 150), (120, 150), (5, 295)
            ):  # fmt: skip
                took_s = await lift.go(left_mm, right_mm)
                assert lift.stopped == ""
                assert took_s < 12.0
                errors_mm.append(abs(machine.units["lift_left"].position_mm - left_mm))
                errors_mm.append(abs(machine.units["lift_right"].position_mm - right_mm))
            assert max(errors_mm) < 1.6

    run_simulated(main)
