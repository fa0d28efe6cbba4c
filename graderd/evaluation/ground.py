"""The bare ground under a bed of soil, from points alone: the lowest plane that much of what is seen lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

CELLS_ALONG_N = 40
"""Points are first thinned to cells, this many along the longer side of what is seen."""
HYPOTHESES_N = 600
STEEPEST_DEG = 15.0
"""Ground steeper than this against the given up is none: a camera is mounted to look down, tilted by a few degrees."""
BAND_MIN_MM = 4.0
NOISE_MAX_MM = 25.0
"""Where neighbouring cells' heights scatter by more than this, there is no plane to be found."""
BELOW_SHARE = 0.04
"""A flat layer of soil is a plane as well; what tells them apart is that under the ground there is nothing."""
SUPPORT_SHARE = 0.05
"""Less bare ground than this share of what is seen is none to build on."""


class NoGroundError(Exception):
    """No plane is there, or too little of it is free of soil; the text says which."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Height of a point above the plane: ``point @ normal + offset_mm``, ``normal`` of length 1 and upwards."""

    normal: F64
    offset_mm: float

    def heights_mm(self, points_mm: F64) -> F64:
        """Heights of points, N x 3."""
        return np.asarray(points_mm @ self.normal + self.offset_mm, dtype=np.float64)


def find_plane(points_mm: F64, up: F64) -> Plane:
    """The lowest plane that much of ``points_mm`` (N x 3) lies on; ``up`` is roughly upwards, of length 1.

    Raises:
        NoGroundError: no such plane within 15 degrees of level, or hardly anything of it is bare.
    """
    cells, noise_mm = _cells(points_mm, up)
    if len(cells) < 30:
        raise NoGroundError("there are too few points with depth to find the ground")
    if noise_mm > NOISE_MAX_MM:
        raise NoGroundError(f"heights scatter by {noise_mm:.0f} mm from place to place: no ground is to be seen")
    band_mm = max(BAND_MIN_MM, 3.0 * noise_mm)
    rng = np.random.default_rng(1)  # the same scan always gives the same plane
    corners = cells[rng.integers(0, len(cells), (HYPOTHESES_N, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    wide = lengths > 1e-6
    normals, corners = normals[wide] / lengths[wide, None], corners[wide]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = normals @ up > np.cos(np.radians(STEEPEST_DEG))
    normals, corners = normals[level], corners[level]
    heights = cells @ normals.T - np.einsum("ij,ij->i", normals, corners[:, 0])
    below = (heights < -2.0 * band_mm).mean(axis=0)
    on = (np.abs(heights) < band_mm).mean(axis=0)
    on[below > BELOW_SHARE] = 0.0
    if not on.size or on.max() == 0.0:
        raise NoGroundError(f"no plane within {STEEPEST_DEG:.0f} degrees of level that nothing lies under")
    best = int(on.argmax())
    plane = Plane(normals[best], -float(normals[best] @ corners[best, 0]))
    for _ in range(3):
        near = cells[np.abs(plane.heights_mm(cells)) < band_mm]
        plane = _through(near, up)
    support = float((np.abs(plane.heights_mm(cells)) < band_mm).mean())
    if support < SUPPORT_SHARE:
        raise NoGroundError(f"only {support * 100:.0f} % of what is seen is bare ground")
    return plane


def _cells(points_mm: F64, up: F64) -> tuple[F64, float]:
    """Mean points of the cells of a coarse grid across ``up``, and the noise of their heights."""
    aside = np.eye(3)[int(np.abs(up).argmin())]
    first = np.cross(up, aside)
    first /= np.linalg.norm(first)
    flat = points_mm @ np.column_stack((first, np.cross(up, first)))
    low, high = np.percentile(flat, (0.5, 99.5), axis=0) if len(flat) else (np.zeros(2), np.zeros(2))
    side = float((high - low).max()) / CELLS_ALONG_N
    if side <= 0.0:
        return np.zeros((0, 3)), 0.0
    index = np.floor((flat - low) / side).astype(np.int64)
    columns = CELLS_ALONG_N + 1
    inside = ((index >= 0) & (index < columns)).all(axis=1)
    key = index[inside, 0] * columns + index[inside, 1]
    count = np.bincount(key, minlength=columns**2)
    mean = (
        np.column_stack([np.bincount(key, points_mm[inside, axis], minlength=columns**2) for axis in range(3)])
        / np.maximum(count, 1)[:, None]
    )
    full = count >= max(3.0, 0.2 * float(np.median(count[count > 0])) if count.any() else 3.0)
    height = np.where(full, mean @ up, np.nan).reshape(columns, columns)
    bend = np.abs(height[:-2] - 2.0 * height[1:-1] + height[2:])
    known = bend[np.isfinite(bend)]
    noise_mm = 1.4826 * float(np.median(known)) / np.sqrt(6.0) if known.size else 0.0
    return mean[full], noise_mm


def _through(points_mm: F64, up: F64) -> Plane:
    """The plane of least squares."""
    middle = points_mm.mean(axis=0)
    normal = np.linalg.svd(points_mm - middle, full_matrices=False)[2][2]
    normal = np.asarray(normal * (1.0 if normal @ up > 0 else -1.0), dtype=np.float64)
    return Plane(normal, -float(normal @ middle))
