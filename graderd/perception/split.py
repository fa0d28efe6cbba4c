"""Soil ahead and soil carried, told apart in a height map: two questions, two answers.

What leans on the face falls away from it at the angle of repose, whatever lies further out; it goes where the blade
goes. The rest lies still, and the blade meets it along the direction of travel, not square to itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graderd.core.blade import BladeGeometry, meeting_point, third_bounds_m
from graderd.perception.geometry import F64

CREST_M = 0.06
"""A carried heap is highest within so much of the face; between crest and face the camera sees nothing."""

ThirdsL = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Where the cells of a height map lie: ``s_m`` of its rows, ``d_m`` of its columns (middles), and a cell's area."""

    s_m: F64
    d_m: F64
    area_m2: float


def split_soil(
    height_m: F64, cells: Cells, angle_deg: float, blade: BladeGeometry, repose_deg: float, travel_m: float
) -> tuple[ThirdsL, ThirdsL]:
    """Litres carried, and litres ahead (right, center, left each) of a map of soil heights (0 where there is none).

    The map's rows may go on beyond the blade's ends: with the blade turned, what its leading end will meet lies there.
    Carried: under the slope at ``repose_deg`` from the crest at the face, by the third it lies before. Ahead: what
    stands above that slope, by the third that will meet it within ``travel_m`` of travel.

    Raises:
        ValueError: the blade is turned too far to meet anything.
    """
    slope = np.tan(np.radians(repose_deg))
    # The slope goes through the crest. Where soil rises towards one, the face behind it was seen lower, or not at all.
    near = cells.d_m < CREST_M
    climb = np.clip(height_m[:, near] - height_m[:, :1], 0.0, slope * cells.d_m[near])
    rise = height_m + slope * cells.d_m
    rise[:, near] = (height_m[:, near] + climb).max(axis=1, keepdims=True)
    carried = np.clip(np.minimum.accumulate(rise, axis=1) - slope * cells.d_m, 0.0, height_m)
    carried[np.abs(cells.s_m) > blade.length_m / 2] = 0.0  # nothing to lean on
    met_s, met_m = meeting_point(cells.s_m[:, None], cells.d_m[None, :], angle_deg)
    borders = (-blade.length_m / 2, *third_bounds_m(blade.length_m), blade.length_m / 2)
    third, met = np.digitize(cells.s_m, borders), np.digitize(met_s, borders)
    met[np.broadcast_to(met_m > travel_m, met.shape)] = 0
    litres = 1000.0 * cells.area_m2
    leaning = np.bincount(third, weights=carried.sum(axis=1), minlength=5) * litres
    coming = np.bincount(met.ravel(), weights=(height_m - carried).ravel(), minlength=5) * litres
    return _inner(leaning), _inner(coming)


def _inner(amounts: npt.NDArray[np.floating]) -> ThirdsL:
    """Without what lies beyond either end."""
    return float(amounts[1]), float(amounts[2]), float(amounts[3])
