"""The gate: dense sweeps around every bound, and nothing gets out when it should not."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graderd.config import Config
from graderd.core.axes import AXES, LIFTS, Goals, Pose
from graderd.core.gate import STANDING_S, GateInputs, GateSettings, GateState, Setpoint, pass_gate
from graderd.core.machine import ARMED, Mode
from graderd.hal.settings import ElectrakSettings, Ph54Settings

SETTINGS = GateSettings()
FIGURES = Config().figures()
REGULATED = {axis: replace(figures, profile_in_device=False) for axis, figures in FIGURES.items()}
"""As for devices without a profile of their own: the gate itself moves every goal with speed and acceleration."""
POSE = Pose(0.0, 100.0, 100.0, 50.0)
DT_S = 0.02
PACED = ("rotation", "tilt")
"""The axes whose speed is the gate's; the lifts' is the lift pair's."""
FIELDS = {"rotation": "rotation_deg", "lift_left": "lift_left_mm", "lift_right": "lift_right_mm", "tilt": "tilt_mm"}


def inputs(**changes: object) -> GateInputs:
    return GateInputs(SETTINGS, FIGURES, Mode.MANUAL, POSE, DT_S, lease_ok=True, height_mm=0.0)._replace(**changes)  # type: ignore[arg-type]


def goal(axis: str, value: float) -> Goals:
    return Goals(**{FIELDS[axis]: value})


def drive(goals: Goals, given_inputs: GateInputs, ticks_n: int, follow: bool = True) -> list[dict[str, float | None]]:
    """Run the gate for some ticks on a machine that follows perfectly (or not at all); what came out, tick by tick."""
    state, seen = GateState(), []
    for _ in range(ticks_n):
        state, passed = pass_gate(state, goals, given_inputs)
        seen.append({axis: result.limited for axis, result in passed.items()})
        if follow:
            pose = given_inputs.pose
            for axis, field in FIELDS.items():
                if passed[axis].limited is not None:
                    pose = replace(pose, **{field: passed[axis].limited})
            given_inputs = given_inputs._replace(pose=pose)
    return seen


@pytest.mark.parametrize("mode", [Mode.DISARMED, Mode.STOPPED])
@pytest.mark.parametrize("axis", AXES)
def test_disarmed_or_stopped_only_staying_is_allowed(mode: Mode, axis: str) -> None:
    state, passed = pass_gate(GateState(), goal(axis, 20.0), inputs(mode=mode))
    assert all(result.limited is None for result in passed.values())
    assert str(mode) in passed[axis].reason
    assert not state.setpoints


@pytest.mark.parametrize("axis", AXES)
def test_no_goal_no_motion(axis: str) -> None:
    _, passed = pass_gate(GateState(), Goals(), inputs())
    assert passed[axis].limited is None
    assert passed[axis].reason == ""


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_only_finite_numbers(axis: str, value: float) -> None:
    _, passed = pass_gate(GateState(), goal(axis, value), inputs())
    assert passed[axis].limited is None
    assert "finite" in passed[axis].reason


@pytest.mark.parametrize("axis", AXES)
def test_no_motion_without_a_measurement(axis: str) -> None:
    _, passed = pass_gate(GateState(), goal(axis, 20.0), inputs(pose=replace(POSE, **{FIELDS[axis]: None})))
    assert passed[axis].limited is None
    assert "measurement" in passed[axis].reason
    _, passed = pass_gate(GateState(), goal(axis, 20.0), inputs(pose=replace(POSE, **{FIELDS[axis]: math.nan})))
    assert passed[axis].limited is None
    assert "measurement" in passed[axis].reason


@pytest.mark.parametrize("axis", AXES)
def test_no_motion_without_the_lease(axis: str) -> None:
    _, passed = pass_gate(GateState(), goal(axis, 20.0), inputs(lease_ok=False))
    assert passed[axis].limited is None
    assert "lease" in passed[axis].reason


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("side", ["low", "high"])
def test_absolute_limits_swept_densely(axis: str, side: str) -> None:
    limits = FIGURES[axis]
    bound = getattr(limits, side)
    start = replace(POSE, **{FIELDS[axis]: bound - 1.0 if side == "high" else bound + 1.0})
    for step in range(-40, 41):
        wanted = bound + step * 0.01
        end = drive(goal(axis, wanted), inputs(pose=start), 80)[-1][axis]
        assert end is not None
        assert limits.low <= end <= limits.high
        assert end == pytest.approx(min(max(wanted, limits.low), limits.high), abs=1e-9)
        _, passed = pass_gate(GateState(), goal(axis, wanted), inputs(pose=start))
        outside = wanted < limits.low or wanted > limits.high
        assert bool(passed[axis].reason) is outside


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_window_around_the_armed_pose(axis: str, sign: float) -> None:
    narrow = {axis: replace(figures, window=5.0) for axis, figures in FIGURES.items()}
    start = getattr(POSE, FIELDS[axis])
    for step in range(-20, 21):
        offset = 5.0 + step * 0.05
        seen = drive(goal(axis, start + sign * offset), inputs(figures=narrow), 300)
        end = seen[-1][axis]
        assert end is not None
        assert abs(end - start) <= 5.0 + 1e-9
        assert end == pytest.approx(start + sign * min(offset, 5.0), abs=1e-9)
    _, passed = pass_gate(GateState(), goal(axis, start + sign * 5.1), inputs(figures=narrow))
    assert "window" in passed[axis].reason


@pytest.mark.parametrize("axis", PACED)
def test_speed_and_acceleration_are_limited_and_it_arrives_without_overshoot(axis: str) -> None:
    limits = FIGURES[axis]
    start = getattr(POSE, FIELDS[axis])
    wanted = start + 0.6 * (limits.high - start)
    path = [start, *[tick[axis] for tick in drive(goal(axis, wanted), inputs(figures=REGULATED), 1500)]]
    speeds = [(b - a) / DT_S for a, b in pairwise(path)]
    assert max(speeds) <= limits.speed + 1e-6
    assert max(speeds) == pytest.approx(limits.speed, rel=0.02)
    assert min(speeds) >= -1e-9
    changes = [(b - a) / DT_S for a, b in pairwise([0.0, *speeds])]
    assert max(changes) <= limits.acceleration + 1e-6
    # The last tick's rounding on to the goal may brake a little harder than the ramp.
    assert min(changes) >= -3.0 * limits.acceleration - 1e-6
    assert path[-1] == wanted


@given(st.lists(st.tuples(st.floats(-200, 200), st.booleans()), min_size=1, max_size=60))
@settings(max_examples=200)
def test_whatever_is_asked_the_goal_stays_inside_and_slow(asked: list[tuple[float, bool]]) -> None:
    limits = FIGURES["rotation"]
    state, pose, last = GateState(), POSE, 0.0
    for value, lease in asked:
        step = inputs(figures=REGULATED, pose=pose, lease_ok=lease)
        state, passed = pass_gate(state, Goals(rotation_deg=value), step)
        limited = passed["rotation"].limited
        if limited is None:
            assert not lease
            continue
        assert limits.low <= limited <= limits.high
        assert abs(limited - last) <= limits.speed * DT_S + 1e-6
        last = limited
        pose = replace(pose, rotation_deg=limited)


@given(st.lists(st.tuples(st.floats(-200, 200), st.floats(-75, 75)), min_size=1, max_size=60))
@settings(max_examples=200)
def test_a_device_with_its_own_profile_gets_the_goal_itself_inside_and_near(asked: list[tuple[float, float]]) -> None:
    limits, state = replace(FIGURES["rotation"], window=1000.0), GateState()
    for value, measured in asked:
        step = inputs(figures=FIGURES | {"rotation": limits}, pose=replace(POSE, rotation_deg=measured))
        state, passed = pass_gate(state, Goals(rotation_deg=value), step)
        limited = passed["rotation"].limited
        assert limited is not None
        assert limits.low <= limited <= limits.high
        inside = min(max(value, limits.low), limits.high)
        if limits.low <= measured <= limits.high:
            assert limited == pytest.approx(min(max(inside, measured - limits.lead), measured + limits.lead)) or (
                abs(limited - measured) < limits.lead  # it stands although it is asked to move: the lead shrinks
            )


@pytest.mark.parametrize("axis", PACED)
@pytest.mark.parametrize("share", [0.0, 0.31, 0.83, 1.0])
def test_late_ticks_do_not_carry_it_past_a_standing_goal(axis: str, share: float) -> None:
    """On a busy machine ticks come late, and with them the braking; the axis's own limits are among the goals."""
    limits = FIGURES[axis]
    wanted = limits.low + share * (limits.high - limits.low)
    for seed in range(30):
        ticks = random.Random(seed)
        state, pose, last = GateState(), POSE, getattr(POSE, FIELDS[axis])
        while last != wanted:
            dt_s = ticks.choice((0.001, 0.01, 0.02, 0.02, 0.021, 0.04, 0.08, 0.2))
            step = inputs(figures=REGULATED, pose=pose, dt_s=dt_s)
            state, passed = pass_gate(state, goal(axis, wanted), step)
            limited = passed[axis].limited
            assert limited is not None
            assert min(last, wanted) <= limited <= max(last, wanted)
            assert abs(limited - last) <= limits.speed * dt_s + 1e-6
            last = limited
            pose = replace(pose, **{FIELDS[axis]: limited})


@given(st.lists(st.tuples(st.floats(-70, 70), st.sampled_from((0.005, 0.02, 0.05, 0.2))), min_size=1, max_size=80))
@settings(max_examples=200)
def test_with_goals_that_change_and_ticks_that_are_late_it_stays_inside(asked: list[tuple[float, float]]) -> None:
    narrow = FIGURES | {"rotation": replace(FIGURES["rotation"], window=8.0)}
    for figures, low, high in ((FIGURES, -60.0, 60.0), (narrow, 42.0, 58.0)):
        state, pose = GateState(), replace(POSE, rotation_deg=50.0)
        for value, dt_s in asked:
            step = inputs(figures=figures, pose=pose, dt_s=dt_s)
            state, passed = pass_gate(state, Goals(rotation_deg=value), step)
            limited = passed["rotation"].limited
            assert limited is not None
            assert low <= limited <= high
            pose = replace(pose, rotation_deg=limited)


def test_a_goal_moved_nearer_than_the_way_to_stop_is_passed_and_come_back_to() -> None:
    limits = FIGURES["rotation"]
    way_to_stop = limits.speed**2 / (2.0 * limits.acceleration)
    state = GateState({"rotation": Setpoint(0.0, limits.speed, 0.0)})
    seen, pose = [0.0], POSE
    for _ in range(400):
        state, passed = pass_gate(state, goal("rotation", 0.5 * way_to_stop), inputs(figures=REGULATED, pose=pose))
        limited = passed["rotation"].limited
        assert limited is not None
        seen.append(limited)
        pose = replace(pose, rotation_deg=limited)
    assert 0.9 * way_to_stop < max(seen) < 1.1 * way_to_stop
    assert seen[-1] == 0.5 * way_to_stop


@pytest.mark.parametrize(("at", "first"), [(61.0, 61.0), (-61.0, -61.0)])
def test_pushed_outside_it_goes_in_and_never_further_out(at: float, first: float) -> None:
    sign = math.copysign(1.0, at)
    outward = GateState({"rotation": Setpoint(at, sign * 20.0, at)})
    pushed = inputs(figures=REGULATED, pose=replace(POSE, rotation_deg=at))
    _, passed = pass_gate(outward, goal("rotation", 0.0), pushed)
    assert passed["rotation"].limited == first
    at_rest = GateState({"rotation": Setpoint(at, 0.0, at)})
    _, passed = pass_gate(at_rest, goal("rotation", 50.0 * sign), pushed)
    limited = passed["rotation"].limited
    assert limited is not None
    assert 60.0 < abs(limited) < 61.0


def test_rotation_waits_for_the_blade_height() -> None:
    high = SETTINGS.model_copy(update={"rotation_min_height_mm": 50.0})
    for height_mm in [None, *[49.0 + 0.1 * i for i in range(10)]]:
        _, passed = pass_gate(GateState(), goal("rotation", 10.0), inputs(settings=high, height_mm=height_mm))
        assert passed["rotation"].limited is None
        assert "height" in passed["rotation"].reason
    for height_mm in (50.0, 50.1, 80.0):
        _, passed = pass_gate(GateState(), goal("rotation", 10.0), inputs(settings=high, height_mm=height_mm))
        assert passed["rotation"].limited is not None
    _, passed = pass_gate(GateState(), goal("tilt", 60.0), inputs(settings=high, height_mm=0.0))
    assert passed["tilt"].limited is not None


def test_after_a_hold_it_starts_again_from_the_measured_position_at_rest() -> None:
    state, given_inputs = GateState(), inputs(figures=REGULATED)
    for _ in range(20):
        state, _ = pass_gate(state, goal("rotation", 40.0), given_inputs)
    pushed = replace(POSE, rotation_deg=-3.0)
    state, passed = pass_gate(state, Goals(), inputs(pose=pushed))
    assert passed["rotation"].limited is None
    assert (state.setpoints["rotation"].position, state.setpoints["rotation"].speed) == (-3.0, 0.0)
    state, passed = pass_gate(state, goal("rotation", 40.0), inputs(figures=REGULATED, pose=pushed))
    limits = FIGURES["rotation"]
    assert passed["rotation"].limited == pytest.approx(-3.0 + limits.acceleration * DT_S * DT_S)


def test_what_is_pushed_while_it_is_held_starts_from_where_it_is_now() -> None:
    """Not from where it was in the tick before: that would be a leap in the very first tick."""
    state, _ = pass_gate(GateState(), Goals(), inputs())
    pushed = replace(POSE, rotation_deg=-30.0)
    _, passed = pass_gate(state, goal("rotation", 40.0), inputs(pose=pushed, figures=REGULATED))
    limits = REGULATED["rotation"]
    assert passed["rotation"].limited == pytest.approx(-30.0 + limits.acceleration * DT_S * DT_S)


@pytest.mark.parametrize("axis", PACED)
def test_a_late_tick_is_not_made_up_for(axis: str) -> None:
    """Drivers have held meanwhile: the goal goes on from there as if the tick had not been so late."""
    limits = FIGURES[axis]
    state = GateState({axis: Setpoint(getattr(POSE, FIELDS[axis]), limits.speed, getattr(POSE, FIELDS[axis]))})
    for late_s in (0.11, 0.4, 3.0, 1e6):
        _, passed = pass_gate(state, goal(axis, limits.high), inputs(dt_s=late_s, figures=REGULATED))
        limited = passed[axis].limited
        assert limited is not None
        assert limited - getattr(POSE, FIELDS[axis]) <= 0.1 * limits.speed + 1e-9


def test_a_measurement_lost_in_motion_holds_and_keeps_the_armed_pose() -> None:
    state, _ = pass_gate(GateState(), goal("rotation", 40.0), inputs())
    lost = inputs(pose=replace(POSE, rotation_deg=None))
    state, passed = pass_gate(state, goal("rotation", 40.0), lost)
    assert passed["rotation"].limited is None
    assert state.setpoints["rotation"].speed == 0.0
    assert state.setpoints["rotation"].armed_at == 0.0


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_axis_that_is_held_back_is_not_led_far(axis: str, sign: float) -> None:
    limits = FIGURES[axis]
    start = getattr(POSE, FIELDS[axis])
    wanted = limits.high if sign > 0 else limits.low
    for offset in (-1e-6, 0.0, 1e-6):
        setpoint = Setpoint(start + sign * (limits.lead + offset), 0.0, start)
        _, passed = pass_gate(GateState({axis: setpoint}), goal(axis, wanted), inputs(dt_s=1e-9))
        limited = passed[axis].limited
        assert limited is not None
        assert abs(limited - start) <= limits.lead
        assert abs(limited - start) == pytest.approx(limits.lead, abs=2e-6)


@pytest.mark.parametrize("axis", PACED)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_lead_shrinks_while_the_axis_stands_and_only_then(axis: str, sign: float) -> None:
    """A jam that frees snaps no further than what is left of the lead; an axis that works its way has all of it."""
    limits = FIGURES[axis]
    start = getattr(POSE, FIELDS[axis])
    wanted = limits.high if sign > 0 else limits.low

    def led(speed: float, seconds: float) -> list[float]:
        """The leads of an axis that moves slowly, whatever it is told."""
        state, at, leads = GateState(), start, []
        for _ in range(round(seconds / DT_S)):
            state, passed = pass_gate(state, goal(axis, wanted), inputs(pose=replace(POSE, **{FIELDS[axis]: at})))
            at += sign * speed * DT_S
            limited = passed[axis].limited
            assert limited is not None
            leads.append(abs(limited - at))
        return leads

    jammed = led(0.0, 3.0)
    assert max(jammed) < 0.8 * limits.lead or limits.profile_in_device
    settled = jammed[round((STANDING_S + limits.lead / limits.speed + 0.3) / DT_S) :]
    assert max(settled) <= max(0.2 * limits.lead, limits.tolerance) + 1e-9
    assert min(settled) > limits.tolerance, "the driver must see that it was told to move"
    assert max(led(0.15 * limits.lead, 3.0)) > 0.95 * limits.lead, "slow, held back by soil: this is work"


def test_the_lead_is_whole_again_once_the_axis_moves() -> None:
    state = GateState({"rotation": Setpoint(2.0, 0.0, 0.0, moved_at=0.0, standing_s=5.0)})
    for angle in (0.1, 0.3):
        state, _ = pass_gate(state, goal("rotation", 40.0), inputs(pose=replace(POSE, rotation_deg=angle)))
    assert state.setpoints["rotation"].standing_s == 0.0


@pytest.mark.parametrize("axis", LIFTS)
def test_the_lifts_go_where_the_pair_says_inside_bounds_and_lead(axis: str) -> None:
    """The pair is asked with bounded goals only, and has no way around the gate."""
    limits, asked = FIGURES[axis], []

    def pace(says: float | None) -> float | None:
        def paced(goals: Goals) -> Goals:
            asked.append(goals[axis])
            return Goals.of(**{axis: says})

        _, passed = pass_gate(GateState(), goal(axis, 400.0), inputs(), paced)
        assert passed[axis].bounded == limits.high
        return passed[axis].limited

    assert pace(None) is None
    assert pace(101.0) == 101.0
    assert pace(400.0) == 100.0 + limits.lead
    assert pace(-400.0) == 100.0 - limits.lead
    assert set(asked) == {limits.high}
    for refused in (
        inputs(lease_ok=False),
        inputs(mode=Mode.STOPPED),
        inputs(pose=replace(POSE, **{FIELDS[axis]: None})),
    ):
        _, passed = pass_gate(GateState(), goal(axis, 150.0), refused, lambda _: Goals.of(**{axis: 150.0}))
        assert passed[axis].limited is None


def test_the_leash_never_leads_outside_the_limits() -> None:
    outside = replace(POSE, rotation_deg=75.0)
    state = GateState({"rotation": Setpoint(60.0, 0.0, 0.0)})
    _, passed = pass_gate(state, goal("rotation", 0.0), inputs(pose=outside))
    assert passed["rotation"].limited == 60.0


def test_no_time_no_motion() -> None:
    state, _ = pass_gate(GateState(), goal("rotation", 40.0), inputs())
    after, passed = pass_gate(state, goal("rotation", 40.0), inputs(dt_s=0.0))
    assert after.setpoints["rotation"] == state.setpoints["rotation"]
    assert passed["rotation"].limited == state.setpoints["rotation"].position


def test_disarming_forgets_the_window() -> None:
    state, _ = pass_gate(GateState(), goal("rotation", 40.0), inputs())
    assert state.setpoints
    state, _ = pass_gate(state, Goals(), inputs(mode=Mode.DISARMED))
    assert not state.setpoints


@pytest.mark.parametrize("mode", ARMED)
def test_armed_modes_move(mode: Mode) -> None:
    _, passed = pass_gate(GateState(), goal("rotation", 40.0), inputs(mode=mode))
    assert passed["rotation"].limited is not None
    assert passed["rotation"].limited > 0.0


def test_limits_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ValueError, match="below"):
        Ph54Settings(min_deg=10.0, max_deg=10.0)
    with pytest.raises(ValueError, match="below"):
        ElectrakSettings(min_mm=10.0, max_mm=5.0)
