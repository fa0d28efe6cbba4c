"""The paper's rotation rule, and when an observation is sure enough to act on it (paper 2.6, Fig. 3).

Soil left: 30° counter-clockwise. Right: 30° clockwise. Center: 15° counter-clockwise. Spread evenly: the 45° base
working angle. None or unknown: the present angle is held.

A pass has one decision. It is taken from the soil ahead and kept while the machine drives through it: what the blade
carries spreads along it, whatever was decided, and would undo the decision. See docs/adr/0006.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pydantic import Field, model_validator

from graderd.core.soil import SoilObservation, Zone
from graderd.hal.settings import Finite, NotNegative, Positive, Settings

TURNING_ZONES = (Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN)


class RuleSettings(Settings):
    """Angles of the rule, the sureness it asks for, and what a pass is.

    A swing itself shifts soil, so a *change* of decision before the machine has started asks for more than a first one:
    ``switch_share`` of the soil ahead in the new third, after ``dwell_s``. Afterwards it is kept until the pass ends.
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
    standing_m_per_s: Positive = Field(
        0.03, le=0.2, description="slower counts as standing; wheel speed reads to 0.001 m/s and few senders below 0.02"
    )
    standing_s: NotNegative = Field(
        0.5, le=10, description="standing so long ends the pass; a wheel that slips or a gear change ends none"
    )
    pass_m: Positive = Field(
        10.0, le=200, description="a pass ends after so much travel: another 8 m bed begins, or the site goes on and on"
    )
    pass_s: Positive = Field(
        32.0, le=600, description="without speed or travel, after so much time: 8 m at 0.25 m/s, the slowest work"
    )

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
class Travel:
    """How the machine drives: forward is positive. ``travelled_m`` counts from anywhere; only differences mean
    something. A speed without a sign (J1939) cannot tell reverse."""

    speed_m_per_s: float
    travelled_m: float


@dataclass(frozen=True, slots=True)
class Decision:
    """What automatic operation has decided, for which pass, and the votes on the way to the next decision.

    ``ended``: why the pass it was taken for is over; empty while it is kept. One that is not kept holds its angle until
    the next one. ``begun``: the machine drives, or may (it does not say), so that the decision is kept whatever
    is seen. ``angle_deg`` None with a zone: a hold took the angle away, and the pass goes on.

    ``at_m``: what the machine's count of travel was at the decision, None where it does not say; ``since_m``: travelled
    since, as far as it said, None: it never did. ``silent_since_s``: since when it has not said how it drives.
    """

    zone: Zone | None = None
    angle_deg: float | None = None
    decided_s: float = float("-inf")
    votes: tuple[SoilObservation, ...] = ()
    ended: str = ""
    begun: bool = False
    at_m: float | None = None
    since_m: float | None = None
    silent_since_s: float | None = None
    standing_since_s: float | None = None

    @property
    def kept(self) -> bool:
        """Whether it stands for a pass that is not over."""
        return self.zone is not None and not self.ended

    def reason(self, now_s: float) -> str:
        """One line for people."""
        if self.zone is None:
            return "no decision yet"
        if self.ended:
            return f"{self.zone}, until the next pass: {self.ended}"
        if not self.begun:
            return f"{self.zone}, before the pass"
        told = self.silent_since_s is None and self.since_m is not None
        since = f"{self.since_m:.1f} m" if told else f"{now_s - self.decided_s:.1f} s"
        held = "" if self.angle_deg is not None else "; held, until that is seen again"
        return f"{self.zone}, kept for this pass since {since}{held}"


Agreeing = Mapping[Zone, Sequence[SoilObservation]]


def decide(
    decision: Decision,
    observation: SoilObservation | None,
    settled: bool,
    now_s: float,
    rule: RuleSettings,
    travel: Travel | None = None,
) -> Decision:
    """Take one new observation (or None) into account and return the decision that now holds.

    ``settled`` is whether the blade stands at its goal: while it swings, votes are dropped, because the blade and the
    soil are moving against each other. So they are in reverse: what is seen ahead then is what the blade moves away
    from. ``travel`` None: the machine does not say how it drives.
    """
    votes = _votes(decision.votes, observation, now_s, rule) if settled and not _reverses(travel, rule) else ()
    if votes != decision.votes:
        decision = replace(decision, votes=votes)
    agreeing = _agreeing(votes, rule)
    decision = _pass(decision, agreeing, now_s, rule, travel)
    winner = _winner(decision, agreeing, rule) if decision.votes else None
    if winner is not None and winner is decision.zone and decision.kept:
        # The same again; after a hold it gives the blade its angle back.
        return decision if decision.angle_deg is not None else replace(decision, angle_deg=rule.angle_deg(winner))
    if winner is None or now_s - decision.decided_s < rule.dwell_s:
        return decision
    drives = travel is None or abs(travel.speed_m_per_s) >= rule.standing_m_per_s
    return Decision(
        zone=winner,
        angle_deg=rule.angle_deg(winner),
        decided_s=now_s,
        begun=drives,
        at_m=travel.travelled_m if travel else None,
        since_m=0.0 if travel else None,
        silent_since_s=None if travel else now_s,
    )


def interrupted(decision: Decision, now_s: float, rule: RuleSettings, travel: Travel | None = None) -> Decision:
    """What a hold of the rotation leaves of a decision: no angle and no votes, for what moves afterwards was decided
    afterwards; the pass, in which nothing else is decided because a camera failed for a moment; and when it was taken,
    for a camera that comes and goes must not let the blade swing more often."""
    decision = _pass(replace(decision, votes=()), {}, now_s, rule, travel)
    if decision.kept and decision.begun:
        return replace(decision, angle_deg=None)
    return Decision(decided_s=decision.decided_s)


def _reverses(travel: Travel | None, rule: RuleSettings) -> bool:
    return travel is not None and travel.speed_m_per_s <= -rule.standing_m_per_s


def _votes(
    votes: tuple[SoilObservation, ...], new: SoilObservation | None, now_s: float, rule: RuleSettings
) -> tuple[SoilObservation, ...]:
    # A picture far ahead of the clock would never grow old: it counts as little as one far behind it.
    kept = tuple(v for v in votes if abs(now_s - v.capture_s) <= rule.vote_max_age_s)
    if new is not None and abs(now_s - new.capture_s) <= rule.vote_max_age_s:
        kept = (*kept, new)[-rule.votes_window_n :]
    return kept


def _pass(decision: Decision, agreeing: Agreeing, now_s: float, rule: RuleSettings, travel: Travel | None) -> Decision:
    """Follow the pass that the decision is kept for, and end it where it ends."""
    if not decision.kept:
        return decision
    decision = _driven(decision, now_s, rule, travel)
    stood_s = 0.0 if decision.standing_since_s is None else now_s - decision.standing_since_s
    ended, gone = "", agreeing.get(Zone.NONE, ())
    if _reverses(travel, rule):
        ended = "the machine reversed"
    elif decision.begun and stood_s >= rule.standing_s:
        ended = "the machine stands"
    elif decision.since_m is not None and decision.since_m >= rule.pass_m:
        ended = f"{rule.pass_m:g} m were travelled"
    elif decision.silent_since_s is not None and now_s - decision.silent_since_s >= rule.pass_s:
        ended = f"{rule.pass_s:g} s went by"
    elif gone and all(v.zone is Zone.NONE for v in gone):  # nor is any carried
        ended = "the soil is gone"
    # What was seen in one pass says nothing about the next.
    return replace(decision, ended=ended, votes=(), standing_since_s=None) if ended else decision


def _driven(decision: Decision, now_s: float, rule: RuleSettings, travel: Travel | None) -> Decision:
    if travel is None:
        # Not said any more, or never: kept, since it may drive; from here on the time counts.
        if decision.silent_since_s is not None:
            return decision
        return replace(decision, begun=True, at_m=None, silent_since_s=now_s, standing_since_s=None)
    at_m, since_m = decision.at_m, decision.since_m or 0.0
    if at_m is None or travel.travelled_m < at_m + since_m:
        at_m = travel.travelled_m - since_m  # it counts from somewhere else now, and the pass goes on
    since_m = travel.travelled_m - at_m
    drives = abs(travel.speed_m_per_s) >= rule.standing_m_per_s
    standing_since_s = None if drives else decision.standing_since_s if decision.standing_since_s is not None else now_s
    return replace(
        decision,
        begun=decision.begun or drives,
        at_m=at_m,
        since_m=since_m,
        silent_since_s=None,
        standing_since_s=standing_since_s,
    )


def _winner(decision: Decision, agreeing: Agreeing, rule: RuleSettings) -> Zone | None:
    for zone in TURNING_ZONES:
        votes = agreeing.get(zone)
        if votes and (not decision.kept or zone is decision.zone or _may_follow(decision, zone, votes, rule)):
            return zone
    return None


def _may_follow(decision: Decision, zone: Zone, agreeing: Sequence[SoilObservation], rule: RuleSettings) -> bool:
    """Whether ``zone`` may take the place of a decision in the pass that this was taken for.

    Even is a job of its own, flattening: it follows on scattering where what *comes* lies evenly, once.
    """
    if zone is Zone.EVEN:
        return all(v.ahead is not None for v in agreeing)
    return not decision.begun and sum(v.coming.litres.share_of(zone) for v in agreeing) >= rule.switch_share * len(
        agreeing
    )


def _agreeing(votes: tuple[SoilObservation, ...], rule: RuleSettings) -> Agreeing:
    """The sure votes for what comes, by zone, where they are enough; none where they are for two zones at once."""
    sure: dict[Zone, list[SoilObservation]] = {}
    for vote in votes:
        coming = vote.coming
        if coming.confidence >= rule.min_confidence:
            sure.setdefault(coming.zone, []).append(vote)
    enough = {zone: of for zone, of in sure.items() if len(of) >= rule.votes_needed_n}
    return enough if len(enough) == 1 else {}
