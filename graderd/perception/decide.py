"""From what lies in each third to a zone: the one place where a method's numbers become a word."""

from __future__ import annotations

from dataclasses import dataclass

from graderd.core.soil import OPPOSITE, Zone
from graderd.perception.geometry import CENTER, LEFT, RIGHT
from graderd.perception.settings import DecisionSettings

NAMES = {LEFT: Zone.LEFT, CENTER: Zone.CENTER, RIGHT: Zone.RIGHT}


@dataclass(frozen=True, slots=True)
class Verdict:
    """A zone, how sure (0 to 1), why, and the shares of the thirds (left, center, right; sum 1, or all 0)."""

    zone: Zone
    confidence: float
    reason: str
    shares: tuple[float, float, float] = (0.0, 0.0, 0.0)
    volumes_l: tuple[float, float, float] | None = None

    def unknown(self, reason: str) -> Verdict:
        """The same numbers, not believed."""
        return Verdict(Zone.UNKNOWN, 0.0, reason, self.shares, self.volumes_l)


def shares_of(amounts: tuple[float, float, float]) -> tuple[float, float, float]:
    """Parts of the whole; all 0 where there is nothing."""
    total = sum(amounts)
    if total <= 0:
        return 0.0, 0.0, 0.0
    return amounts[0] / total, amounts[1] / total, amounts[2] / total


def decide(
    amounts: tuple[float, float, float],
    none_below: float,
    unit: str,
    settings: DecisionSettings,
    volumes_l: tuple[float, float, float] | None = None,
) -> Verdict:
    """Judge three amounts of soil (left, center, right; litres or percent of the third, named by ``unit``).

    Less than ``none_below`` in all is none. A third that leads the next by ``margin_ratio`` names the zone, unless
    all three hold a fair part (even). What lies between is unknown. Confidence grows with the lead, and near
    ``none_below`` with the distance from it.
    """
    shares = shares_of(amounts)
    total = sum(amounts)
    numbers = f"left {amounts[LEFT]:.1f}, center {amounts[CENTER]:.1f}, right {amounts[RIGHT]:.1f} {unit}"
    if total < none_below:
        confidence = min(1.0, 2.0 * (1.0 - total / none_below))
        return Verdict(
            Zone.NONE, confidence, f"{numbers}: less than {none_below:.1f} in all", (0.0, 0.0, 0.0), volumes_l
        )
    sure = min(1.0, total / none_below - 1.0) if total < 2 * none_below else 1.0
    order = sorted((LEFT, CENTER, RIGHT), key=lambda third: shares[third], reverse=True)
    most, next_most = shares[order[0]], shares[order[1]]
    least = shares[order[2]]
    even_min, even_max = settings.even_share_min_percent / 100, settings.even_share_max_percent / 100
    if least >= even_min and most <= even_max:
        room = min((least - even_min) / (1 / 3 - even_min), (even_max - most) / (even_max - 1 / 3))
        return Verdict(
            Zone.EVEN, sure * min(1.0, 0.5 + room), f"{numbers}: every third holds a fair part", shares, volumes_l
        )
    lead = most / next_most if next_most > 0 else float("inf")
    name = NAMES[order[0]]
    if lead < settings.margin_ratio:
        reason = f"{numbers}: {name} leads {NAMES[order[1]]} by {lead:.2f}, {settings.margin_ratio:.2f} is asked"
        return Verdict(Zone.UNKNOWN, 0.0, reason, shares, volumes_l)
    confidence = sure * min(1.0, 0.5 + (lead - settings.margin_ratio) / 2)
    return Verdict(name, confidence, f"{numbers}: most of it {name}", shares, volumes_l)


SURE_COLOR = 0.8
"""Confidence from which a colour verdict counts as an objection."""


def fuse(depth: Verdict, color: Verdict) -> Verdict:
    """One verdict out of two.

    The zone is depth's. Colour that names the same zone raises the confidence; colour that surely names the
    *opposite* side turns it into UNKNOWN (a swing the wrong way is the one mistake that must not happen). Any other
    difference only lowers the confidence: the hue rule is fooled by rust, grey gravel and shade.
    """
    if depth.zone is Zone.UNKNOWN:
        return depth
    if color.zone is depth.zone:
        confidence = depth.confidence + 0.5 * (1.0 - depth.confidence)
        return Verdict(depth.zone, confidence, f"{depth.reason}; colour agrees", depth.shares, depth.volumes_l)
    if OPPOSITE.get(depth.zone) is color.zone and color.confidence >= SURE_COLOR:
        return depth.unknown(f"depth says {depth.zone} ({depth.reason}), colour says {color.zone} ({color.reason})")
    return Verdict(
        depth.zone, 0.9 * depth.confidence, f"{depth.reason}; colour says {color.zone}", depth.shares, depth.volumes_l
    )
