"""The rig's height-field soil, fitted to the runs with grains: so that rig and study tell one story, or say where not.

Each run of the 1/4-scale machine with scattered soil that the store has (blade on the floor, moved as imposed) is
driven again on the rig's soil: the settled grains' surface as the height field, the same blade along the same way, the
same measures by the same code. Fitted are the angle of repose, the friction on the blade and how readily slopes follow
(spread and casting), then the friction within the soil (load).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from graderd.evaluation.bed import Grid
from graderd.evaluation.measures import Blade, Spread, spread
from graderd.simulator.grader.blade import BladePose, Plough
from graderd.simulator.grader.load import blade_load
from graderd.simulator.grader.soil import SoilField, SoilProperties
from graderd.studies.blade_rotation.case import PACKING, QUARTER_SIZE, Case, Work
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.outcome import CELL_MM, RULES, grid_over, surface
from graderd.studies.blade_rotation.store import Store, written

F64 = npt.NDArray[np.float64]

PAGE: Final = "rig-soil.md"
CELL_M: Final = CELL_MM / 1000.0
MARGIN_M: Final = 1.5
MOVE_M: Final = 0.01
LOAD_MOVES: Final = 5
"""Moves from one look at the load to the next."""
SPREADS: Final = (f"spread_{Spread.EXTREME}_mm", f"spread_{Spread.MASS_95}_mm")
CAST: Final = "cast_mm"
"""How far the soil's middle goes to the left in the pass."""
LOAD: Final = "blade_load_n"
MEASURES: Final = (*SPREADS, CAST, LOAD)
CAST_SCALE_MM: Final = 1000.0
"""Casting is compared as a share of the blade's length: it may be zero."""
FITTED: Final = ("repose_deg", "steel_friction", "slide_m")
START: Final = (34.0, 0.37, 0.06)
LOW: Final = (15.0, 0.02, 0.005)
HIGH: Final = (45.0, 1.5, 1.0)
AGREES_SHARE: Final = 0.10
TRIES_N: Final = 40
"""Sets of values that the fit looks at; each is half a second a run."""


@dataclass(frozen=True, slots=True)
class Run:
    """A run with grains: its soil before (heights of a field of ``CELL_M`` whose axis y = 0 is the blade's way), where
    the blade's axis went, and its measures."""

    case: Case
    heights_m: F64
    from_x_m: float
    to_x_m: float
    dem: dict[str, float]

    @property
    def distribution(self) -> str:
        """Whose angles are compared with one another."""
        return "middle" if self.case.work is Work.MIDDLE else f"left, end {self.case.sense}"


def runs(store: Store) -> list[Run]:
    """What the store has to fit to, in the order of distribution, angle and seed.

    Raises:
        StudyError: nothing.
    """
    found = []
    for result in store.results():
        case = result.case
        if (
            case.blade == QUARTER_SIZE
            and case.work is not Work.FLATTENING
            and (case.motion, case.decision, case.gap_m) == ("imposed", "held", 0.0)
        ):
            found.append(_run(store, case, result.measures))
    if not found:
        raise StudyError(str(store.folder), "no run of the 1 m blade with scattered soil", "graderd study paper")
    return sorted(found, key=lambda run: (run.distribution, run.case.angle_deg, run.case.seed))


def _run(store: Store, case: Case, measures: dict[str, float]) -> Run:
    soil = {name: np.array(column) for name, column in store.table(case, "soil").to_pydict().items()}
    frames = store.table(case, "frames").to_pydict()
    first, last = (np.flatnonzero(soil["frame"] == frame) for frame in (0, soil["frame"].max()))
    weight = soil["radius"] ** 3
    before, after = (float(np.average(soil["y"][each], weights=weight[each])) for each in (first, last))
    grains = np.zeros((first.size, 5))
    for column, name in enumerate(("x", "y", "z", "radius"), 1):
        grains[:, column] = soil[name][first]
    grains[:, 2] -= case.blade_y_m
    start, end = float(frames["x"][0]), float(frames["x"][-1])
    left = min(start, float(grains[:, 1].min())) - MARGIN_M
    grains[:, 1] -= left
    grid = grid_over(grains)
    heights_mm = surface(grains, grid)
    length, half = math.ceil((end - left + MARGIN_M + 1.0) / CELL_M), math.ceil(2.5 / CELL_M)
    heights = np.zeros((length, 2 * half))
    heights[grid.first_x : grid.first_x + grid.cells_x, grid.first_y + half : grid.first_y + half + grid.cells_y] = (
        heights_mm / 1000.0
    )
    # The surface over coarse grains is rough; their volume is known.
    volume_m3 = float((4.0 / 3.0 * math.pi * grains[:, 4] ** 3).sum()) / PACKING
    heights *= volume_m3 / (float(heights.sum()) * CELL_M**2)
    dem = {name: measures[name] for name in (*SPREADS, LOAD)} | {CAST: 1000.0 * (after - before)}
    return Run(case, heights, start - left, end - left, dem)


def driven(run: Run, soil: SoilProperties) -> dict[str, float]:
    """The same pass on the rig's soil: its :data:`MEASURES`."""
    length, width = (cells * CELL_M for cells in run.heights_m.shape)
    field = SoilField(cell_m=CELL_M, length_m=length, width_m=width, soil=soil)
    field.add(run.heights_m)
    middle = _middle_m(field)
    plough, pose = Plough(field), BladePose(angle_deg=run.case.angle_ccw_deg)
    loads = []
    places = np.linspace(run.from_x_m, run.to_x_m, math.ceil((run.to_x_m - run.from_x_m) / MOVE_M) + 1)
    for number, (here, there) in enumerate(pairwise(places.tolist())):
        plough.move(here, pose, there, pose)
        if number % LOAD_MOVES == 0:
            load_n = blade_load(field, there, pose, run.case.speed_m_per_s, 0.0).force_n
            if load_n > 0.0:
                loads.append(load_n)
    blade = Blade(
        1000.0 * run.to_x_m, 0.0, pose.angle_deg, 1000.0 * run.case.blade.length_m, 1000.0 * run.case.travel_m
    )
    half = field.heights_m.shape[1] // 2
    grid = Grid(1000.0 * CELL_M, 0, -half, *field.heights_m.shape)
    widths = spread(1000.0 * field.heights_m, grid, 0.0, RULES, (Spread.EXTREME, Spread.MASS_95), blade)
    cast = 1000.0 * (_middle_m(field) - middle)
    return {name: widths[name] for name in SPREADS} | {CAST: cast, LOAD: float(np.mean(loads))}


def all_driven(of: Sequence[Run], soil: SoilProperties) -> list[dict[str, float]]:
    """:func:`driven` of each."""
    return [driven(run, soil) for run in of]


def _middle_m(field: SoilField) -> float:
    across = field.heights_m.sum(axis=0)
    return float(across @ field.y_m / across.sum())


def misfit(run: Run, rig: dict[str, float]) -> F64:
    """How far the rig is from the grains in spread and casting, as shares."""
    shares = [rig[name] / run.dem[name] - 1.0 for name in SPREADS]
    return np.array([*shares, (rig[CAST] - run.dem[CAST]) / CAST_SCALE_MM])


def fit(of: Sequence[Run], tries_n: int = TRIES_N) -> SoilProperties:
    """The soil that makes the rig come nearest to these runs, by least squares (Nelder and Mead); to the first seed of
    each, as the rig has no seeds."""
    of = [of[numbers[0]] for numbers in _groups(of).values()]

    def soil_of(values: F64) -> SoilProperties:
        low, high = np.log(LOW), np.log(HIGH)
        return SoilProperties(**dict(zip(FITTED, np.exp(np.clip(values, low, high)).tolist(), strict=True)))

    def cost(values: F64) -> float:
        rig = all_driven(of, soil_of(values))
        return float(np.mean([np.mean(misfit(run, each) ** 2) for run, each in zip(of, rig, strict=True)]))

    start = np.log(START)
    simplex = np.vstack((start, start + np.diag((-0.3, 0.8, 1.0))))
    best = minimize(
        cost, start, method="Nelder-Mead", options={"maxfev": tries_n, "initial_simplex": simplex, "xatol": 0.02}
    )
    soil = soil_of(best.x)
    # The load is a straight line over the friction within the soil.
    less, more = (replace(soil, soil_friction=value) for value in (0.3, 0.7))
    at = np.array([[rig[LOAD] for rig in all_driven(of, each)] for each in (less, more)]).T
    slope = (at[:, 1] - at[:, 0]) / 0.4
    wanted = np.array([run.dem[LOAD] for run in of]) - at[:, 0]
    friction = 0.3 + float(slope @ wanted / (slope @ slope))
    return replace(soil, soil_friction=min(max(friction, 0.05), 2.0))


def write(store: Store, tries_n: int = TRIES_N) -> Path:
    """Fit, and write the page into the store's folder.

    Raises:
        StudyError: there is nothing to fit to.
    """
    of = runs(store)
    soil = fit(of, tries_n)
    path = store.folder / PAGE
    written(path, f"# The rig's soil, fitted to grains\n\n{page(of, soil)}")
    return path


def page(of: Sequence[Run], soil: SoilProperties) -> str:
    """The fit and its error (Markdown)."""
    before, after = all_driven(of, SoilProperties()), all_driven(of, soil)
    values = {name: round(getattr(soil, name), 3) for name in (*FITTED, "soil_friction")}
    text = [
        f"{len(of)} runs of the 1 m blade with {min(run.case.grains_n for run in of)} grains or more, "
        f"{of[0].case.travel_m:g} m of travel. The fit: "
        f"`SoilProperties({', '.join(f'{name}={value:g}' for name, value in values.items())})`.",
        "## Order of the angles",
        "\n".join(_orders(of, after)),
        "## Values",
        f"Grains / rig as it is / rig fitted, means over seeds. Bold: fitted, and still off by more than "
        f"{100 * AGREES_SHARE:.0f} % (casting: of the blade's length).",
        _values(of, before, after),
        "## Error",
        _errors(of, before, after),
    ]
    return "\n\n".join(text) + "\n"


def _groups(of: Sequence[Run]) -> dict[tuple[str, float], list[int]]:
    groups: dict[tuple[str, float], list[int]] = {}
    for number, run in enumerate(of):
        groups.setdefault((run.distribution, run.case.angle_deg), []).append(number)
    return groups


def _mean(numbers: Sequence[int], values: Sequence[dict[str, float]], name: str) -> float:
    return float(np.mean([values[number][name] for number in numbers]))


def _orders(of: Sequence[Run], rig: Sequence[dict[str, float]]) -> list[str]:
    """For each distribution and spread the angles from the widest to the narrowest, with grains and on the rig."""
    lines = []
    for distribution in dict.fromkeys(run.distribution for run in of):
        groups = {angle: numbers for (name, angle), numbers in _groups(of).items() if name == distribution}
        for measure in SPREADS:
            orders = []
            for values in ([run.dem for run in of], rig):
                widths = {angle: _mean(numbers, values, measure) for angle, numbers in groups.items()}
                orders.append(", ".join(f"{angle:g}°" for angle in sorted(widths, key=lambda each: -widths[each])))
            same = "the same on the rig" if orders[0] == orders[1] else f"**not the same** on the rig: {orders[1]}"
            lines.append(f"- {distribution}, {measure.removesuffix('_mm')}: {orders[0]} with grains, {same}.")
    return lines


def _off(name: str, rig: float, dem: float) -> float:
    return (rig - dem) / CAST_SCALE_MM if name == CAST else rig / dem - 1.0


def _values(of: Sequence[Run], before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]) -> str:
    dem = [run.dem for run in of]
    lines = [f"| soil | angle | runs | {' | '.join(MEASURES)} |", "|" + "---|" * (3 + len(MEASURES))]
    for (distribution, angle), numbers in _groups(of).items():
        cells = []
        for name in MEASURES:
            grains, old, new = (_mean(numbers, values, name) for values in (dem, before, after))
            off = abs(_off(name, new, grains)) > AGREES_SHARE
            cells.append(f"{grains:.0f} / {old:.0f} / {f'**{new:.0f}**' if off else f'{new:.0f}'}")
        lines.append(f"| {distribution} | {angle:g}° | {len(numbers)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _errors(of: Sequence[Run], before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]) -> str:
    lines = ["| measure | rig as it is | rig fitted |", "|---|---|---|"]
    for name in MEASURES:
        cells = [
            math.sqrt(np.mean([_off(name, rig[name], run.dem[name]) ** 2 for run, rig in zip(of, values, strict=True)]))
            for values in (before, after)
        ]
        lines.append(f"| {name} | {100 * cells[0]:.1f} % | {100 * cells[1]:.1f} % |")
    return "Root mean square over the runs; of casting in shares of the blade's length.\n\n" + "\n".join(lines)
