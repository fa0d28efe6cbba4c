"""Soil by its form: what in a height map is a heap of soil, and what is a leg, a plant, a pipe or a stone.

Soil falls at its angle of repose, so that the points in one cell of the map lie close together in height, and cells
beside each other differ little. What stands or is rough does not: a steep cell is no soil. A lump (a connected piece
of the map that stands out of the ground) of which hardly anything lies clear of steep cells is a thing as a whole;
one with a large smooth core is soil, with something on it or across it. This is no detector of people: it tells form.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from graderd.perception.geometry import F32, F64, U8
from graderd.perception.settings import FormSettings

Bools = npt.NDArray[np.bool_]
Counts = npt.NDArray[np.integer[Any]]

UNSEEN = 10.0
"""Stands for a height that is not known, metres."""
SPAN_M = 0.5
"""A cone is followed until it has risen so far: heights in a map differ by less."""
STEEP_TOLERANCE_M = 0.02
"""So far above what could rise there a cell is steep: the noise of a cell's mean is 2 to 6 mm."""
STEP_M = 0.008
"""Where a lump ends so much is enough: the edge of a plank 45 mm thick rises by 10 mm more than soil does in a cell."""
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
ENDS_LEAST_N = 6
"""Where fewer cells show how a lump ends, as between the blade's face and a heap, nothing is said by it."""
WALL_CELLS_N = 2
"""An upright wall lies in so many cells, whose points spread over its height: they show neither ground nor top."""
BESIDE_CELLS_N = 2
"""Cells so near to a steep one are not clear of it."""
CROSS = np.asarray(cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), dtype=np.uint8)
SQUARE, WALL, BESIDE, FOOT = (
    np.ones((2 * n + 1,) * 2, dtype=np.uint8) for n in (1, WALL_CELLS_N, BESIDE_CELLS_N, FOOT_CELLS_N)
)


@dataclass(frozen=True, slots=True, eq=False)
class Forms:
    """Masks over the height map: ``soil`` that stands out of the ground; of it ``doubtful`` what lies beside something
    steep or is ``apart``: a piece of a heap that ends in steps by itself, as a thing does whose foot or shadow meets a
    heap's; ``things`` that are no soil; ``weak``: higher than the ground's unevenness, but not enough to tell."""

    soil: Bools
    doubtful: Bools
    apart: Bools
    things: Bools
    weak: Bools


def sort_out(
    height: F64, filled: F64, seen: Bools, steep: Bools, above: Bools, high: F64,
    residual_m: float, stands_out_m: float, settings: FormSettings,
) -> Forms:  # fmt: skip
    """Sort a height map into soil, things and ground.

    ``height`` of the ``seen`` cells and of those that are far ``above`` their neighbours, ``filled``: of the seen ones
    without the steep cells (which are seen ones), and with what is hidden guessed. ``high``: how far each is above what
    could rise there.
    ``stands_out_m``: what soil must rise above the ground somewhere.
    """
    surface = np.where(seen, height, filled)
    low_m = max(settings.lowest_m, 2.0 * residual_m)
    count, labels = cv2.connectedComponents((surface > low_m).view(np.uint8), connectivity=4)
    tall = seen & (height > TALL_M)
    # Soil runs out into the ground, wherever that is seen beside it. A box or a plank ends all round in a step.
    abrupt = steep | (high > STEP_M)
    low = seen & ~tall
    low |= _dilated(low, WALL) & ~seen
    ends = tall & _dilated(low, CROSS)
    rim = above
    if above.any():  # what hangs over it is higher
        rim = above & (height < cv2.dilate(np.where(tall, height, 0.0), CROSS) + LEVEL_M)
    clear = tall & ~_dilated(steep, BESIDE)
    stands_out = cv2.blur(filled, (3, 3)) > stands_out_m
    lump = np.asarray(labels, dtype=np.intp)
    tall_n, core_n, steep_n, ends_n, steps_n, high_n = _counts(
        lump, count, (tall, clear, tall & steep, ends | rim, (ends & abrupt) | rim, stands_out)
    )
    is_thing = (core_n * 100.0 < settings.thing_core_percent * tall_n) & (steep_n > 0)
    is_thing |= _ends_in_steps(ends_n, steps_n, settings)
    stands = (high_n > 0) & ~is_thing
    is_weak = ~stands & ~is_thing
    is_thing[0] = stands[0] = is_weak[0] = False  # the ground
    things, weak = is_thing.take(lump), is_weak.take(lump)
    foot = _dilated(stands.take(lump), FOOT)
    soil = foot & ~things & ~weak
    doubtful, apart = soil & _dilated(steep, SQUARE), np.zeros_like(soil)
    if (steps_n[stands] * 100.0 > settings.thing_steps_percent * ENDS_LEAST_N).any():
        # Low ground and hidden cells hold a lump together: what a heap and a thing beside it are, seen each by itself.
        cliff = tall & (high > STEEP_TOLERANCE_M)
        whole = (tall & ~cliff) | rim
        count, labels = cv2.connectedComponents(whole.view(np.uint8), connectivity=4)
        piece = np.asarray(labels, dtype=np.intp)
        cut = _dilated(cliff, CROSS) | rim
        ends_n, steps_n = _counts(piece, count, (ends | cut, (ends & abrupt) | cut))
        is_apart = _ends_in_steps(ends_n, steps_n, settings)
        is_apart[0] = False
        apart = soil & _dilated(is_apart.take(piece), SQUARE)
        doubtful |= apart
    return Forms(soil, doubtful, apart, things, weak)


def _ends_in_steps(ends_n: F64, steps_n: F64, settings: FormSettings) -> Bools:
    """Of pieces of a map that show so many cells of their border, and so many of those steep: which are no soil."""
    return (ends_n >= ENDS_LEAST_N) & (steps_n * 100.0 > settings.thing_steps_percent * ends_n)


def _dilated(where: Bools, kernel: U8) -> Bools:
    return np.asarray(cv2.dilate(where.view(np.uint8), kernel)).view(np.bool_)


def _counts(lump: npt.NDArray[np.intp], count: int, facts: tuple[Bools, ...]) -> F64:
    """Of how many cells of each lump each fact is true: a row a fact.

    The facts of a cell make one number, so that one pass counts them all.
    """
    held = facts[-1].astype(np.uint8)
    for fact in facts[-2::-1]:
        held <<= 1
        held |= fact.view(np.uint8)
    numbers_n = 1 << len(facts)
    index = lump * numbers_n
    index += held
    found = np.bincount(index.ravel(), minlength=count * numbers_n).reshape(count, numbers_n)
    return np.asarray(_holds(len(facts)) @ found.T.astype(np.float64))


@functools.cache
def _holds(facts_n: int) -> F64:
    """Which of so many facts each number stands for: 1 where it holds one, a row a fact."""
    holds = (np.arange(1 << facts_n) >> np.arange(facts_n)[:, None]) & 1
    return holds.astype(np.float64)


def steep_cells(square_m2: F64, count: Counts, noise_m: F64, settings: FormSettings) -> tuple[Bools, Bools]:
    """Cells whose points spread more in height than soil's do, and cells over which something hangs.

    ``square_m2``: sum of the squares of their heights about their mean, over ``count`` points; ``noise_m``: the noise
    of heights there. A cell holds a few points only, so that five in a row are judged together, along s and along d:
    a pipe is steep along one of them.
    """
    freedom = np.maximum(count - 1, 0).astype(np.float64)  # the variance is the squares over this
    several = freedom > 0
    hanging = several & (square_m2 > GAP_SPREAD_M**2 * freedom)
    freedom[hanging] = 0.0
    # One cell of a hose must not make its neighbours steep.
    capped = np.minimum(square_m2, OWN_SPREAD_M**2 * freedom)
    limit = settings.steep_spread_m**2 + (SLOPE_NOISE_RATIO * noise_m) ** 2
    steep = square_m2 > (OWN_SPREAD_M**2 + limit) * freedom
    for row in ((ROW_CELLS_N, 1), (1, ROW_CELLS_N)):
        points = cv2.boxFilter(freedom, -1, row, normalize=False)
        squares = cv2.boxFilter(capped, -1, row, normalize=False)
        steep |= squares > limit * points
    return np.asarray(steep & several & ~hanging), np.asarray(hanging)


def standing(s: F32, d: F32, z: F32, half_m: float, reach_m: float) -> tuple[float, float] | None:
    """Where something stands upright before the face (s, d in m); None where nothing does."""
    # What begins low enough and is tall enough goes through one level, which most pictures leave empty.
    through = z > LOWEST_M + (ON_SOIL_STARTS_N - 1 - 0.5) * LEVEL_M
    through &= z < LOWEST_M + (ON_SOIL_STARTS_N + 0.5) * LEVEL_M
    through &= d > STANDING_FROM_M
    if np.count_nonzero(through) < LEVEL_POINTS_N * STANDING_COLUMNS_N:
        return None
    inside = np.flatnonzero(
        (z > LOWEST_M) & (z < HIGHEST_M) & (d > STANDING_FROM_M) & (d < reach_m) & (np.abs(s) < half_m)
    )
    columns_n, rows_n = int(2 * half_m / CELL_M) + 1, int(reach_m / CELL_M) + 1
    levels_n = round((HIGHEST_M - LOWEST_M) / LEVEL_M) + 1
    index = ((s.take(inside) + half_m) / CELL_M).astype(np.intp)
    index *= rows_n
    index += (d.take(inside) / CELL_M).astype(np.intp)
    index *= levels_n
    index += ((z.take(inside) - LOWEST_M) / LEVEL_M).astype(np.intp)
    counts = np.bincount(index, minlength=columns_n * rows_n * levels_n).reshape(-1, levels_n)
    if np.count_nonzero(counts[:, ON_SOIL_STARTS_N - 1] >= LEVEL_POINTS_N) < STANDING_COLUMNS_N:
        return None
    high = np.flatnonzero(counts[:, LEVELS_N - 1 :].max(axis=1) >= LEVEL_POINTS_N)
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
        if start < LOW_STARTS_N or (start < ON_SOIL_STARTS_N and start <= _level(levels, upright, at) + 2)
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


def _lower_cones(height: F64, rise_s_per_cell: float, rise_d_per_cell: float) -> F32:
    """The lower envelope of upward cones standing on every cell, of these slopes along s and d.

    Distances run along the two directions of the cells; each round looks twice as far as the one before.
    """
    lower = height.astype(np.float32)
    for rise_per_cell in (rise_s_per_cell, rise_d_per_cell):
        risen = np.empty_like(lower)
        far_n = 1
        while far_n < len(lower) and far_n * rise_per_cell < SPAN_M:
            np.add(lower, far_n * rise_per_cell, out=risen)
            np.minimum(lower[far_n:], risen[:-far_n], out=lower[far_n:])
            np.minimum(lower[:-far_n], risen[far_n:], out=lower[:-far_n])
            far_n *= 2
        lower = np.ascontiguousarray(lower.T)  # whole rows are quicker than strided columns
    return lower
