"""The judgement of motion: what each axis must be told for, and what must never be."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graderd.config import Config, parse
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import catalogue_key
from graderd.core.plausibility import AxisSample, PlausibilityMonitor, axis_sample, motion_figures
from graderd.drivers.dynamixel.arming import HOLD_ACCELERATION_FACTOR
from graderd.hal.device import Lifecycle
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo.motion import Profile, Trajectory

FIGURES = motion_figures(Config().rotation, Config().actuators(), Config().figures())
TICK_S = 0.02
FEEDBACK_S = 0.105
Course = Callable[[float], float]
Goal = Callable[[float], float | None]


def watch(
    axis: str,
    position: Course,
    goal: Goal,
    seconds: float,
    *,
    period_s: float | None = None,
    powered: Callable[[float], bool] = lambda _: True,
    velocity: bool = True,
    monitor: PlausibilityMonitor | None = None,
) -> dict[str, float]:
    """Conditions seen, each with the time it came up first; judged every tick, measured every ``period_s``."""
    period_s = period_s or (TICK_S if axis == "rotation" else FEEDBACK_S)
    monitor = monitor or PlausibilityMonitor(FIGURES)
    seen: dict[str, float] = {}
    for tick in range(int(seconds / TICK_S)):
        now_s = tick * TICK_S
        at_s = math.floor(now_s / period_s + 1e-9) * period_s
        speed = (position(at_s) - position(at_s - period_s)) / period_s if velocity else None
        sample = AxisSample(axis, position(at_s), at_s, speed, goal(now_s), powered(now_s), 1.0)
        for fault in monitor.judge((sample,), now_s):
            assert fault.device == axis
            assert catalogue_key(axis, fault.condition) in CATALOGUE
            seen.setdefault(fault.condition, now_s)
    return seen


def ramp(rate: float, from_s: float = 1.0, to: float = math.inf, start: float = 0.0) -> Course:
    return lambda t: start + math.copysign(min(abs(to), abs(rate) * max(0.0, t - from_s)), rate)


def still(at: float = 0.0) -> Course:
    return lambda _: at


def to(goal: float | None, from_s: float = 1.0, before: float | None = None) -> Goal:
    return lambda t: goal if t >= from_s else before


# -- what is normal -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("velocity", [True, False])
def test_a_blade_that_follows_raises_nothing(velocity: bool) -> None:
    assert watch("rotation", ramp(25.0, to=45.0), to(45.0, 0.9, 0.0), 6.0, velocity=velocity) == {}


@pytest.mark.parametrize("velocity", [True, False])
def test_a_lift_that_follows_raises_nothing(velocity: bool) -> None:
    course = ramp(-55.0, to=150.0, start=250.0)
    assert watch("lift_left", course, to(100.0, 0.9), 6.0, velocity=velocity) == {}


def test_standing_still_raises_nothing_for_long() -> None:
    assert watch("rotation", still(3.0), lambda _: None, 20.0) == {}
    assert watch("rotation", still(3.0), lambda _: 3.2, 20.0) == {}
    assert watch("tilt", still(50.0), lambda _: None, 20.0) == {}
    assert watch("tilt", still(50.0), lambda _: 51.4, 20.0) == {}, "an actuator rests short of its goal"


def test_the_slowest_moves_are_not_stuck_and_arrive() -> None:
    """A lift at its lowest duty, a tilt at its lowest duty, and a goal of an operator that moves slowly."""
    assert watch("lift_left", ramp(15.6, to=200.0), to(200.0, 0.9), 16.0) == {}
    assert watch("tilt", ramp(5.9, to=60.0), to(60.0, 0.9), 13.0) == {}
    assert watch("rotation", ramp(1.0), lambda t: max(0.0, 1.0 * (t - 0.3)), 20.0) == {}


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-60, 60), st.floats(0.1, 3.0), st.booleans()), min_size=1, max_size=6),
    st.floats(10, 30),
    st.floats(20, 60),
)
def test_a_servo_that_obeys_raises_nothing_whatever_it_is_told(
    moves: list[tuple[float, float, bool]], top: float, acceleration: float
) -> None:
    """Goals, reversals and holds in mid-turn, at the profile's own speed and braking; a hold brakes harder."""
    rotation = Ph54Settings(speed_deg_per_s=top, acceleration_deg_per_s2=acceleration)
    top, acceleration = rotation.profile_velocity_deg_per_s, rotation.profile_acceleration_deg_per_s2
    monitor = PlausibilityMonitor(motion_figures(rotation, Config().actuators(), Config(rotation=rotation).figures()))
    trajectory, now_s = Trajectory(), 0.0
    for goal_deg, lasts_s, held in moves:
        trajectory.goal_deg = trajectory.position_deg if held else goal_deg
        profile = Profile(top, acceleration * (HOLD_ACCELERATION_FACTOR if held else 1.0))
        for _ in range(int(lasts_s / TICK_S)):
            for _ in range(10):
                trajectory.step(TICK_S / 10, profile, 200.0)
            now_s += TICK_S
            goal = None if held else goal_deg
            s = AxisSample("rotation", trajectory.position_deg, now_s, trajectory.velocity_deg_per_s, goal, True)
            assert monitor.judge((s,), now_s) == ()


def test_noise_at_rest_and_one_odd_reading_raise_nothing() -> None:
    noise = random.Random(4)
    course = {round(t * TICK_S, 3): noise.uniform(-0.1, 0.1) for t in range(-10, 2000)}
    assert watch("rotation", lambda t: course.get(round(t, 3), 0.0), lambda _: None, 30.0) == {}
    assert watch("rotation", lambda t: course.get(round(t, 3), 0.0), lambda _: 0.0, 30.0) == {}
    assert watch("rotation", lambda t: 0.4 if abs(t - 2.0) < 0.01 else 0.0, lambda _: None, 4.0) == {}


def test_feedback_that_bunches_up_is_no_overspeed() -> None:
    """Two messages on the heels of one another: nothing for 0.2 s, then the way of 0.2 s within 2 ms."""
    monitor = PlausibilityMonitor(FIGURES)
    for pair in range(40):
        for at_s, way_s in ((0.21 * pair + 0.208, 0.21 * pair + 0.105), (0.21 * pair + 0.21, 0.21 * pair + 0.21)):
            s = AxisSample("lift_left", 60.0 * way_s, at_s, 60.0, 600.0, True)
            assert monitor.judge((s,), at_s) == ()


def test_a_jog_between_two_readings_is_a_command() -> None:
    """The goal was given and taken back before the next feedback: the motion it caused is not uncommanded."""
    course: Course = lambda t: 100.0 if t < 2.05 else 106.0  # noqa: E731
    assert watch("lift_left", course, lambda t: 130.0 if 2.02 <= t < 2.09 else None, 5.0) == {}
    assert "uncommanded_motion" in watch("lift_left", course, lambda _: None, 5.0)


def test_an_actuator_is_judged_by_what_its_own_section_says_of_it() -> None:
    """A slow valve is no runaway where it is known to be slow, and is one by an Electrak's figures."""
    of_slow = parse({"tilt": {"reaction_s": 0.5, "not_moving_s": 1.5, "braking_mm_per_s2": 60.0}})
    motion = motion_figures(of_slow.rotation, of_slow.actuators(), of_slow.figures())

    def late(t: float) -> float:
        """At 60 mm/s for 0.5 s after the hold, then braking at 60 mm/s2."""
        return 60.0 * min(t, 2.5) + (60.0 * min(t - 2.5, 1.0) - 30.0 * min(t - 2.5, 1.0) ** 2 if t > 2.5 else 0.0)

    goal: Goal = lambda t: 400.0 if t < 2.0 else None  # noqa: E731
    assert "uncommanded_motion" not in watch("tilt", late, goal, 6.0, monitor=PlausibilityMonitor(motion))
    assert "uncommanded_motion" in watch("tilt", late, goal, 6.0)
    stuck = watch("tilt", still(), to(20.0), 4.0, monitor=PlausibilityMonitor(motion))
    assert 1.0 + 1.5 < stuck["not_moving"] < 1.0 + 1.5 + 0.13
    assert motion["lift_left"] == FIGURES["lift_left"]


# -- not moving, not arriving -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", FIGURES)
def test_stuck_is_named_after_its_time(axis: str) -> None:
    seen = watch(axis, still(), to(20.0), 4.0)
    assert set(seen) == {"not_moving"}
    assert 1.0 + FIGURES[axis].not_moving_s < seen["not_moving"] < 1.0 + FIGURES[axis].not_moving_s + 0.13


def test_stuck_in_mid_way_is_named() -> None:
    assert "not_moving" in watch("rotation", ramp(25.0, to=10.0), to(40.0, 0.9), 4.0)
    assert "not_moving" in watch("tilt", ramp(20.0, to=10.0), to(40.0, 0.9), 4.0)


@pytest.mark.parametrize("axis", FIGURES)
def test_a_jam_is_named_down_to_where_the_axis_counts_as_arrived(axis: str) -> None:
    near = FIGURES[axis].near
    assert "not_moving" in watch(axis, ramp(20.0, to=20.0 - 1.1 * near), to(20.0, 0.9), 4.0)
    assert watch(axis, ramp(20.0, to=20.0 - 0.9 * near), to(20.0, 0.9), 4.0) == {}


def test_a_slow_blade_is_not_stuck_but_does_not_arrive() -> None:
    seen = watch("rotation", ramp(1.0, from_s=0.0), lambda _: 40.0, 20.0)
    assert set(seen) == {"not_arriving"}
    assert 2.8 < seen["not_arriving"] < 3.0


def test_a_slow_blade_does_not_arrive_also_where_the_goal_keeps_ahead_of_it() -> None:
    """The gate's lead: the goal is never more than 10 degrees ahead of a blade that lags, and so it moves with it."""
    course = ramp(0.6, from_s=0.0)
    assert set(watch("rotation", course, lambda t: course(t) + 10.0, 6.0)) == {"not_arriving"}


def test_swinging_beside_the_goal_is_not_arriving() -> None:
    seen = watch("rotation", lambda t: -8.0 + 0.8 * math.sin(3.0 * t), lambda _: 0.0, 8.0)
    assert "not_arriving" in seen


def test_a_device_that_rests_by_itself_is_not_stuck() -> None:
    """Rests of a hot actuator: it has no goal for most of every four seconds."""

    def position(t: float) -> float:
        return 100.0 + 3.0 * (t // 4.0) + min(3.0, 15.0 * (t % 4.0))

    assert watch("tilt", position, lambda t: 190.0 if t % 4.0 < 0.4 else None, 40.0) == {}


# -- wrong way --------------------------------------------------------------------------------------------------------


def test_running_away_from_the_goal_is_named_in_time() -> None:
    seen = watch("rotation", ramp(-20.0), to(20.0, before=0.0), 3.0)
    assert 1.1 < seen["wrong_way"] < 1.4


def test_creeping_away_from_the_goal_is_named_too() -> None:
    seen = watch("rotation", ramp(-0.5), to(20.0, before=0.0), 8.0)
    assert seen["wrong_way"] == pytest.approx(1.0 + 1.0 / 0.5, abs=0.1)


def test_an_actuator_against_its_direction_is_named_within_five_millimetres() -> None:
    for axis, speed in (("tilt", 21.0), ("lift_left", 9.0), ("lift_left", 33.0)):
        seen = watch(axis, ramp(-speed, start=100.0), to(180.0), 4.0)
        assert seen["uncommanded_motion"] <= 1.0 + 1.5 / speed + FEEDBACK_S + TICK_S


def test_braking_before_a_reversal_is_not_the_wrong_way() -> None:
    def angle(t: float) -> float:
        into = max(0.0, t - 1.0)  # 25 °/s, reversed with 60 °/s²
        return 25.0 * t if t < 1.0 else 25.0 + 25.0 * into - 30.0 * into * into

    assert watch("rotation", angle, lambda t: 50.0 if t < 1.0 else -20.0, 1.9) == {}


def test_a_reversal_in_mid_lift_is_not_the_wrong_way_and_one_that_is_not_obeyed_is() -> None:
    turns: Course = lambda t: 55.0 * t if t < 2.1 else max(115.5 - 55.0 * (t - 2.1), 0.0)  # noqa: E731
    assert watch("lift_left", turns, lambda t: 300.0 if t < 2.0 else 30.0, 3.2) == {}
    seen = watch("lift_left", lambda t: 55.0 * t, lambda t: 300.0 if t < 2.0 else 30.0, 4.0)
    assert 55.0 * (seen["uncommanded_motion"] - 2.0) < 35.0


def test_a_runaway_under_a_goal_is_named_before_braking_could_be_over() -> None:
    """At a speed that is not permitted, the time to brake from it is not granted: 12.3 degrees in any case."""
    seen = watch("rotation", ramp(-60.0, from_s=0.0), lambda t: -50.0 if t < 1.0 else 50.0, 3.0)
    assert 60.0 * (seen["wrong_way"] - 1.0) < 14.5


def test_a_runaway_faster_than_permitted_is_the_wrong_way_at_once() -> None:
    seen = watch("rotation", ramp(-130.0), to(20.0, before=0.0), 3.0)
    assert seen["wrong_way"] == seen["overspeed"] < 1.07


# -- uncommanded ------------------------------------------------------------------------------------------------------


def test_what_was_turned_to_a_goal_since_an_old_reading_was_commanded() -> None:
    """A stop on a bad line: nothing was heard for 0.4 s around it, and the blade went on to its goal for half of it."""
    settings = Ph54Settings(speed_deg_per_s=40.0, acceleration_deg_per_s2=160.0)
    config = Config(rotation=settings)
    monitor = PlausibilityMonitor(motion_figures(settings, config.actuators(), config.figures()))
    course, seen = ramp(40.0, to=50.0), set[str]()
    for tick in range(200):
        now_s = tick * TICK_S
        at_s = 2.0 if 2.0 < now_s < 2.4 else now_s
        goal = 90.0 if 1.0 <= now_s < 2.2 else None
        sample = AxisSample("rotation", course(at_s), at_s, 40.0 if 1.0 < at_s < 2.25 else 0.0, goal, True)
        seen |= {fault.condition for fault in monitor.judge((sample,), now_s)}
    assert seen == set()


@pytest.mark.parametrize("goal", [None, 0.0])
@pytest.mark.parametrize("powered", [True, False])
def test_moving_without_a_command_is_named(goal: float | None, powered: bool) -> None:
    seen = watch("rotation", ramp(3.0, from_s=3.0, to=5.0), lambda _: goal, 4.0, powered=lambda _: powered)
    assert seen["moving_uncommanded"] == pytest.approx(3.0 + 0.5 / 3.0, abs=0.05)


@pytest.mark.parametrize("rate", [0.01, 0.1, 0.5, 0.79])
@pytest.mark.parametrize("powered", [True, False])
def test_creep_is_named_after_half_a_degree_however_slow(rate: float, powered: bool) -> None:
    seen = watch("rotation", ramp(rate), lambda _: None, 3.0 + 0.7 / rate, powered=lambda _: powered)
    assert seen["moving_uncommanded"] == pytest.approx(1.0 + 0.5 / rate, abs=0.1)


def test_creep_of_an_actuator_is_named_after_two_millimetres() -> None:
    assert watch("tilt", ramp(0.5), lambda _: None, 8.0)["uncommanded_motion"] == pytest.approx(5.0, abs=0.15)


def test_what_goes_on_is_told_as_long_as_it_goes_on_and_no_longer() -> None:
    monitor = PlausibilityMonitor(FIGURES)
    course = ramp(0.6, to=6.0)
    told = []
    for tick in range(1000):
        now_s = tick * TICK_S
        s = AxisSample("rotation", course(now_s), now_s, None, None, False)
        told.append(bool(monitor.judge((s,), now_s)))
    first, last = told.index(True) * TICK_S, (999 - told[::-1].index(True)) * TICK_S
    assert all(told[int(first / TICK_S) : int(10.9 / TICK_S)])
    assert last == pytest.approx(12.0, abs=0.9), "a displacement that stays is a fault no more: reset is possible"


def test_a_blade_that_does_not_obey_a_hold_is_named() -> None:
    """It runs on at the gate's speed: after the time to brake, and at most what braking could take."""
    seen = watch("rotation", ramp(25.0, from_s=0.0), lambda t: 80.0 if t < 1.0 else None, 4.0)
    assert 25.0 * (seen["moving_uncommanded"] - 1.0) < 13.0


def test_a_lift_that_does_not_obey_a_hold_is_named() -> None:
    seen = watch("lift_left", ramp(55.0, from_s=0.0), lambda t: 300.0 if t < 1.0 else None, 4.0)
    assert 55.0 * (seen["uncommanded_motion"] - 1.0) < 45.0


def test_a_hold_that_overruns_and_comes_back_raises_nothing() -> None:
    def angle(t: float) -> float:  # braked with ten times the profile's acceleration: 0.75° beyond, and back
        return 25.0 * t if t < 1.0 else 25.0 + 0.75 * math.exp(-10.0 * (t - 1.0)) * math.sin(30.0 * (t - 1.0))

    assert watch("rotation", angle, lambda t: 60.0 if t < 1.0 else None, 5.0) == {}


def test_pushed_from_the_goal_it_had_reached_is_uncommanded() -> None:
    seen = watch("rotation", ramp(-20.0, from_s=4.0, start=10.0), lambda _: 10.0, 6.0)
    assert 4.0 < seen["moving_uncommanded"] < 4.1
    assert seen["moving_uncommanded"] < seen["wrong_way"]


# -- overspeed --------------------------------------------------------------------------------------------------------


def test_a_snap_is_overspeed() -> None:
    """A jam that comes free: 10 degrees at 150 °/s, toward its goal."""
    seen = watch("rotation", ramp(150.0, to=10.0), to(10.0, 0.9), 3.0)
    assert set(seen) == {"overspeed"}
    assert seen["overspeed"] < 1.07


@pytest.mark.parametrize(("axis", "speed"), [("rotation", 45.0), ("lift_right", 110.0), ("tilt", 45.0)])
def test_faster_than_permitted_is_named(axis: str, speed: float) -> None:
    figures = FIGURES[axis]
    needed_s = figures.overspeed_margin / (speed - 1.5 * figures.speed)
    assert watch(axis, ramp(speed), to(900.0, 0.95), 4.0)["overspeed"] < 1.0 + needed_s + 0.25


def test_making_up_for_a_lag_is_not_overspeed() -> None:
    assert watch("rotation", ramp(30.0, to=50.0), to(50.0, 0.95), 4.0) == {}
    assert watch("lift_left", ramp(71.0, to=200.0), to(200.0, 0.95), 6.0) == {}


# -- readings ---------------------------------------------------------------------------------------------------------


def test_a_reading_seen_before_is_no_new_one() -> None:
    """A device that has gone silent is judged by whoever misses it, not as one that stands still."""
    monitor = PlausibilityMonitor(FIGURES)
    for tick in range(200):
        s = AxisSample("rotation", 0.0, 0.0, 0.0, 30.0, True)
        assert monitor.judge((s,), tick * TICK_S) == ()


def test_nothing_is_concluded_across_a_gap_or_an_invalid_reading() -> None:
    """Lost for a while and turned by hand meanwhile: what is found afterwards is where it rests."""
    for gap in (True, False):
        monitor = PlausibilityMonitor(FIGURES)
        for tick in range(300):
            now_s = tick * TICK_S
            away = 2.0 < now_s < 3.0
            sample = AxisSample("rotation", 0.0 if now_s < 2.5 else 40.0, now_s, 0.0, None, False)
            samples = () if away and not gap else (sample,)
            if away and gap:
                continue
            assert monitor.judge(samples, now_s) == ()


@pytest.mark.parametrize(
    ("torque_on", "lifecycle", "stops"),
    [
        (False, Lifecycle.STANDBY, False),
        (True, Lifecycle.STANDBY, True),
        (None, Lifecycle.STANDBY, True),
        (False, Lifecycle.ACTIVE, True),
    ],
)
def test_a_disarmed_blade_without_torque_may_be_turned_by_hand(
    torque_on: bool | None, lifecycle: Lifecycle, stops: bool
) -> None:
    """As bring-up and the calibration ask for; with torque, or where nobody knows, a turn is uncommanded."""
    monitor, seen = PlausibilityMonitor(FIGURES), set()
    for tick in range(150):
        now_s = tick * TICK_S
        told = RotatorTelemetry(
            angle_deg=Reading(max(0.0, now_s - 1.0) * 15.0, now_s, True),
            velocity_deg_per_s=Reading(15.0 if now_s > 1.0 else 0.0, now_s, True),
            torque_on=None if torque_on is None else Reading(torque_on, now_s, True),
        )
        sample = axis_sample("rotation", lifecycle, told)
        seen |= {fault.condition for fault in monitor.judge(() if sample is None else (sample,), now_s)}
    assert ("moving_uncommanded" in seen) is stops


def test_arming_and_disarming_begin_anew() -> None:
    """Torque goes on or off: where the blade stands then is where it is held."""
    course = ramp(0.45, from_s=2.0, to=0.45)
    course2: Course = lambda t: course(t) + (0.45 if t > 3.6 else 0.0)  # noqa: E731
    assert watch("rotation", course2, lambda _: None, 8.0, powered=lambda t: t < 3.4) == {}
    assert "moving_uncommanded" in watch("rotation", course2, lambda _: None, 8.0)


def test_every_axis_is_judged_by_its_own_readings() -> None:
    monitor = PlausibilityMonitor(FIGURES)
    names: set[str] = set()
    for tick in range(150):
        now_s = tick * TICK_S
        samples = [AxisSample(axis, 0.0, now_s, None, None, True) for axis in FIGURES if axis != "lift_right"]
        samples.append(AxisSample("lift_right", 5.0 * max(0.0, now_s - 1.0), now_s, None, None, True, 2.5))
        found = monitor.judge(samples, now_s)
        names |= {fault.name for fault in found}
        assert all("2.5 A" in fault.detail and " mm " in fault.detail for fault in found)
    assert names == {"lift_right.uncommanded_motion"}
