"""Soil by its height: how many litres lie in front of each third of the blade, from the depth picture alone.

Colour, light, wetness and rust do not enter. One frame: every n-th pixel becomes a point in the vehicle frame; ground
(:mod:`graderd.perception.ground`) and blade (:mod:`graderd.perception.registration`) are found again; points in front
of the face fill a height map in blade coordinates; what a crest hides from the camera is filled with a slope at the
angle of repose; what has the form of soil (:mod:`graderd.perception.forms`) adds up to litres, the moldboard's hollow
behind it included.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from graderd.core.blade import STEEPEST_MEETING_DEG, BladeGeometry, meeting_point
from graderd.core.soil import Zone
from graderd.hal.camera import DepthImage
from graderd.perception.decide import Verdict, decide
from graderd.perception.forms import (
    HANGS_M,
    SLOPE_NOISE_RATIO,
    STEEP_TOLERANCE_M,
    Bools,
    above_neighbours,
    fill_hidden,
    sort_out,
    standing,
    steep_cells,
)
from graderd.perception.geometry import F32, F64, NOMINAL_WIDTH_PX, U8, View, third_outlines_px
from graderd.perception.ground import Ground, GroundFit
from graderd.perception.registration import BladeFinder, BladeFix, Stance, UpperEdge
from graderd.perception.settings import DecisionSettings, DepthSettings

I64 = npt.NDArray[np.intp]
Litres = tuple[float, float, float]
NOTHING: Litres = (0.0, 0.0, 0.0)

LEAST_CELLS_N = 6
"""A map of fewer cells along the blade or ahead of it, on a toy's blade, would show no form."""
KEPT_GRIDS_N = 64
"""Thirds of the picture are kept for so many blade angles, a degree apart: 1 MB."""
CONTEXT_M = 0.14
"""The height map goes on so far beyond the reach: what stands at its border is judged by what stands before it."""
BESIDE_RATIO = 0.87
"""And beyond both ends of the blade by this part of the travel looked ahead: the sine of 60 degrees, as far as a blade
turns; one turned further looks less far ahead at its leading end."""
BEHIND_M = 0.16
"""And so far behind the face points are kept: a face that is knocked back is found there."""
STANDING_REACH_M = 0.60
"""So far ahead of the face what stands is looked for: a person a step before the soil's zone."""
SUNK_M = 0.017
"""The edge lower than it should be by more than this: what looks like ground is a layer of soil, or is being cut."""
LAYER_SIGMAS = 3.0
"""A layer stands out by this many times the unevenness: its own edges are part of that."""
LIFTS_AGREE_M = 0.10
"""Edge and measured lifts further apart than this: one of the two is wrong."""
UNEVEN_SHARE = 0.15
"""Of the volume of a layer as thick as the ground is uneven: so much may stand above twice that without being soil."""
FACE_MARGIN_M = 0.025
"""Points closer to the blade's face than this are the face."""


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Soil in blade coordinates: ``height_m[i, j]`` at s cell i (right to left) and d cell j (blade to front).

    ``seen`` is False where the height was filled in. Triples are per third: left, center, right. ``valid``: share of
    the pixels on it that measure it, neither without depth nor hidden by something nearer. ``volumes_l``: all soil
    before each third to the reach; ``carried_l``, ``ahead_l``: see :func:`graderd.perception.split.split_soil`.
    ``doubtful_l``, ``doubtful_ahead_l``: what of ``volumes_l`` and ``ahead_l`` lies beside something that is no soil.
    ``things_l``, ``weak_l``: what else rises there, and is no soil or does not stand out of the uneven ground.
    ``angle_deg``: where the blade was found. ``standing_at_m``: s and d of something that stands upright. ``cut_m``:
    how far the edge is under what looks like ground, where no lift says why. ``form_is_sure``: noise does not drown
    what tells soil from things.
    """

    height_m: F64
    seen: Bools
    volumes_l: Litres
    carried_l: Litres
    ahead_l: Litres
    doubtful_l: Litres
    doubtful_ahead_l: Litres
    things_l: Litres
    weak_l: Litres
    valid: Litres
    ground: Ground
    blade: BladeFix
    angle_deg: float
    edge: UpperEdge | None = None
    standing_at_m: tuple[float, float] | None = None
    cut_m: float = 0.0
    form_is_sure: bool = True


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
        self._rays = np.ascontiguousarray(rays.reshape(-1, 3).T) * np.float32(0.001)  # a millimetre of depth each
        self._ground = GroundFit(
            blade, view.position_m, settings.ground_offset_limit_m, settings.ground_slope_limit_deg
        )
        self._finder = BladeFinder(view, blade)
        self._along_n = max(LEAST_CELLS_N, 3 * round(blade.length_m / settings.cell_m / 3))
        self._ahead_n = max(LEAST_CELLS_N, round(blade.reach_m / settings.cell_m))
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
        self._before = slice(self._beside_n, self._beside_n + self._along_n), slice(self._ahead_n)

    def height_map(self, depth_mm: DepthImage, stance: Stance) -> HeightMap:
        """Measure one depth picture (uint16, mm along the optical axis, 0 = no value)."""
        blade, angle_deg = self._blade, stance.angle_deg
        points = self._points(depth_mm)
        ground = self._ground.fit(points[0], points[1], points[2], angle_deg)
        edge = self._finder.upper_edge(depth_mm, stance, ground)
        ground, cut_m = self._layer(ground, edge, stance)
        s, d, z = self._in_blade(points, ground, angle_deg)
        # Some way behind and beside the blade too, where its face is looked for.
        wide = np.float32(blade.length_m / 2 + self._travel_m * BESIDE_RATIO)
        pixels = np.flatnonzero((d > np.float32(-BEHIND_M)) & (d < np.float32(STANDING_REACH_M)) & (np.abs(s) < wide))
        s, d, z, raw_z = s[pixels], d[pixels], z[pixels], points[2][pixels]
        above_edge = self._above_edge(s, z, raw_z, edge, stance)
        lean = np.float32(stance.lean) * np.clip(above_edge, 0, np.float32(blade.height_m))
        face = d + self._finder.setback(above_edge) - lean  # 0 on the face
        low = z < self._settings.max_height_m
        fix = self._finder.find(s, face, above_edge, stance.tall_m(blade))
        if fix.seen == 0:
            fix = self._finder.displaced(depth_mm, stance)
        # Small rotation and shift of the blade against its calibrated place.
        turn = np.float32(np.radians(fix.turn_deg))
        moved = turn * s - np.float32(fix.ahead_m)
        d, face = np.asarray(d + moved, dtype=np.float32), np.asarray(face + moved, dtype=np.float32)
        s = np.asarray(s - np.float32(fix.along_m) - turn * d, dtype=np.float32)
        stands = standing(s, d, z, blade.length_m / 2, STANDING_REACH_M)
        low &= d < np.float32(blade.reach_m + CONTEXT_M)
        valid = self._valid_shares(pixels[np.flatnonzero(low)], angle_deg)
        in_front = np.flatnonzero(
            low
            & (face > np.float32(FACE_MARGIN_M))
            & (d > 0)
            & (np.abs(s) < np.float32(self._cells.s_m.size * self._cell_s_m / 2))
        )
        soil = self._map(s[in_front], d[in_front], z[in_front], ground, fix, valid, angle_deg)
        return replace(soil, edge=edge, standing_at_m=stands, cut_m=cut_m)

    def _layer(self, ground: Ground, edge: UpperEdge | None, stance: Stance) -> tuple[Ground, float]:
        """The ground under a level layer of soil, and how far the edge is in the ground where nothing says why.

        A level layer all round looks like ground, and so does ground that is cut. The measured lifts say how deep the
        edge is; what it is deeper in what looks like ground is soil, if it stands out of the unevenness.
        """
        if edge is None:
            return ground, 0.0
        deep_m = stance.edge_m(self._blade) + stance.tall_m(self._blade) - edge.above_ground_m
        if deep_m < SUNK_M:
            return ground, 0.0
        rough_m = ground.noise_m_per_m2 * float(np.sum(self._view.position_m**2))
        uneven_m = LAYER_SIGMAS * ground.residual_m
        stands_out = deep_m > max(self._settings.noise_factor_ratio * rough_m, uneven_m)
        if stance.attitude.height_mm is None or not stands_out or deep_m > LIFTS_AGREE_M:
            return ground, deep_m
        return replace(ground, offset_m=ground.offset_m - deep_m), 0.0

    def _above_edge(self, s: F32, z: F32, raw_z: F32, edge: UpperEdge | None, stance: Stance) -> F32:
        """Heights above the cutting edge: below the upper edge where it was found, else as the lifts say."""
        if edge is None:
            bottom = np.float32(stance.edge_m(self._blade))
            return np.asarray(z - bottom - np.float32(stance.rise) * s, dtype=np.float32)
        bottom = np.float32(edge.height_m - stance.tall_m(self._blade))
        return np.asarray(raw_z - bottom - np.float32(edge.rise) * s, dtype=np.float32)

    def verdict(self, soil: HeightMap) -> Verdict:
        """Judge a height map."""
        return self._believed(soil, soil.volumes_l, soil.doubtful_l)

    def verdict_ahead(self, soil: HeightMap) -> Verdict:
        """Judge what the blade will meet."""
        verdict = self._believed(soil, soil.ahead_l, soil.doubtful_ahead_l)
        ahead_l, carried_l = sum(soil.ahead_l), sum(soil.carried_l)
        if verdict.zone is not Zone.NONE and ahead_l * 100 < self._settings.ahead_min_percent * carried_l:
            return verdict.unknown(f"{ahead_l:.1f} l ahead do not stand out of the {carried_l:.1f} l that are carried")
        if abs(soil.angle_deg) > STEEPEST_MEETING_DEG:
            return verdict.unknown(f"the blade is turned by {soil.angle_deg:.0f} degrees: it meets hardly anything")
        return verdict

    def _believed(self, soil: HeightMap, amounts_l: Litres, doubtful_l: Litres) -> Verdict:
        settings = self._settings
        verdict = decide(amounts_l, settings.none_volume_l, "l", self._decision, amounts_l)
        weakest = min(soil.valid)
        if weakest * 100 < settings.min_valid_percent:
            return verdict.unknown(
                f"only {weakest * 100:.0f} % of a third has depth, {settings.min_valid_percent:.0f} % is asked"
            )
        if soil.ground.slope_deg() > settings.ground_slope_limit_deg:
            return verdict.unknown(f"the ground tilts by {soil.ground.slope_deg():.1f} deg against the machine")
        if soil.cut_m:
            return verdict.unknown(
                f"the edge seems to be {soil.cut_m * 1000:.0f} mm in the ground: cut ground and a level layer of soil "
                "look the same without a measured lift that agrees"
            )
        raised_m = float(soil.ground.height_at(np.zeros(1), np.zeros(1))[0])
        if soil.edge is None and raised_m > SUNK_M:
            return verdict.unknown(
                f"what looks like ground is {raised_m * 1000:.0f} mm higher than calibrated, and the blade's upper "
                "edge, which tells a level layer of soil from ground, is not in sight: lower the blade"
            )
        things_l = sum(soil.things_l)
        most_l = settings.form.thing_largest_l if soil.form_is_sure else settings.none_volume_l
        if verdict.zone is Zone.NONE and things_l > most_l:
            return verdict.unknown(
                f"{things_l:.1f} l lie there whose form is not soil's, or hidden by noise, dust or drops"
            )
        most_doubtful_l = settings.form.doubtful_most_percent / 100 * sum(amounts_l)
        if verdict.zone is not Zone.NONE and sum(doubtful_l) > most_doubtful_l:
            return verdict.unknown(
                f"{sum(doubtful_l):.1f} of {sum(amounts_l):.1f} l lie beside what has not soil's form"
            )
        if any(doubtful_l):
            without = decide(_less(amounts_l, doubtful_l), settings.none_volume_l, "l", self._decision)
            if without.zone is not verdict.zone:
                return verdict.unknown(f"something that is no soil lies in it: without that {without.zone}")
        ground_l = UNEVEN_SHARE * soil.ground.residual_m * self._blade.length_m * self._blade.reach_m * 1000.0
        if verdict.zone is Zone.NONE and sum(soil.weak_l) > settings.none_volume_l + ground_l:
            return verdict.unknown(
                f"{sum(soil.weak_l):.1f} l do not stand out of the ground, which is uneven by "
                f"{soil.ground.residual_m * 1000:.0f} mm"
            )
        return verdict

    def _points(self, depth_mm: DepthImage) -> F32:
        """Points in the vehicle frame of the sampled pixels (3 x N); NaN where one has no depth."""
        stride = self._stride
        depth = depth_mm[stride // 2 :: stride, stride // 2 :: stride].ravel()
        points: F32 = self._rays * np.where(depth, depth, np.float32(np.nan))
        points += self._position[:, None]
        return points

    def _in_blade(self, points: F32, ground: Ground, angle_deg: float) -> tuple[F32, F32, F32]:
        """Points in blade coordinates s and d, and their heights above the ground."""
        x, y, z = points
        angle = np.radians(angle_deg)
        cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        s = y * cos - x * sin
        d = x * cos + y * sin - np.float32(self._blade.x_offset_m)
        return s, d, ground.above(x, y, z)

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
                cv2.fillPoly(grid, [np.round(places * (1 << 4)).astype(np.int32)], third, shift=4)
        return grid.ravel(), tuple(int(n) for n in np.bincount(grid.ravel(), minlength=4))

    def _noise_m(self, ground: Ground, angle_deg: float) -> F64:
        """The noise of heights in each cell: it grows with the square of the distance, as disparity has it."""
        angle = np.radians(angle_deg)
        x, y, z = self._view.position_m
        s, d = y * np.cos(angle) - x * np.sin(angle), x * np.cos(angle) + y * np.sin(angle) - self._blade.x_offset_m
        square_m2 = (self._cells.s_m[:, None] - s) ** 2 + (self._cells.d_m[None, :] - d) ** 2 + z**2
        return np.asarray(ground.noise_m_per_m2 * square_m2, dtype=np.float64)

    def _map(self, s: F32, d: F32, z: F32, ground: Ground, fix: BladeFix, valid: Litres, angle_deg: float) -> HeightMap:
        settings = self._settings
        along_n = self._cells.s_m.size
        half = np.float32(along_n * self._cell_s_m / 2)
        noise_m = self._noise_m(ground, angle_deg)
        ahead_n = self._ahead_n + self._context_n
        i = np.minimum(((s + half) * np.float32(1 / self._cell_s_m)).astype(np.int32), along_n - 1)
        j = np.minimum((d * np.float32(1 / self._cell_d_m)).astype(np.int32), ahead_n - 1)
        flat = i * ahead_n + j
        shape = (along_n, ahead_n)
        size = along_n * ahead_n
        count = np.bincount(flat, minlength=size)
        seen = count > 0
        n = np.maximum(count, 1)
        height = np.bincount(flat, weights=z, minlength=size) / n
        square: F64 = np.maximum(np.bincount(flat, weights=z * z, minlength=size) / n - height**2, 0.0) * count
        seen, height = seen.reshape(shape), height.reshape(shape)
        form = settings.form
        slope = np.tan(np.radians((form.steepest_deg, settings.repose_deg))) * self._cell_d_m
        spread, hanging = steep_cells(square.reshape(shape), count.reshape(shape), noise_m, form)
        high = above_neighbours(height, seen & ~hanging, float(slope[0]))
        above = seen & ~hanging & (high >= HANGS_M)
        seen &= ~hanging & ~above
        steep = seen & (spread | (high > STEEP_TOLERANCE_M))
        good = seen & ~steep
        # What touches the face hides in the face's own margin: soil goes on to it as high as it is just before.
        touching = good[:, 1] & ~good[:, 0]
        height[touching, 0], good[touching, 0] = height[touching, 1], True
        filled = fill_hidden(height, good, float(slope[1]), float(slope[0]))
        threshold = max(settings.min_height_m, settings.noise_factor_ratio * ground.residual_m)
        forms = sort_out(height, filled, seen, steep, above, ground.residual_m, threshold, form)
        volumes_l, carried_l, ahead_l = self._split(filled, forms.soil, angle_deg + fix.turn_deg)
        doubtful_l, doubtful_ahead_l = NOTHING, NOTHING
        if forms.doubtful[self._before].any():
            sure_l, _, sure_ahead_l = self._split(filled, forms.soil & ~forms.doubtful, angle_deg + fix.turn_deg)
            doubtful_l, doubtful_ahead_l = _less(volumes_l, sure_l), _less(ahead_l, sure_ahead_l)
        return HeightMap(
            filled[self._before],
            seen[self._before],
            volumes_l,
            carried_l,
            ahead_l,
            doubtful_l,
            doubtful_ahead_l,
            self._litres(np.where(seen, height, filled), forms.things)[0],
            self._litres(filled, forms.weak)[0],
            valid,
            ground,
            fix,
            angle_deg + fix.turn_deg,
            form_is_sure=not bool((noise_m[forms.things] * SLOPE_NOISE_RATIO > form.steep_spread_m).any()),
        )

    def _split(self, height: F64, where: Bools, angle_deg: float) -> tuple[Litres, Litres, Litres]:
        """Litres per third of the map's cells ``where``: all before the blade, carried by it, and ahead of it."""
        soil = np.where(where, np.maximum(height, 0.0), 0.0)
        meeting_deg = min(max(angle_deg, -STEEPEST_MEETING_DEG), STEEPEST_MEETING_DEG)
        repose_deg = self._settings.repose_deg
        carried_l, ahead_l = split_soil(soil, self._cells, meeting_deg, self._blade, repose_deg, self._travel_m)
        all_l, hollow_l = self._litres(height, where)
        return all_l, _plus(carried_l, hollow_l), ahead_l

    def _litres(self, height: F64, where: Bools) -> tuple[Litres, Litres]:
        """Litres per third of the map's cells ``where``; and what of it lies in the hollow of the face."""
        if not where.any():
            return NOTHING, NOTHING
        ahead = np.where(where, height, 0.0)[self._before]
        hollow = self._finder.hollow_m2(ahead[:, 0])
        both = np.stack((ahead.sum(axis=1) * self._cell_d_m + hollow, hollow))
        thirds = np.maximum(both.reshape(2, 3, -1).sum(axis=2) * self._cell_s_m * 1000.0, 0.0).tolist()
        (right, center, left), (behind_right, behind_center, behind_left) = thirds  # along growing s
        return (left, center, right), (behind_left, behind_center, behind_right)


def _plus(one: Litres, other: Litres) -> Litres:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _less(one: Litres, other: Litres) -> Litres:
    return max(one[0] - other[0], 0.0), max(one[1] - other[1], 0.0), max(one[2] - other[2], 0.0)


CREST_M = 0.06
"""A carried heap is highest within so much of the face; between crest and face the camera sees nothing."""

PLACES_N = 5
"""The three thirds, and what lies beyond either end."""

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
    """Litres carried, and litres ahead (left, center, right each) of a map of soil heights (0 where there is none).

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
    met = _third(met_s, blade)
    met[np.broadcast_to(met_m > travel_m, met.shape)] = 0
    litres = 1000.0 * cells.area_m2
    leaning = np.bincount(_third(cells.s_m, blade), weights=carried.sum(axis=1), minlength=PLACES_N) * litres
    coming = np.bincount(met.ravel(), weights=(height_m - carried).ravel(), minlength=PLACES_N) * litres
    return _inner(leaning), _inner(coming)


def _third(s_m: F64, blade: BladeGeometry) -> I64:
    """1, 2, 3 for the left, center and right third in which places lie; 0 and 4 for what lies beyond the ends."""
    return np.clip(np.floor(s_m * (-3.0 / blade.length_m) + 2.5), 0.0, 4.0).astype(np.intp)


def _inner(amounts: npt.NDArray[np.floating]) -> ThirdsL:
    """Without what lies beyond either end."""
    return float(amounts[1]), float(amounts[2]), float(amounts[3])
