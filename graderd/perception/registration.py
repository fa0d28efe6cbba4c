"""Where the camera really is, from this one depth picture: the ground's level and slope, and the blade's own place.

The calibrated pose is never exact: mounts bend, tyres give, the machine pitches. Soil two centimetres high cannot
be told from a camera two centimetres off, unless level and slope of the ground are fitted anew in every frame; and a
third is not where the calibration says unless the blade's face and ends are found again. What is found also tells when
the camera was knocked out of place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graderd.core.blade import BladeGeometry
from graderd.hal.camera import DepthImage
from graderd.perception.geometry import F32, F64, View, blade_points_m, face_setback_m, top_edge_m

GROUND_CELL_M = 0.08
GROUND_BAND_M = 0.13
"""Points this close to the calibrated ground may be ground."""
GROUND_EXTENT_M = (-2.0, 1.2, -1.2, 1.2)
"""x from, x to, y from, y to (vehicle frame) of what is looked at."""
CELL_FLAT_M = 0.010
"""Heights within a cell of ground spread less than this; the side of a pile spreads more."""
MIN_CELL_POINTS_N = 3
INLIER_M = 0.010
HYPOTHESES_N = 64
VOTERS_N = 100
NOMINAL_WIDTH_PX = 848
FACE_POINTS_N = 2000
FACE_BAND_M = 0.16
"""The face is looked for from its upper edge down to here."""
PLACE_M = 0.01
LEVEL_M = 0.015
UPRIGHT_LEVELS_N = 4
"""Soil at 45 degrees shows in no more than 3 levels within two places (2 cm)."""
TOP_COLUMNS_N = 24
EDGE_ANGLE_STEP_DEG = 0.5
KEPT_COLUMNS_N = 256
BODY_BELOW_M = (0.05, 0.13)
"""Heights below the upper edge at which the face is probed."""
TOP_SEARCH_PX = 36
"""The upper edge is looked for so far above and below where it should be, at 848 pixels across."""
SUNK_M = 0.017
"""The blade lower in the ground than this: what was taken for the ground is a layer of soil."""


@dataclass(frozen=True, slots=True)
class Ground:
    """Plane ``z = offset_m + slope_x * x + slope_y * y`` in the calibrated vehicle frame.

    ``residual_m``: robust rms of the heights about it. ``support``: share of the flat cells that lie on it.
    ``cells``: how many cells those are; 0 where no ground was seen and the calibration is kept.
    """

    offset_m: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0
    residual_m: float = 0.0
    support: float = 0.0
    cells: int = 0

    def slope_deg(self) -> float:
        """Angle between this plane and the calibrated ground."""
        return float(np.degrees(np.hypot(self.slope_x, self.slope_y)))

    def offset_under_m(self, x_m: float, y_m: float) -> float:
        """Height of the plane at a place."""
        return self.offset_m + self.slope_x * x_m + self.slope_y * y_m


class GroundFit:
    """Fits the ground: flat cells vote on planes, soil above does no harm, soil below does not exist."""

    def __init__(self, offset_limit_m: float, slope_limit_deg: float) -> None:
        self._offset_limit_m = offset_limit_m
        self._slope_limit = float(np.tan(np.radians(slope_limit_deg)))
        # Fixed draws: the same picture always gives the same plane.
        self._draws = np.random.default_rng(1).random((HYPOTHESES_N, 3))
        x0, x1, y0, y1 = GROUND_EXTENT_M
        self._columns = round((y1 - y0) / GROUND_CELL_M)
        self._rows = round((x1 - x0) / GROUND_CELL_M)

    def fit(self, x: F32, y: F32, z: F32) -> Ground:
        """Plane through the ground points among ``x, y, z`` (vehicle frame, m)."""
        cx, cy, cz, noise = self._flat_cells(x[::2], y[::2], z[::2])  # half of the points are plenty
        if cx.size < 6:
            return Ground()
        a = np.column_stack((np.ones_like(cx), cx, cy))
        few = max(1, cx.size // VOTERS_N)
        plane = self._vote(a[::few], cz[::few])
        for width in (2.0 * INLIER_M, INLIER_M):
            near = np.abs(cz - a @ plane) < width
            if near.sum() < 6:
                return Ground()
            # A weak pull towards the calibration keeps slopes sane where ground is seen on one side only.
            pull = np.diag((0.0, 0.05, 0.05))
            plane = np.asarray(np.linalg.solve(a[near].T @ a[near] + pull, a[near].T @ cz[near]), dtype=np.float64)
        near = np.abs(cz - a @ plane) < INLIER_M
        return Ground(
            float(plane[0]),
            float(plane[1]),
            float(plane[2]),
            float(np.median(noise[near])) if near.any() else 0.0,
            float(near.mean()),
            int(near.sum()),
        )

    def _flat_cells(self, x: F32, y: F32, z: F32) -> tuple[F64, F64, F64, F64]:
        x0, x1, y0, y1 = GROUND_EXTENT_M
        take = np.flatnonzero((np.abs(z) < GROUND_BAND_M) & (x > x0) & (np.abs(y) < y1) & (x < x1))
        x, y, z = x[take], y[take], z[take]
        cell = ((x - np.float32(x0)) * np.float32(1 / GROUND_CELL_M)).astype(np.int32) * self._columns
        cell += ((y - np.float32(y0)) * np.float32(1 / GROUND_CELL_M)).astype(np.int32)
        size = self._rows * self._columns
        count = np.bincount(cell, minlength=size)[:size]
        full = np.flatnonzero(count >= MIN_CELL_POINTS_N)
        n = count[full].astype(np.float64)
        sums = [np.bincount(cell, weights=w, minlength=size)[full] / n for w in (x, y, z)]
        spread = np.sqrt(np.maximum(np.bincount(cell, weights=z * z, minlength=size)[full] / n - sums[2] ** 2, 0.0))
        flat = spread < CELL_FLAT_M
        return sums[0][flat], sums[1][flat], sums[2][flat], spread[flat]

    def _vote(self, a: F64, z: F64) -> F64:
        count = z.size
        picks = np.minimum((self._draws * count).astype(np.intp), count - 1)
        x, y, height = a[:, 1][picks], a[:, 2][picks], z[picks]
        dx, dy, dz = x[:, 1:] - x[:, :1], y[:, 1:] - y[:, :1], height[:, 1:] - height[:, :1]
        area = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
        good = np.abs(area) > 0.01
        area = np.where(good, area, 1.0)
        slope_x = (dz[:, 0] * dy[:, 1] - dz[:, 1] * dy[:, 0]) / area
        slope_y = (dx[:, 0] * dz[:, 1] - dx[:, 1] * dz[:, 0]) / area
        offset = height[:, 0] - slope_x * x[:, 0] - slope_y * y[:, 0]
        good &= np.hypot(slope_x, slope_y) < 1.5 * self._slope_limit
        good &= np.abs(offset) < 1.5 * self._offset_limit_m
        planes = np.vstack((np.zeros((1, 3)), np.column_stack((offset, slope_x, slope_y))[good]))
        residual = (z[None, :] - planes @ a.T).astype(np.float32)
        inlier = np.maximum(np.float32(0.0), 1 - (residual * np.float32(1 / INLIER_M)) ** 2).sum(axis=1)
        # Nothing lies under the ground: cells below a plane speak against it.
        below = (residual < -2.0 * INLIER_M).sum(axis=1)
        prior = (planes[:, 0] / self._offset_limit_m) ** 2 + (
            np.hypot(planes[:, 1], planes[:, 2]) / self._slope_limit
        ) ** 2
        score = inlier - 1.5 * below - 0.05 * count * prior
        return np.asarray(planes[int(np.argmax(score))], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class BladeFix:
    """Where the blade was found, relative to the calibrated place at the measured angle.

    ``ahead_m`` along d, ``along_m`` along s, ``turn_deg`` counter-clockwise; each 0 where it could not be seen.
    ``seen``: share of the pixels on the calibrated face that show the face. ``missing``: share of places
    on the face that show something else upright, or what lies behind, where the face should be.
    """

    ahead_m: float = 0.0
    along_m: float = 0.0
    turn_deg: float = 0.0
    seen: float = 0.0
    missing: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _EdgeColumns:
    """Pieces of picture columns across the blade's upper edge: flat pixel indices and their rays, columns x pixels.

    ``body``: two pixels on the face below the edge in each column, likewise.
    """

    pixels: npt.NDArray[np.intp]
    rays: F32
    body: npt.NDArray[np.intp]
    body_rays: F32


class BladeFinder:
    """Finds the moldboard's face and ends in the points, given roughly where they are."""

    SEARCH_M = 0.09
    COLUMNS_N = 12

    def __init__(self, view: View, blade: BladeGeometry) -> None:
        self._view = view
        self._all_rays = view.rays()
        self._position = view.position_m.astype(np.float32)
        self._columns: dict[int, _EdgeColumns | None] = {}
        self._blade = blade
        table = np.linspace(-0.2, 0.8, 1001)
        self._setback = face_setback_m(blade, table).astype(np.float32)

    def setback(self, z: npt.NDArray[np.floating]) -> F32:
        """Set-back of the hollow face at heights ``z`` (table look-up, 1 mm)."""
        index = np.clip((z + 0.2) * 1000.0, 0, 1000).astype(np.int32)
        return np.asarray(self._setback[index], dtype=np.float32)

    def sunk_m(self, depth_mm: DepthImage, angle_deg: float, ground: Ground) -> float:
        """How far the blade's upper edge lies lower than it would above this ground; 0 where it cannot be told.

        A level layer of soil all round looks like ground. But a blade does not stand deep in the ground: where it
        seems to, the level was the layer's. The edge is looked for down columns of the picture; one above which
        something nearer stands is hidden, not low.
        """
        columns = self._edge_columns(round(angle_deg / EDGE_ANGLE_STEP_DEG))
        if columns is None:
            return 0.0
        blade = self._blade
        z_optical = depth_mm.ravel()[columns.pixels] * np.float32(0.001)
        at = columns.rays * z_optical[..., None] + self._position
        height = at[..., 2] - ground.offset_m - ground.slope_x * at[..., 0] - ground.slope_y * at[..., 1]
        cos, sin = np.float32(np.cos(np.radians(angle_deg))), np.float32(np.sin(np.radians(angle_deg)))
        d = at[..., 0] * cos + at[..., 1] * sin - np.float32(blade.x_offset_m)
        valid = z_optical > 0
        face = valid & (np.abs(d + self.setback(height)) < self.SEARCH_M)
        column, first = np.arange(len(z_optical)), face.argmax(axis=1)
        free = face.any(axis=1) & (first > 0)
        edge_m = z_optical[column, first]
        behind = np.zeros(len(z_optical), dtype=np.intp)
        for above in range(1, 7):
            over = z_optical[column, np.maximum(first - above, 0)]
            free &= (over == 0) | (over > edge_m - 0.08)
            behind += over > edge_m + 0.08
        free &= behind >= 2  # what has no depth may be nearer as well
        if free.sum() < TOP_COLUMNS_N // 3:
            return 0.0
        tops = height[column[free], first[free]]
        return blade.bottom_z_m + blade.height_m - float(np.median(tops))

    def displaced(self, depth_mm: DepthImage, angle_deg: float) -> BladeFix:
        """What stands where the face should be, when :meth:`find` saw no face near: a face further off, or nothing.

        Two pixels a little apart in height, down each column: on a face they are as far ahead as each other, on a
        slope of soil they are not.
        """
        columns = self._edge_columns(round(angle_deg / EDGE_ANGLE_STEP_DEG))
        if columns is None:
            return BladeFix()
        z_optical = depth_mm.ravel()[columns.body] * np.float32(0.001)
        at = columns.body_rays * z_optical[..., None] + self._position
        cos, sin = np.float32(np.cos(np.radians(angle_deg))), np.float32(np.sin(np.radians(angle_deg)))
        d = at[..., 0] * cos + at[..., 1] * sin - np.float32(self._blade.x_offset_m)
        face = d + self.setback(at[..., 2])
        valid = (z_optical > 0).all(axis=1)
        if valid.sum() < TOP_COLUMNS_N // 3:
            return BladeFix()
        face = face[valid]
        upright = np.abs(face[:, 0] - face[:, 1]) < 0.03
        through = face.max(axis=1) < -0.2
        elsewhere = through | (upright & (np.abs(face[:, 0]) > self.SEARCH_M))
        return BladeFix(missing=float(elsewhere.mean()))

    def _edge_columns(self, step: int) -> _EdgeColumns | None:
        """The pixels in which the upper edge is looked for at this angle; None where too few are in the picture."""
        if step in self._columns:
            return self._columns[step]
        lens = self._view.lens
        angle_deg = step * EDGE_ANGLE_STEP_DEG
        edge = self._view.project(top_edge_m(self._blade, angle_deg, TOP_COLUMNS_N, 0.04))
        scale = lens.width / NOMINAL_WIDTH_PX
        reach, stride = round(TOP_SEARCH_PX * scale), max(1, round(2 * scale))
        u, v = np.round(edge[np.isfinite(edge).all(axis=1)]).astype(np.intp).T
        inside = (u >= 0) & (u < lens.width) & (v >= reach) & (v < lens.height - reach)
        columns: _EdgeColumns | None = None
        if inside.sum() >= TOP_COLUMNS_N // 3:
            down = np.arange(-reach, reach + 1, stride)
            v = v[inside, None] + down[None, :]
            u = np.broadcast_to(u[inside, None], v.shape)
            columns = _EdgeColumns(v * lens.width + u, self._all_rays[v, u], *self._body(angle_deg))
        if len(self._columns) >= KEPT_COLUMNS_N:
            self._columns.clear()
        self._columns[step] = columns
        return columns

    def _body(self, angle_deg: float) -> tuple[npt.NDArray[np.intp], F32]:
        lens, blade = self._view.lens, self._blade
        s = np.linspace(-0.45, 0.45, TOP_COLUMNS_N) * blade.length_m
        places = []
        for below_m in BODY_BELOW_M:
            z = np.full(TOP_COLUMNS_N, blade.bottom_z_m + blade.height_m - below_m)
            places.append(self._view.project(blade_points_m(blade, angle_deg, s, -face_setback_m(blade, z), z)))
        both = np.round(np.stack(places, axis=1))
        seen = np.isfinite(both).all(axis=(1, 2)) & (both >= 0).all(axis=(1, 2))
        seen &= (both[..., 0] < lens.width).all(axis=1) & (both[..., 1] < lens.height).all(axis=1)
        u, v = both[seen].astype(np.intp).transpose(2, 0, 1)
        return v * lens.width + u, self._all_rays[v, u]

    def find(self, s: F32, d: F32, z: F32, setback: F32) -> BladeFix:
        """``s, d, z``: points in blade coordinates, level ground at z = 0; ``setback`` that of their heights."""
        blade = self._blade
        half = blade.length_m / 2
        top = blade.bottom_z_m + blade.height_m
        face = d + setback  # 0 on the face
        upper = (z > top - FACE_BAND_M) & (z < top - 0.01) & (np.abs(s) < half + self.SEARCH_M)
        near = np.flatnonzero(upper & (np.abs(face) < self.SEARCH_M))
        if near.size < 40:
            return BladeFix()
        near = near[:: max(1, near.size // FACE_POINTS_N)]
        near_s, near_face = s[near], face[near]
        column = ((near_s + np.float32(half)) * np.float32(self.COLUMNS_N / blade.length_m)).astype(np.int32)
        inside = (column >= 0) & (column < self.COLUMNS_N)
        face_at, upright = self._upright(column[inside], near_face[inside], top - z[near][inside])
        s_at = (np.flatnonzero(upright) + 0.5) / self.COLUMNS_N * blade.length_m - half
        if s_at.size < self.COLUMNS_N // 3:
            return BladeFix()
        first, second = np.triu_indices(s_at.size, 3)
        slopes = (face_at[second] - face_at[first]) / (s_at[second] - s_at[first])
        slope = float(np.median(slopes)) if slopes.size else 0.0
        ahead = float(np.median(face_at - slope * s_at))
        on_face = np.abs(near_face - np.float32(ahead) - np.float32(slope) * near_s) < 0.015
        along = self._ends(near_s[on_face])
        return BladeFix(ahead, along, -float(np.degrees(np.arctan(slope))), float(on_face.mean()), 0.0)

    def _upright(self, column: npt.NDArray[np.int32], face: F32, below_m: F32) -> tuple[F64, npt.NDArray[np.bool_]]:
        """Per column where the face stands, for the columns in which something upright is seen, and which those are.

        What stands upright shows at the same place at many heights. Soil that leans on the face, up to the edge where
        the blade casts it aside, shows at each height at another place; hoses and rods are narrow and lie ahead.
        """
        places_n = round(2 * self.SEARCH_M / PLACE_M)
        place = ((face + np.float32(self.SEARCH_M)) * np.float32(1 / PLACE_M)).astype(np.int32)
        place = np.minimum(place, places_n - 1)
        levels_n = round(FACE_BAND_M / LEVEL_M)
        level = np.clip((below_m * np.float32(1 / LEVEL_M)).astype(np.int32), 0, levels_n - 1)
        shape = (self.COLUMNS_N, places_n, levels_n)
        index = (column * places_n + place) * levels_n + level
        shown = np.bincount(index, minlength=self.COLUMNS_N * places_n * levels_n).reshape(shape) > 0
        two = shown[:, 1:] | shown[:, :-1]  # a face lies across the bound of two places as well as on one
        tall = two.sum(axis=2)
        best = tall.argmax(axis=1)  # the rearmost where several are as tall
        upright = tall[np.arange(self.COLUMNS_N), best] >= UPRIGHT_LEVELS_N
        on_it = (place == best[column]) | (place == best[column] + 1)
        middles = [float(np.median(face[on_it & (column == i)])) for i in np.flatnonzero(upright)]
        return np.asarray(middles, dtype=np.float64), upright

    def _ends(self, s: F32) -> float:
        if s.size < 60:
            return 0.0
        rank = s.size * 7 // 1000
        ranked = np.partition(s, (rank, s.size - 1 - rank))
        low, high = ranked[rank], ranked[s.size - 1 - rank]
        length = self._blade.length_m
        if abs((high - low) - length) > 0.05:
            return 0.0  # an end is hidden; the middle of what is seen says nothing
        return float(low + high) / 2
