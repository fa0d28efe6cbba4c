"""What a pass did, in numbers, from maps of heights above bare ground. Definitions stand with their functions.

Heights and lengths are millimetres in the bed frame (``bed.py``), volumes litres.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

import cv2
import numpy as np

from graderd.core.blade import blade_coordinates
from graderd.evaluation.bed import SMOOTH_MM, SOIL_DEVIATIONS_N, Bool, Grid, box_mean, dilate, erode
from graderd.evaluation.ground import F64

LENGTH_SHARE = 0.95
"""The soil's length along the travel is the stretch that holds this share of it."""
LUMP_SHARE = 0.02
FINER_N = 10
RIM_MM = 60.0
"""What lies so near to soil still counts to it, so that its thin foot does."""
FLANK = 0.75
"""From where a layer is half as high to its full height it takes this many of its heights, at 34 degrees."""
EDGE_RANGE = (0.4, 2.5)
"""Where soil ends is read off a line through its flank between these parts of the edge's height."""


class Spread(StrEnum):
    """Definitions of the degree of spread, all of them widths across the travel."""

    EXTREME = "extreme"
    MASS_90 = "mass_90"
    MASS_95 = "mass_95"
    SECOND_MOMENT = "second_moment"


class Interval(NamedTuple):
    """From and to, mm."""

    low_mm: float
    high_mm: float


EVERYWHERE: Final = Interval(-np.inf, np.inf)


@dataclass(frozen=True, slots=True)
class Blade:
    """Where the blade stood at the end of the pass: its axis on the bed, its angle, and how far ahead soil is "
    "carried."""

    x_mm: float
    y_mm: float
    angle_deg: float
    length_mm: float
    reach_mm: float


@dataclass(frozen=True, slots=True)
class Rules:
    """What counts: soil from ``edge_mm`` in height; the part of the bed that is looked at."""

    edge_mm: float = 10.0
    x_mm: Interval = EVERYWHERE
    y_mm: Interval = EVERYWHERE

    def area(self, grid: Grid) -> Bool:
        """The cells of the part that is looked at."""
        x, y = grid.x_mm[:, None], grid.y_mm[None, :]
        inside = (x >= self.x_mm.low_mm) & (x <= self.x_mm.high_mm) & (y >= self.y_mm.low_mm) & (y <= self.y_mm.high_mm)
        return np.asarray(inside, dtype=np.bool_)

    @property
    def limited(self) -> bool:
        """Whether a part was named at all."""
        return bool(np.isfinite([*self.x_mm, *self.y_mm]).any())


class NothingThereError(Exception):
    """There is no soil to measure."""


def soil_cells(heights: F64, grid: Grid, area: Bool, noise_mm: float, edge_mm: float) -> Bool:
    """Where soil lies: heights over 100 x 100 mm stand out of half the edge's height and of the ground's noise. Lumps
    with less than a fiftieth of the largest one's volume do not count: clods, and what noise makes."""
    smooth = box_mean(heights, grid.cells(SMOOTH_MM))
    soil = (smooth > max(edge_mm / 2.0, SOIL_DEVIATIONS_N * noise_mm)) & area
    lumps_n, lump = cv2.connectedComponents(soil.astype(np.uint8))
    volume = np.bincount(lump.reshape(-1), np.where(soil, smooth, 0.0).reshape(-1), minlength=lumps_n)
    return np.asarray(soil & (volume >= LUMP_SHARE * volume.max())[lump], dtype=np.bool_)


def height_difference(
    heights: F64, grid: Grid, target_mm: float, noise_mm: float, cell_noise_mm: float, rules: Rules
) -> dict[str, float]:
    """Flattening: how the layer lies to the target plane, ``target_mm`` above the ground and parallel to it.

    ``height_difference_mm``: mean of height less target over the area named, or else over the soil without its flanks
    (what is within 60 mm and three quarters of its height of where it is half as high); negative where the layer is too
    low. ``height_spread_mm``: standard deviation of the cells' heights over the same, the scans' own noise taken off
    where repeated scans tell it.

    Raises:
        NothingThereError: no cell of the layer was seen.
    """
    here = layer_cells(heights, grid, noise_mm, rules)
    off = heights[here] - target_mm
    variance = float(off.var()) - (cell_noise_mm**2 if np.isfinite(cell_noise_mm) else 0.0)
    return {"height_difference_mm": float(off.mean()), "height_spread_mm": max(variance, 0.0) ** 0.5}


def layer_cells(heights: F64, grid: Grid, noise_mm: float, rules: Rules) -> Bool:
    """The cells whose heights say how flat the layer is.

    Raises:
        NothingThereError: there are none.
    """
    area = rules.area(grid) & np.isfinite(heights)
    here = area
    if not rules.limited:
        smooth = box_mean(heights, grid.cells(SMOOTH_MM))
        soil = soil_cells(heights, grid, area, noise_mm, rules.edge_mm)
        height_mm = float(np.median(smooth[soil])) if soil.any() else 0.0
        here = erode(soil & (smooth > height_mm / 2.0), grid.cells(RIM_MM + FLANK * height_mm))
    if not here.any():
        raise NothingThereError("no layer of soil is to be seen in the area")
    return here


def spread(
    heights: F64, grid: Grid, noise_mm: float, rules: Rules, definitions: tuple[Spread, ...], blade: Blade | None = None
) -> dict[str, float]:
    """Scattering: the degree of spread, the width over which soil lies across the travel.

    All definitions look at the profile across the bed: at each y, the heights of the soil along the travel summed up.

    - ``extreme``: between the outermost places where the profile is ``edge_mm`` high, as a mean over the soil's length
      (the stretch along the travel that holds 95 % of it): how far soil reaches to the left and to the right;
    - ``mass_90``, ``mass_95``: the width that holds 90 or 95 % of the soil, what is left out in equal parts at both
      sides;
    - ``second_moment``: the square root of 12 times the profile's standard deviation, the width of an even layer that
      is spread as far.

    With ``blade``, soil that it still carries (from its face to its reach ahead, along its length) counts in these and
    is left out in ``spread_..._without_carried_mm``; soil farther ahead, which it has not met, counts in neither.

    Raises:
        NothingThereError: no soil.
    """
    area = rules.area(grid)
    if blade is None:
        return _spread(heights, grid, area, noise_mm, rules, definitions, "mm")
    s, d = _from_blade(grid, blade)
    beside = (np.abs(s) <= blade.length_mm / 2.0) & (d > 0.0)
    carried = beside & (d <= blade.reach_mm)
    with_it = _spread(heights, grid, area & ~(beside & ~carried), noise_mm, rules, definitions, "mm")
    return with_it | _spread(heights, grid, area & ~beside, noise_mm, rules, definitions, "without_carried_mm")


def _from_blade(grid: Grid, blade: Blade) -> tuple[F64, F64]:
    x, y = np.meshgrid(grid.x_mm - blade.x_mm, grid.y_mm - blade.y_mm, indexing="ij")
    return blade_coordinates(x, y, blade.angle_deg)


def _spread(
    heights: F64, grid: Grid, area: Bool, noise_mm: float, rules: Rules, definitions: tuple[Spread, ...], unit: str
) -> dict[str, float]:
    soil = soil_cells(heights, grid, area, noise_mm, rules.edge_mm)
    counted = dilate(soil, grid.cells(RIM_MM)) & area & np.isfinite(heights)
    field = np.where(counted, heights, 0.0)
    across = field.sum(axis=0)
    if not soil.any() or across.sum() <= 0.0:
        raise NothingThereError("no soil is to be seen in the area")
    widths: dict[str, float] = {}
    for definition in definitions:
        match definition:
            case Spread.EXTREME:
                length_cells = _holding(field.sum(axis=1), grid.x_mm, LENGTH_SHARE) / grid.cell_mm
                width = _reach(across / length_cells, grid.y_mm, rules.edge_mm)
            case Spread.MASS_90 | Spread.MASS_95:
                width = _holding(across, grid.y_mm, 0.90 if definition is Spread.MASS_90 else 0.95)
            case Spread.SECOND_MOMENT:
                middle = float(across @ grid.y_mm / across.sum())
                variance = float(across @ (grid.y_mm - middle) ** 2 / across.sum())
                width = float(np.sqrt(12.0 * max(variance, 0.0)))
        widths[f"spread_{definition}_{unit}"] = width
    return widths


def _holding(profile: F64, places_mm: F64, share: float) -> float:
    """Width of the stretch that holds ``share`` of a profile, the rest in equal parts beyond its two ends."""
    step = places_mm[1] - places_mm[0]
    before = np.cumsum(profile) - profile
    # Within a cell by a cubic that keeps the cell's sum and takes the heights at its two edges from its neighbours.
    edge = np.convolve(profile, (0.5, 0.5))
    t = (np.arange(FINER_N) / FINER_N)[None, :]
    here, low_edge, high_edge = (each[:, None] for each in (profile, edge[:-1], edge[1:]))
    inner = here * t**2 * (3 - 2 * t) + low_edge * t * (1 - t) ** 2 - high_edge * t**2 * (1 - t)
    held = np.maximum.accumulate(
        (before[:, None] + inner).reshape(-1) / profile.sum()
    )  # noise takes a little away again
    fine_mm = ((places_mm - step / 2.0)[:, None] + t * step).reshape(-1)
    low, high = np.interp(((1.0 - share) / 2.0, (1.0 + share) / 2.0), held, fine_mm)
    return float(high - low)


def _reach(profile: F64, places_mm: F64, edge_mm: float) -> float:
    """Distance between the outermost places where a profile is ``edge_mm`` high."""
    high = np.flatnonzero(profile >= edge_mm)
    if not high.size:
        raise NothingThereError(f"no soil is {edge_mm:g} mm high")
    least, most = EDGE_RANGE[0] * edge_mm, EDGE_RANGE[1] * edge_mm
    ends = []
    for at, outward in ((int(high[0]), -1), (int(high[-1]), 1)):
        low, top = at, at
        while 0 <= low + outward < profile.size and profile[low + outward] > least:
            low += outward
        while 0 <= top - outward < profile.size and edge_mm / 2.0 < profile[top - outward] < most:
            top -= outward
        flank = np.arange(min(low, top), max(low, top) + 1)
        if flank.size < 3 or np.ptp(profile[flank]) < edge_mm / 2.0:  # steep: between two cells
            out = min(max(at + outward, 0), profile.size - 1)
            flank = np.array((at, out) if profile[out] < edge_mm else (at,))
        if flank.size == 1:
            ends.append(float(places_mm[at]))
        else:
            slope, start = np.polyfit(profile[flank], places_mm[flank], 1)
            ends.append(float(slope * edge_mm + start))
    return ends[1] - ends[0]


def volume_moved(before: F64, after: F64, grid: Grid, noise_mm: float, rules: Rules) -> dict[str, float]:
    """Soil that changed its place between two maps of the same cells.

    ``volume_moved_l``: what is gone from where it lay. ``volume_balance_l``: what came less what went; far from 0, soil
    left the view, or was loosened or packed.
    """
    change = np.where(rules.area(grid), after - before, np.nan)
    smooth = box_mean(change, grid.cells(SMOOTH_MM))
    clear = max(rules.edge_mm / 2.0, SOIL_DEVIATIONS_N * noise_mm)
    came, went = dilate(smooth > clear, grid.cells(RIM_MM)), dilate(smooth < -clear, grid.cells(RIM_MM))
    came, went = came & ~(went & (smooth < 0.0)), went & ~(came & (smooth > 0.0))
    known = np.where(np.isfinite(change), change, 0.0)
    gained, lost = (float(known[cells].sum()) * grid.cell_l_per_mm for cells in (came & ~went, went))
    return {"volume_moved_l": -lost, "volume_balance_l": gained + lost}


def windrow(heights: F64, grid: Grid, noise_mm: float, rules: Rules) -> dict[str, float]:
    """The ridge that a pass leaves along its way, in the mean profile across the bed.

    Its foot is the layer's height, the median of the profile over the soil. ``windrow_height_mm``: the profile's
    highest place above that. ``windrow_l_per_m``: what stands more than ``edge_mm`` above it about that place, from the
    foot up, for each metre along the travel; 0 where there is no such ridge. ``windrow_y_mm``: where it lies, to the
    left positive; absent where there is none.

    Raises:
        NothingThereError: no soil.
    """
    area = rules.area(grid) & np.isfinite(heights)
    soil = soil_cells(heights, grid, area, noise_mm, rules.edge_mm)
    rows = soil.any(axis=1)
    if not rows.any():
        raise NothingThereError("no soil is to be seen in the area")
    count = area[rows].sum(axis=0)
    profile = np.where(area[rows], heights[rows], 0.0).sum(axis=0) / np.maximum(count, 1)
    bearing = (count > 0) & (soil[rows].sum(axis=0) > 0.5 * count)
    if not bearing.any():
        bearing = count > 0
    foot = float(np.median(profile[bearing]))
    above = np.where(count > 0, profile - foot, 0.0)
    top = int(above.argmax())
    found = {"windrow_height_mm": float(above[top]), "windrow_l_per_m": 0.0}
    if above[top] > rules.edge_mm:
        low, high = top, top
        while low > 0 and above[low - 1] > rules.edge_mm:
            low -= 1
        while high < above.size - 1 and above[high + 1] > rules.edge_mm:
            high += 1
        part = above[low : high + 1]
        found["windrow_l_per_m"] = float(part.sum()) * grid.cell_mm / 1000.0
        found["windrow_y_mm"] = float(part @ grid.y_mm[low : high + 1] / part.sum())
    return found
