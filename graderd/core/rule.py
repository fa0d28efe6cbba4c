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

ROUNDING_M = 1e-6
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
        0.5,
        le=10,
        description="standing or reversing so long ends the pass; a wheel that slips, a gear change or a wrong reading"
        " ends none",
    )
    pass_m: Positive = Field(
        10.0, le=200, description="a pass ends after so much travel: another 8 m bed begins, or the site goes on and on"
    )
    pass_s: Positive = Field(
        32.0,
        le=600,
        description="without speed or travel, after so much time: 8 m at 0.25 m/s, the slowest work; while they are"
        " not known, pass_m in so much time is taken to be driven, or as fast as last known where that was faster",
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
    """How the machine drove at ``time_s``: forward is positive. ``travelled_m`` counts from anywhere; only differences
    mean something. A speed without a sign (J1939) cannot tell reverse."""

    speed_m_per_s: float
    travelled_m: float
    time_s: float


@dataclass(frozen=True, slots=True)
class Decision:
    """What automatic operation has decided, for which pass, and the votes on the way to the next decision.

    ``ended``: why the pass it was taken for is over; empty while it is kept. One that is not kept holds its angle until
    the next one. ``begun``: the machine drives, or may (it does not say), so that the decision is kept whatever
    is seen. ``angle_deg`` None with a zone: a hold took the angle away, and the pass goes on.

    ``since_m``: travelled since, up to ``counted_s``: what the machine said, and what it may have driven while it said
    nothing. ``told``: what it said last in this pass, None: nothing; ``silent``: it does not say now.
    ``standing_since_s``, ``reversing_since_s``: the first reading of those that said so, one after the other.
    """

    zone: Zone | None = None
    angle_deg: float | None = None
    decided_s: float = float("-inf")
    votes: tuple[SoilObservation, ...] = ()
    ended: str = ""
    begun: bool = False
    since_m: float = 0.0
    counted_s: float = 0.0
    told: Travel | None = None
    silent: bool = True
    standing_since_s: float | None = None
    reversing_since_s: float | None = None

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
        since = f"{now_s - self.decided_s:.1f} s" if self.silent else f"{self.since_m:.1f} m"
        held = "" if self.angle_deg is not None else "; held, until that is seen again"
        return f"{self.zone}, kept for this pass since {since}{held}"


Votes = tuple[SoilObservation, ...]
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
    agreeing = _agreeing(votes, rule)
    decision = _pass(decision, votes, agreeing, now_s, rule, travel)
    winner = _winner(decision, agreeing, rule) if decision.votes else None
    if winner is not None and winner is decision.zone and decision.kept:
        # The same again; after a hold it gives the blade its angle back.
        return decision if decision.angle_deg is not None else replace(decision, angle_deg=rule.angle_deg(winner))
    if winner is None or now_s - decision.decided_s < rule.dwell_s:
        return decision
    return Decision(
        zone=winner,
        angle_deg=rule.angle_deg(winner),
        decided_s=now_s,
        begun=travel is None or _drives_on(travel, rule),
        counted_s=travel.time_s if travel else now_s,
        told=travel,
        silent=travel is None,
    )


def interrupted(decision: Decision, now_s: float, rule: RuleSettings, travel: Travel | None = None) -> Decision:
    """What a hold of the rotation leaves of a decision: no angle and no votes, for what moves afterwards was decided
    afterwards; the pass, in which nothing else is decided because a camera failed for a moment; and when it was taken,
    for a camera that comes and goes must not let the blade swing more often."""
    decision = _pass(decision, (), {}, now_s, rule, travel)
    if decision.kept and decision.begun:
        return replace(decision, angle_deg=None)
    return Decision(decided_s=decision.decided_s)


def _drives_on(travel: Travel, rule: RuleSettings) -> bool:
    return travel.speed_m_per_s >= rule.standing_m_per_s


def _reverses(travel: Travel | None, rule: RuleSettings) -> bool:
    return travel is not None and travel.speed_m_per_s <= -rule.standing_m_per_s


def _votes(votes: Votes, new: SoilObservation | None, now_s: float, rule: RuleSettings) -> Votes:
    # A picture far ahead of the clock would never grow old: it counts as little as one far behind it.
    kept = tuple(v for v in votes if abs(now_s - v.capture_s) <= rule.vote_max_age_s)
    if new is not None and abs(now_s - new.capture_s) <= rule.vote_max_age_s:
        kept = (*kept, new)[-rule.votes_window_n :]
    return kept


def _pass(
    decision: Decision, votes: Votes, agreeing: Agreeing, now_s: float, rule: RuleSettings, travel: Travel | None
) -> Decision:
    """The decision with these votes; follow the pass that it is kept for, and end it where it ends."""
    if not decision.kept:
        return decision if votes == decision.votes else replace(decision, votes=votes)
    decision = _driven(decision, votes, now_s, rule, travel)
    ended, gone = "", agreeing.get(Zone.NONE, ())
    if _lasted_s(decision.reversing_since_s, travel) >= rule.standing_s:
        ended = "the machine reversed"
    elif decision.begun and _lasted_s(decision.standing_since_s, travel) >= rule.standing_s:
        ended = "the machine stands"
    elif decision.since_m >= rule.pass_m - ROUNDING_M:
        ended = f"{now_s - decision.decided_s:.0f} s went by" if travel is None else f"{rule.pass_m:g} m were travelled"
    elif gone and all(v.zone is Zone.NONE for v in gone):  # nor is any carried
        ended = "the soil is gone"
    # What was seen in one pass says nothing about the next.
    return replace(decision, ended=ended, votes=()) if ended else decision


def _lasted_s(since_s: float | None, travel: Travel | None) -> float:
    """From the first to the newest of the readings that said so. One reading says it of one moment, however long no
    other comes; nor is anything ended while nothing is said."""
    return travel.time_s - since_s if since_s is not None and travel is not None else float("-inf")


def _driven(decision: Decision, votes: Votes, now_s: float, rule: RuleSettings, travel: Travel | None) -> Decision:
    """With these votes, and the travel counted. It goes on while the machine does not say: what is not known makes no
    pass longer."""
    told = decision.told
    known_m_per_s = told.speed_m_per_s if told is not None else 0.0
    unknown_m_per_s = max(rule.pass_m / rule.pass_s, known_m_per_s)
    if travel is None:
        counted_s = max(decision.counted_s, now_s)
        since_m = decision.since_m + unknown_m_per_s * (counted_s - decision.counted_s)
        return replace(decision, votes=votes, begun=True, silent=True, since_m=since_m, counted_s=counted_s)
    if travel == told and not decision.silent:
        return decision if votes == decision.votes else replace(decision, votes=votes)
    dt_s = max(0.0, travel.time_s - decision.counted_s)
    if decision.silent or told is None:
        step_m = unknown_m_per_s * dt_s
    else:
        # A count that stands still while it drives, or starts anew, counts for less than what it drove meanwhile.
        step_m = max(travel.travelled_m - told.travelled_m, known_m_per_s * dt_s, 0.0)
    return replace(
        decision,
        votes=votes,
        begun=decision.begun or _drives_on(travel, rule),
        since_m=decision.since_m + step_m,
        counted_s=max(decision.counted_s, travel.time_s),
        told=travel,
        silent=False,
        standing_since_s=_since(decision.standing_since_s, travel, not _drives_on(travel, rule)),
        reversing_since_s=_since(decision.reversing_since_s, travel, _reverses(travel, rule)),
    )


def _since(former_s: float | None, travel: Travel, is_so: bool) -> float | None:
    """The first of the readings in a row that say it is so; a silence between two of them does not break the row."""
    return None if not is_so else travel.time_s if former_s is None else former_s


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


def _agreeing(votes: Votes, rule: RuleSettings) -> Agreeing:
    """The sure votes for what comes, by zone, where they are enough; none where they are for two zones at once."""
    sure: dict[Zone, list[SoilObservation]] = {}
    for vote in votes:
        coming = vote.coming
        if coming.confidence >= rule.min_confidence:
            sure.setdefault(coming.zone, []).append(vote)
    enough = {zone: of for zone, of in sure.items() if len(of) >= rule.votes_needed_n}
    return enough if len(enough) == 1 else {}
