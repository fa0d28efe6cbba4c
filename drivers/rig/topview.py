"""The bed seen from above: a picture for people, and depth for judging the work."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from drivers.rig.blade import LENGTH_M, BladePose
from drivers.rig.look import Look
from drivers.rig.paint import ground_palette, soil_palette
from drivers.rig.soil import FloatArray

CAMERA_HEIGHT_M = 2.5
"""Height of the imagined camera above the bed's floor; depth is measured along the vertical."""
_SCALE = 4


def top_depth(heights_m: FloatArray) -> npt.NDArray[np.uint16]:
    """Millimetres from the camera to the surface, one pixel a cell; up is forward, left is the operator's left."""
    depth = np.rint((CAMERA_HEIGHT_M - heights_m) * 1000.0).astype(np.uint16)
    return np.ascontiguousarray(depth[::-1, ::-1])


def top_view(
    heights_m: FloatArray, cell_m: float, vehicle_x_m: float, blade: BladePose, look: Look
) -> npt.NDArray[np.uint8]:
    """A shaded colour picture of the bed with the blade drawn in, oriented as :func:`top_depth`."""
    size = (heights_m.shape[1] * _SCALE, heights_m.shape[0] * _SCALE)
    fine = cv2.resize(heights_m.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    slope_x, slope_y = np.gradient(fine, cell_m / _SCALE)
    light = np.clip(1.0 - 0.45 * slope_x + 0.45 * slope_y, 0.4, 1.5)
    soil = soil_palette(look)[128, 0].astype(np.float32)
    floor = ground_palette(look)[128, 0].astype(np.float32)
    share = np.clip((fine - 0.002) / 0.01, 0.0, 1.0)[:, :, None]
    picture = np.clip((floor + (soil - floor) * share) * light[:, :, None], 0, 255).astype(np.uint8)
    picture = np.ascontiguousarray(picture[::-1, ::-1])
    angle = math.radians(blade.angle_deg)
    ends = []
    for s in (-LENGTH_M / 2.0, LENGTH_M / 2.0):
        x, y = vehicle_x_m - s * math.sin(angle), s * math.cos(angle)
        column = (heights_m.shape[1] * cell_m / 2.0 - y) / cell_m * _SCALE
        row = (heights_m.shape[0] * cell_m - x) / cell_m * _SCALE
        ends.append((round(column), round(row)))
    cv2.line(picture, ends[0], ends[1], (40, 200, 255), 5, cv2.LINE_AA)
    return picture
