"""The angle table that computed results carry, as the configuration's section ``rule``; and no more than they carry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from graderd.core.rule import RuleSettings
from graderd.evaluation.statistics import Row, differences_of, rows_of
from graderd.evaluation.trial import TrialResult
from graderd.evaluation.uncertainty import Estimate
from graderd.studies.blade_rotation.case import Case, Work
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.matrix import CONFIDENCE, HEIGHT, LOAD, SPREAD
from graderd.studies.blade_rotation.store import Result

VARIED = {"work", "angle_deg", "sense", "seed", "pile", "offset_share", "gap_m", "travel_m", "grains_n"}
"""What cases may differ in that speak of one machine, soil and speed."""
KEYS = {Work.LEFT: "left_deg", Work.MIDDLE: "center_deg", Work.FLATTENING: "even_deg"}


@dataclass(frozen=True, slots=True)
class Choice:
    """The best angle (counter-clockwise) for one distribution: None where it is not told from ``rivals_deg``, or where
    nothing was computed. ``measure``: what is best at it. ``runs_n``: that it rests on, of one pile, gap and grain."""

    work: Work
    angle_deg: float | None
    measure: str
    rows: tuple[Row, ...]
    rivals_deg: tuple[float, ...]
    runs_n: int

    def reason(self) -> str:
        """One line for people."""
        if not self.rows:
            return "not computed"
        told = "; ".join(
            f"{row.angle_deg:+g}° {row.value:.0f}" + ("" if row.low is None else f" [{row.low:.0f}, {row.high:.0f}]")
            for row in self.rows
        )
        best = "least" if self.measure == LOAD else "most"
        if self.angle_deg is not None:
            verdict = f"{best} at {self.angle_deg:+g}°"
        else:
            verdict = f"{best} at {self.rivals_deg[0]:+g}°, not told from "
            verdict += ", ".join(f"{rival:+g}°" for rival in self.rivals_deg[1:])
        return f"{verdict}. {self.measure}: {told}"


@dataclass(frozen=True, slots=True)
class Rule:
    """The table, and where it is from."""

    machine: Case
    choices: tuple[Choice, ...]
    engine: str

    @property
    def runs_n(self) -> int:
        """The runs that it rests on; others of the machine are of another pile, gap or grain."""
        return sum(choice.runs_n for choice in self.choices)

    def angles_deg(self) -> dict[str, float]:
        """By the configuration's names; those alone that the results carry."""
        found = {KEYS[choice.work]: choice.angle_deg for choice in self.choices if choice.angle_deg is not None}
        if "left_deg" in found:
            found["right_deg"] = -found["left_deg"]
        return found

    def data(self) -> dict[str, Any]:
        """For programs."""
        why = {KEYS[choice.work]: choice.reason() for choice in self.choices}
        return {"rule": self.angles_deg(), "why": why, "runs_n": self.runs_n, "engine": self.engine}

    def toml(self) -> str:
        """The section of a configuration file, which the daemon reads."""
        case, found, default = self.machine, self.angles_deg(), RuleSettings()
        shape = "flat" if case.blade.radius_m is None else f"radius {case.blade.radius_m:g} m"
        lines = [
            f"# Derived by graderd {version('graderd')} study rule from {self.runs_n} runs ({self.engine}):",
            f"# blade {case.blade.length_m:g} x {case.blade.height_m:g} m, {shape}, {case.speed_m_per_s:g} m/s; "
            f"soil with G {case.shear_modulus_pa:.3g} Pa,",
            f"# friction {case.friction:g}, rolling friction {case.rolling_friction:g}, floor as {case.floor}. "
            "Positive: counter-clockwise.",
            "# An angle behind # is the default: there the 95 % intervals of the pairs tell no best one.",
            "[rule]",
        ]
        for choice in self.choices:
            key = KEYS[choice.work]
            lines += [f"# {choice.reason()}", _line(key, found, getattr(default, key))]
            if choice.work is Work.LEFT:
                lines += ["# the left's mirror image", _line("right_deg", found, default.right_deg)]
        return "\n".join(lines) + "\n"


def _line(key: str, found: dict[str, float], default: float) -> str:
    return f"{key} = {found[key]:.1f}" if key in found else f"# {key} = {default:.1f}"


def derive(results: Iterable[Result], like: Case | None = None) -> Rule:
    """The rule of all results with the machine, soil and speed of ``like``; by default the most of a kind.

    Raises:
        StudyError: there are none.
    """
    held = [result for result in results if result.case.decision == "held" and result.case.motion == "imposed"]
    groups: dict[str, list[Result]] = {}
    for result in held:
        groups.setdefault(result.case.model_dump_json(exclude=VARIED), []).append(result)
    if like is not None:
        groups = {key: group for key, group in groups.items() if key == like.model_dump_json(exclude=VARIED)}
    if not groups:
        raise StudyError("rule", "nothing has been computed", "Run `graderd study paper` or a sweep first")
    group = max(groups.values(), key=len)
    choices = tuple(_choice(work, [each for each in group if each.case.work is work]) for work in KEYS)
    return Rule(group[0].case, choices, group[0].engine)


def _choice(work: Work, results: Sequence[Result]) -> Choice:
    """Of several piles or grain sizes the one with the most runs."""
    same: dict[str, list[Result]] = {}
    for result in results:
        same.setdefault(result.case.model_dump_json(exclude={"angle_deg", "sense", "seed"}), []).append(result)
    measure = LOAD if work is Work.FLATTENING else SPREAD
    if not same:
        return Choice(work, None, measure, (), (), 0)
    trials = [
        TrialResult(work, result.case.angle_ccw_deg, result.case.seed, _values(result, measure))
        for result in max(same.values(), key=len)
    ]
    rows = rows_of(trials, CONFIDENCE)
    tested = {each.measure: each for each in differences_of(rows, CONFIDENCE)}
    chosen = tuple(row for row in rows if row.measure == measure)
    sign = -1.0 if measure == LOAD else 1.0
    best = max(chosen, key=lambda row: sign * row.value)
    rivals = [row.angle_deg for row in chosen if row is not best]
    if measure in tested:
        for pair in tested[measure].pairs:
            if best.angle_deg in (pair.angle_deg, pair.other_deg) and not pair.low <= 0.0 <= pair.high:
                rivals.remove(pair.other_deg if pair.angle_deg == best.angle_deg else pair.angle_deg)
    if (
        work is Work.FLATTENING
        and HEIGHT in tested
        and any(not pair.low <= 0.0 <= pair.high for pair in tested[HEIGHT].pairs)
    ):
        # The load decides where the work is as good at each angle, which it is not here.
        rivals = rivals or [row.angle_deg for row in chosen if row is not best]
    angle = None if rivals or len(chosen) < 2 else best.angle_deg
    return Choice(work, angle, measure, chosen, () if angle is not None else (best.angle_deg, *rivals), len(trials))


def _values(result: Result, measure: str) -> dict[str, Estimate]:
    names = (measure, HEIGHT) if measure == LOAD else (measure,)
    return {
        name: Estimate(result.measures[name], float("inf"), float("inf")) for name in names if name in result.measures
    }
