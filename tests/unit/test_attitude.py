"""Blade attitude: extensions to height, slope and pitch and back; and the pair of lifts kept together."""

from __future__ import annotations

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


@pytest.mark.parametrize("slope_deg", [90.0, 178.0, 180.0, 361.0, -180.0, 1e308])
def test_what_is_steeper_than_upright_is_out_of_reach(slope_deg: float) -> None:
    """The tangent begins anew beyond 90 deg: a slope of 180 deg was taken for level, and the blade went there."""
    left_mm, right_mm = lift_extensions(AttitudeGeometry(), Attitude(100.0, slope_deg))
    assert abs(left_mm - right_mm) > 1e6
    assert (left_mm > right_mm) is (slope_deg > 0)


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


def test_both_hold_while_one_is_silent_and_go_on_when_it_is_heard() -> None:
    pair = LiftPair()
    pair.step(1.0, reading(100.0, 1.0), reading(100.0, 1.0), 150.0, 150.0)
    for age_s, holds in ((0.12, False), (0.15, True), (0.34, True)):
        command = pair.step(1.0 + age_s, reading(100.0, 1.0 + age_s), reading(100.0, 1.0), 150.0, 150.0)
        assert [side.target_mm is None for side in (command.left, command.right)] == [holds, holds]
        assert not command.stopped
    command = pair.step(1.35, reading(100.0, 1.35), reading(100.0, 1.35), 150.0, 150.0)
    assert command.left.target_mm == command.right.target_mm == 150.0


def test_no_side_is_told_to_go_faster_than_its_axis_may() -> None:
    pair, at_mm, now_s = LiftPair(max_speed_mm_per_s=20.0), 100.0, 0.0
    for _ in range(200):
        command = pair.step(now_s, reading(at_mm, now_s), reading(at_mm, now_s), 250.0, 250.0)
        now_s, at_mm = now_s + 0.02, at_mm + 0.02 * 33.0 * command.left.speed_share
    assert at_mm < 250.0, "it is still on its way"
    assert command.left.speed_share * 33.0 == pytest.approx(20.0, rel=0.1)


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


def test_a_side_that_sticks_holds_the_other_with_the_next_reading() -> None:
    """Both run at 33 mm/s; then one stands. Half of the way to the next reading is enough to know."""
    for stands_ms in (0, 20, 40):
        pair, at_mm, held_s = LiftPair(), [100.0, 100.0], 0.0
        left, right = reading(100.0, 0.0), reading(100.0, 0.0)
        for ms in range(0, 2000, 20):
            now_s = ms / 1000.0
            if ms % 100 == 0:
                left, right = reading(at_mm[0], now_s), reading(at_mm[1], now_s)
            command = pair.step(now_s, left, right, 250.0, 250.0)
            if command.left.target_mm is None:
                held_s = now_s
                break
            at_mm[0] += 0.66 if ms >= 200 else 0.0
            at_mm[1] += 0.66 if 200 <= ms < 1000 + stands_ms else 0.0
        assert command.right.target_mm is not None, "it is let come up"
        assert held_s == pytest.approx(1.1), stands_ms
        assert not command.stopped


def test_sides_far_apart_are_reported_and_then_stopped() -> None:
    pair = LiftPair()
    pair.step(0.0, reading(100, 0), reading(100, 0), 200.0, 200.0)
    command = pair.step(0.1, reading(104.0, 0.1), reading(100.0, 0.1), 200.0, 200.0)
    assert command.condition == "sides_apart"
    assert command.apart_mm == pytest.approx(4.0)
    command = pair.step(0.2, reading(109.0, 0.2), reading(100.0, 0.2), 200.0, 200.0)
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
    pair, now_s = LiftPair(LiftPairSettings(stop_apart_mm=10.0)), 0.0
    for left_mm, right_mm, left_target_mm, right_target_mm, wait_s in steps:
        now_s += wait_s
        command = pair.step(now_s, reading(left_mm, now_s), reading(right_mm, now_s), left_target_mm, right_target_mm)
        for side in (command.left, command.right):
            assert 0.0 < side.speed_share <= 1.0
            assert side.target_mm is None or abs(side.target_mm) < 1e6


@pytest.mark.parametrize("nothing", [0.0, -1e-300, 1e300])
def test_a_tilt_that_pitches_nothing_or_anything_is_refused_before_a_jog_divides_by_it(nothing: float) -> None:
    with pytest.raises(ValidationError, match="tilt_deg_per_mm"):
        AttitudeGeometry(tilt_deg_per_mm=nothing)
