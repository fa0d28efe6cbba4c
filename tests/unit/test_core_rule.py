"""The paper's rule, and how sure it must be."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.core.rule import Decision, RuleSettings, Travel, decide
from graderd.core.soil import SoilAhead, SoilObservation, Thirds, Zone

RULE = RuleSettings()
STANDING = Travel(0.0, 0.0, 0.0)
SPREAD = (12.0, 20.0, 12.0)
"""A carried heap, litres, spread over the whole blade as every heap is within a metre."""
SHARES = {
    Zone.LEFT: (0.8, 0.15, 0.05),
    Zone.CENTER: (0.1, 0.8, 0.1),
    Zone.RIGHT: (0.05, 0.15, 0.8),
    Zone.EVEN: (0.33, 0.34, 0.33),
    Zone.NONE: (0.0, 0.0, 0.0),
    Zone.UNKNOWN: (0.0, 0.0, 0.0),
}


def seen(zone: Zone, capture_s: float, confidence: float = 0.9, shares: tuple[float, ...] = ()) -> SoilObservation:
    left, center, right = shares or SHARES[zone]
    return SoilObservation(capture_s, zone, confidence, "", left, center, right)


def apart(ahead: Zone, carried: tuple[float, float, float], capture_s: float) -> SoilObservation:
    """Soil of which the method could tell what lies ahead; ``zone`` is what all of it looks like together."""
    litres = Thirds(*(20.0 * share for share in SHARES[ahead]))
    both = {
        Zone.LEFT: litres.left + carried[0],
        Zone.CENTER: litres.center + carried[1],
        Zone.RIGHT: litres.right + carried[2],
    }
    total = sum(both.values())
    zone = (
        Zone.NONE if total < 1.0 else Zone.EVEN if min(both.values()) > 0.2 * total else max(both, key=both.__getitem__)
    )
    return replace(seen(zone, capture_s), ahead=SoilAhead(ahead, 0.9, "", litres), carried=Thirds(*carried))


def run(
    zones: list[Zone],
    start: Decision | None = None,
    start_s: float = 100.0,
    step_s: float = 0.066,
    travel: Travel | None = STANDING,
) -> Decision:
    decision = start or Decision()
    for index, zone in enumerate(zones):
        now_s = start_s + index * step_s
        told = travel and replace(travel, time_s=now_s)
        decision = decide(decision, seen(zone, now_s), settled=True, now_s=now_s, rule=RULE, travel=told)
    return decision


def drive(
    decision: Decision,
    ahead: Zone,
    carried: tuple[float, float, float] = (0.0, 0.0, 0.0),
    metres: float = 1.0,
    speed: float = 0.5,
    at: tuple[float, float] = (100.0, 0.0),
) -> tuple[Decision, tuple[float, float]]:
    """Drive so far with this before the blade, a picture every 66 ms; returns the decision and (time, travel) then."""
    now_s, travelled_m = at
    for _ in range(round(metres / speed / 0.066)):
        now_s, travelled_m = now_s + 0.066, travelled_m + 0.066 * speed
        decision = decide(decision, apart(ahead, carried, now_s), True, now_s, RULE, Travel(speed, travelled_m, now_s))
    return decision, (now_s, travelled_m)


def stand(
    decision: Decision, ahead: Zone, at: tuple[float, float], seconds: float
) -> tuple[Decision, tuple[float, float]]:
    now_s, travelled_m = at
    for _ in range(round(seconds / 0.066)):
        now_s += 0.066
        decision = decide(decision, apart(ahead, (0, 0, 0), now_s), True, now_s, RULE, Travel(0.0, travelled_m, now_s))
    return decision, (now_s, travelled_m)


@pytest.mark.parametrize(
    ("zone", "angle_deg"), [(Zone.LEFT, 30.0), (Zone.RIGHT, -30.0), (Zone.CENTER, 15.0), (Zone.EVEN, 45.0)]
)
def test_the_papers_angles(zone: Zone, angle_deg: float) -> None:
    decision = run([zone] * 6)
    assert (decision.zone, decision.angle_deg) == (zone, angle_deg)


@pytest.mark.parametrize("zone", [Zone.NONE, Zone.UNKNOWN])
def test_none_and_unknown_hold_the_present_angle(zone: Zone) -> None:
    assert run([zone] * 20).angle_deg is None
    turned = run([Zone.LEFT] * 6)
    assert run([zone] * 50, turned, 110.0).angle_deg == 30.0


def test_one_vote_less_than_needed_decides_nothing() -> None:
    votes = [Zone.LEFT] * (RULE.votes_needed_n - 1) + [Zone.UNKNOWN] * (RULE.votes_window_n - RULE.votes_needed_n + 1)
    assert run(votes).zone is None
    assert run([Zone.LEFT] * RULE.votes_needed_n).zone is Zone.LEFT


def test_unsure_votes_do_not_count() -> None:
    decision = Decision()
    for index in range(20):
        vote = seen(Zone.LEFT, index * 0.066, confidence=RULE.min_confidence - 0.01)
        decision = decide(decision, vote, True, index * 0.066, RULE)
    assert decision.zone is None


def test_old_votes_do_not_count() -> None:
    decision = run([Zone.LEFT] * 3)
    late_s = 100.0 + 2 * 0.066 + RULE.vote_max_age_s + 0.01
    assert decide(decision, seen(Zone.LEFT, late_s), True, late_s, RULE).zone is None
    assert decide(decision, seen(Zone.LEFT, late_s - RULE.vote_max_age_s - 1), True, late_s, RULE).votes == ()


def test_votes_are_dropped_while_the_blade_swings() -> None:
    decision = run([Zone.LEFT] * 3)
    decision = decide(decision, seen(Zone.LEFT, 100.3), settled=False, now_s=100.3, rule=RULE)
    assert decision.votes == ()


def test_dwell_separates_decisions() -> None:
    first = run([Zone.LEFT] * 6)
    assert first.zone is Zone.LEFT
    within = run([Zone.RIGHT] * 8, first, first.decided_s + 0.01)
    assert within.zone is Zone.LEFT
    later = run([Zone.RIGHT] * 8, first, first.decided_s + RULE.dwell_s)
    assert later.zone is Zone.RIGHT


def test_a_change_needs_a_clear_share() -> None:
    first = run([Zone.LEFT] * 6)
    now_s = first.decided_s + RULE.dwell_s + 1.0
    decision = first
    for index in range(10):
        at_s = now_s + index * 0.066
        decision = decide(
            decision, seen(Zone.CENTER, at_s, shares=(0.35, 0.6, 0.05)), True, at_s, RULE, Travel(0.0, 0.0, at_s)
        )
    assert decision.zone is Zone.LEFT
    for index in range(10):
        at_s = now_s + 2 + index * 0.066
        decision = decide(
            decision, seen(Zone.CENTER, at_s, shares=(0.15, 0.8, 0.05)), True, at_s, RULE, Travel(0.0, 0.0, at_s)
        )
    assert decision.zone is Zone.CENTER


SPEEDS = st.sampled_from([None, -0.3, 0.0, 0.3])


@given(st.lists(st.tuples(st.sampled_from(list(Zone)), SPEEDS), min_size=1, max_size=300))
def test_never_more_often_than_the_dwell_allows(told: list[tuple[Zone, float | None]]) -> None:
    decision, times, travelled_m = Decision(), [], 0.0
    for index, (zone, speed) in enumerate(told):
        now_s = index * 0.066
        travelled_m += 0.066 * (speed or 0.0)
        travel = None if speed is None else Travel(speed, travelled_m, now_s)
        new = decide(decision, seen(zone, now_s, shares=(1.0, 1.0, 1.0)), True, now_s, RULE, travel)
        if new.zone is not decision.zone:
            times.append(now_s)
        decision = new
    assert all(b - a >= RULE.dwell_s - 1e-9 for a, b in pairwise(times))


def test_more_votes_needed_than_kept_is_refused() -> None:
    with pytest.raises(ValueError, match="votes_needed_n"):
        RuleSettings(votes_needed_n=7, votes_window_n=6)


# ---- one decision a pass --------------------------------------------------------------------------------------------


def test_what_the_blade_carries_does_not_undo_the_decision_of_the_pass() -> None:
    """A center pile ended at 45 degrees: carried it spreads over the blade and looks even."""
    decision, at = drive(Decision(), Zone.CENTER)
    assert (decision.zone, decision.angle_deg, decision.kept) == (Zone.CENTER, 15.0, True)
    assert apart(Zone.NONE, SPREAD, 0.0).zone is Zone.EVEN
    decision, at = drive(decision, Zone.NONE, SPREAD, metres=3.0, at=at)
    assert (decision.zone, decision.angle_deg) == (Zone.CENTER, 15.0)
    assert decision.reason(at[0]) == "center, kept for this pass since 3.9 m"


def test_another_heap_ahead_does_not_turn_the_blade_in_mid_pass() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    decision, at = drive(decision, Zone.RIGHT, (20.0, 5.0, 0.0), metres=4.0, at=at)
    assert decision.zone is Zone.LEFT


def test_even_follows_on_soil_ahead_that_lies_evenly_and_then_stays() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    decision, at = drive(decision, Zone.EVEN, (20.0, 5.0, 0.0), at=at)
    assert (decision.zone, decision.angle_deg) == (Zone.EVEN, 45.0)
    decision, at = drive(decision, Zone.RIGHT, SPREAD, metres=4.0, at=at)
    assert decision.zone is Zone.EVEN


def test_even_by_a_method_that_cannot_tell_what_is_carried_follows_on_nothing() -> None:
    for travel in (None, STANDING, Travel(0.5, 3.0, 0.0)):
        first = run([Zone.CENTER] * 6, travel=travel)
        assert run([Zone.EVEN] * 20, first, first.decided_s + 5.0, travel=travel).zone is Zone.CENTER


def test_the_pass_ends_when_the_machine_stands() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    decision, at = stand(decision, Zone.LEFT, at, RULE.standing_s - 0.1)
    assert decision.kept
    decision, at = stand(decision, Zone.NONE, at, 0.3)
    assert not decision.kept
    assert decision.reason(at[0]) == "left, until the next pass: the machine stands"
    assert decision.angle_deg == 30.0  # held until there is another decision
    decision, at = drive(decision, Zone.RIGHT, at=at)
    assert (decision.zone, decision.kept) == (Zone.RIGHT, True)


def test_a_machine_that_has_not_started_yet_does_not_end_the_pass_by_standing() -> None:
    decision, at = stand(Decision(), Zone.LEFT, (100.0, 0.0), 5.0)
    assert decision.kept
    assert decision.reason(at[0]) == "left, before the pass"


def test_the_pass_ends_when_the_machine_reverses() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    decision, at = drive(decision, Zone.LEFT, metres=-0.2 * RULE.standing_s, speed=-0.2, at=at)
    assert decision.kept
    decision, at = drive(decision, Zone.LEFT, metres=-0.04, speed=-0.2, at=at)
    assert (decision.kept, decision.ended) == (False, "the machine reversed")


@pytest.mark.parametrize("speed", [-0.3, 0.0])
@pytest.mark.parametrize("begun", [True, False])
def test_one_reading_of_the_speed_ends_no_pass(speed: float, begun: bool) -> None:
    """The first negative one ended it, and one of standing that stayed the newest for half a second."""
    decision, at = drive(Decision(), Zone.LEFT) if begun else stand(Decision(), Zone.LEFT, (100.0, 0.0), 1.0)
    wrong = Travel(speed, at[1], at[0] + 0.02)
    for number in range(1, 26):
        decision = decide(decision, None, True, at[0] + 0.02 * number, RULE, wrong)
        assert (decision.kept, decision.begun) == (True, begun)
    # Nobody says more: what one reading said ends nothing then either.
    decision = decide(decision, None, True, at[0] + 1.0, RULE, None)
    assert decision.kept
    decision = decide(decision, None, True, at[0] + 1.02, RULE, Travel(0.5, at[1] + 0.3, at[0] + 1.02))
    assert (decision.kept, decision.standing_since_s, decision.reversing_since_s) == (True, None, None)


@pytest.mark.parametrize(("speed", "ended"), [(0.0, "the machine stands"), (-0.3, "the machine reversed")])
def test_a_speed_that_comes_and_goes_while_it_stands_or_reverses_ends_the_pass_no_later(
    speed: float, ended: str
) -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    for number in range(8):
        now_s = at[0] + 0.1 * number
        travel = None if number % 2 else Travel(speed, at[1] + speed * 0.1 * number, now_s)
        decision = decide(decision, None, True, now_s, RULE, travel)
    assert (decision.kept, decision.ended) == (False, ended)


def test_a_machine_that_creeps_to_and_fro_stands() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    for number in range(12):
        now_s = at[0] + 0.05 * number
        decision = decide(decision, None, True, now_s, RULE, Travel((0.0, -0.1)[number % 2], at[1], now_s))
    assert decision.ended == "the machine stands"


def test_the_pass_ends_when_the_soil_is_gone_and_not_while_some_is_carried() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    decision, at = drive(decision, Zone.NONE, SPREAD, at=at)
    assert decision.kept
    decision, at = drive(decision, Zone.NONE, at=at)
    assert decision.ended == "the soil is gone"
    decision, at = drive(decision, Zone.RIGHT, at=at)
    assert decision.zone is Zone.RIGHT


def test_the_pass_ends_after_the_configured_travel() -> None:
    decision, at = drive(Decision(), Zone.LEFT, metres=RULE.pass_m + 0.05)
    assert decision.kept
    decision, at = drive(decision, Zone.UNKNOWN, metres=0.3, at=at)
    assert decision.ended == "10 m were travelled"


def test_without_speed_the_time_counts() -> None:
    first = run([Zone.LEFT] * 6, travel=None)
    assert first.reason(first.decided_s + 4.0) == "left, kept for this pass since 4.0 s"
    later = run([Zone.RIGHT] * 20, first, first.decided_s + RULE.pass_s - 2.0, travel=None)
    assert later.zone is Zone.LEFT
    later = run([Zone.RIGHT] * 20, first, first.decided_s + RULE.pass_s, travel=None)
    assert later.zone is Zone.RIGHT


def test_a_speed_that_is_lost_in_mid_pass_keeps_the_decision() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    now_s = at[0]
    for _ in range(100):
        now_s += 0.066
        decision = decide(decision, apart(Zone.RIGHT, SPREAD, now_s), True, now_s, RULE, None)
    assert decision.zone is Zone.LEFT
    # Back again, counting from somewhere else: the pass goes on from what was known and what may have been driven.
    told_m = decision.since_m
    assert told_m == pytest.approx(0.5 * (now_s - decision.decided_s), abs=0.05)
    decision = decide(decision, None, True, now_s + 0.02, RULE, Travel(0.5, 0.0, now_s + 0.02))
    assert decision.kept
    assert decision.since_m == pytest.approx(told_m + 0.01)


def test_a_speed_that_is_lost_for_a_moment_late_in_a_slow_pass_keeps_the_decision() -> None:
    """The time rule counted from the decision, and one lost reading after 40 s ended the pass."""
    decision, at = drive(Decision(), Zone.LEFT, metres=8.0, speed=0.2)
    decision = decide(decision, None, True, at[0] + 0.02, RULE, None)
    decision, at = drive(decision, Zone.RIGHT, SPREAD, speed=0.2, at=at)
    assert (decision.zone, decision.kept) == (Zone.LEFT, True)
    # What is left of the pass goes by as it would in one of which nothing is told.
    left_s = (RULE.pass_m - decision.since_m) * RULE.pass_s / RULE.pass_m
    assert 3.0 < left_s < 4.0
    assert decide(decision, None, True, at[0] + left_s - 0.1, RULE, None).kept
    assert decide(decision, None, True, at[0] + left_s, RULE, None).ended == "48 s went by"


@pytest.mark.parametrize("told_s", [0.02, 0.3, 1.0])
@pytest.mark.parametrize("silent_s", [0.1, 0.6, 3.0])
@pytest.mark.parametrize("counts_on", [True, False])
@pytest.mark.parametrize("speed", [0.1, 0.5, 1.0])
def test_a_speed_that_comes_and_goes_does_not_make_the_pass_longer(
    told_s: float, silent_s: float, counts_on: bool, speed: float
) -> None:
    """While it was not told, neither travel nor time counted, and each time it was told again both began anew."""
    decision, at = drive(Decision(), Zone.LEFT)
    now_s, travelled_m, counted_m, told = at[0], at[1], at[1], Travel(0.5, at[1], at[0])
    fastest = max(speed, RULE.pass_m / RULE.pass_s)
    while decision.kept:
        now_s, travelled_m, counted_m = now_s + 0.02, travelled_m + 0.02 * speed, counted_m + 0.02 * speed
        is_told = (now_s - at[0]) % (told_s + silent_s) < told_s
        if is_told and not counts_on and told.time_s < now_s - 0.03:
            counted_m = 0.0
        told = Travel(speed, counted_m, now_s) if is_told else told
        # A reading is taken for what is for half a second, as the tick does.
        fresh = told if now_s - told.time_s <= 0.5 else None
        decision = decide(decision, None, True, now_s, RULE, fresh)
        assert decision.since_m <= RULE.pass_m + 0.5
        assert now_s - decision.decided_s <= RULE.pass_m / min(speed, RULE.pass_m / RULE.pass_s) + 1.0
        assert travelled_m - 0.3 <= RULE.pass_m + 0.5 * fastest + 0.1, "as far as a pass of which all is told"


def test_a_count_of_travel_that_stands_still_does_not_make_the_pass_longer() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    for number in range(1, 1200):
        now_s = at[0] + 0.02 * number
        decision = decide(decision, None, True, now_s, RULE, Travel(0.5, at[1], now_s))
        if not decision.kept:
            break
    assert decision.ended == "10 m were travelled"
    assert now_s - decision.decided_s == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("lost", [True, False])
def test_travel_that_is_lost_or_counts_anew_does_not_make_the_pass_longer(lost: bool) -> None:
    decision, at = drive(Decision(), Zone.LEFT, metres=6.0)
    if lost:
        decision = decide(decision, None, True, at[0] + 0.02, RULE, None)
    decision, at = drive(decision, Zone.NONE, SPREAD, metres=RULE.pass_m - 5.5, at=(at[0], 0.0))
    assert decision.ended == "10 m were travelled"


def test_nothing_is_decided_in_reverse() -> None:
    """What is seen ahead is then what the blade moves away from: it swung from side to side all the way back."""
    decision, at = drive(Decision(), Zone.LEFT)
    for zone in (Zone.RIGHT, Zone.EVEN, Zone.LEFT, Zone.RIGHT):
        decision, at = drive(decision, zone, metres=-1.0, speed=-0.3, at=at)
        assert (decision.zone, decision.ended, decision.votes) == (Zone.LEFT, "the machine reversed", ())
    decision, at = drive(decision, Zone.RIGHT, at=at)
    assert (decision.zone, decision.kept) == (Zone.RIGHT, True)


def test_as_many_votes_for_one_side_as_for_the_other_decide_nothing() -> None:
    rule = RuleSettings(votes_needed_n=3, votes_window_n=6)
    for last in (Zone.RIGHT, Zone.LEFT):
        votes = tuple(seen(zone, 0.0) for zone in (Zone.RIGHT, Zone.LEFT, Zone.RIGHT, Zone.LEFT, last))
        other = Zone.LEFT if last is Zone.RIGHT else Zone.RIGHT
        assert decide(Decision(votes=votes), seen(other, 0.1), True, 0.1, rule).zone is None
        assert decide(Decision(votes=votes), seen(last, 0.1), True, 0.1, rule).zone is last


def test_the_swing_of_the_blade_does_not_hide_the_end_of_the_pass() -> None:
    decision, at = drive(Decision(), Zone.LEFT)
    for number in range(60):
        decision = decide(decision, None, False, at[0] + number * 0.02, RULE, Travel(0.0, at[1], at[0] + number * 0.02))
    assert decision.ended == "the machine stands"
