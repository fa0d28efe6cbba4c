"""Depth decides, colour cross-checks."""

from __future__ import annotations

import pytest

from graderd.core.soil import Zone
from graderd.perception.decide import Verdict, fuse


def says(zone: Zone, confidence: float = 0.9) -> Verdict:
    return Verdict(zone, confidence, f"{zone}", (0.1, 0.2, 0.7), (1.0, 2.0, 7.0))


def test_agreement_is_more_confident() -> None:
    both = fuse(says(Zone.LEFT, 0.6), says(Zone.LEFT, 0.5))
    assert both.zone is Zone.LEFT
    assert both.confidence == pytest.approx(0.8)
    assert both.volumes_l == (1.0, 2.0, 7.0)


@pytest.mark.parametrize(("one", "other"), [(Zone.LEFT, Zone.RIGHT), (Zone.RIGHT, Zone.LEFT)])
def test_a_sure_colour_on_the_opposite_side_is_unknown(one: Zone, other: Zone) -> None:
    answer = fuse(says(one), says(other, 0.95))
    assert answer.zone is Zone.UNKNOWN
    assert str(one) in answer.reason
    assert str(other) in answer.reason
    assert fuse(says(one), says(other, 0.5)).zone is one


@pytest.mark.parametrize("color", [Zone.CENTER, Zone.EVEN, Zone.NONE, Zone.UNKNOWN])
def test_colour_that_says_something_else_only_lowers_the_confidence(color: Zone) -> None:
    answer = fuse(says(Zone.LEFT), says(color, 1.0))
    assert answer.zone is Zone.LEFT
    assert answer.confidence < 0.9


@pytest.mark.parametrize("color", list(Zone))
def test_colour_never_decides_where_depth_does_not(color: Zone) -> None:
    assert fuse(says(Zone.UNKNOWN, 0.0), says(color, 1.0)).zone is Zone.UNKNOWN
