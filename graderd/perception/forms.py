"""Soil by its form: what in a height map is a heap of soil, and what is a leg, a plant, a pipe or a stone.

Soil falls at its angle of repose, so that the points in one cell of the map lie close together in height, and cells
beside each other differ little. What stands or is rough does not: a steep cell is no soil. A lump (a connected piece
of the map that stands out of the ground) of which hardly anything lies clear of steep cells is a thing as a whole;
one with a large smooth core is soil, with something on it or across it. This is no detector of people: it tells form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from graderd.perception.geometry import F32, F64
from graderd.perception.settings import FormSettings

Bools = npt.NDArray[np.bool_]
Counts = npt.NDArray[np.integer[Any]]

UNSEEN = 10.0
"""Stands for a height that is not known, metres."""
STEEP_TOLERANCE_M = 0.02
"""So far above what could rise there a cell is steep: the noise of a cell's mean is 2 to 6 mm."""
OWN_SPREAD_M = 0.020
"""Heights in one cell spread by this: steep whatever its neighbours are (soil at 60 degrees: 10 mm)."""
GAP_SPREAD_M = 0.040
"""Points of one cell spread by this lie on two things above each other, with nothing between."""
HANGS_M = 0.08
"""So far above what could rise there: it hangs (a hose, an arm of the machine); what stands is found by standing()."""
ROW_CELLS_N = 5
"""Cells in a row that are judged together: 10 cm, as wide as a boot or a pipe."""
SLOPE_NOISE_RATIO = 2.0
"""Noise along the line of sight lifts points of a slope that faces the camera twice as much as those of ground."""
CELL_M = 0.04
"""Ground plan of the columns in which something standing is looked for."""
LEVEL_M = 0.02
"""Their levels: between a full blade's heap and the machine's arms above it one at least stays empty."""
LEVELS_N = 8
"""So many in a row without a gap: soil at 60 degrees crosses six of them within a column's diagonal, a leg all."""
LEVEL_POINTS_N = 2
"""Points in a level: a single one may be a wrong match."""
LOWEST_M, HIGHEST_M = 0.04, 0.52
"""What stands is looked for between these heights: lower there is soil, higher the camera and the machine's arms."""
LOW_STARTS_N = 6
"""It must begin below 16 cm, or on soil beside it: what hangs from above (hoses, the machine's arms) does not stand."""
ON_SOIL_STARTS_N = 8
"""On soil too it begins below 20 cm: higher, the machine's arms touch a heap that fills the blade."""
BESIDE_COLUMNS_N = 2
"""Soil beside an upright column is what shows in columns so near."""
STANDING_FROM_M = 0.06
"""Nearer to the face than this, the face itself may show."""
STANDING_COLUMNS_N = 2
"""So many columns must stand: one may be a rod or a hose, and a leg is 6 cm wide at least."""
TALL_M = 0.03
"""Cells lower than this say nothing about form: their steepness drowns in noise."""
FOOT_CELLS_N = 3
"""A heap's foot runs out below the level at which lumps are told apart: so many cells more count."""
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
ENDS_LEAST_N = 6
"""Where fewer cells show how a lump ends, as between the blade's face and a heap, nothing is said by it."""
BESIDE_CELLS_N = 2
"""Cells so near to a steep one are not clear of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Forms:
    """Masks over the height map: ``soil`` that stands out of the ground; of it ``doubtful`` what lies beside something
    steep; ``things`` that are no soil; ``weak``: higher than the ground's unevenness, but not enough to tell."""

    soil: Bools
    doubtful: Bools
    things: Bools
    weak: Bools


def sort_out(
    height: F64, filled: F64, seen: Bools, steep: Bools, above: Bools,
    residual_m: float, stands_out_m: float, settings: FormSettings,
) -> Forms:  # fmt: skip
    """Sort a height map into soil, things and ground.

    ``height`` of the ``seen`` cells and of those that are far ``above`` their neighbours, ``filled``: of the seen ones
    without the steep cells, and with what is hidden guessed.
    ``stands_out_m``: what soil must rise above the ground somewhere.
    """
    surface = np.where(seen, height, filled)
    low_m = max(settings.lowest_m, 2.0 * residual_m)
    count, labels = cv2.connectedComponents((surface > low_m).astype(np.uint8), connectivity=4)
    size = 2 * BESIDE_CELLS_N + 1
    beside = cv2.dilate((steep & seen).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    tall = seen & (height > TALL_M)
    flat = np.asarray(labels.ravel(), dtype=np.intp)
    tall_n = np.bincount(flat, weights=tall.ravel(), minlength=count)
    core_n = np.bincount(flat, weights=(tall & ~beside).ravel(), minlength=count)
    steep_n = np.bincount(flat, weights=(tall & steep).ravel(), minlength=count)
    core = np.divide(core_n, tall_n, out=np.ones(count), where=tall_n > 0)
    is_thing = (core * 100.0 < settings.thing_core_percent) & (steep_n > 0)
    # Soil runs out into the ground, wherever that is seen beside it. A box or a slab ends all round in a step.
    ends = tall & (cv2.dilate((seen & ~tall).astype(np.uint8), CROSS) > 0)
    rim = above & (height < cv2.dilate(np.where(tall, height, 0.0), CROSS) + LEVEL_M)  # what hangs over it is higher
    ends_n = np.bincount(flat, weights=(ends | rim).ravel(), minlength=count)
    steps_n = np.bincount(flat, weights=((ends & steep) | rim).ravel(), minlength=count)
    is_thing |= (ends_n >= ENDS_LEAST_N) & (steps_n * 100.0 > settings.thing_steps_percent * ends_n)
    high = cv2.blur(filled, (3, 3)) > stands_out_m
    is_thing[0] = False
    stands = (np.bincount(flat, weights=high.ravel(), minlength=count) > 0) & ~is_thing
    stands[0] = False
    weak = ~stands & ~is_thing
    weak[0] = False
    soil, things = stands[labels], is_thing[labels]
    foot = cv2.dilate(soil.astype(np.uint8), np.ones((2 * FOOT_CELLS_N + 1,) * 2, np.uint8)) > 0
    soil = foot & ~things & ~weak[labels]
    touched = cv2.dilate((steep & seen).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return Forms(soil, soil & touched, things, weak[labels])


def steep_cells(square_m2: F64, count: Counts, noise_m: F64, settings: FormSettings) -> tuple[Bools, Bools]:
    """Cells whose points spread more in height than soil's do, and cells over which something hangs.

    ``square_m2``: sum of the squares of their heights about their mean, over ``count`` points; ``noise_m``: the noise
    of heights there. A cell holds a few points only, so that five in a row are judged together, along s and along d:
    a pipe is steep along one of them.
    """
    freedom = np.maximum(count - 1, 0).astype(np.float64)
    variance = np.divide(square_m2, freedom, out=np.zeros(square_m2.shape), where=freedom > 0)
    hanging = variance > GAP_SPREAD_M**2
    freedom[hanging] = 0.0
    # One cell of a hose must not make its neighbours steep.
    capped = np.minimum(variance, OWN_SPREAD_M**2) * freedom
    pooled = np.zeros(variance.shape)
    for row in ((ROW_CELLS_N, 1), (1, ROW_CELLS_N)):
        points = cv2.boxFilter(freedom, -1, row, normalize=False)
        squares = cv2.boxFilter(capped, -1, row, normalize=False)
        pooled = np.maximum(pooled, np.divide(squares, points, out=np.zeros(pooled.shape), where=points > 0.5))
    limit = settings.steep_spread_m**2 + (SLOPE_NOISE_RATIO * noise_m) ** 2
    steep = ((pooled > limit) | (variance > OWN_SPREAD_M**2 + limit)) & (freedom > 0)
    return np.asarray(steep), np.asarray(hanging)


def standing(s: F32, d: F32, z: F32, half_m: float, reach_m: float) -> tuple[float, float] | None:
    """Where something stands upright before the face (s, d in m); None where nothing does."""
    inside = np.flatnonzero(
        (z > LOWEST_M) & (z < HIGHEST_M) & (d > STANDING_FROM_M) & (d < reach_m) & (np.abs(s) < half_m)
    )
    columns_n, rows_n = int(2 * half_m / CELL_M) + 1, int(reach_m / CELL_M) + 1
    levels_n = round((HIGHEST_M - LOWEST_M) / LEVEL_M) + 1
    i = ((s[inside] + np.float32(half_m)) * np.float32(1 / CELL_M)).astype(np.int32)
    j = (d[inside] * np.float32(1 / CELL_M)).astype(np.int32)
    k = ((z[inside] - np.float32(LOWEST_M)) * np.float32(1 / LEVEL_M)).astype(np.int32)
    column = i * rows_n + j
    counts = np.bincount(column * levels_n + k, minlength=columns_n * rows_n * levels_n).reshape(-1, levels_n)
    # Few columns reach so high as to hold a run.
    high = np.flatnonzero(np.bincount(column[k >= LEVELS_N - 1], minlength=len(counts)) >= LEVEL_POINTS_N)
    if high.size < STANDING_COLUMNS_N:
        return None
    there = counts[high] >= LEVEL_POINTS_N
    runs = there[:, : 1 - LEVELS_N].copy()
    for level in range(1, LEVELS_N):
        runs &= there[:, level : levels_n - LEVELS_N + 1 + level]
    is_upright = runs.any(axis=1)
    if np.count_nonzero(is_upright) < STANDING_COLUMNS_N:
        return None
    places = np.column_stack(np.divmod(high[is_upright], rows_n))
    starts = runs[is_upright].argmax(axis=1)
    upright = np.zeros((columns_n, rows_n), dtype=np.bool_)
    upright[places[:, 0], places[:, 1]] = True
    levels = (counts >= LEVEL_POINTS_N).reshape(columns_n, rows_n, levels_n)
    found = [
        at
        for at, start in zip(places, starts, strict=True)
        if start < LOW_STARTS_N or start <= min(_level(levels, upright, at) + 2, ON_SOIL_STARTS_N - 1)
    ]
    if len(found) < STANDING_COLUMNS_N:
        return None
    at_s, at_d = np.median(found, axis=0)
    return float(at_s + 0.5) * CELL_M - half_m, float(at_d + 0.5) * CELL_M


def _level(levels: Bools, upright: Bools, at: Counts) -> int:
    """The level at which soil lies beside an upright column; -1 where none does."""
    around = tuple(slice(max(i - BESIDE_COLUMNS_N, 0), i + BESIDE_COLUMNS_N + 1) for i in at)
    plain = levels[around][~upright[around]]
    lowest = plain.argmax(axis=1)
    # A column in which nothing was seen says so.
    return int(np.median(np.where(plain.any(axis=1), lowest, -1))) if plain.size else -1


def above_neighbours(height: F64, seen: Bools, rise_per_cell: float) -> F64:
    """How far cells stand above what could rise out of what is seen beside them at this slope (m)."""
    return np.asarray(height - _lower_cones(np.where(seen, height, UNSEEN), rise_per_cell, rise_per_cell))


def fill_hidden(height: F64, seen: Bools, drop_per_cell: float, aside_per_cell: float) -> F64:
    """Heights with the unseen cells filled from what is seen on any side: the least that can lie behind a crest.

    They fall by ``drop_per_cell`` each cell along d, at the angle of repose, and by the steeper ``aside_per_cell``
    along the blade: what a heap hides of the third beside it must not be filled up with a heap of guesses.
    """
    least = -_lower_cones(np.where(seen, -height, UNSEEN), aside_per_cell, drop_per_cell)
    return np.where(seen, height, np.maximum(least, 0.0))


def _lower_cones(height: F64, rise_s_per_cell: float, rise_d_per_cell: float) -> F64:
    """The lower envelope of upward cones standing on every cell, of these slopes along s and d.

    Distances run along the two directions of the cells, so that four accumulations give it.
    """
    for axis, rise_per_cell in enumerate((rise_s_per_cell, rise_d_per_cell)):
        steps = rise_per_cell * np.arange(height.shape[axis])
        steps = steps[:, None] if axis == 0 else steps[None, :]
        back = np.s_[::-1] if axis == 0 else np.s_[:, ::-1]
        up = np.minimum.accumulate(height - steps, axis=axis) + steps
        down = np.minimum.accumulate((height + steps)[back], axis=axis)[back] - steps
        height = np.minimum(up, down)
    return height
