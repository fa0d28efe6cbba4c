"""The ground from one depth picture: a surface fitted anew, and how far real ground departs from it.

The calibrated pose is never exact, the machine pitches, and ground is no plane. Level and slope are voted on by flat
cells, so that soil above does no harm; then a surface of second order (bowl, crown, ridge) is fitted to what lies
round the soil's zone and carried through under it. How far cells depart from that surface is its residual: soil that
does not stand out of it cannot be told from ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from graderd.core.blade import BladeGeometry, blade_coordinates
from graderd.perception.geometry import F32, F64, cos_sin, middle

CELL_M = 0.08
"""Ground is judged in cells of this size: a dozen points each, and a heap's side spreads in it more than noise."""
BAND_M, BAND_SLOPE = 0.15, 0.12
"""Points this close to the calibrated ground may be ground: 3 cm, and 12 % of slope over the metre before the blade;
further off as much more as such a slope rises."""
EXTENT_M = (-2.0, 1.2, -1.2, 1.2)
"""x from, x to, y from, y to (vehicle frame) of what is looked at."""
CELL_FLAT_M = 0.010
"""Heights within a cell of ground spread less than this; the side of a pile at 33 degrees spreads by 15 mm."""
MIN_CELL_POINTS_N = 3
"""With fewer points the spread in a cell says nothing."""
MIN_CELLS_N = 6
"""Twice as many as a plane has numbers: with fewer the calibration is kept."""
INLIER_M = 0.010
"""A cell so near to a plane lies on it: three times the noise of a cell's mean."""
HYPOTHESES_N = 64
"""Planes through three cells; with half of the cells on the ground, a few of them have all three there."""
VOTERS_N = 100
"""Cells that vote: with more the plane is the same, and the vote costs more."""
WIDE_M2 = 0.01
"""Three cells that span less (a triangle of 14 cm) tell noise, not slope."""
LIMIT_RATIO = 1.5
"""Planes are looked for so far beyond the limits, so that ground beyond them is found, and named."""
BELOW_VOTES = 1.5
"""A cell below a plane speaks against it by so many that lie on it: nothing lies under the ground."""
CALIBRATED_VOTES = 0.05
"""A plane at the limits needs this share of the cells more than the calibrated one: a heap's top is flat as well."""
SLOPE_PULL = 0.05
"""A weak pull towards the calibrated slope, in cells a metre away: for ground that shows on one side only."""
OFFSET_PULL = 0.02
"""The same for the height, in cells: against round-off alone."""
NEAR_M = 0.8
"""Ground within this of the blade's middle shapes the surface; what lies further tells nothing about the zone."""
SURFACE_BAND_M = 0.06
"""Cells further than this from the plane are soil or things, not unevenness."""
SURFACE_SIGMA_M = 0.008
"""A cell off the surface by this has half its weight: as uneven is ground that is worked."""
CLEAR_M = 0.06
"""Cells nearer than this to the soil's zone do not shape the surface."""
CURVATURE_SIGMA_PER_M = 0.08
"""Curvature that ground plausibly has: 30 mm over 0.6 m."""
MIN_RING_N = 25
"""Four times as many cells as a surface of second order has numbers; with fewer the plane is kept."""
SURFACE_PRIOR = np.diag((OFFSET_PULL, SLOPE_PULL, SLOPE_PULL, *[(SURFACE_SIGMA_M / CURVATURE_SIGMA_PER_M) ** 2] * 3))
"""How firmly the surface is held to the plane."""
REWEIGHED_N = 4
"""After so many rounds the weights stand still to a hundredth."""
SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation over median absolute deviation, of a normal distribution."""


@dataclass(frozen=True, slots=True)
class Ground:
    """Surface ``z = offset_m + slope_x x + slope_y y + bend_xx x^2 + bend_xy x y + bend_yy y^2``, calibrated frame.

    ``residual_m``: robust rms of the heights about it, unevenness and noise together. ``noise_m_per_m2``: the part that
    shows between neighbouring points, over the square of their distance from the camera.
    """

    offset_m: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0
    bend_xx_per_m: float = 0.0
    bend_xy_per_m: float = 0.0
    bend_yy_per_m: float = 0.0
    residual_m: float = 0.0
    noise_m_per_m2: float = 0.0

    def slope_deg(self) -> float:
        """Angle between this surface at the blade's axis and the calibrated ground."""
        return math.degrees(math.atan(math.hypot(self.slope_x, self.slope_y)))

    def height_at(self, x_m: F64, y_m: F64) -> F64:
        """Heights of the surface at places."""
        bend = self.bend_xx_per_m * x_m**2 + self.bend_xy_per_m * x_m * y_m + self.bend_yy_per_m * y_m**2
        return np.asarray(self.offset_m + self.slope_x * x_m + self.slope_y * y_m + bend, dtype=np.float64)

    def turned(self, angle_deg: float) -> Ground:
        """The same surface over axes that are turned counter-clockwise by an angle: along a blade, x ahead of it."""
        cos, sin = cos_sin(angle_deg)
        xx, xy, yy = self.bend_xx_per_m, self.bend_xy_per_m, self.bend_yy_per_m
        return Ground(
            self.offset_m,
            self.slope_x * cos + self.slope_y * sin,
            self.slope_y * cos - self.slope_x * sin,
            xx * cos**2 + xy * cos * sin + yy * sin**2,
            xy * (cos**2 - sin**2) + 2 * (yy - xx) * cos * sin,
            xx * sin**2 - xy * cos * sin + yy * cos**2,
            self.residual_m,
            self.noise_m_per_m2,
        )

    def above(self, x: F32, y: F32, z: F32) -> F32:
        """Heights above the surface."""
        along_x = self.bend_xx_per_m * x
        along_x += self.bend_xy_per_m * y
        along_x += self.slope_x
        along_x *= x
        along_y = self.bend_yy_per_m * y
        along_y += self.slope_y
        along_y *= y
        along_x += along_y
        along_x += self.offset_m
        return np.asarray(z - along_x, dtype=np.float32)


class GroundFit:
    """Fits the ground: flat cells vote on planes, then what surrounds the zone shapes the surface."""

    def __init__(self, blade: BladeGeometry, eye_m: F64, offset_limit_m: float, slope_limit_deg: float) -> None:
        self._eye_m = eye_m
        self._blade = blade
        self._offset_limit_m = offset_limit_m
        self._slope_limit = float(np.tan(np.radians(slope_limit_deg)))
        # Fixed draws: the same picture always gives the same plane.
        self._draws = np.random.default_rng(1).random((HYPOTHESES_N, 3)).T
        x0, x1, y0, y1 = EXTENT_M
        self._columns = round((y1 - y0) / CELL_M)
        self._rows = round((x1 - x0) / CELL_M)

    def fit(self, points: F32, angle_deg: float) -> Ground:
        """Surface through the ground points among ``points`` (3 x N, vehicle frame, m), the blade standing at an angle.

        Points that are far away count as none.
        """
        x, y, z, spread = self._cells(np.ascontiguousarray(points[:, ::2]))  # half of the points are plenty
        flat = spread < CELL_FLAT_M
        if np.count_nonzero(flat) < MIN_CELLS_N:
            return Ground()
        plane = self._plane(_rows(1.0, x, y).compress(flat, axis=1), z.compress(flat))
        if plane is None:
            return Ground()
        return self._surface(plane, x, y, z, spread, angle_deg)

    def _plane(self, a: F64, z: F64) -> Ground | None:
        """The plane on which most cells lie; ``a``: 1, x and y of each."""
        few = max(1, z.size // VOTERS_N)
        plane = self._vote(np.ascontiguousarray(a[:, ::few]), np.ascontiguousarray(z[::few]))
        for width in (2.0 * INLIER_M, INLIER_M):
            near = np.abs(z - plane @ a) < width
            if np.count_nonzero(near) < MIN_CELLS_N:
                return None
            on_it = a * near
            normal = on_it @ a.T
            normal[1, 1] += SLOPE_PULL
            normal[2, 2] += SLOPE_PULL
            plane = _solve(normal, on_it @ z)
        return Ground(*plane.tolist())

    def _surface(self, plane: Ground, x: F64, y: F64, z: F64, spread: F64, angle_deg: float) -> Ground:
        s, d = blade_coordinates(x, y, angle_deg)
        d -= self._blade.x_offset_m
        half, reach = self._blade.length_m / 2 + CLEAR_M, self._blade.reach_m + CLEAR_M
        off = z - plane.offset_m - plane.slope_x * x - plane.slope_y * y
        ground = (np.abs(s) > half) | (d < -CLEAR_M) | (d > reach)
        ground &= np.abs(off) < SURFACE_BAND_M
        ground &= spread < CELL_FLAT_M
        ring = ground & (x * x + y * y < NEAR_M**2)
        if np.count_nonzero(ring) < MIN_RING_N:
            ring = ground
        if np.count_nonzero(ring) < MIN_RING_N:
            noise = middle(spread)
            return replace(plane, residual_m=noise, noise_m_per_m2=self._per_square(noise, x, y))
        x, y, rest = x[ring], y[ring], off[ring]
        a = _rows(1.0, x, y, x * x, x * y, y * y)
        left = rest
        for _ in range(REWEIGHED_N):
            weighed = a / (1.0 + (left / SURFACE_SIGMA_M) ** 2)
            bend = _solve(weighed @ a.T + SURFACE_PRIOR, weighed @ rest)
            left = rest - bend @ a
        uneven = SIGMA_OF_MEDIAN * middle(np.abs(left))
        noise = middle(spread[ring])
        offset_m, slope_x, slope_y, bend_xx, bend_xy, bend_yy = bend.tolist()
        return Ground(
            plane.offset_m + offset_m,
            plane.slope_x + slope_x,
            plane.slope_y + slope_y,
            bend_xx,
            bend_xy,
            bend_yy,
            residual_m=math.hypot(uneven, noise),
            noise_m_per_m2=self._per_square(noise, x, y),
        )

    def _per_square(self, noise_m: float, x: F64, y: F64) -> float:
        eye_x, eye_y, eye_z = self._eye_m
        return noise_m / middle((x - eye_x) ** 2 + (y - eye_y) ** 2 + eye_z**2)

    def _cells(self, points: F32) -> tuple[F64, F64, F64, F64]:
        """Mean place, mean height and spread of height of the cells that hold points near the calibrated ground."""
        x, y, z = points
        x0, x1, _, y1 = EXTENT_M
        band = np.abs(x)
        band *= BAND_SLOPE
        band += BAND_M
        near = np.abs(z) < band
        near &= x > x0
        near &= x < x1
        near &= np.abs(y) < y1
        x, y, z = points.take(np.flatnonzero(near), axis=1)
        cell = ((x - x0) / CELL_M).astype(np.intp)
        cell *= self._columns
        cell += ((y + y1) / CELL_M).astype(np.intp)
        count = np.bincount(cell, minlength=self._rows * self._columns)
        full = np.flatnonzero(count >= MIN_CELL_POINTS_N)
        n = count.take(full).astype(np.float64)
        mean_x, mean_y, mean_z, mean_square = (
            np.bincount(cell, weights=weights, minlength=count.size).take(full) / n for weights in (x, y, z, z * z)
        )
        return mean_x, mean_y, mean_z, np.sqrt(np.maximum(mean_square - mean_z * mean_z, 0.0))

    def _vote(self, a: F64, z: F64) -> F64:
        """The plane through three cells that most cells lie on and fewest lie below; ``a``: 1, x and y of each."""
        count = z.size
        picks = (self._draws * count).astype(np.intp)
        x, y, height = a[1].take(picks), a[2].take(picks), z.take(picks)  # corner, draw
        (dx, ex), (dy, ey), (dz, ez) = x[1:] - x[0], y[1:] - y[0], height[1:] - height[0]
        area = dx * ey - ex * dy
        good = np.abs(area) > WIDE_M2
        area[~good] = 1.0
        slope_x, slope_y = (dz * ey - ez * dy) / area, (dx * ez - ex * dz) / area
        offset = height[0] - slope_x * x[0] - slope_y * y[0]
        tilt = slope_x * slope_x + slope_y * slope_y
        good &= tilt < (LIMIT_RATIO * self._slope_limit) ** 2
        good &= np.abs(offset) < LIMIT_RATIO * self._offset_limit_m
        good[0], offset[0], slope_x[0], slope_y[0] = True, 0.0, 0.0, 0.0  # the calibrated plane
        planes = np.array((offset, slope_x, slope_y)).compress(good, axis=1)
        residual = z.astype(np.float32) - planes.T.astype(np.float32) @ a.astype(np.float32)
        below = residual < -2.0 * INLIER_M
        residual /= INLIER_M
        residual *= residual
        votes = np.maximum(1.0 - residual, 0.0)
        votes -= np.float32(BELOW_VOTES) * below
        prior = (planes[0] / self._offset_limit_m) ** 2 + (planes[1] ** 2 + planes[2] ** 2) / self._slope_limit**2
        return planes[:, (votes.sum(axis=1) - CALIBRATED_VOTES * count * prior).argmax()]


def _rows(constant: float, *rows: F64) -> F64:
    """A row of a constant and others below it; a quarter of what ``np.stack`` costs."""
    every = np.empty((1 + len(rows), rows[0].size))
    every[0] = constant
    for at, row in enumerate(rows, 1):
        every[at] = row
    return every


def _solve(normal: F64, right: F64) -> F64:
    """Solution of normal equations, which are positive definite; a quarter of what ``np.linalg.solve`` costs on few."""
    return np.asarray(cv2.solve(normal, right[:, None], flags=cv2.DECOMP_CHOLESKY)[1][:, 0], dtype=np.float64)
