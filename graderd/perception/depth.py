"""Soil by its height: how many litres lie in front of each third of the blade, from the depth picture alone.

Colour, light, wetness and rust do not enter. One frame: every n-th pixel becomes a point in the vehicle frame; ground
and blade are found again (:mod:`graderd.perception.registration`); points in front of the face fill a height map
in blade coordinates; what a crest hides from the camera is filled with a slope at the angle of repose; heights above
the noise add up to litres.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from graderd.core.blade import STEEPEST_MEETING_DEG, BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import DepthImage
from graderd.perception.decide import Verdict, decide
from graderd.perception.geometry import F32, F64, U8, View, third_outlines_px
from graderd.perception.registration import SUNK_M, BladeFinder, BladeFix, Ground, GroundFit
from graderd.perception.settings import DecisionSettings, DepthSettings
from graderd.perception.split import Cells, split_soil

I64 = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

NOMINAL_WIDTH_PX = 848
KEPT_GRIDS_N = 64
CONTEXT_M = 0.14
"""The height map goes on so far beyond the reach: what stands at its border is judged by what stands before it."""
BESIDE_RATIO = 0.87
"""And beyond both ends of the blade by this part of the travel looked ahead: the sine of 60 degrees, as far as a blade
turns; one turned further looks less far ahead at its leading end."""
STEEP_TOLERANCE_M = 0.02
UNSEEN = 10.0
"""Stands for a height that is not known, metres."""
FACE_MARGIN_M = 0.025
"""Points closer to the blade's face than this are the face."""


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Soil in blade coordinates: ``height_m[i, j]`` at s cell i (right to left) and d cell j (blade to front).

    ``seen`` is False where the height was filled in. ``valid``: per third (right, center, left) the share of the pixels
    on it that measure it, neither without depth nor hidden by something nearer. ``volumes_l``: all soil before each
    third to the reach; ``carried_l``, ``ahead_l``: see :func:`graderd.perception.split.split_soil`. ``angle_deg``:
    where the blade was found.
    """

    height_m: F64
    seen: Bools
    threshold_m: float
    volumes_l: tuple[float, float, float]
    carried_l: tuple[float, float, float]
    ahead_l: tuple[float, float, float]
    valid: tuple[float, float, float]
    ground: Ground
    blade: BladeFix
    angle_deg: float


class DepthJudge:
    """Turns depth pictures of one stream into litres per third."""

    def __init__(self, view: View, blade: BladeGeometry, settings: DepthSettings, decision: DecisionSettings) -> None:
        self._settings = settings
        self._view = view
        self._grids: OrderedDict[int, tuple[U8, tuple[int, ...]]] = OrderedDict()
        self._decision = decision
        self._blade = blade
        self._position = view.position_m.astype(np.float32)
        # The stride is meant for a picture 848 pixels across; a smaller one is sampled as densely on the ground.
        self._stride = max(1, round(settings.stride_px * view.lens.width / NOMINAL_WIDTH_PX))
        rays = view.rays(self._stride)
        self._rays = np.ascontiguousarray(rays.reshape(-1, 3).T)
        self._focal_px = view.lens.fx
        self._ground = GroundFit(settings.ground_offset_limit_m, settings.ground_slope_limit_deg)
        self._finder = BladeFinder(view, blade)
        self._along_n = max(6, 3 * round(blade.length_m / settings.cell_m / 3))
        self._ahead_n = max(4, round(blade.reach_m / settings.cell_m))
        self._cell_s_m = blade.length_m / self._along_n
        self._cell_d_m = blade.reach_m / self._ahead_n
        self._context_n = round(CONTEXT_M / self._cell_d_m)
        self._travel_m = blade.reach_m + CONTEXT_M
        self._beside_n = int(np.ceil(self._travel_m * BESIDE_RATIO / self._cell_s_m))
        rows_n, columns_n = self._along_n + 2 * self._beside_n, self._ahead_n + self._context_n
        self._cells = Cells(
            self._cell_s_m * np.arange(0.5 - rows_n / 2, rows_n / 2, dtype=np.float64),
            self._cell_d_m * np.arange(0.5, columns_n, dtype=np.float64),
            self._cell_s_m * self._cell_d_m,
        )

    def height_map(self, depth_mm: DepthImage, angle_deg: float) -> HeightMap:
        """Measure one depth picture (uint16, mm along the optical axis, 0 = no value)."""
        pixels, points = self._points(depth_mm)
        ground = self._ground.fit(*points)
        sunk = self._finder.sunk_m(depth_mm, angle_deg, ground)
        if sunk > SUNK_M:
            ground = replace(ground, offset_m=ground.offset_m - sunk)
        s, d, z = self._in_blade(points, ground, angle_deg)
        near = np.flatnonzero((d > -0.20) & (d < self._blade.reach_m + CONTEXT_M) & (z < self._settings.max_height_m))
        valid = self._valid_shares(pixels[near], angle_deg)
        s, d, z = s[near], d[near], z[near]
        setback = self._finder.setback(z)
        fix = self._finder.find(s, d, z, setback)
        if fix.seen == 0:
            fix = self._finder.displaced(depth_mm, angle_deg)
        # Small rotation and shift of the blade against its calibrated place.
        turn = np.float32(np.radians(fix.turn_deg))
        ahead, along = np.float32(fix.ahead_m), np.float32(fix.along_m)
        d = np.asarray(d - ahead + turn * s, dtype=np.float32)
        s = np.asarray(s - along - turn * d, dtype=np.float32)
        return self._map(s, d, z, setback, ground, fix, valid, angle_deg + fix.turn_deg)

    def verdict(self, soil: HeightMap) -> Verdict:
        """Judge a height map."""
        return self._believed(soil, soil.volumes_l)

    def verdict_ahead(self, soil: HeightMap) -> Verdict:
        """Judge what the blade will meet."""
        verdict = self._believed(soil, soil.ahead_l)
        ahead_l, carried_l = sum(soil.ahead_l), sum(soil.carried_l)
        if verdict.zone is not Zone.NONE and ahead_l * 100 < self._settings.ahead_min_percent * carried_l:
            return verdict.unknown(f"{ahead_l:.1f} l ahead do not stand out of the {carried_l:.1f} l that are carried")
        if abs(soil.angle_deg) > STEEPEST_MEETING_DEG:
            return verdict.unknown(f"the blade is turned by {soil.angle_deg:.0f} degrees: it meets hardly anything")
        return verdict

    def _believed(self, soil: HeightMap, amounts_l: tuple[float, float, float]) -> Verdict:
        settings = self._settings
        verdict = decide(amounts_l, settings.none_volume_l, "l", self._decision, amounts_l)
        weakest = min(soil.valid)
        if weakest * 100 < settings.min_valid_percent:
            return verdict.unknown(
                f"only {weakest * 100:.0f} % of a third has depth, {settings.min_valid_percent:.0f} % is asked"
            )
        return verdict

    def _points(self, depth_mm: DepthImage) -> tuple[I64, F32]:
        """Indices of the sampled pixels that have depth, and their points in the vehicle frame (3 x N)."""
        stride = self._stride
        depth = depth_mm[stride // 2 :: stride, stride // 2 :: stride].ravel()
        valid = np.flatnonzero(depth)
        points = np.take(self._rays, valid, axis=1)
        points *= depth[valid] * np.float32(0.001)
        points += self._position[:, None]
        return valid, points

    def _in_blade(self, points: F32, ground: Ground, angle_deg: float) -> tuple[F32, F32, F32]:
        """Points in blade coordinates s and d, and their heights above the ground: one product for all three."""
        angle = np.radians(angle_deg)
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array(((-sin, cos, 0), (cos, sin, 0), (-ground.slope_x, -ground.slope_y, 1)), dtype=np.float32)
        shift = np.array((0, -self._blade.x_offset_m, -ground.offset_m), dtype=np.float32)
        s, d, z = np.asarray(turn @ points + shift[:, None], dtype=np.float32)
        return s, d, z

    def _valid_shares(self, pixels: I64, angle_deg: float) -> tuple[float, float, float]:
        """Of the pixels on each third, the share among ``pixels``."""
        step = round(angle_deg)
        if step not in self._grids:
            self._grids[step] = self._third_grid(step)
            if len(self._grids) > KEPT_GRIDS_N:
                self._grids.popitem(last=False)
        thirds, totals = self._grids[step]
        counts = np.bincount(thirds[pixels], minlength=4)
        shares = [float(counts[third]) / totals[third] if totals[third] else 0.0 for third in range(3)]
        return shares[0], shares[1], shares[2]

    def _third_grid(self, angle_deg: float) -> tuple[U8, tuple[int, ...]]:
        """For each sampled pixel the third it lies on (3: none), and how many lie on each."""
        lens = self._view.lens
        rows, columns = (len(range(self._stride // 2, side, self._stride)) for side in (lens.height, lens.width))
        grid = np.full((rows, columns), 3, dtype=np.uint8)
        for third, outline in enumerate(third_outlines_px(self._view, self._blade, angle_deg)):
            if np.isfinite(outline).all():
                places = (outline - self._stride // 2) / self._stride
                cv2.fillPoly(grid, [np.round(places * 16).astype(np.int32)], third, shift=4)
        return grid.ravel(), tuple(int(n) for n in np.bincount(grid.ravel(), minlength=4))

    def _map(
        self,
        s: F32,
        d: F32,
        z: F32,
        setback: F32,
        ground: Ground,
        fix: BladeFix,
        valid: tuple[float, float, float],
        angle_deg: float,
    ) -> HeightMap:
        blade, settings = self._blade, self._settings
        along_n = self._cells.s_m.size
        half = np.float32(along_n * self._cell_s_m / 2)
        front = d > np.maximum(np.float32(FACE_MARGIN_M) - setback, np.float32(0.0))
        inside = np.flatnonzero(front & (np.abs(s) < half))
        s, d, z = s[inside], d[inside], z[inside]
        ahead_n = self._ahead_n + self._context_n
        i = np.minimum(((s + half) * np.float32(1 / self._cell_s_m)).astype(np.int32), along_n - 1)
        j = np.minimum((d * np.float32(1 / self._cell_d_m)).astype(np.int32), ahead_n - 1)
        flat = i * ahead_n + j
        size = along_n * ahead_n
        count = np.bincount(flat, minlength=size)
        total = np.bincount(flat, weights=z, minlength=size)
        seen = (count > 0).reshape(along_n, ahead_n)
        height = np.divide(total, count, out=np.zeros(size), where=count > 0).reshape(seen.shape)
        slope = np.tan(np.radians((settings.steepest_deg, settings.repose_deg))) * self._cell_d_m
        seen = without_steep(height, seen, float(slope[0]))
        filled = fill_hidden(height, seen, float(slope[1]), float(slope[0]))
        distance = 0.9
        expected = settings.disparity_noise_px * distance**2 / (self._focal_px * settings.baseline_m)
        noise = max(expected, ground.residual_m)
        threshold = max(settings.min_height_m, settings.noise_factor_ratio * noise / 2.0)
        soil = np.where(filled > threshold, filled, 0.0)
        meeting_deg = min(max(angle_deg, -STEEPEST_MEETING_DEG), STEEPEST_MEETING_DEG)
        carried_l, ahead_l = split_soil(soil, self._cells, meeting_deg, blade, settings.repose_deg, self._travel_m)
        before = slice(self._beside_n, along_n - self._beside_n), slice(self._ahead_n)
        litres = soil[before].reshape(3, -1).sum(axis=1) * self._cells.area_m2 * 1000.0
        return HeightMap(
            filled[before],
            seen[before],
            threshold,
            (float(litres[0]), float(litres[1]), float(litres[2])),
            carried_l,
            ahead_l,
            valid,
            ground,
            fix,
            angle_deg,
        )


def without_steep(height: F64, seen: Bools, rise_per_cell: float) -> Bools:
    """Which seen cells are ground or soil: hoses, rods and legs rise steeper out of what is seen beside them."""
    bound = _lower_cones(np.where(seen, height, UNSEEN), rise_per_cell, rise_per_cell)
    return np.asarray(seen & (height <= bound + STEEP_TOLERANCE_M))


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
        up = np.minimum.accumulate(height - steps, axis=axis) + steps
        down = np.flip(np.minimum.accumulate(np.flip(height + steps, axis), axis=axis), axis) - steps
        height = np.minimum(up, down)
    return height
