"""From amounts to a zone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.core.soil import Zone
from graderd.perception.decide import decide
from graderd.perception.settings import DecisionSettings

SETTINGS = DecisionSettings()
amount = st.floats(0, 50)


@pytest.mark.parametrize(
    ("amounts", "zone"),
    [
        ((9.0, 1.0, 0.0), Zone.LEFT),
        ((0.0, 1.0, 9.0), Zone.RIGHT),
        ((2.0, 9.0, 2.0), Zone.CENTER),
        ((5.0, 5.0, 5.0), Zone.EVEN),
        ((4.0, 6.0, 5.0), Zone.EVEN),
        ((0.1, 0.1, 0.2), Zone.NONE),
        ((0.0, 5.0, 5.5), Zone.UNKNOWN),  # two thirds alike, the third empty: neither side nor even
        ((0.0, 0.0, 0.0), Zone.NONE),
    ],
)
def test_zone(amounts: tuple[float, float, float], zone: Zone) -> None:
    verdict = decide(amounts, 1.0, "l", SETTINGS)
    assert verdict.zone is zone
    assert verdict.reason


@given(amount, amount, amount)
def test_never_a_guess(left: float, center: float, right: float) -> None:
    verdict = decide((left, center, right), 1.0, "l", SETTINGS)
    assert 0.0 <= verdict.confidence <= 1.0
    if verdict.zone is Zone.NONE:
        assert right + center + left < 1.0
        assert sum(verdict.shares) == 0
        return
    assert sum(verdict.shares) == pytest.approx(1.0)
    if verdict.zone is Zone.UNKNOWN:
        assert verdict.confidence == 0.0
    if verdict.zone is Zone.LEFT:
        assert left >= SETTINGS.margin_ratio * max(center, right)


@given(amount, amount, amount)
def test_left_and_right_are_treated_alike(right: float, center: float, left: float) -> None:
    mirror = {Zone.LEFT: Zone.RIGHT, Zone.RIGHT: Zone.LEFT}
    one = decide((right, center, left), 1.0, "l", SETTINGS)
    other = decide((left, center, right), 1.0, "l", SETTINGS)
    assert other.zone is mirror.get(one.zone, one.zone)
    assert other.confidence == pytest.approx(one.confidence)
