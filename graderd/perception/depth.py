"""Soil by its height: how many litres lie in front of each third of the blade, from the depth picture alone.

Colour, light, wetness and rust do not enter. One frame: every n-th pixel becomes a point in the vehicle frame; ground
(:mod:`graderd.perception.ground`) and blade (:mod:`graderd.perception.registration`) are found again; points in front
of the face fill a height map in blade coordinates; what a crest hides from the camera is filled with a slope at the
angle of repose; what has the form of soil (:mod:`graderd.perception.forms`) adds up to litres, the moldboard's hollow
behind it included.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from graderd.core.blade import STEEPEST_MEETING_DEG, BladeGeometry, meeting_point
from graderd.core.soil import PROFILE_BINS_N, Profile, Zone
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
from graderd.perception.geometry import (
    CENTER,
    F32,
    F64,
    LEFT,
    NOMINAL_WIDTH_PX,
    RIGHT,
    U8,
    View,
    cos_sin,
    third_outlines_px,
)
from graderd.perception.ground import Ground, GroundFit
from graderd.perception.registration import BladeFinder, BladeFix, Stance, UpperEdge
from graderd.perception.settings import DecisionSettings, DepthSettings

I64 = npt.NDArray[np.intp]
Litres = tuple[float, float, float]
NOTHING: Litres = (0.0, 0.0, 0.0)

LEAST_CELLS_N = 6
"""A map of fewer cells along the blade or ahead of it, on a toy's blade, would show no form."""
KEPT_GRIDS_N = 64
"""Thirds of the picture are kept for so many blade angles, a degree apart: 3 MB."""
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
    before each third to the reach; ``carried_l``, ``ahead_l``: see :class:`SoilSplit`.
    ``doubtful_l``, ``doubtful_ahead_l``: what of ``volumes_l`` and ``ahead_l`` lies beside something that is no soil.
    ``things_l``, ``weak_l``: what else rises there, and is no soil or does not stand out of the uneven ground.
    ``angle_deg``: where the blade was found. ``standing_at_m``: s and d of something that stands upright. ``cut_m``:
    how far the edge is under what looks like ground, where no lift says why. ``form_is_sure``: noise does not drown
    what tells soil from things. ``profile_mm``: see :class:`~graderd.core.soil.SoilObservation`.
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
    edge: UpperEdge | None
    standing_at_m: tuple[float, float] | None
    cut_m: float
    form_is_sure: bool
    profile_mm: Profile


class DepthJudge:
    """Turns depth pictures of one stream into litres per third."""

    def __init__(self, view: View, blade: BladeGeometry, settings: DepthSettings, decision: DecisionSettings) -> None:
        self._settings = settings
        self._view = view
        self._grids: OrderedDict[int, tuple[U8, list[int]]] = OrderedDict()
        self._decision = decision
        self._blade = blade
        # The stride is meant for a picture 848 pixels across; a smaller one is sampled as densely on the ground.
        self._stride = max(1, round(settings.stride_px * view.lens.width / NOMINAL_WIDTH_PX))
        rays = view.rays(self._stride)
        self._rays = np.ascontiguousarray(rays.reshape(-1, 3).T) * np.float32(0.001)  # a millimetre of depth each
        self._origins = view.position_m.astype(np.float32)[:, None] + self._rays
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
        self._soil_split = SoilSplit(self._cells, blade, settings.repose_deg, self._travel_m)
        # How much steep soil, and soil at its angle of repose, rises from cell to cell.
        self._steepest_m = math.tan(math.radians(settings.form.steepest_deg)) * self._cell_d_m
        self._repose_m = math.tan(math.radians(settings.repose_deg)) * self._cell_d_m
        # How much of each row of the map lies before each of the profile's parts, the left end's first.
        borders = np.linspace(0.0, self._along_n, PROFILE_BINS_N + 1)
        rows = np.clip(borders[:, None] - np.arange(self._along_n), 0.0, 1.0)
        self._profile_rows = np.ascontiguousarray(np.diff(rows, axis=0)[::-1])
        self._before = slice(self._beside_n, self._beside_n + self._along_n), slice(self._ahead_n)

    def height_map(self, depth_mm: DepthImage, stance: Stance) -> HeightMap:
        """Measure one depth picture (uint16, mm along the optical axis, 0 = no value)."""
        blade, angle_deg = self._blade, stance.angle_deg
        points = self._points(depth_mm)
        ground = self._ground.fit(points, angle_deg)
        edge = self._finder.upper_edge(depth_mm, stance, ground)
        ground, cut_m = self._layer(ground, edge, stance)
        pixels, s, d, raw_z = self._near_blade(points, angle_deg)
        z = ground.turned(angle_deg).above(d, s, raw_z)
        d -= blade.x_offset_m
        above_edge = self._above_edge(s, z, raw_z, edge, stance)
        face = self._finder.setback(above_edge)  # 0 on the face
        face += d
        if stance.lean:
            face -= stance.lean * above_edge.clip(0, blade.height_m)
        low = z < self._settings.max_height_m
        fix = self._finder.find(s, face, above_edge, stance.tall_m(blade))
        if fix.seen == 0:
            fix = self._finder.displaced(depth_mm, stance)
        # Small rotation and shift of the blade against its calibrated place.
        turn = math.radians(fix.turn_deg)
        moved = turn * s
        moved -= fix.ahead_m
        d += moved
        face += moved
        s -= turn * d
        s -= fix.along_m
        stands = standing(s, d, z, blade.length_m / 2, STANDING_REACH_M)
        low &= d < self._travel_m
        valid = self._valid_shares(pixels, low, angle_deg)
        low &= face > FACE_MARGIN_M
        low &= d > 0
        low &= np.abs(s) < self._cells.s_m.size * self._cell_s_m / 2
        in_front = np.flatnonzero(low)
        there = s.take(in_front), d.take(in_front), z.take(in_front)
        return self._map(*there, ground, fix, valid, angle_deg, edge=edge, standing_at_m=stands, cut_m=cut_m)

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
            bottom = stance.edge_m(self._blade)
            return np.asarray(z - bottom - stance.rise * s, dtype=np.float32)
        bottom = edge.height_m - stance.tall_m(self._blade)
        return np.asarray(raw_z - bottom - edge.rise * s, dtype=np.float32)

    def verdict(self, soil: HeightMap) -> Verdict:
        """Judge a height map."""
        return self._believed(soil, soil.volumes_l, soil.doubtful_l)

    def verdict_ahead(self, soil: HeightMap, whole: Verdict) -> Verdict:
        """Judge what the blade will meet; ``whole``: the verdict on all that lies before it.

        What is met lies a little further ahead too, where a plank on the ground is no more than its near edge: where
        there is no soil before the blade yet, that alone turns nothing.
        """
        verdict = self._believed(soil, soil.ahead_l, soil.doubtful_ahead_l)
        ahead_l, carried_l = sum(soil.ahead_l), sum(soil.carried_l)
        if verdict.zone is not Zone.NONE and whole.zone is Zone.NONE:
            return verdict.unknown(f"{ahead_l:.1f} l lie ahead, and too little of it before the blade to tell soil by")
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
        raised_m = soil.ground.offset_m
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
        """Points in the vehicle frame of the sampled pixels (3 x N); far away where one has no depth."""
        stride = self._stride
        # 0 less one is 65.5 m; the rays begin a millimetre from the camera instead.
        depth = depth_mm[stride // 2 :: stride, stride // 2 :: stride] - np.uint16(1)
        points: F32 = self._rays * depth.ravel().astype(np.float32)
        points += self._origins
        return points

    def _near_blade(self, points: F32, angle_deg: float) -> tuple[I64, F32, F32, F32]:
        """Which points lie about the blade, and these: along it, ahead of its axis, and their heights.

        Some way behind and beside it too, where its face is looked for.
        """
        cos, sin = cos_sin(angle_deg)
        s, ahead = np.array(((-sin, cos), (cos, sin)), dtype=np.float32) @ points[:2]
        near = ahead > self._blade.x_offset_m - BEHIND_M
        near &= ahead < self._blade.x_offset_m + STANDING_REACH_M
        near &= np.abs(s) < self._blade.length_m / 2 + self._travel_m * BESIDE_RATIO
        pixels = np.flatnonzero(near)
        return pixels, s.take(pixels), ahead.take(pixels), points[2].take(pixels)

    def _valid_shares(self, pixels: I64, good: Bools, angle_deg: float) -> tuple[float, float, float]:
        """Of the pixels on each third, the share that is among the ``good`` of ``pixels``."""
        step = round(angle_deg)
        if step not in self._grids:
            self._grids[step] = self._third_grid(step)
            if len(self._grids) > KEPT_GRIDS_N:
                self._grids.popitem(last=False)
        thirds, totals = self._grids[step]
        on = thirds.take(pixels)
        left, center, right = (np.count_nonzero((on == third) & good) / total_n for third, total_n in enumerate(totals))
        return left, center, right

    def _third_grid(self, angle_deg: float) -> tuple[U8, list[int]]:
        """On which third each sampled pixel lies, 3 for none, and how many lie on each, or 1 where none do."""
        lens = self._view.lens
        rows, columns = (len(range(self._stride // 2, side, self._stride)) for side in (lens.height, lens.width))
        grid = np.full((rows, columns), 3, dtype=np.uint8)
        for third, outline in enumerate(third_outlines_px(self._view, self._blade, angle_deg)):
            if np.isfinite(outline).all():
                places = (outline - self._stride // 2) / self._stride
                cv2.fillPoly(grid, [np.round(places * (1 << 4)).astype(np.int32)], third, shift=4)
        return grid.ravel(), [max(int(np.count_nonzero(grid == third)), 1) for third in (LEFT, CENTER, RIGHT)]

    def _noise_m(self, ground: Ground, angle_deg: float) -> F64:
        """The noise of heights in each cell: it grows with the square of the distance, as disparity has it."""
        cos, sin = cos_sin(angle_deg)
        x, y, z = self._view.pose.position_m
        s, d = y * cos - x * sin, x * cos + y * sin - self._blade.x_offset_m
        square_m2 = np.add.outer((self._cells.s_m - s) ** 2 + z**2, (self._cells.d_m - d) ** 2)
        return np.asarray(ground.noise_m_per_m2 * square_m2, dtype=np.float64)

    def _map(
        self, s: F32, d: F32, z: F32, ground: Ground, fix: BladeFix, valid: Litres, angle_deg: float,
        *, edge: UpperEdge | None, standing_at_m: tuple[float, float] | None, cut_m: float,
    ) -> HeightMap:  # fmt: skip
        settings = self._settings
        along_n = self._cells.s_m.size
        half = along_n * self._cell_s_m / 2
        noise_m = self._noise_m(ground, angle_deg)
        ahead_n = self._ahead_n + self._context_n
        i = ((s + half) / self._cell_s_m).astype(np.intp)
        j = (d / self._cell_d_m).astype(np.intp)
        np.minimum(i, along_n - 1, out=i)
        i *= ahead_n
        i += np.minimum(j, ahead_n - 1, out=j)
        shape = (along_n, ahead_n)
        count = np.bincount(i, minlength=along_n * ahead_n).reshape(shape)
        heights = z.astype(np.float64)
        total = np.bincount(i, weights=heights, minlength=count.size).reshape(shape)
        squares = np.bincount(i, weights=heights * heights, minlength=count.size).reshape(shape)
        seen = count > 0
        height = np.asarray(total / np.maximum(count, 1), dtype=np.float64)
        form = settings.form
        spread, hanging = steep_cells(squares - total * height, count, noise_m, form)
        seen &= ~hanging
        high = above_neighbours(height, seen, self._steepest_m)
        above = seen & (high >= HANGS_M)
        seen ^= above
        steep = seen & (spread | (high > STEEP_TOLERANCE_M))
        good = seen & ~steep
        # What touches the face hides in the face's own margin: soil goes on to it as high as it is just before.
        touching = good[:, 1] & ~good[:, 0]
        np.copyto(height[:, 0], height[:, 1], where=touching)
        good[:, 0] |= touching
        filled = fill_hidden(height, good, self._repose_m, self._steepest_m)
        threshold = max(settings.min_height_m, settings.noise_factor_ratio * ground.residual_m)
        forms = sort_out(height, filled, seen, steep, above, high, ground.residual_m, threshold, form)
        volumes_l, carried_l, ahead_l = self._split(filled, forms.soil, angle_deg + fix.turn_deg)
        doubtful_l, doubtful_ahead_l = NOTHING, NOTHING
        if forms.doubtful[self._before].any():
            sure = filled
            if forms.apart.any():  # what it hides is filled from what else is seen
                sure = fill_hidden(height, good & ~forms.apart, self._repose_m, self._steepest_m)
            sure_l, _, sure_ahead_l = self._split(sure, forms.soil & ~forms.doubtful, angle_deg + fix.turn_deg)
            doubtful_l, doubtful_ahead_l = _less(volumes_l, sure_l), _less(ahead_l, sure_ahead_l)
        return HeightMap(
            filled[self._before],
            seen[self._before],
            volumes_l,
            carried_l,
            ahead_l,
            doubtful_l,
            doubtful_ahead_l,
            self._litres(np.where(seen, height, filled) * forms.things)[0] if forms.things.any() else NOTHING,
            self._litres(filled * forms.weak)[0] if forms.weak.any() else NOTHING,
            valid,
            ground,
            fix,
            angle_deg + fix.turn_deg,
            edge,
            standing_at_m,
            cut_m,
            form_is_sure=not bool((noise_m[forms.things] * SLOPE_NOISE_RATIO > form.steep_spread_m).any()),
            profile_mm=self._profile_mm(filled[self._before] * forms.soil[self._before], seen[self._before]),
        )

    def _profile_mm(self, soil_m: F64, seen: Bools) -> Profile:
        """The crest of the soil along the blade: the mean of the rows that lie before each part of it."""
        known = seen.any(axis=1)
        crests_m = soil_m.max(axis=1)
        np.maximum(crests_m, 0.0, out=crests_m)
        # A part's border may cut a row in two: each has its share of it.
        sums_m, known_n = (self._profile_rows @ np.array((crests_m * known, known)).T).T
        enough = known_n >= 0.5 * known.size / PROFILE_BINS_N
        heights_mm = np.round(1000.0 * sums_m / np.where(enough, known_n, 1.0), 1) + 0.0  # no -0
        return tuple(
            height_mm if is_known else None
            for height_mm, is_known in zip(heights_mm.tolist(), enough.tolist(), strict=True)
        )

    def _split(self, height: F64, where: Bools, angle_deg: float) -> tuple[Litres, Litres, Litres]:
        """Litres per third of the map's cells ``where``: all before the blade, carried by it, and ahead of it."""
        soil = height * where
        all_l, hollow_l = self._litres(soil)
        meeting_deg = min(max(angle_deg, -STEEPEST_MEETING_DEG), STEEPEST_MEETING_DEG)
        carried_l, ahead_l = self._soil_split(np.maximum(soil, 0.0, out=soil), meeting_deg)
        return all_l, _plus(carried_l, hollow_l), ahead_l

    def _litres(self, height: F64) -> tuple[Litres, Litres]:
        """Litres per third of a map (0 where there is nothing); and what of it lies in the hollow of the face."""
        ahead = height[self._before]
        hollow = self._finder.hollow_m2(ahead[:, 0])
        both = np.array((ahead.sum(axis=1) * self._cell_d_m + hollow, hollow))
        thirds = both.reshape(2, 3, -1).sum(axis=2) * (self._cell_s_m * 1000.0)
        (right, center, left), (behind_right, behind_center, behind_left) = np.maximum(thirds, 0.0).tolist()
        return (left, center, right), (behind_left, behind_center, behind_right)  # s grows from right to left


def _plus(one: Litres, other: Litres) -> Litres:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _less(one: Litres, other: Litres) -> Litres:
    return max(one[0] - other[0], 0.0), max(one[1] - other[1], 0.0), max(one[2] - other[2], 0.0)


CREST_M = 0.06
"""A carried heap is highest within so much of the face; between crest and face the camera sees nothing."""

PLACES_N = 5
"""The three thirds, and what lies beyond either end."""


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Where the cells of a height map lie: ``s_m`` of its rows, ``d_m`` of its columns (middles), and a cell's area."""

    s_m: F64
    d_m: F64
    area_m2: float


class SoilSplit:
    """Tells soil that the blade carries from soil that lies ahead of it.

    The map's rows may go on beyond the blade's ends: with the blade turned, what its leading end will meet lies there.
    Carried: under the slope at ``repose_deg`` from the crest at the face, by the third it lies before. Ahead: what
    stands above that slope, by the third that will meet it within ``travel_m`` of travel.
    """

    def __init__(self, cells: Cells, blade: BladeGeometry, repose_deg: float, travel_m: float) -> None:
        self._cells, self._blade, self._travel_m = cells, blade, travel_m
        self._drop_m = math.tan(math.radians(repose_deg)) * cells.d_m
        self._crest_n = int(np.count_nonzero(cells.d_m < CREST_M))
        self._leans = (np.abs(cells.s_m) <= blade.length_m / 2).astype(np.float64)[:, None]
        self._place = 2.5 - cells.s_m * (3.0 / blade.length_m)
        self._leaning = self._thirds(self._place.copy())
        self._met: tuple[float, I64, int] = (math.nan, self._leaning, 0)

    def __call__(self, height_m: F64, angle_deg: float) -> tuple[Litres, Litres]:
        """Litres carried, and litres ahead, of a map of soil heights (0 where there is none).

        Raises:
            ValueError: the blade is turned too far to meet anything.
        """
        # The slope goes through the crest. Where soil rises towards one, the face behind was seen lower, or not at all.
        crest = height_m[:, : self._crest_n]
        climb = np.maximum(crest - height_m[:, :1], 0.0)
        rise = height_m + self._drop_m
        top = crest + np.minimum(climb, self._drop_m[: self._crest_n])
        rise[:, : self._crest_n] = top.max(axis=1, keepdims=True)
        carried = np.minimum.accumulate(rise, axis=1)
        carried -= self._drop_m
        np.maximum(carried, 0.0, out=carried)
        np.minimum(carried, height_m, out=carried)
        carried *= self._leans  # beyond the ends there is nothing to lean on
        if self._met[0] != angle_deg:
            self._met = angle_deg, *self._meeting(angle_deg)
        _, meeting, met_n = self._met
        coming = height_m[:, :met_n] - carried[:, :met_n]
        return self._litres(self._leaning, carried.sum(axis=1)), self._litres(meeting, coming.ravel())

    def _meeting(self, angle_deg: float) -> tuple[I64, int]:
        """The third that will meet each cell of the map's first columns, and how many are met within the travel.

        Soil is met the further along the blade the further ahead it lies, wherever along it that is.
        """
        along_m, travel_m = meeting_point(np.zeros(()), self._cells.d_m, angle_deg)
        met_n = int(np.count_nonzero(travel_m <= self._travel_m))
        along_m *= -3.0 / self._blade.length_m
        return self._thirds(np.add.outer(self._place, along_m[:met_n])), met_n

    @staticmethod
    def _thirds(place: F64) -> I64:
        """1, 2, 3 for the left, center and right third, 0 and 4 for what lies beyond the ends, of places in thirds of
        a blade that begins at 1; these are spent."""
        np.maximum(place, 0.0, out=place)
        return np.minimum(place, 4.0, out=place).astype(np.intp).ravel()

    def _litres(self, thirds: I64, heights_m: F64) -> Litres:
        sums = np.bincount(thirds, weights=heights_m, minlength=PLACES_N) * (1000.0 * self._cells.area_m2)
        _, left, center, right, *_ = sums.tolist()
        return left, center, right
