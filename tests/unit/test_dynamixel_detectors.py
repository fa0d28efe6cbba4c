"""Motion detectors, calibration and fault book: pure, no wire."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graderd.drivers.dynamixel.arming import watchdog_counts
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.faultbook import FaultBook
from graderd.drivers.dynamixel.motion_faults import MotionDetectors, Sample
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo.motion import Profile, Trajectory

TABLE = ControlTable.load("ph54_200_s500")
SETTINGS = Ph54Settings()


def watch(
    angle: Callable[[float], float],
    goal: Callable[[float], float | None],
    seconds: float,
    *,
    volts: Callable[[float], float] = lambda _: 24.0,
    celsius: Callable[[float], float] = lambda _: 30.0,
) -> dict[str, float]:
    """Conditions seen, each with the time it came up first, at 50 samples a second."""
    detectors = MotionDetectors(SETTINGS)
    seen: dict[str, float] = {}
    for i in range(int(seconds * 50)):
        t = i * 0.02
        speed = (angle(t) - angle(t - 0.02)) / 0.02
        for name in detectors.look(Sample(t, angle(t), speed, 1.0, volts(t), celsius(t), goal(t))):
            seen.setdefault(name, t)
    return seen


def ramp(rate_deg_per_s: float, from_s: float = 1.0, to_deg: float = math.inf) -> Callable[[float], float]:
    return lambda t: math.copysign(min(abs(to_deg), abs(rate_deg_per_s) * max(0.0, t - from_s)), rate_deg_per_s)


def test_a_blade_that_follows_raises_nothing() -> None:
    assert watch(ramp(30.0, to_deg=45.0), lambda t: 45.0 if t > 0.8 else 0.0, 5.0) == {}


def test_standing_still_raises_nothing_for_long() -> None:
    assert watch(lambda _: 3.0, lambda _: None, 20.0) == {}
    assert watch(lambda _: 3.0, lambda _: 3.2, 20.0) == {}


def test_stuck_is_named_after_its_time() -> None:
    seen = watch(lambda _: 0.0, lambda t: 20.0 if t > 1.0 else 0.0, 4.0)
    assert set(seen) == {"not_moving"}
    assert seen["not_moving"] == pytest.approx(1.0 + SETTINGS.not_moving_s, abs=0.1)


def test_stuck_in_mid_way_is_named() -> None:
    assert "not_moving" in watch(ramp(30.0, to_deg=10.0), lambda _: 40.0, 4.0)


def test_a_slow_blade_is_not_stuck() -> None:
    assert "not_moving" not in watch(ramp(1.0, from_s=0.0), lambda _: 40.0, 20.0)


def test_running_away_from_the_goal_is_named_in_time() -> None:
    seen = watch(ramp(-20.0), lambda t: 20.0 if t > 1.0 else 0.0, 3.0)
    assert 1.1 < seen["wrong_way"] < 2.0


def test_braking_before_a_reversal_is_not_the_wrong_way() -> None:
    def angle(t: float) -> float:
        into = max(0.0, t - 1.0)  # 30 °/s, reversed with 60 °/s²
        return 30.0 * t if t < 1.0 else 30.0 + 30.0 * into - 30.0 * into * into

    assert "wrong_way" not in watch(angle, lambda t: 50.0 if t < 1.0 else -20.0, 2.0)


@pytest.mark.parametrize("goal", [None, 0.0])
def test_moving_without_a_command_is_named(goal: float | None) -> None:
    seen = watch(ramp(3.0, from_s=3.0, to_deg=5.0), lambda _: goal, 4.0)
    assert 3.0 < seen["moving_uncommanded"] < 3.5


def test_one_odd_sample_raises_nothing() -> None:
    assert watch(lambda t: 0.3 if abs(t - 2.0) < 0.01 else 0.0, lambda _: 0.0, 4.0) == {}


def test_near_limits_have_hysteresis_and_clear() -> None:
    detectors, flickers = MotionDetectors(SETTINGS), 0
    before = False
    for i in range(200):
        volts = 20.0 + (0.1 if i % 2 else -0.1)
        now = "voltage_near_limit" in detectors.look(Sample(i * 0.02, 0.0, 0.0, 0.0, volts, 30.0, None))
        flickers += now != before
        before = now
    assert flickers == 1
    assert detectors.look(Sample(5.0, 0.0, 0.0, 0.0, 24.0, 30.0, None)) == {}
    assert "temperature_near_limit" in detectors.look(Sample(5.1, 0.0, 0.0, 0.0, 24.0, 70.0, None))
    assert "temperature_near_limit" in detectors.look(Sample(5.2, 0.0, 0.0, 0.0, 24.0, 69.0, None))
    assert detectors.look(Sample(5.3, 0.0, 0.0, 0.0, 24.0, 67.0, None)) == {}


# -- calibration ------------------------------------------------------------------------------------------------

_settings = st.builds(
    Ph54Settings,
    zero_deg=st.floats(-90, 90),
    sign=st.sampled_from([1, -1]),
    gear_ratio=st.floats(0.2, 20),
)


@given(_settings, st.floats(-60, 60))
def test_angles_survive_the_way_to_counts_and_back(made: Ph54Settings, angle_deg: float) -> None:
    cal = Calibration.of(made, TABLE)
    count_deg = 360.0 / TABLE.profile["motion"]["pulses_per_turn"] / made.gear_ratio
    assert cal.blade_deg(cal.counts(angle_deg)) == pytest.approx(angle_deg, abs=count_deg)


@given(_settings)
def test_the_servos_limits_lie_just_outside_the_soft_ones_whichever_way_it_turns(made: Ph54Settings) -> None:
    cal = Calibration.of(made, TABLE)
    low, high = cal.servo_limits()
    assert low < high
    for angle_deg in (made.min_deg, made.max_deg, 0.0):
        assert low < cal.counts(angle_deg) < high
    assert not low <= cal.counts(made.max_deg + 1.5) <= high


def test_the_documented_example_and_signs() -> None:
    cal = Calibration.of(Ph54Settings(zero_deg=5.0, sign=-1, gear_ratio=2.0), TABLE)
    assert cal.blade_deg(1_003_846 // 2) == pytest.approx(-95.0)
    assert cal.blade_deg_per_s(1000) == pytest.approx(-30.0)
    assert cal.torque_nm(1000) == pytest.approx(-2 * 4.806)
    assert cal.velocity_counts(30.0) == 1000
    assert cal.acceleration_counts(60.0) == 1200
    assert cal.velocity_counts(1e-6) == cal.acceleration_counts(1e-6) == 1  # 0 would mean "no limit"
    assert not cal.needs_turns
    assert Calibration.of(Ph54Settings(gear_ratio=4.0), TABLE).needs_turns
    assert cal.within_limits(60.0)
    assert not cal.within_limits(math.nan)


@pytest.mark.parametrize(("seconds", "counts"), [(0.2, 9), (0.02, 1), (0.001, 1), (2.54, 126), (0.1, 4)])
def test_the_watchdog_leaves_time_to_brake(seconds: float, counts: int) -> None:
    assert watchdog_counts(Ph54Settings(watchdog_s=seconds)) == counts


# -- fault book -------------------------------------------------------------------------------------------------


def test_faults_hold_until_cleared_and_events_fade() -> None:
    book = FaultBook("rotation")
    assert book.set("no_reply", "a", 1.0)
    assert not book.set("no_reply", "b", 2.0)
    assert book.event("torque_off", "c", 2.5)
    (first, second) = book.present(3.0)
    assert (first.name, first.detail, first.since_s) == ("rotation.no_reply", "b", 1.0)
    assert second.condition == "torque_off"
    assert [f.condition for f in book.present(3.6)] == ["no_reply"]
    book.clear("no_reply", "never there")
    assert book.present(4.0) == ()
    book.replace(frozenset({"x", "y"}), {"x": "1"}, 5.0)
    book.replace(frozenset({"x", "y"}), {"y": "2"}, 6.0)
    assert [f.condition for f in book.present(6.0)] == ["y"]


# -- trajectory of the virtual servo --------------------------------------------------------------------------------


@settings(max_examples=30)
@given(st.lists(st.floats(-200, 200), min_size=1, max_size=4), st.floats(1, 90), st.floats(5, 400))
def test_a_trajectory_keeps_its_profile_and_arrives_wherever_it_is_sent(
    goals: list[float], velocity: float, acceleration: float
) -> None:
    trajectory, profile, dt_s = Trajectory(), Profile(velocity, acceleration), 0.002
    for goal_deg in goals:
        trajectory.goal_deg = goal_deg
        for _ in range(150):
            before = trajectory.velocity_deg_per_s
            trajectory.step(dt_s, profile, 200.0)
            assert abs(trajectory.velocity_deg_per_s) <= velocity + 1e-6
            assert abs(trajectory.velocity_deg_per_s - before) <= acceleration * dt_s * 2 + 1e-6
    way_deg = abs(goals[-1] - trajectory.position_deg) + 2 * velocity**2 / acceleration
    for _ in range(int((way_deg / velocity + 4 * velocity / acceleration + 1.0) / dt_s)):
        trajectory.step(dt_s, profile, 200.0)
    assert trajectory.done
    assert trajectory.position_deg == goals[-1]
