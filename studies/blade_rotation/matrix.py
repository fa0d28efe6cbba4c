"""The study's tables as cases to compute, and what was computed as rows beside the study's numbers.

Every comparison is ``graderd.evaluation.statistics``': Student's intervals over the seeds, Welch's analysis of variance
and the pairs by Games and Howell. An order is reproduced where each pair that the study tells apart is told apart the
same way, not reproduced where one is told apart the other way, and else it is not known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from graderd.evaluation import study
from graderd.evaluation.statistics import Difference, Row, differences_of, rows_of
from graderd.evaluation.trial import TrialResult
from graderd.evaluation.uncertainty import Estimate
from graderd.studies.blade_rotation import case as named
from graderd.studies.blade_rotation.case import Case, Sense, Work
from graderd.studies.blade_rotation.store import Result

CONFIDENCE = 0.95
SIMILAR_SHARE = 0.02
"""Values of the study that differ by less are similar, as it calls loads 0.9 % apart; it claims no order of them."""
SIMILAR_MM = 0.5
"""So are heights that differ by no more (2.5: similar results for all three angles)."""
OFFSET_SHARE = 0.2
DESIRED_HEIGHT_M = 0.15
"""Of flattening, which the study does not print: a layer poured 0.25 m high slumps to 0.2 m or so, and a quarter of
it is taken off."""
HEIGHT = "height_difference_mm"
SPREAD = "spread_extreme_mm"
"""The definition that reads like the study's: how far soil reaches to the left and to the right."""
LOAD = "blade_load_n"
LABELS = {Sense.TRAILS: "trailing", Sense.LEADS: "leading"}


@dataclass(frozen=True, slots=True)
class Size:
    """How much is computed. ``few_seeds_n``: for the field's 1 m blade, and for what is compared with the tables."""

    scattered_n: int
    layer_n: int
    seeds_n: int
    few_seeds_n: int


QUICK = Size(scattered_n=1200, layer_n=2500, seeds_n=5, few_seeds_n=3)
FULL = Size(
    scattered_n=named.SCATTERED.study_grains_n, layer_n=named.LAYER_ACROSS.study_grains_n, seeds_n=5, few_seeds_n=3
)


AGAIN = "decided again"
ERROR_ANGLE_DEG = 30.0


def errors(size: Size) -> dict[str, dict[str, float]]:
    """By name what is changed to see the error of the method: coarser and finer grains, half the time step."""
    coarser, finer = round(size.scattered_n / 2), 2 * size.scattered_n
    return {
        f"{coarser} grains": {"grains_n": coarser},
        f"{finer} grains": {"grains_n": finer},
        "half the step": {"step_of_rayleigh": Case.model_fields["step_of_rayleigh"].default / 2.0},
    }


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a table: a distribution, a sense, a machine. ``name`` is the rows' ``case``; ``order_by``: the
    measure that the study decides by; ``study``: its values at 15, 30 and 45 degrees by measure."""

    name: str
    case: Case
    angles_deg: tuple[float, ...]
    seeds_n: int
    order_by: str
    study: dict[str, tuple[float, ...]]

    def cases(self) -> list[Case]:
        """All runs of it."""
        return [
            self.case.model_copy(update={"angle_deg": angle, "seed": seed})
            for seed in range(1, self.seeds_n + 1)
            for angle in self.angles_deg
        ]


def lines(size: Size) -> list[Line]:
    """Tables 3 and 4, and the daemon's own behaviour, in the order they are told."""
    table_3, table_4 = study.data()["table_3"], study.data()["table_4_averages"]
    angles = tuple(map(float, study.ANGLES_DEG))
    found: list[Line] = []
    for prefix, seeds_n, blade, layer, travel_m in (
        ("", size.seeds_n, named.FULL_SIZE, named.LAYER_ACROSS, (1.5, 3.0)),
        ("quarter, ", size.few_seeds_n, named.QUARTER_SIZE, named.LAYER_ALONG, (2.5, 2.0)),
    ):
        quarter = bool(prefix)
        flat = Case(
            work=Work.FLATTENING, angle_deg=15, blade=blade, pile=layer, gap_m=DESIRED_HEIGHT_M, travel_m=travel_m[0],
            grains_n=size.layer_n,
        )  # fmt: skip
        heights = tuple(table_4["flattening"] if quarter else table_3["flattening"][HEIGHT])
        loads = {} if quarter else {LOAD: tuple(table_3["flattening"][LOAD])}
        by = HEIGHT if quarter else LOAD
        found.append(Line(f"{prefix}flattening", flat, angles, seeds_n, by, {HEIGHT: heights, **loads}))
        for work, sense in (
            (Work.LEFT, Sense.TRAILS), (Work.LEFT, Sense.LEADS), (Work.MIDDLE, Sense.TRAILS),
            (Work.RIGHT, Sense.TRAILS), (Work.RIGHT, Sense.LEADS),
        ):  # fmt: skip
            middle = work is Work.MIDDLE
            case = Case(
                work=work, angle_deg=15, sense=sense, blade=blade, pile=named.SCATTERED, travel_m=travel_m[1],
                offset_share=0.0 if middle else OFFSET_SHARE, grains_n=size.scattered_n,
            )  # fmt: skip
            side = "middle" if middle else "left"  # the study has no right: its rule takes the left's mirror image
            spreads = tuple(table_4[side] if quarter else table_3[side]["spread_mm"])
            loads = {} if quarter else {LOAD: tuple(table_3[side][LOAD])}
            name = f"{prefix}{work}" if middle else f"{prefix}{work}, {LABELS[sense]}"
            found.append(Line(name, case, angles, seeds_n, SPREAD, {SPREAD: spreads, **loads}))
    for line in list(found):
        # What the rule decides for the pile, and the same pass with the decision taken again in the midst of it.
        if line.name in ("left, trailing", "middle"):
            angle = (30.0,) if line.name.startswith("left") else (15.0,)
            again = line.case.model_copy(update={"decision": "again"})
            found.append(Line(f"{line.name}, {AGAIN}", again, angle, size.few_seeds_n, SPREAD, {}))
    middle_line = next(line for line in found if line.name == "middle")
    for name, update in errors(size).items():
        case = middle_line.case.model_copy(update=update)
        found.append(Line(f"middle, {name}", case, (ERROR_ANGLE_DEG,), size.few_seeds_n, SPREAD, {}))
    return found


def cases(of: Iterable[Line]) -> list[Case]:
    """What has to be computed for lines, each once. Seeds come first: whatever has been computed when somebody stops
    is a whole table of fewer seeds."""
    every = {case.key(): case.canonical for line in of for case in line.cases()}
    return sorted(every.values(), key=lambda case: case.seed)


@dataclass(frozen=True, slots=True)
class Table:
    """What came out, line by line."""

    lines: list[Line]
    rows: list[Row]
    differences: list[Difference]

    def study_value(self, row: Row) -> float | None:
        """The study's number for a row, None where it has none."""
        line = self.line(row.case)
        values = line.study.get(row.measure)
        return values[line.angles_deg.index(row.angle_deg)] if values else None

    def line(self, name: str) -> Line:
        """A line by its name."""
        return next(line for line in self.lines if line.name == name)

    def order(self, name: str, measure: str) -> bool | None:
        """Whether the study's order of the angles by a measure came out; None: the intervals do not tell, or the study
        claims none."""
        line = self.line(name)
        values = line.study.get(measure)
        return None if values is None else reproduced(measure, line.angles_deg, values, self._difference(name, measure))

    def orders(self) -> dict[str, bool | None]:
        """By line, for the measure that the study decides by."""
        return {line.name: self.order(line.name, line.order_by) for line in self.lines if line.study}

    def _difference(self, name: str, measure: str) -> Difference | None:
        wanted = (name, f"|{measure}|" if measure == HEIGHT else measure)
        return next((each for each in self.differences if (each.case, each.measure) == wanted), None)


def claimed(measure: str, values: Sequence[float]) -> list[tuple[int, int]]:
    """Which pairs of the study's values, by their places, are far enough apart to have an order. Of heights the size
    counts: they are all below the target."""
    sizes = np.abs(values)
    least = SIMILAR_MM + 1e-9 if measure == HEIGHT else SIMILAR_SHARE * float(sizes.max())
    return [(a, b) for a, b in combinations(range(len(sizes)), 2) if abs(sizes[a] - sizes[b]) >= least]


def reproduced(
    measure: str, angles_deg: Sequence[float], values: Sequence[float], found: Difference | None
) -> bool | None:
    """Whether differences between angles have the signs that the study's ``values`` have."""
    if found is None:
        return None
    by_angles = {(pair.angle_deg, pair.other_deg): pair for pair in found.pairs}
    told = []
    for a, b in claimed(measure, values):
        pair = by_angles[angles_deg[a], angles_deg[b]]
        # How far apart they are in the study's direction, at least and at most.
        falls = abs(values[a]) > abs(values[b])
        least, most = (pair.low, pair.high) if falls else (-pair.high, -pair.low)
        told.append(True if least > 0.0 else False if most < 0.0 else None)
    if not told or (None in told and False not in told):
        return None
    return all(told)


def table(of: Sequence[Line], results: Iterable[Result]) -> Table:
    """Rows and tests of all that has been computed."""
    by_key = {result.key: result for result in results}
    trials = [
        TrialResult(line.name, case.angle_deg, case.seed, _estimates(by_key[case.key()]))
        for line in of
        for case in line.cases()
        if case.key() in by_key
    ]
    sized = [
        replace(trial, values={f"|{HEIGHT}|": replace(found, value=abs(found.value))})
        for trial in trials
        if (found := trial.values.get(HEIGHT))
    ]
    rows = rows_of(trials, CONFIDENCE)
    ordered = {(line.name, measure) for line in of for measure in line.study}
    compared = [row for row in (*rows, *rows_of(sized, CONFIDENCE)) if (row.case, row.measure.strip("|")) in ordered]
    return Table(list(of), rows, differences_of(compared, CONFIDENCE))


def _estimates(result: Result) -> dict[str, Estimate]:
    """A run knows nothing of its own uncertainty: other seeds do."""
    return {name: Estimate(value, float("inf"), float("inf")) for name, value in result.measures.items()}


def finished(found: Table) -> dict[str, Any]:
    """The last line for programs."""
    rows = [
        {
            "case": row.case,
            "angle_deg": row.angle_deg,
            "measure": row.measure,
            "value": row.value,
            "low": row.low,
            "high": row.high,
            "seeds_n": row.trials_n,
            "study_value": found.study_value(row),
        }
        for row in found.rows
    ]
    return {"event": "study_finished", "rows": rows, "orders_reproduced": found.orders()}
