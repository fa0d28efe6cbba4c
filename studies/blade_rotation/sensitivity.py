"""What decides which angle spreads soil widest: a design of experiments, a surrogate with its own error, and a page.

What the study leaves open, and friction, is drawn from ranges by a Sobol sequence: the first points of a longer design
are those of a shorter one, so that it can be gone on with at any time. Every point is run at 15, 30 and 45 degrees with
one pile. Travelled distance and definition of spread cost nothing: each run has them all.

The surrogate is a Gaussian process over the factors and the angle, one for each distance and definition, with a length
for each input and a noise of its own, which is what other seeds would do. Its error is that of leaving out a point with
its three angles and predicting it from all others.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, qmc, sobol_indices, uniform

from graderd.evaluation import study
from graderd.evaluation.measures import Spread
from graderd.studies.blade_rotation.case import FULL_SIZE, SCATTERED, Case, Sense, Work
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.store import Store, written

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

F64 = npt.NDArray[np.float64]

PAGE: Final = "sensitivity.md"
GRAINS_N: Final = 600
TRAVEL_M: Final = 4.0
ANGLES_DEG: Final = tuple(map(float, study.ANGLES_DEG))
DISTANCES_M: Final = (2.0, 4.0)
"""Travelled from first contact on."""
DEFINITIONS: Final = (
    *(f"spread_{each}_mm" for each in (Spread.EXTREME, Spread.MASS_95, Spread.SECOND_MOMENT)),
    f"spread_{Spread.MASS_95}_without_carried_mm",
)
GAPS_M: Final = (0.0, 0.05)
"""At which the page tells the chances."""
DRAWS_N: Final = 4000
TOLD_SHARE: Final = 0.95
"""Chance from which an angle is said to be the widest,"""
EXPLAINED_SHARE: Final = 0.5
"""where the surrogate explains so much of the variance at least."""
LEAST_POINTS_N: Final = 8
"""No surrogate of fewer."""


@dataclass(frozen=True, slots=True)
class Factor:
    """What is varied, from and to; ``name`` carries the unit."""

    name: str
    low: float
    high: float
    means: str


FACTORS: Final = (
    Factor(
        "place_share", -0.25, 0.25, "pile's middle beside the blade's, in blade lengths; positive: by the trailing end"
    ),
    Factor("gap_m", 0.0, 0.08, "cutting edge above the floor"),
    Factor("size_share", 0.5, 1.5, "soil, as a share of the study's pile of 1.0 x 0.5 x 0.3 m, its height kept"),
    Factor("curvature_per_m", 0.0, 2.4, "of the moldboard; below 0.2 it is a flat plate"),
    Factor("friction", 0.3, 0.7, "between grains; Table 2 has 0.49"),
)
LOW, HIGH = (np.array([getattr(each, end) for each in FACTORS]) for end in ("low", "high"))


def points(until: int) -> F64:
    """The first points of the design, each a row in the units of :data:`FACTORS`."""
    power = max(1, until - 1).bit_length()  # the sequence is balanced in powers of two
    return np.asarray(qmc.scale(qmc.Sobol(len(FACTORS), scramble=True, rng=19).random_base2(power), LOW, HIGH))[:until]


def case_of(number: int, point: F64, angle_deg: float) -> Case:
    """The run of a point at an angle."""
    place, gap_m, size, curvature, friction = (round(float(value), 6) for value in point)
    pile = SCATTERED.model_copy(
        update={
            "length_m": round(SCATTERED.length_m * size**0.5, 6),
            "width_m": round(SCATTERED.width_m * size**0.5, 6),
            "study_grains_n": round(SCATTERED.study_grains_n * size),
        }
    )
    radius_m = round(1.0 / curvature, 6) if curvature > 0.2 else None
    return Case(
        work=Work.LEFT,
        angle_deg=angle_deg,
        sense=Sense.TRAILS if place >= 0.0 else Sense.LEADS,
        offset_share=max(abs(place), 1e-6),
        blade=FULL_SIZE.model_copy(update={"radius_m": radius_m}),
        pile=pile,
        gap_m=gap_m,
        friction=friction,
        travel_m=TRAVEL_M,
        grains_n=round(GRAINS_N * size),
        seed=number + 1,
    )


def cases(points_n: int) -> list[Case]:
    """The runs of the first points, each point's angles one after the other."""
    return [case_of(n, point, angle) for n, point in enumerate(points(points_n)) for angle in ANGLES_DEG]


@dataclass(frozen=True, slots=True)
class Data:
    """What has been run: ``points``, a row of :data:`FACTORS` each; ``spread_mm`` by definition and distance, a row a
    point with a column an angle, not a number where there was nothing to measure."""

    points: F64
    spread_mm: dict[tuple[str, float], F64]


def collect(store: Store, points_n: int) -> Data:
    """The points of the design, of the first ``points_n``, whose three angles the store has."""
    every, numbers = points(points_n), []
    rows: dict[tuple[str, float], list[list[float]]] = {each: [] for each in product(DEFINITIONS, DISTANCES_M)}
    for number, point in enumerate(every):
        runs = [case_of(number, point, angle) for angle in ANGLES_DEG]
        if any(store.get(run) is None for run in runs):
            continue
        numbers.append(number)
        tables = [store.table(run, "travel").to_pydict() for run in runs]
        for (definition, distance_m), found in rows.items():
            found.append([_at(table, definition, distance_m) for table in tables])
    return Data(every[numbers], {key: np.array(found).reshape(-1, len(ANGLES_DEG)) for key, found in rows.items()})


def _at(table: dict[str, list[float | None]], name: str, distance_m: float) -> float:
    travel = np.array(table["travel_m"], dtype=np.float64)
    values = np.array(table.get(name, [None] * travel.size), dtype=np.float64)
    return float(values[int(np.argmin(np.abs(travel - distance_m)))])


@dataclass(frozen=True, slots=True)
class Surrogate:
    """Spread over factors and angle. ``error_mm``: root mean square of what leaving points out gets wrong;
    ``explained``: the share of the variance that is not that; ``covered``: the share of values within the 95 %
    intervals that were predicted for them; ``noise_mm``: the deviation that it takes for chance."""

    process: GaussianProcessRegressor
    error_mm: float
    explained: float
    covered: float
    noise_mm: float

    def spreads(self, of: F64) -> F64:
        """Expected spread, mm, a row a point with a column an angle."""
        return np.asarray(self.process.predict(_inputs(of))).reshape(-1, len(ANGLES_DEG))

    def widest(self, point: F64) -> F64:
        """The chance of each angle to be the one that spreads widest on the mean of many piles."""
        mean, covariance = self.process.predict(_inputs(point[None, :]), return_cov=True)
        # A prediction carries one pile's noise; which angle is better is about the mean of many.
        covariance = covariance - self.noise_mm**2 * np.eye(len(ANGLES_DEG))
        draws = np.random.default_rng(1).multivariate_normal(mean, covariance, DRAWS_N, check_valid="ignore")
        return np.asarray(np.bincount(draws.argmax(axis=1), minlength=len(ANGLES_DEG)) / DRAWS_N)


def fit(of: F64, spread_mm: F64) -> Surrogate:
    """The surrogate of some points, with its error. Points that have a value missing are left out."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    known = np.isfinite(spread_mm).all(axis=1)
    inputs, targets = _inputs(of[known]), spread_mm[known].reshape(-1)
    smooth = ConstantKernel(1.0, (1e-2, 1e2)) * RBF(np.ones(inputs.shape[1]), (0.2, 50.0))
    process = GaussianProcessRegressor(
        smooth + WhiteKernel(0.05, (1e-4, 1.0)), normalize_y=True, n_restarts_optimizer=1, random_state=0
    )
    with warnings.catch_warnings():
        # An input that decides nothing has its length at the upper bound, and should.
        warnings.simplefilter("ignore", ConvergenceWarning)
        process.fit(inputs, targets)
    group = np.repeat(np.arange(int(known.sum())), len(ANGLES_DEG))
    predicted, deviation = np.zeros_like(targets), np.zeros_like(targets)
    for number in range(int(known.sum())):
        here = group == number
        others = GaussianProcessRegressor(process.kernel_, optimizer=None, normalize_y=True)
        others.fit(inputs[~here], targets[~here])
        predicted[here], deviation[here] = others.predict(inputs[here], return_std=True)
    wrong = targets - predicted
    return Surrogate(
        process,
        error_mm=float(np.sqrt(np.mean(wrong**2))),
        explained=1.0 - float(np.mean(wrong**2) / targets.var()),
        covered=float((np.abs(wrong) <= 1.96 * deviation).mean()),
        noise_mm=float(np.sqrt(process.kernel_.k2.noise_level) * targets.std()),
    )


def _inputs(of: F64) -> F64:
    """Factors and angle, each from -1 to 1, a row for each angle of each point."""
    scaled = np.repeat(2.0 * (of - LOW) / (HIGH - LOW) - 1.0, len(ANGLES_DEG), axis=0)
    return np.column_stack((scaled, np.tile((np.array(ANGLES_DEG) - 30.0) / 15.0, len(of))))


def decided_by(surrogate: Surrogate, one: int, other: int) -> dict[str, float]:
    """Total Sobol index of each factor for the difference of spread between two angles: the share of its variance over
    the ranges that goes when all other factors are held."""

    def difference(x: F64) -> F64:
        spreads = surrogate.spreads(x.reshape(len(FACTORS), -1).T)
        return np.asarray(spreads[:, one] - spreads[:, other]).reshape(1, *x.shape[1:])

    ranges = [uniform(each.low, each.high - each.low) for each in FACTORS]
    found = sobol_indices(func=difference, n=512, dists=ranges, rng=3)
    return dict(zip((each.name for each in FACTORS), np.ravel(found.total_order).tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class Claim:
    """The rule's angle for a place of the pile, and between which places points are counted for it."""

    name: str
    angle_deg: float
    place_share: float
    least_share: float
    most_share: float

    @property
    def own(self) -> int:
        """The number of its angle."""
        return ANGLES_DEG.index(self.angle_deg)


CLAIMS: Final = (
    Claim("on one side, that end trails", 30.0, 0.2, 0.1, 0.25),
    Claim("on one side, that end leads", 30.0, -0.2, -0.25, -0.1),
    Claim("in the middle", 15.0, 0.0, -0.1, 0.1),
)


def counted(data: Data, claim: Claim, key: tuple[str, float]) -> list[int]:
    """Of the points with the pile there, how many each angle spread widest."""
    place = data.points[:, 0]
    values = data.spread_mm[key][(place >= claim.least_share) & (place <= claim.most_share)]
    values = values[np.isfinite(values).all(axis=1)]
    wins: list[int] = np.bincount(values.argmax(axis=1), minlength=len(ANGLES_DEG)).tolist()
    return wins


def usual(place_share: float, gap_m: float) -> F64:
    """A point with the study's pile and friction and a standard moldboard."""
    assert FULL_SIZE.radius_m
    return np.array((place_share, gap_m, 1.0, min(1.0 / FULL_SIZE.radius_m, HIGH[3]), 0.49))


def write(store: Store, points_n: int) -> tuple[Path, int]:
    """Write the page of what has been run of the first points into the store's folder; its path, and of how many piles.

    Raises:
        StudyError: too few have been run.
    """
    data = collect(store, points_n)
    if len(data.points) < LEAST_POINTS_N:
        raise StudyError(
            str(store.folder), f"{len(data.points)} piles have been run at all three angles", f"Run {LEAST_POINTS_N}"
        )
    path = store.folder / PAGE
    written(path, f"# What decides the angle\n\n{page(data)}")
    return path, len(data.points)


def page(data: Data) -> str:
    """The findings (Markdown)."""
    models = {
        key: fit(data.points, values)
        for key, values in data.spread_mm.items()
        if np.isfinite(values).all(axis=1).sum() >= LEAST_POINTS_N
    }
    piles_n = len(data.points)
    factors = [(each.name, f"{each.low:g}", f"{each.high:g}", each.means) for each in FACTORS]
    quality = [
        (
            *_key(key),
            f"{model.error_mm:.0f} mm",
            f"{model.explained:.2f}",
            f"{100 * model.covered:.0f} %",
            f"{model.noise_mm:.0f} mm",
        )
        for key, model in models.items()
    ]
    text = [
        f"{piles_n} piles, each at 15, 30 and 45° before a 4 m blade: {piles_n * len(ANGLES_DEG)} runs of "
        f"{round(GRAINS_N * LOW[2])} to {round(GRAINS_N * HIGH[2])} grains, {TRAVEL_M:g} m of travel.",
        "## Where the rule holds",
        "\n".join(_verdict(claim, models) for claim in CLAIMS),
        "Counted are single runs, whatever the other factors were, with the 95 % interval by Clopper and Pearson of "
        "how often the rule's angle spreads widest (a third is chance). The chances are the surrogate's for the mean "
        "of many piles of the study's size and friction before a standard moldboard, its edge on the floor or 50 mm "
        f"above it; {TOLD_SHARE:g} or more is bold, where the surrogate explains half of the variance.",
        _claims(data, models),
        "## What the order hangs on",
        "Total Sobol indices for the difference of spread between two angles, by the surrogate: the share of its "
        "variance over the ranges that this factor has a part in. Above 1 in all, factors act together.",
        _indices(models),
        "## How far the surrogate can be trusted",
        "Each point with its three angles was left out and predicted from all others. There is none where fewer than "
        f"{LEAST_POINTS_N} points have the measure at all three angles: without the carried soil there is often none.",
        _table(("definition", "distance", "error", "explained", "within 95 % intervals", "taken for chance"), quality),
        "## What was varied",
        _table(("factor", "from", "to", ""), factors),
        "Besides: travelled distance and definition of spread, which each run has all of, and the sense of rotation, "
        "which is the sign of `place_share`.",
    ]
    return "\n\n".join(text) + "\n"


def _verdict(claim: Claim, models: dict[tuple[str, float], Surrogate]) -> str:
    chances = [(model, model.widest(usual(claim.place_share, gap_m))) for model in models.values() for gap_m in GAPS_M]
    sure = [sum(_sure(model, chance[n]) for model, chance in chances) for n in range(len(ANGLES_DEG))]
    others = [f"{angle:g}° in {n}" for angle, n in zip(ANGLES_DEG, sure, strict=True) if n and angle != claim.angle_deg]
    return (
        f"- **Soil {claim.name}: the rule says {claim.angle_deg:g}°.** Of {len(chances)} combinations of definition, "
        f"distance and gap this is the widest in {sure[claim.own]} with a chance of at least {TOLD_SHARE:g}"
        f"{', ' + ', '.join(others) if others else ', no other angle in any'}; {len(chances) - sum(sure)} are open."
    )


def _sure(model: Surrogate, chance: float) -> bool:
    return bool(chance >= TOLD_SHARE and model.explained >= EXPLAINED_SHARE)


def _claims(data: Data, models: dict[tuple[str, float], Surrogate]) -> str:
    rows = []
    for claim, key in product(CLAIMS, data.spread_mm):
        wins = counted(data, claim, key)
        interval = binomtest(wins[claim.own], sum(wins)).proportion_ci() if sum(wins) else None
        said = f"{100 * interval.low:.0f} to {100 * interval.high:.0f} %" if interval else "-"
        model = models.get(key)
        chances = [_bold(model, model.widest(usual(claim.place_share, gap))) if model else "-" for gap in GAPS_M]
        rows.append((claim.name, f"{claim.angle_deg:g}°", *_key(key), " / ".join(map(str, wins)), said, *chances))
    head = ("soil", "rule", "definition", "distance", "widest at 15 / 30 / 45°", "the rule's", "chances, on the floor")
    return _table((*head, "chances, 50 mm above"), rows)


def _indices(models: dict[tuple[str, float], Surrogate]) -> str:
    rows = []
    for key, model in models.items():
        for one, other in ((1, 0), (1, 2), (0, 2)):
            pair = f"{ANGLES_DEG[one]:g}° less {ANGLES_DEG[other]:g}°"
            rows.append((*_key(key), pair, *(f"{value:.2f}" for value in decided_by(model, one, other).values())))
    return _table(("definition", "distance", "difference", *(each.name for each in FACTORS)), rows)


def _bold(model: Surrogate, chances: F64) -> str:
    return " / ".join(f"**{each:.2f}**" if _sure(model, each) else f"{each:.2f}" for each in chances.tolist())


def _key(key: tuple[str, float]) -> tuple[str, str]:
    return key[0].removeprefix("spread_").removesuffix("_mm").replace("_", " "), f"{key[1]:g} m"


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(map(str, row)) + " |" for row in rows])
