"""Piles and layers of soil, as the paper's test bed has them, laid in front of the blade."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from graderd.simulator.grader.blade import LENGTH_M, BladePose, blade_grid
from graderd.simulator.grader.soil import FloatArray, SoilField

PILE_LENGTH_M, PILE_WIDTH_M, PILE_HEIGHT_M = 1.0, 0.45, 0.3
"""A heap for scattering work (section 3.3 of the paper), along the travel, across, and up, as poured."""
PILE_OFFSET_M = 0.45
"""Distance of a left or right heap's middle line from the bed's."""
LAYER_HEIGHT_M = 0.04
LAYER_HALF_WIDTH_M = 0.70
LAYER_BEHIND_M, LAYER_AHEAD_M = 0.9, 4.5
TOE_M = -0.10
"""Where a heap's near foot lies ahead of the face of a blade at angle 0; negative: the heap leans on the blade."""


class SceneZone(StrEnum):
    """What a scene puts in front of the blade; left and right are the operator's."""

    LEFT = "left"
    CENTER = "center"
    RIGHT = "right"
    EVEN = "even"
    NONE = "none"


def heap(
    field: SoilField, x_m: float, y_m: float, length_m: float, width_m: float, height_m: float, seed: int = 0
) -> FloatArray:
    """A heap as poured: a rough dome over ``length_m`` (along the bed) by ``width_m``, centred at (``x_m``, ``y_m``).

    Returns heights for :meth:`SoilField.add`, which lets it slump to the angle of repose: a heap steeper than that
    ends lower and wider than poured.
    """
    along = (field.x_m - x_m)[:, None] / (length_m / 2.0)
    across = (field.y_m - y_m)[None, :] / (width_m / 2.0)
    dome = np.clip(1.0 - np.abs(along) ** 3 - np.abs(across) ** 2, 0.0, None) ** 0.5
    return np.asarray(height_m * dome * lumps(field, seed))


def layer(
    field: SoilField, x_min_m: float, x_max_m: float, half_width_m: float, height_m: float, seed: int = 0
) -> FloatArray:
    """An even layer between two places along the bed, ``half_width_m`` to either side of its middle line."""
    inside = ((field.x_m >= x_min_m) & (field.x_m <= x_max_m))[:, None] & (np.abs(field.y_m) <= half_width_m)[None, :]
    return np.asarray(inside * height_m * lumps(field, seed, depth=0.12))


def lay_scene(field: SoilField, zone: SceneZone, x_m: float, pose: BladePose, seed: int = 0) -> None:
    """Empty the bed and lay ``zone`` in front of a blade whose axis stands at bed ``x_m``.

    Heaps have their near foot ``TOE_M`` ahead of the face of a blade at angle 0; what would lie under or behind the
    blade is left out. The even layer goes on behind the blade too, as if it had been let down into it.
    """
    field.clear()
    if zone is SceneZone.NONE:
        return
    if zone is SceneZone.EVEN:
        ends_m = x_m - LAYER_BEHIND_M, x_m + LAYER_AHEAD_M
        field.add(layer(field, *ends_m, LAYER_HALF_WIDTH_M, LAYER_HEIGHT_M, seed))
        return
    y_m = {SceneZone.LEFT: PILE_OFFSET_M, SceneZone.CENTER: 0.0, SceneZone.RIGHT: -PILE_OFFSET_M}[zone]
    field.add(heap(field, field.length_m / 2.0, y_m, PILE_LENGTH_M, PILE_WIDTH_M, PILE_HEIGHT_M, seed))
    foot_m = float(field.x_m[field.heights_m.max(axis=1) > 0.004].min())
    _shift_along(field, round((x_m + TOE_M - foot_m) / field.cell_m))
    s_m, d_m = blade_grid(field, field.whole, x_m, pose.angle_deg)
    field.heights_m[(d_m < 0.02) & (np.abs(s_m) < LENGTH_M / 2.0 + 0.3)] = 0.0


def _shift_along(field: SoilField, cells: int) -> None:
    """Move all soil along the bed; what would lie beyond an end is left out."""
    shifted = np.zeros_like(field.heights_m)
    if cells >= 0:
        shifted[cells:] = field.heights_m[: shifted.shape[0] - cells]
    else:
        shifted[:cells] = field.heights_m[-cells:]
    field.heights_m[:] = shifted


def lumps(field: SoilField, seed: int, depth: float = 0.2) -> FloatArray:
    """Smooth random factors about 1 (within ``depth``), a hand's breadth wide: no two heaps are alike."""
    rng = np.random.default_rng(seed)
    n_x, n_y = field.heights_m.shape
    coarse = rng.uniform(-1.0, 1.0, (n_x // 6 + 2, n_y // 6 + 2))
    i, j = np.arange(n_x) / 6.0, np.arange(n_y) / 6.0
    i0, j0 = i.astype(np.intp), j.astype(np.intp)
    fi, fj = (i - i0)[:, None], (j - j0)[None, :]
    blended = (
        coarse[i0][:, j0] * (1 - fi) * (1 - fj)
        + coarse[i0 + 1][:, j0] * fi * (1 - fj)
        + coarse[i0][:, j0 + 1] * (1 - fi) * fj
        + coarse[i0 + 1][:, j0 + 1] * fi * fj
    )
    return np.asarray(1.0 + depth * blended)
