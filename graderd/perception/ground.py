"""The ground from one depth picture: a surface fitted anew, and how far real ground departs from it.

The calibrated pose is never exact, the machine pitches, and ground is no plane. Level and slope are voted on by flat
cells, so that soil above does no harm; then a surface of second order (bowl, crown, ridge) is fitted to what lies
round the soil's zone and carried through under it. How far cells depart from that surface is its residual: soil that
does not stand out of it cannot be told from ground.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from graderd.core.blade import BladeGeometry, blade_coordinates
from graderd.perception.geometry import F32, F64, middle

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
        return float(np.degrees(np.arctan(np.hypot(self.slope_x, self.slope_y))))

    def height_at(self, x_m: F64, y_m: F64) -> F64:
        """Heights of the surface at places."""
        bend = self.bend_xx_per_m * x_m**2 + self.bend_xy_per_m * x_m * y_m + self.bend_yy_per_m * y_m**2
        return np.asarray(self.offset_m + self.slope_x * x_m + self.slope_y * y_m + bend, dtype=np.float64)

    def above(self, x: F32, y: F32, z: F32) -> F32:
        """Heights above the surface."""
        a, b, c, d, e, f = (
            np.float32(value)
            for value in (
                self.offset_m,
                self.slope_x,
                self.slope_y,
                self.bend_xx_per_m,
                self.bend_xy_per_m,
                self.bend_yy_per_m,
            )
        )
        return np.asarray(z - a - x * (b + d * x + e * y) - y * (c + f * y), dtype=np.float32)


class GroundFit:
    """Fits the ground: flat cells vote on planes, then what surrounds the zone shapes the surface."""

    def __init__(self, blade: BladeGeometry, eye_m: F64, offset_limit_m: float, slope_limit_deg: float) -> None:
        self._eye_m = eye_m
        self._blade = blade
        self._offset_limit_m = offset_limit_m
        self._slope_limit = float(np.tan(np.radians(slope_limit_deg)))
        # Fixed draws: the same picture always gives the same plane.
        self._draws = np.random.default_rng(1).random((HYPOTHESES_N, 3))
        x0, x1, y0, y1 = EXTENT_M
        self._columns = round((y1 - y0) / CELL_M)
        self._rows = round((x1 - x0) / CELL_M)

    def fit(self, x: F32, y: F32, z: F32, angle_deg: float) -> Ground:
        """Surface through the ground points among ``x, y, z`` (vehicle frame, m), the blade standing at an angle."""
        cx, cy, cz, spread = self._cells(x[::2], y[::2], z[::2])  # half of the points are plenty
        flat = spread < CELL_FLAT_M
        if flat.sum() < MIN_CELLS_N:
            return Ground()
        plane = self._plane(cx[flat], cy[flat], cz[flat])
        if plane is None:
            return Ground()
        return self._surface(Ground(*plane), cx, cy, cz, spread, angle_deg)

    def _plane(self, cx: F64, cy: F64, cz: F64) -> tuple[float, float, float] | None:
        a = np.column_stack((np.ones_like(cx), cx, cy))
        few = max(1, cx.size // VOTERS_N)
        plane = self._vote(a[::few], cz[::few])
        for width in (2.0 * INLIER_M, INLIER_M):
            near = np.abs(cz - a @ plane) < width
            if near.sum() < MIN_CELLS_N:
                return None
            pull = np.diag((0.0, SLOPE_PULL, SLOPE_PULL))
            on_it = a[near]
            plane = _solve(on_it.T @ on_it + pull, on_it.T @ cz[near])
        offset_m, slope_x, slope_y = plane.tolist()
        return offset_m, slope_x, slope_y

    def _surface(self, plane: Ground, cx: F64, cy: F64, cz: F64, spread: F64, angle_deg: float) -> Ground:
        s, d = blade_coordinates(cx, cy, angle_deg)
        d -= self._blade.x_offset_m
        half, reach = self._blade.length_m / 2 + CLEAR_M, self._blade.reach_m + CLEAR_M
        zone = (np.abs(s) < half) & (d > -CLEAR_M) & (d < reach)
        far = np.hypot(cx, cy) > NEAR_M
        off = _about(plane, cx, cy, cz)
        ground = ~zone & (np.abs(off) < SURFACE_BAND_M) & (spread < CELL_FLAT_M)
        ring = ground & ~far
        if ring.sum() < MIN_RING_N:
            ring = ground
        if ring.sum() < MIN_RING_N:
            noise = middle(spread)
            return replace(plane, residual_m=noise, noise_m_per_m2=self._per_square(noise, cx, cy))
        x, y, rest = cx[ring], cy[ring], off[ring]
        a = np.column_stack((np.ones_like(x), x, y, x * x, x * y, y * y))
        bend: F64 = np.zeros(a.shape[1])
        prior = np.diag((OFFSET_PULL, SLOPE_PULL, SLOPE_PULL, *[(SURFACE_SIGMA_M / CURVATURE_SIGMA_PER_M) ** 2] * 3))
        for _ in range(REWEIGHED_N):
            weight = 1.0 / (1.0 + ((rest - a @ bend) / SURFACE_SIGMA_M) ** 2)
            weighed = a * weight[:, None]
            bend = _solve(a.T @ weighed + prior, weighed.T @ rest)
        uneven = SIGMA_OF_MEDIAN * middle(np.abs(rest - a @ bend))
        noise = middle(spread[ring])
        offset_m, slope_x, slope_y, bend_xx, bend_xy, bend_yy = bend.tolist()
        return replace(
            plane,
            offset_m=plane.offset_m + offset_m,
            slope_x=plane.slope_x + slope_x,
            slope_y=plane.slope_y + slope_y,
            bend_xx_per_m=bend_xx,
            bend_xy_per_m=bend_xy,
            bend_yy_per_m=bend_yy,
            residual_m=float(np.hypot(uneven, noise)),
            noise_m_per_m2=self._per_square(noise, cx[ring], cy[ring]),
        )

    def _per_square(self, noise_m: float, x: F64, y: F64) -> float:
        eye_x, eye_y, eye_z = self._eye_m
        return noise_m / middle((x - eye_x) ** 2 + (y - eye_y) ** 2 + eye_z**2)

    def _cells(self, x: F32, y: F32, z: F32) -> tuple[F64, F64, F64, F64]:
        """Mean place, mean height and spread of height of the cells that hold points near the calibrated ground."""
        x0, x1, _, y1 = EXTENT_M
        take = np.flatnonzero((np.abs(z) < BAND_M + BAND_SLOPE * np.abs(x)) & (x > x0) & (np.abs(y) < y1) & (x < x1))
        x, y, z = x[take], y[take], z[take]
        cell = ((x - np.float32(x0)) * np.float32(1 / CELL_M)).astype(np.int32) * self._columns
        cell += ((y + np.float32(y1)) * np.float32(1 / CELL_M)).astype(np.int32)
        size = self._rows * self._columns
        count = np.bincount(cell, minlength=size)[:size]
        full = np.flatnonzero(count >= MIN_CELL_POINTS_N)
        n = count[full].astype(np.float64)
        sums = [np.bincount(cell, weights=w, minlength=size)[full] / n for w in (x, y, z)]
        spread = np.sqrt(np.maximum(np.bincount(cell, weights=z * z, minlength=size)[full] / n - sums[2] ** 2, 0.0))
        return sums[0], sums[1], sums[2], spread

    def _vote(self, a: F64, z: F64) -> F64:
        count = z.size
        picks = np.minimum((self._draws * count).astype(np.intp), count - 1)
        x, y, height = a[:, 1][picks], a[:, 2][picks], z[picks]
        dx, dy, dz = x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1], height[:, 1:] - height[:, :1]
        area = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
        good = np.abs(area) > WIDE_M2
        area = np.where(good, area, 1.0)
        slope_x = (dz[:, 0] * dy[:, 1] - dz[:, 1] * dy[:, 0]) / area
        slope_y = (dx[:, 0] * dz[:, 1] - dx[:, 1] * dz[:, 0]) / area
        offset = height[:, 0] - slope_x * x[:, 0] - slope_y * y[:, 0]
        good &= np.hypot(slope_x, slope_y) < LIMIT_RATIO * self._slope_limit
        good &= np.abs(offset) < LIMIT_RATIO * self._offset_limit_m
        planes = np.vstack((np.zeros((1, 3)), np.column_stack((offset, slope_x, slope_y))[good]))
        residual = (z[None, :] - planes @ a.T).astype(np.float32)
        inlier = np.maximum(np.float32(0.0), 1 - (residual * np.float32(1 / INLIER_M)) ** 2).sum(axis=1)
        below = (residual < -2.0 * INLIER_M).sum(axis=1)
        prior = (planes[:, 0] / self._offset_limit_m) ** 2 + (
            np.hypot(planes[:, 1], planes[:, 2]) / self._slope_limit
        ) ** 2
        score = inlier - BELOW_VOTES * below - CALIBRATED_VOTES * count * prior
        return np.asarray(planes[int(np.argmax(score))], dtype=np.float64)


def _about(ground: Ground, x: F64, y: F64, z: F64) -> F64:
    return np.asarray(z - ground.offset_m - ground.slope_x * x - ground.slope_y * y, dtype=np.float64)


def _solve(normal: F64, right: F64) -> F64:
    """Solution of normal equations, which are positive definite; a quarter of what ``np.linalg.solve`` costs on few."""
    return np.asarray(cv2.solve(normal, right[:, None], flags=cv2.DECOMP_CHOLESKY)[1][:, 0], dtype=np.float64)
