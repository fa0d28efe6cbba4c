"""The paper's rule, and how sure it must be."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.core.rule import Decision, RuleSettings, decide
from graderd.core.soil import SoilObservation, Zone

RULE = RuleSettings()
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


def run(zones: list[Zone], start: Decision | None = None, start_s: float = 100.0, step_s: float = 0.066) -> Decision:
    decision = start or Decision()
    for index, zone in enumerate(zones):
        now_s = start_s + index * step_s
        decision = decide(decision, seen(zone, now_s), settled=True, now_s=now_s, rule=RULE)
    return decision


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
        decision = decide(decision, seen(Zone.CENTER, at_s, shares=(0.35, 0.6, 0.05)), True, at_s, RULE)
    assert decision.zone is Zone.LEFT
    for index in range(10):
        at_s = now_s + 2 + index * 0.066
        decision = decide(decision, seen(Zone.CENTER, at_s, shares=(0.15, 0.8, 0.05)), True, at_s, RULE)
    assert decision.zone is Zone.CENTER


@given(st.lists(st.sampled_from(list(Zone)), min_size=1, max_size=300))
def test_never_more_often_than_the_dwell_allows(zones: list[Zone]) -> None:
    decision, times = Decision(), []
    for index, zone in enumerate(zones):
        now_s = index * 0.066
        new = decide(decision, seen(zone, now_s, shares=(1.0, 1.0, 1.0)), True, now_s, RULE)
        if new.zone is not decision.zone:
            times.append(now_s)
        decision = new
    assert all(b - a >= RULE.dwell_s - 1e-9 for a, b in pairwise(times))


def test_more_votes_needed_than_kept_is_refused() -> None:
    with pytest.raises(ValueError, match="votes_needed_n"):
        RuleSettings(votes_needed_n=7, votes_window_n=6)
