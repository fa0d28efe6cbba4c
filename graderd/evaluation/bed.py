"""A bed of soil as a map of heights above its bare ground, made of repeated scans of the same state.

Bed frame: x in the direction of travel, y to the operator's left, z up from the ground, millimetres; the origin is the
foot of the sensor on the ground. ``heights_mm`` is ``(cells along x, cells along y)``, NaN where nothing is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from graderd.evaluation.ground import F64, NoGroundError, Plane, find_plane

Bool = npt.NDArray[np.bool_]

PLANE_POINTS_N = 100_000
"""So many points are plenty to find a plane and the extent of what is seen."""
CELLS_MAX_N = 4_000_000
SMOOTH_MM = 50.0
"""Half the side of the square that heights are averaged over where soil is told from ground."""
GROUND_MM = 200.0
"""Less bare ground than a square of this side is none."""
SEEN_SHARE = 0.2
"""A cell with fewer points than this share of what is usual was not seen."""
FAR_DEVIATIONS_N = 4.0
CLEAR_MM = 60.0
"""Ground nearer than this to soil is not used as ground."""
HOLE_MM = 160.0
"""Holes up to twice this wide are filled from their rims; what is wider, or outside the view, stays unknown."""
SMOOTHINGS_N = 25
UPRIGHT_MM = 150.0
"""Heights that differ by more than this within :data:`UPRIGHT_WITHIN_MM` belong to a thing: no soil is as steep."""
UPRIGHT_WITHIN_MM = 90.0
WALL_SLOPE = 2.0
"""Where the mean profile along or across the bed rises more steeply than this (63 degrees), a wall stands."""
WALL_WITHIN_MM = 20.0
WALL_FOOT_MM = 30.0
"""So much before a wall belongs to it: noise mixes the two."""
SOIL_DEVIATIONS_N = 3.5
"""Soil stands out of the ground's noise, averaged over that square, by this many of its deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """One scan: points (N x 3, mm) in the sensor's frame, with the directions up and forward in it, of length 1."""

    points_mm: F64
    up: F64
    forward: F64


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Square cells in the bed frame; ``first_x`` and ``first_y`` number the first ones, so that grids agree."""

    cell_mm: float
    first_x: int
    first_y: int
    cells_x: int
    cells_y: int

    @property
    def x_mm(self) -> F64:
        """Middles of the cells along the travel."""
        return np.asarray((np.arange(self.cells_x) + self.first_x + 0.5) * self.cell_mm, dtype=np.float64)

    @property
    def y_mm(self) -> F64:
        """Middles of the cells across it."""
        return np.asarray((np.arange(self.cells_y) + self.first_y + 0.5) * self.cell_mm, dtype=np.float64)

    def cells(self, length_mm: float) -> int:
        """How many cells a length is, at least one."""
        return max(1, round(length_mm / self.cell_mm))

    @property
    def cell_l_per_mm(self) -> float:
        """Litres in one cell, a millimetre high."""
        return self.cell_mm**2 / 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Bed:
    """The map of one state: ``heights_mm`` with small holes filled, and what its uncertainty is told from.

    ``measured``: cells that were seen, not filled; ``inside``: those and the filled ones. ``ground``: the bare ones
    that say where the ground's plane is; none where scans of the empty bed say it. ``residual_mm``: what bare ground
    shows beside its plane, NaN elsewhere: the noise. ``noise_mm``: its deviation averaged as for telling soil.
    ``repeats_mm``: the map with one scan left out, for each of them; empty for a single scan. ``cell_noise_mm``:
    deviation of a cell's height in the mean of all scans, from how they differ; NaN for a single scan.
    """

    grid: Grid
    heights_mm: F64
    measured: Bool
    inside: Bool
    ground: Bool
    residual_mm: F64
    noise_mm: float
    repeats_mm: tuple[F64, ...]
    cell_noise_mm: float


def bed_of(scans: Sequence[Points], cell_mm: float, grid: Grid | None = None, bare: Sequence[Points] = ()) -> Bed:
    """The map of one state from its repeated scans, which the sensor took from one place.

    ``grid``: the cells to use, for maps that are to be compared. ``bare``: scans of the empty bed from the same place,
    which then say where the ground is.

    Raises:
        NoGroundError: the ground cannot be found.
    """
    plane = _plane(bare or scans)
    frames = [_in_bed(scan, plane) for scan in scans]
    grid = grid or grid_of(frames[:1], cell_mm)
    binned = [_bin(frame, grid) for frame in frames]
    sums, counts = (np.stack([part[number] for part in binned]) for number in (0, 1))
    heights = _mean(sums, counts)
    total = counts.sum(axis=0)
    heights[total < SEEN_SHARE * float(np.median(total[total > 0]))] = np.nan
    heights[~_between_walls(heights, grid)] = np.nan
    measured = np.isfinite(heights)
    if not measured.any():
        raise NoGroundError("nothing but upright things is to be seen")
    inside = _close(measured, grid.cells(HOLE_MM))
    if bare:
        ground, level = np.zeros_like(measured), np.zeros_like(heights)
        empty = [_bin(_in_bed(scan, plane), grid) for scan in bare]
        residual = _mean(np.stack([part[0] for part in empty]), np.stack([part[1] for part in empty]))
        residual *= np.sqrt(max(1.0, len(bare) / len(scans)))
    else:
        ground, level = _level(heights, grid)
        residual = np.where(ground, heights - level, np.nan)
    heights -= level
    repeats = []
    for left_out in range(len(scans)) if len(scans) > 1 else ():
        others = np.arange(len(scans)) != left_out
        each = _mean(sums[others], counts[others])
        each[~measured] = np.nan
        repeats.append(fill(each - (level if bare else LevelFit(ground & np.isfinite(each), grid).of(each)), inside))
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    cell_noise = _scan_noise_mm(each, measured & (counts > 0).all(axis=0))
    noise = float(np.sqrt(np.nanmean(box_mean(residual, grid.cells(SMOOTH_MM)) ** 2)))
    filled = fill(heights, inside)
    return Bed(grid, filled, measured, inside, ground, residual, noise, tuple(repeats), cell_noise)


def _plane(scans: Sequence[Points]) -> Plane:
    few = [scan.points_mm[:: max(1, len(scans) * len(scan.points_mm) // PLANE_POINTS_N)] for scan in scans]
    return find_plane(np.concatenate(few), scans[0].up)


def _in_bed(scan: Points, plane: Plane) -> F64:
    """Points in the bed frame."""
    ahead = scan.forward - plane.normal * float(scan.forward @ plane.normal)
    ahead /= np.linalg.norm(ahead)
    left = np.cross(plane.normal, ahead)
    result = scan.points_mm @ np.column_stack((ahead, left, plane.normal))
    result[:, 2] += plane.offset_mm
    return np.asarray(result, dtype=np.float64)


def grid_of(frames: Sequence[F64], cell_mm: float) -> Grid:
    """Cells for all of the points (bed frame); single points far away do not count.

    Raises:
        NoGroundError: that many cells cannot be meant.
    """
    few = [frame[:: max(1, len(frame) // PLANE_POINTS_N), :2] for frame in frames]
    ends = np.array([np.percentile(frame, (0.05, 99.95), axis=0) for frame in few])
    first = np.floor(ends[:, 0].min(axis=0) / cell_mm).astype(int)
    last = np.ceil(ends[:, 1].max(axis=0) / cell_mm).astype(int)
    cells = np.maximum(last - first, 1)
    if int(cells[0]) * int(cells[1]) > CELLS_MAX_N:
        size = " x ".join(f"{value * cell_mm / 1000:.0f}" for value in cells)
        raise NoGroundError(f"{size} m in cells of {cell_mm:g} mm are more than {CELLS_MAX_N} cells")
    return Grid(cell_mm, int(first[0]), int(first[1]), int(cells[0]), int(cells[1]))


def common_grid(states: Sequence[Sequence[Points]], cell_mm: float, bare: Sequence[Points] = ()) -> Grid:
    """The cells that hold several states of one bed.

    Raises:
        NoGroundError: the ground cannot be found.
    """
    return grid_of([_in_bed(scan, _plane(bare or scans)) for scans in states for scan in scans[:1]], cell_mm)


def _bin(points: F64, grid: Grid) -> tuple[F64, F64]:
    """Per cell the sum of heights and the number of points; lone points far off their cell do not count."""
    shape = (grid.cells_x, grid.cells_y)
    i = np.floor(points[:, 0] / grid.cell_mm).astype(np.int64) - grid.first_x
    j = np.floor(points[:, 1] / grid.cell_mm).astype(np.int64) - grid.first_y
    inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
    key, z = (i * shape[1] + j)[inside], points[inside, 2]
    size = shape[0] * shape[1]
    total, count, square = (np.bincount(key, value, minlength=size) for value in (z, None, z**2))
    mean = total / np.maximum(count, 1)
    square = np.maximum(square - count * mean**2, 0.0)
    far = (z - mean[key]) ** 2 > (FAR_DEVIATIONS_N**2 * square / np.maximum(count, 1))[key] + 1e-6
    if far.any():
        total -= np.bincount(key[far], z[far], minlength=size)
        count = count - np.bincount(key[far], minlength=size)
    return np.asarray(total.reshape(shape), dtype=np.float64), np.asarray(count.reshape(shape), dtype=np.float64)


def _mean(sums: F64, counts: F64) -> F64:
    total = counts.sum(axis=0)
    return np.asarray(np.where(total > 0, sums.sum(axis=0) / np.maximum(total, 1.0), np.nan), dtype=np.float64)


def _between_walls(heights: F64, grid: Grid) -> Bool:
    """Cells inside the bed: not beyond a wall, nor of a thing that stands in it."""
    known = np.isfinite(heights)
    smooth = box_mean(heights, grid.cells(SMOOTH_MM / 2.0))
    near = np.ones((2 * grid.cells(UPRIGHT_WITHIN_MM / 2.0) + 1,) * 2, np.uint8)
    highest = np.asarray(cv2.dilate(np.where(known, smooth, -np.inf), near, borderValue=-np.inf))
    lowest = np.asarray(cv2.erode(np.where(known, smooth, np.inf), near, borderValue=np.inf))
    with np.errstate(invalid="ignore"):
        inside = known & (highest - lowest <= UPRIGHT_MM)
    inside[:, ~_before_walls(heights, 0, grid)] = False
    inside[~_before_walls(heights, 1, grid), :] = False
    return inside


def _before_walls(heights: F64, along: int, grid: Grid) -> Bool:
    """Which rows or columns lie between the walls at both ends, by the mean profile over the axis ``along``."""
    known = np.isfinite(heights)
    count = known.sum(axis=along)
    profile = np.where(known, heights, 0.0).sum(axis=along) / np.maximum(count, 1)
    sure = count >= 0.1 * count.max()
    step = grid.cells(WALL_WITHIN_MM)
    rise = np.abs(profile[step:] - profile[:-step]) > WALL_SLOPE * step * grid.cell_mm
    at = np.flatnonzero(rise & sure[step:] & sure[:-step])
    middle, foot = profile.size // 2, grid.cells(WALL_FOOT_MM)
    low = int(at[at + step <= middle].max(initial=-step - foot - 1)) + step + foot + 1
    high = int(at[at >= middle].min(initial=profile.size + foot)) - foot
    place = np.arange(profile.size)
    return (place >= low) & (place < high)


def _level(heights: F64, grid: Grid) -> tuple[Bool, F64]:
    """Bare ground and its plane in the map: soil and what lies near it is left out, again and again."""
    level = np.zeros_like(heights)
    half = grid.cells(SMOOTH_MM)
    smooth = box_mean(heights, half)
    # At first by the lower half: the plane that was found has the ground about it, and soil above.
    known = smooth[np.isfinite(smooth)]
    low = np.abs(known[known < np.median(known)])
    threshold = SOIL_DEVIATIONS_N * 1.4826 * float(np.median(low)) if low.size else 0.0
    for _ in range(5):
        soil = np.abs(box_mean(heights - level, half)) > max(threshold, 2.0)
        ground = np.isfinite(heights) & ~dilate(soil, grid.cells(CLEAR_MM))
        if ground.sum() < grid.cells(GROUND_MM) ** 2:
            raise NoGroundError("hardly any ground is clear of soil")
        level = LevelFit(ground, grid).of(heights)
        off = box_mean(np.where(ground, heights - level, np.nan), half)[ground]
        threshold = SOIL_DEVIATIONS_N * float(np.sqrt(np.mean(off**2)))
    return ground, level


class LevelFit:
    """The plane through the cells of ``use``, as a map; for several maps that are known there."""

    def __init__(self, use: Bool, grid: Grid) -> None:
        self._x, self._y = grid.x_mm[:, None] / 1000.0, grid.y_mm[None, :] / 1000.0
        self._cells = np.flatnonzero(use)
        ones = np.ones(self._cells.size)
        x, y = (np.broadcast_to(axis, use.shape).reshape(-1)[self._cells] for axis in (self._x, self._y))
        a = np.stack((ones, x, y))
        self._solved = np.linalg.solve(a @ a.T + 1e-9 * np.eye(3), a)

    def of(self, heights: F64) -> F64:
        """That of a map."""
        c = self._solved @ heights.reshape(-1)[self._cells]
        return np.asarray(c[0] + c[1] * self._x + c[2] * self._y, dtype=np.float64)


def _scan_noise_mm(each: F64, everywhere: Bool) -> float:
    if len(each) < 2 or not everywhere.any():
        return float("nan")
    return float(np.sqrt(each[:, everywhere].var(axis=0, ddof=1).mean() / len(each)))


def box_mean(values: F64, half: int) -> F64:
    """Means over squares of ``2 half + 1`` cells, of the known cells in them; NaN where the cell itself is unknown."""
    known = np.isfinite(values)
    total = _box_sum(np.where(known, values, 0.0), half)
    count = _box_sum(known.astype(np.float64), half)
    return np.asarray(np.where(known, total / np.maximum(count, 1.0), np.nan), dtype=np.float64)


def _box_sum(values: F64, half: int) -> F64:
    side = (2 * half + 1, 2 * half + 1)
    return np.asarray(cv2.boxFilter(values, cv2.CV_64F, side, normalize=False, borderType=cv2.BORDER_CONSTANT))


def dilate(mask: Bool, half: int) -> Bool:
    """Cells within ``half`` cells (along both sides) of a cell of the mask."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * half + 1, 2 * half + 1), np.uint8)) > 0)


def erode(mask: Bool, half: int) -> Bool:
    """Cells with nothing but cells of the mask within ``half`` cells; what lies beyond the map is none of it."""
    return ~dilate(~np.pad(mask, half), half)[half:-half, half:-half]


def _close(mask: Bool, half: int) -> Bool:
    """The mask with its holes of up to twice ``half`` filled."""
    return erode(dilate(np.pad(mask, half), half), half)[half:-half, half:-half]


def fill(heights: F64, inside: Bool) -> F64:
    """Unknown cells of ``inside`` from the rims of their holes: smooth as a stretched skin."""
    hole = inside & ~np.isfinite(heights)
    if not hole.any():
        return heights
    result = np.where(hole, _pull_push(heights), heights)
    known = np.isfinite(result)
    i, j = np.nonzero(hole)
    up, down = np.maximum(i - 1, 0), np.minimum(i + 1, heights.shape[0] - 1)
    left, right = np.maximum(j - 1, 0), np.minimum(j + 1, heights.shape[1] - 1)
    sides = [
        np.where(known[a, b], a * heights.shape[1] + b, i * heights.shape[1] + j)
        for a, b in ((up, j), (down, j), (i, left), (i, right))
    ]
    flat = result.reshape(-1)
    cells = i * heights.shape[1] + j
    for _ in range(SMOOTHINGS_N):
        flat[cells] = (flat[sides[0]] + flat[sides[1]] + flat[sides[2]] + flat[sides[3]]) / 4.0
    return result


def _pull_push(heights: F64) -> F64:
    """Every cell known: averages of ever coarser maps, handed back down to where finer ones know nothing."""
    known = np.isfinite(heights)
    if known.all() or min(heights.shape) < 2:
        return np.where(known, heights, np.nanmean(heights) if known.any() else 0.0)
    value, weight = np.zeros((2, *(size + size % 2 for size in heights.shape)))
    whole = tuple(map(slice, heights.shape))
    value[whole], weight[whole] = np.where(known, heights, 0.0), known
    half = (value.shape[0] // 2, 2, value.shape[1] // 2, 2)
    total, count = value.reshape(half).sum(axis=(1, 3)), weight.reshape(half).sum(axis=(1, 3))
    coarse = _pull_push(np.where(count > 0, total / np.maximum(count, 1.0), np.nan))
    twice = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    fine = np.asarray(twice)[: heights.shape[0], : heights.shape[1]]
    return np.asarray(np.where(known, heights, fine), dtype=np.float64)
