"""The servo's lifecycle: every state and every event, and what must never follow."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.dynamixel.motion import MoveProfile, ServoMotion, possible, rest_deg
from graderd.drivers.dynamixel.servo_task import Event, after
from graderd.hal.device import Lifecycle


@pytest.mark.parametrize(("state", "event"), list(product(Lifecycle, Event)))
def test_every_state_and_event(state: Lifecycle, event: Event) -> None:
    new = after(state, event)
    if new is Lifecycle.ACTIVE:  # nothing but arming a servo in standby makes it active, nothing keeps it so
        assert (state, event) == (Lifecycle.STANDBY, Event.ARMED) or (
            state is Lifecycle.ACTIVE and event in (Event.ARMED, Event.OPENED, Event.FOUND)
        )
    if state is Lifecycle.CLOSED:  # what is still under way when it is closed does not open it again
        assert new is (Lifecycle.STANDBY if event is Event.OPENED else Lifecycle.CLOSED)
    if event is Event.CLOSED:
        assert new is Lifecycle.CLOSED
    if event is Event.LOST:
        assert new in (Lifecycle.FAILED, Lifecycle.CLOSED)
    if state is Lifecycle.FAILED:
        assert new in (Lifecycle.FAILED, Lifecycle.STANDBY, Lifecycle.CLOSED)


SPEEDS = st.floats(-200.0, 200.0)
ANGLES = st.floats(-170.0, 170.0)
BRAKING_DEG_PER_S2 = 600.0
MOVE = MoveProfile(30.0, 60.0)


@given(ANGLES, SPEEDS, st.floats(0.0, 0.2), st.one_of(st.none(), ANGLES))
def test_a_hold_never_turns_back_and_never_passes_the_goal_ahead(
    at_deg: float, speed: float, age_s: float, goal_deg: float | None
) -> None:
    motion = ServoMotion(10.0, at_deg, speed, at_deg, speed)
    rest = rest_deg(motion, 10.0 + age_s, BRAKING_DEG_PER_S2, goal_deg, MOVE)
    ahead = 1.0 if speed > 0 else -1.0
    way, brake = ahead * (rest - at_deg), speed**2 / (2.0 * BRAKING_DEG_PER_S2)
    fastest = max(abs(speed), min(MOVE.deg_per_s, abs(speed) + MOVE.deg_per_s2 * age_s))
    most = fastest * age_s + fastest**2 / (2.0 * BRAKING_DEG_PER_S2) + 1e-9
    assert -1e-9 <= way <= most
    assert way == 0.0 or abs(speed) >= 0.6  # what stands stays where it is, however old the reading
    if goal_deg is not None and 0.0 <= ahead * (goal_deg - at_deg) < brake:
        assert rest == pytest.approx(goal_deg) or abs(speed) < 0.6
    if goal_deg is None and abs(speed) >= 0.6:
        assert way == pytest.approx(abs(speed) * age_s + brake)


def test_a_set_point_ahead_is_not_called_back() -> None:
    motion = ServoMotion(0.0, 10.0, 30.0, 12.0, 30.0)
    assert rest_deg(motion, 0.0, BRAKING_DEG_PER_S2, None, MOVE) == pytest.approx(12.75)
    jammed = ServoMotion(0.0, 10.0, 0.0, 20.0, 0.0)  # but a stuck blade stays where it is
    assert rest_deg(jammed, 0.0, BRAKING_DEG_PER_S2, 20.0, MOVE) == 10.0


@pytest.mark.parametrize("speed", [1.0, 10.0, 29.0, 30.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_blade_that_may_have_sped_up_since_its_reading_is_not_called_back(speed: float, side: float) -> None:
    """On a line that loses readings it is held while it speeds up; goal and reading mirrored for ``side``."""
    age_s, at_deg = 0.1, 0.0
    now_deg, now_deg_per_s = 0.0, speed
    for _ in range(1200):  # as the servo's profile moves it
        now_deg_per_s = min(30.0, now_deg_per_s + 60.0 * age_s / 1200)
        now_deg += now_deg_per_s * age_s / 1200
    motion = ServoMotion(0.0, at_deg, side * speed, at_deg, side * speed)
    rest = side * rest_deg(motion, age_s, BRAKING_DEG_PER_S2, side * 40.0, MOVE)
    assert rest == pytest.approx(now_deg + now_deg_per_s**2 / (2.0 * BRAKING_DEG_PER_S2), abs=0.02)


@pytest.mark.parametrize("age_s", [0.02, 0.1, 0.28, 1.0])
def test_a_blade_that_turns_back_to_its_goal_is_not_sent_on(age_s: float) -> None:
    """Nothing heard for as long: it has braked since, and turned; its former speed would take it far the wrong way."""
    motion = ServoMotion(0.0, 0.0, 30.0, 0.0, 30.0)
    assert rest_deg(motion, age_s, BRAKING_DEG_PER_S2, -20.0, MOVE) <= 30.0**2 / (2.0 * MOVE.deg_per_s2)


@given(ANGLES, SPEEDS, SPEEDS, st.floats(0.0, 1.0), st.floats(0.001, 0.1))
def test_what_a_servo_can_do_is_possible(at_deg: float, v1: float, v2: float, share: float, took_s: float) -> None:
    went = (v1 + share * (v2 - v1)) * took_s
    assert possible(ServoMotion(0.0, at_deg, v1, 0, 0), ServoMotion(took_s, at_deg + went, v2, 0, 0), 300.0)


@given(ANGLES, st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.floats(5.0, 360.0), st.sampled_from((-1.0, 1.0)))
def test_a_reading_that_jumps_is_not(at_deg: float, v1: float, v2: float, off_deg: float, side: float) -> None:
    before = ServoMotion(0.0, at_deg, v1, 0, 0)
    assert not possible(before, ServoMotion(0.02, at_deg + side * off_deg, v2, 0, 0), 300.0)
    assert not possible(before, ServoMotion(0.5, at_deg, v2, 0, 0), 300.0)  # too long ago to vouch for anything
