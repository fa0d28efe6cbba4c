"""From where the grains ended to measures: a map as a camera above would see it, and ``graderd.evaluation``'s code."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from graderd.core.blade import blade_coordinates
from graderd.evaluation.bed import Grid
from graderd.evaluation.load import load, load_along
from graderd.evaluation.measures import Blade, Interval, NothingThereError, Rules, Spread, height_difference, spread
from graderd.studies.blade_rotation.case import NEWTON_G_M_PER_S2, Case, Work
from graderd.studies.blade_rotation.lammps import FORCES, Motion
from graderd.studies.blade_rotation.pile import F64

if TYPE_CHECKING:
    import pyarrow as pa

CELL_MM = 20.0
MARGIN_MM = 200.0
RULES = Rules(edge_mm=10.0)
"""As ``graderd evaluate`` has it."""
WHOLE = Rules(RULES.edge_mm, Interval(-1e9, 1e9), Interval(-1e9, 1e9))
"""The same over all that is known, as over an area that is named."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The grains at one time: rows of :data:`~.files.GRAIN`, m and m/s; where the blade is then."""

    time_s: float
    travel_m: float
    blade: Motion
    grains: F64


def grid_over(*states: F64) -> Grid:
    """Cells for all states of the grains, with bare floor all about."""
    low, high = [], []
    for column in (1, 2):
        edges = [(float((g[:, column] - g[:, 4]).min()), float((g[:, column] + g[:, 4]).max())) for g in states]
        low.append(math.floor((min(a for a, _ in edges) * 1000.0 - MARGIN_MM) / CELL_MM))
        high.append(math.ceil((max(b for _, b in edges) * 1000.0 + MARGIN_MM) / CELL_MM))
    return Grid(CELL_MM, low[0], low[1], high[0] - low[0], high[1] - low[1])


def surface(grains: F64, grid: Grid) -> F64:
    """Height of the topmost grain over each cell's middle, mm; bare floor is 0."""
    x, y, z, r = (grains[:, column] * 1000.0 for column in (1, 2, 3, 4))
    heights = np.zeros((grid.cells_x, grid.cells_y))
    reach = math.ceil(float(r.max()) / grid.cell_mm) + 1
    i = np.floor(x / grid.cell_mm).astype(int) - grid.first_x
    j = np.floor(y / grid.cell_mm).astype(int) - grid.first_y
    for di in range(-reach, reach + 1):
        for dj in range(-reach, reach + 1):
            a, b = i + di, j + dj
            off2 = (grid.x_mm[a] - x) ** 2 + (grid.y_mm[b] - y) ** 2
            under = off2 <= r**2
            top = z[under] + np.sqrt(r[under] ** 2 - off2[under])
            np.maximum.at(heights, (a[under], b[under]), top)
    return heights


def quality(case: Case, before: Frame, frame: Frame) -> dict[str, float]:
    """Work quality as it would be measured if the pass ended at ``frame``; nothing where there is no soil to measure.

    The layer of flattening is where soil stood above the desired height ``before``, as far as the blade has passed.
    """
    x_mm, y_mm, _ = (place * 1000.0 for place in frame.blade.place_m)
    yaw_deg = math.degrees(frame.blade.yaw_rad)
    try:
        if case.work is Work.FLATTENING:
            grid = grid_over(before.grains, frame.grains)
            heights = surface(frame.grains, grid)
            along, across = np.meshgrid(grid.x_mm - x_mm, grid.y_mm - y_mm, indexing="ij")
            _, ahead_mm = blade_coordinates(along, across, yaw_deg)
            target_mm = case.gap_m * 1000.0
            layer = (ahead_mm < 0.0) & (surface(before.grains, grid) > target_mm)
            known = np.where(layer, heights, np.nan)
            return height_difference(known, grid, target_mm, 0.0, float("nan"), WHOLE)
        grid = grid_over(frame.grains)
        heights = surface(frame.grains, grid)
        blade = Blade(x_mm, y_mm, yaw_deg, case.blade.length_m * 1000.0, case.travel_m * 1000.0)
        try:
            return spread(heights, grid, 0.0, RULES, tuple(Spread), blade)
        except NothingThereError:  # the blade still has all of it
            return spread(heights, grid, 0.0, RULES, tuple(Spread))
    except NothingThereError:
        return {}


def measures(case: Case, frames: list[Frame], forces: F64, along: F64, contact_s: float) -> dict[str, float]:
    """The measures of the whole pass. ``forces``: rows of :data:`~.lammps.FORCES`; ``along``: one row a frame;
    ``contact_s``: when the blade met the soil."""
    column = {name: forces[:, number] for number, name in enumerate(FORCES)}
    since = column["time"] >= contact_s
    resultant = np.column_stack([column[name][since] for name in ("fx", "fy", "fz")])
    found = quality(case, frames[0], frames[-1]) | load(resultant) | load_along(along.sum(axis=0))
    found["draft_n"] = float(-column["fx"][since].mean())
    found["side_draft_n"] = float(column["fy"][since].mean())
    found["yaw_torque_nm"] = float(column["mz"][since].mean())
    found["yaw_torque_max_nm"] = float(np.abs(column["mz"][since]).max())
    return found


def checks(frames: list[Frame], forces: F64, density_kg_per_m3: float, dangerous_n: int) -> dict[str, float]:
    """What must hold whatever the soil does.

    ``grains_lost_n``: grains that are not there at the end with the size they began with. ``momentum_share``: the
    soil's momentum along the travel less what blade and floor gave it, as a share of the blade's. ``gained_share``: the
    energy that came from nowhere between two frames, at most, as a share of the blade's work: collisions and friction
    take energy, nothing gives any. ``pace_max_m_per_s``: of the fastest grain; ``dangerous_builds_n``: as told by the
    engine.
    """
    first, last = frames[0], frames[-1]
    same = first.grains.shape == last.grains.shape and np.array_equal(first.grains[:, (0, 4)], last.grains[:, (0, 4)])
    lost = 0 if same else abs(len(first.grains) - len(last.grains)) or len(first.grains)
    column = {name: forces[:, number] for number, name in enumerate(FORCES)}
    time = column["time"]
    window = float(np.median(np.diff(time)))
    given = float(((column["floor_x"] - column["fx"]) * window).sum())
    pushed = float((np.abs(column["fx"]) * window).sum())
    change = float(_momentum_x(last, density_kg_per_m3) - _momentum_x(first, density_kg_per_m3))
    # Work on the soil by the moving blade, summed up to each frame.
    rates = [np.gradient(column[name], time) for name in ("dx", "dy", "dz", "theta")]
    axes = ("fx", "fy", "fz", "mz")
    power = -sum((column[axis] * rate for axis, rate in zip(axes, rates, strict=True)), start=np.zeros_like(time))
    work = np.interp([frame.time_s for frame in frames], time, np.cumsum(power) * window)
    held = np.array([_energy_j(frame, density_kg_per_m3) for frame in frames])
    taken = np.diff(work - held)
    total = float(work[-1])
    fastest = max(float(np.linalg.norm(frame.grains[:, 5:8], axis=1).max()) for frame in frames)
    return {
        "grains_lost_n": float(lost),
        "momentum_share": abs(change - given) / pushed if pushed else 0.0,
        "gained_share": float(max(0.0, -taken.min(initial=0.0)) / total) if total > 0.0 else 0.0,
        "work_j": total,
        "pace_max_m_per_s": fastest,
        "dangerous_builds_n": float(dangerous_n),
    }


def _mass_kg(frame: Frame, density_kg_per_m3: float) -> F64:
    return np.asarray(density_kg_per_m3 * 4.0 / 3.0 * math.pi * frame.grains[:, 4] ** 3)


def _momentum_x(frame: Frame, density_kg_per_m3: float) -> float:
    return float(_mass_kg(frame, density_kg_per_m3) @ frame.grains[:, 5])


def _energy_j(frame: Frame, density_kg_per_m3: float) -> float:
    mass = _mass_kg(frame, density_kg_per_m3)
    return float(mass @ ((frame.grains[:, 5:8] ** 2).sum(axis=1) / 2.0 + NEWTON_G_M_PER_S2 * frame.grains[:, 3]))


def tables(case: Case, frames: list[Frame], forces: F64, along: F64) -> dict[str, pa.Table]:
    """What is kept beside the measures: quality over the travel, forces over time, load along the blade, the soil."""
    import pyarrow as pa

    over = [{"travel_m": frame.travel_m} | quality(case, frames[0], frame) for frame in frames]
    names = list(dict.fromkeys(name for row in over for name in row))
    step = pairwise([frame.time_s for frame in frames])
    soil = {
        "frame": np.concatenate([np.full(len(frame.grains), n, np.int32) for n, frame in enumerate(frames)]),
        **{
            name: np.concatenate([frame.grains[:, column] for frame in frames]).astype(np.float32)
            for column, name in enumerate(("x", "y", "z", "radius"), 1)
        },
    }
    place = ("time_s", "travel_m", "x", "y", "yaw_rad")
    blade = [
        (frame.time_s, frame.travel_m, frame.blade.place_m[0], frame.blade.place_m[1], frame.blade.yaw_rad)
        for frame in frames
    ]
    return {
        "travel": pa.table({name: [row.get(name) for row in over] for name in names}),
        "forces": pa.table({name: forces[:, number].astype(np.float32) for number, name in enumerate(FORCES)}),
        "along": pa.table({"until_s": [end for _, end in step], "load_n": list(along)}),
        "soil": pa.table(soil),
        "frames": pa.table({name: [row[number] for row in blade] for number, name in enumerate(place)}),
    }
