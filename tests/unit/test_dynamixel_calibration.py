"""Calibration, watchdog register and the virtual servo's trajectory: pure, no wire."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graderd.drivers.dynamixel.arming import watchdog_counts
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo.motion import Profile, Trajectory

TABLE = ControlTable.load("ph54_200_s500")


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
