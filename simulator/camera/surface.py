"""Range images of the soil: one sorted sweep outwards along every azimuth instead of a search along every pixel's ray.

All rays of one azimuth lie in one vertical plane through the camera. Walking outwards in that plane, a soil sample
is visible where the ray to it rises above all rays to nearer samples, so a running maximum of the slope gives, for
every slope, the first sample a ray of that slope meets. That is two array passes for the whole picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from graderd.hal.camera import Intrinsics, StreamPose

Image32 = npt.NDArray[np.float32]

NEAR_M, FAR_M = 0.10, 2.7
_RANGE_STEP_M = 0.011
_HORIZON = -0.012
"""Slopes above this never meet the ground within the yard."""


@dataclass(frozen=True, slots=True)
class Rays:
    """The viewing rays of one stream, in the vehicle frame.

    A pixel at optical depth Z (metres) sees ``position_m + Z * (dx, dy, dz)``. ``horizontal`` is the length of
    ``(dx, dy)``, ``slope`` is ``dz / horizontal``, ``azimuth_rad`` is counted from straight back towards image right.
    All arrays are ``(height, width)`` float32.
    """

    position_m: tuple[float, float, float]
    dx: Image32
    dy: Image32
    dz: Image32
    horizontal: Image32
    slope: Image32
    azimuth_rad: Image32

    @classmethod
    def of(cls, intrinsics: Intrinsics, pose: StreamPose) -> Rays:
        """Rays through the pixel centres (no distortion: the D455's depth is rectified, its colour reports zeros)."""
        u = ((np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx).astype(np.float32)[None, :]
        v = ((np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy).astype(np.float32)[:, None]
        r = np.array(pose.rotation, np.float32)
        dx, dy, dz = (np.ascontiguousarray(r[row, 0] * u + r[row, 1] * v + r[row, 2]) for row in range(3))
        horizontal = np.asarray(cv2.magnitude(dx, dy), np.float32)
        azimuth = np.asarray(cv2.phase(-dx, dy), np.float32)
        azimuth = np.where(azimuth > np.pi, azimuth - np.float32(2 * np.pi), azimuth).astype(np.float32)
        return cls(
            pose.position_m, dx, dy, dz, horizontal, np.asarray(dz / np.maximum(horizontal, 1e-6), np.float32), azimuth
        )


def _row_of(slope: Image32) -> Image32:
    """A cheap monotone stand-in for the elevation angle: -1 straight down, 0 at the horizon."""
    return np.asarray(slope / (1.0 - slope), np.float32)


class SurfaceSweep:
    """Finds where the rays of one stream meet a height map given around the vehicle.

    The tables depend on the stream only; :meth:`ranges_m` costs a few milliseconds.
    """

    def __init__(self, rays: Rays) -> None:
        self._rays = rays
        height, width = rays.slope.shape
        slope = np.minimum(rays.slope, np.float32(_HORIZON))
        row = _row_of(slope)
        row_min, row_max = float(row.min()) - 1e-4, float(row.max()) + 1e-4
        azimuth_min, azimuth_max = float(rays.azimuth_rad.min()) - 0.01, float(rays.azimuth_rad.max()) + 0.01
        self._rows = math.ceil(height * 1.15)
        columns = math.ceil(width * 0.85)
        self._ranges_m = np.arange(NEAR_M, FAR_M, _RANGE_STEP_M, dtype=np.float32)[:, None]
        azimuths = np.linspace(azimuth_min, azimuth_max, columns, dtype=np.float32)[None, :]
        self._sample_x = np.ascontiguousarray(rays.position_m[0] - self._ranges_m * np.cos(azimuths))
        self._sample_y = np.ascontiguousarray(rays.position_m[1] + self._ranges_m * np.sin(azimuths))
        self._inverse_m = np.ascontiguousarray(1.0 / self._ranges_m)
        self._row_min, self._row_step = row_min, (row_max - row_min) / (self._rows - 1)
        self._grid_row = (np.arange(self._rows, dtype=np.float32) * self._row_step + row_min)[:, None]
        grid_slope = self._grid_row / (1.0 + self._grid_row)
        self._flat_range_m = np.asarray(rays.position_m[2] / np.maximum(-grid_slope, 1e-3), np.float32)
        self._column = np.arange(columns, dtype=np.int32)[None, :]
        self._pixel_row = np.ascontiguousarray((row - row_min) / self._row_step)
        self._pixel_column = np.ascontiguousarray(
            (rays.azimuth_rad - azimuth_min) / np.float32((azimuth_max - azimuth_min) / (columns - 1))
        )

    def ranges_m(self, heights_m: Image32, x_first_m: float, y_first_m: float, cell_m: float) -> Image32:
        """Horizontal distance from the camera at which every pixel's ray meets the soil or the floor.

        ``heights_m``: ``(along x, along y)``, the centre of cell (0, 0) at vehicle ``(x_first_m, y_first_m)``;
        outside of it the floor is bare. Rays above the horizon get several tens of metres.
        """
        heights = cv2.remap(
            heights_m,
            (self._sample_y - np.float32(y_first_m)) / np.float32(cell_m),
            (self._sample_x - np.float32(x_first_m)) / np.float32(cell_m),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0.0,
        )
        slopes = (heights - np.float32(self._rays.position_m[2])) * self._inverse_m
        np.minimum(slopes, np.float32(_HORIZON), out=slopes)
        rows = _row_of(slopes)
        np.maximum.accumulate(rows, axis=0, out=rows)
        scaled = (rows - np.float32(self._row_min)) * np.float32(1.0 / self._row_step)
        first_row = np.clip(scaled, -1.0, self._rows - 1).astype(np.int32) + 1
        first_row[scaled < 0.0] = 0
        samples, columns = rows.shape
        met = np.zeros((self._rows + 1, columns), np.int32)
        # Samples are written nearest first, so of several in one row the farthest stays: the next to be met above it.
        met[first_row, np.broadcast_to(self._column, first_row.shape)] = np.arange(1, samples + 1, dtype=np.int32)[
            :, None
        ]
        met = np.maximum.accumulate(met[: self._rows], axis=0)
        beyond = met >= samples
        np.minimum(met, samples - 1, out=met)
        flat = met * columns + self._column
        upper = rows.reshape(-1).take(flat)
        lower = rows.reshape(-1).take(np.maximum(flat - columns, self._column))
        share = (self._grid_row - lower) / np.maximum(upper - lower, np.float32(1e-6))
        np.clip(share, 0.0, 1.0, out=share)
        ranges = np.float32(NEAR_M) + (met - 1 + share) * np.float32(_RANGE_STEP_M)
        ranges = np.where(beyond, self._flat_range_m, ranges).astype(np.float32)
        return np.asarray(
            cv2.remap(ranges, self._pixel_column, self._pixel_row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            np.float32,
        )
