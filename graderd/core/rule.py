"""The paper's rotation rule, and when an observation is sure enough to act on it (paper 2.6, Fig. 3).

Soil left: 30° counter-clockwise. Right: 30° clockwise. Center: 15° counter-clockwise. Spread evenly: the 45° base
working angle. None or unknown: the present angle is held.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from pydantic import Field, model_validator

from graderd.core.soil import SoilObservation, Zone
from graderd.hal.settings import Finite, NotNegative, Settings

TURNING_ZONES = (Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN)


class RuleSettings(Settings):
    """Angles of the rule and the sureness it asks for.

    A swing itself shifts soil between the thirds (they turn with the blade), so a *change* of decision asks for
    more than a first one: ``switch_share`` of the soil in the new third, after ``dwell_s``.
    """

    left_deg: Finite = Field(30.0, ge=-180, le=180)
    right_deg: Finite = Field(-30.0, ge=-180, le=180)
    center_deg: Finite = Field(15.0, ge=-180, le=180)
    even_deg: Finite = Field(45.0, ge=-180, le=180)
    votes_needed_n: int = Field(4, ge=1, le=100, description="observations that must agree")
    votes_window_n: int = Field(6, ge=1, le=100, description="among the newest so many")
    vote_max_age_s: NotNegative = Field(1.5, le=10, description="older votes do not count: the soil has moved on")
    min_confidence: float = Field(0.3, ge=0, le=1)
    dwell_s: NotNegative = Field(2.0, le=60, description="least time between two decisions")
    switch_share: float = Field(0.7, ge=0, le=1, description="share of soil a third needs to overturn a decision")

    @model_validator(mode="after")
    def _votes(self) -> RuleSettings:
        if self.votes_needed_n > self.votes_window_n:
            raise ValueError(
                f"votes_needed_n ({self.votes_needed_n}) cannot be more than votes_window_n ({self.votes_window_n})"
            )
        return self

    def angle_deg(self, zone: Zone) -> float | None:
        """Working angle for a zone; None means: hold the present angle."""
        return {
            Zone.LEFT: self.left_deg,
            Zone.RIGHT: self.right_deg,
            Zone.CENTER: self.center_deg,
            Zone.EVEN: self.even_deg,
        }.get(zone)


@dataclass(frozen=True, slots=True)
class Decision:
    """What automatic operation has decided, and the votes on the way to the next decision."""

    zone: Zone | None = None
    angle_deg: float | None = None
    decided_s: float = float("-inf")
    votes: tuple[SoilObservation, ...] = ()

    @property
    def reason(self) -> str:
        """One line for people."""
        if self.zone is None:
            return "no decision yet"
        return f"soil {self.zone}: {self.angle_deg:+.0f}°"


def decide(
    decision: Decision, observation: SoilObservation | None, settled: bool, now_s: float, rule: RuleSettings
) -> Decision:
    """Take one new observation (or None) into account and return the decision that now holds.

    ``settled`` is whether the blade stands at its goal: while it swings, votes are dropped, because the soil and the
    thirds are moving against each other.
    """
    if not settled:
        return replace(decision, votes=()) if decision.votes else decision
    # A picture far ahead of the clock would never grow old: it counts as little as one far behind it.
    votes = tuple(v for v in decision.votes if abs(now_s - v.capture_s) <= rule.vote_max_age_s)
    if observation is not None and abs(now_s - observation.capture_s) <= rule.vote_max_age_s:
        votes = (*votes, observation)[-rule.votes_window_n :]
    decision = replace(decision, votes=votes)
    if now_s - decision.decided_s < rule.dwell_s:
        return decision
    winner = _winner(decision, rule)
    if winner is None or winner == decision.zone:
        return decision
    return Decision(zone=winner, angle_deg=rule.angle_deg(winner), decided_s=now_s)


def _winner(decision: Decision, rule: RuleSettings) -> Zone | None:
    for zone in TURNING_ZONES:
        agreeing = [v for v in decision.votes if v.zone is zone and v.confidence >= rule.min_confidence]
        if len(agreeing) < rule.votes_needed_n:
            continue
        if decision.zone is not None and zone not in (decision.zone, Zone.EVEN):
            mean_share = sum(v.share_of(zone) for v in agreeing) / len(agreeing)
            if mean_share < rule.switch_share:
                continue
        return zone
    return None
