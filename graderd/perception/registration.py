"""Where the blade really is, from this one depth picture.

The calibrated pose is never exact: mounts bend, tyres give. A third is not where the calibration says unless the
blade's face, ends and upper edge are found again; where its lifts and its tilt are measured, they say where to look
and how deep the edge should be. What is found also tells when the camera was knocked out of place.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.hal.camera import DepthImage
from graderd.perception.geometry import (
    F32,
    F64,
    NOMINAL_WIDTH_PX,
    View,
    blade_points_m,
    cos_sin,
    face_setback_m,
    middle,
)
from graderd.perception.ground import Ground

SEARCH_M = 0.09
"""The face is looked for so far ahead and behind: the camera's mount 2 cm and 2 degrees off, a tyre soft."""
COLUMNS_N = 12
"""The blade's length is judged in so many columns, 8 cm each: wide enough to hold points, narrow enough for a heap."""
SEEN_LEAST_N = COLUMNS_N // 3
"""With the face seen in fewer its direction would rest on one place of it."""
FACE_LEAST_N, FACE_POINTS_N = 40, 2000
"""Points on the face: with fewer nothing is said, and more tell nothing new."""
FACE_BAND_M, FACE_BELOW_TOP_M = 0.16, 0.01
"""The face is looked for from so far below its upper edge up to so far: lower there is soil, higher what is behind."""
PLACE_M, LEVEL_M = 0.01, 0.015
"""What is upright is looked for in places (along the travel) and levels of this size: noise is 2 to 6 mm."""
UPRIGHT_LEVELS_N = 4
"""Soil at 45 degrees shows in no more than 3 levels within two places (2 cm)."""
ON_FACE_M = 0.015
"""Points so near to the face lie on it: twice the noise of what is furthest."""
BEHIND_VOTES = 2.0
"""What is seen behind a face speaks against it by so many columns: nothing is seen through the blade."""
TURN_VOTES = 15.0
"""A face turned against the measured angle by 4 degrees needs one column more."""
APART_COLUMNS_N = 3
"""The face's direction is taken from columns so far apart at least: 25 cm, over which noise is 2 degrees."""
ENDS_LEAST_N, ENDS_RANK = 60, 0.007
"""Points on the face from which its ends are taken, and the share beyond either end that is wrong matches."""
ENDS_LENGTH_M = 0.05
"""What is seen of the face is shorter or longer than it by this: an end is hidden, and its middle says nothing."""
TOP_COLUMNS_N = 24
"""The upper edge is looked for down so many columns of the picture, 4 cm apart; a third of them must show it."""
TOP_MARGIN_M = 0.04
"""So far within the ends: beyond them the edge is not, with the blade 2 cm off its place."""
TOP_SEARCH_PX = 36
"""The upper edge is looked for so far above and below where it should be, at 848 pixels across: 7 cm."""
ABOVE_PX = np.arange(1, 7)
"""Steps above the upper edge in which nothing may stand nearer, and what lies behind must show."""
STEP_M = 0.08
"""What is nearer or further than the edge by this is not the blade's: its plate and its ribs are thinner."""
TOP_SHARE = 0.4
"""The edge's rise is taken from what is seen of it, where that is this part of its length; else from the lifts."""
TOP_APART_M = 0.1
"""Two places on it nearer than this tell noise, not slope."""
BODY_BELOW_M = (0.05, 0.13)
"""Heights below the upper edge at which the face is probed."""
BODY_SHARE = 0.45
"""So far to both sides of the middle, as a part of the length."""
UPRIGHT_M = 0.03
"""Two places above each other on a face lie as far ahead, to this; on soil at 60 degrees 5 cm apart."""
THROUGH_M = 0.2
"""So far behind the face: what is seen lies behind the blade, which is not there."""
EDGE_ANGLE_STEP_DEG, EDGE_HEIGHT_STEP_MM, EDGE_LEAN_STEP_DEG = 0.5, 10.0, 2.0
"""Stances that differ by less share their columns: the edge stays well within where it is looked for."""
KEPT_COLUMNS_N = 256
"""So many are kept: 2 MB."""
TABLE_FROM_M, TABLE_TO_M, TABLE_STEP_M = -0.2, 0.8, 0.001
"""Heights above the edge for which the face's hollow is tabled."""


Steps = tuple[int, int | None, int | None, int | None]


@dataclass(frozen=True, slots=True)
class Stance:
    """How the blade stands: its measured angle, and height, cross slope and pitch where they are measured.

    What is not measured counts as calibrated: the edge at ``bottom_z_m``, level and upright.
    """

    angle_deg: float
    attitude: MeasuredAttitude = UNMEASURED

    def edge_m(self, blade: BladeGeometry) -> float:
        """Height of the cutting edge's middle over the calibrated ground."""
        height_mm = self.attitude.height_mm
        return blade.bottom_z_m if height_mm is None else height_mm / 1000.0

    @property
    def rise(self) -> float:
        """How much the edge rises along s (to the left)."""
        return math.tan(math.radians(self.attitude.slope_deg or 0.0))

    @property
    def lean(self) -> float:
        """How much the face comes forward as it goes up."""
        return math.tan(math.radians(self.attitude.pitch_deg or 0.0))

    def tall_m(self, blade: BladeGeometry) -> float:
        """From the cutting edge up to the upper edge."""
        return blade.height_m * math.cos(math.radians(self.attitude.pitch_deg or 0.0))

    def steps(self) -> Steps:
        """Angle, height, slope and pitch in whole steps. What follows from a stance is kept under these and made from
        them (:func:`stance_of`): it must not hang on which stance of the step came first, or the same frame would be
        judged in two ways."""
        at = self.attitude
        return (
            round(self.angle_deg / EDGE_ANGLE_STEP_DEG),
            None if at.height_mm is None else round(at.height_mm / EDGE_HEIGHT_STEP_MM),
            None if at.slope_deg is None else round(at.slope_deg / EDGE_LEAN_STEP_DEG),
            None if at.pitch_deg is None else round(at.pitch_deg / EDGE_LEAN_STEP_DEG),
        )


def stance_of(steps: Steps) -> Stance:
    """The stance in the middle of such steps."""
    angle, height, slope, pitch = steps
    return Stance(
        angle * EDGE_ANGLE_STEP_DEG,
        MeasuredAttitude(
            None if height is None else height * EDGE_HEIGHT_STEP_MM,
            None if slope is None else slope * EDGE_LEAN_STEP_DEG,
            None if pitch is None else pitch * EDGE_LEAN_STEP_DEG,
        ),
    )


@dataclass(frozen=True, slots=True)
class UpperEdge:
    """The blade's upper edge as found: height at its middle and rise along s in the calibrated frame, and height above
    the ground."""

    height_m: float
    rise: float
    above_ground_m: float


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
    """Pieces of picture columns across the blade's upper edge: flat pixel indices, columns x pixels, and their rays,
    3 x columns x pixels. ``starts``: the place of each column's first pixel in the flat ones.

    ``body``: two pixels on the face below the edge in each column, likewise.
    """

    pixels: npt.NDArray[np.intp]
    rays: F32
    starts: npt.NDArray[np.intp]
    body: npt.NDArray[np.intp]
    body_rays: F32


class BladeFinder:
    """Finds the moldboard's face and ends in the points, given roughly where they are."""

    def __init__(self, view: View, blade: BladeGeometry) -> None:
        self._view = view
        self._all_rays = view.rays()
        self._position = view.position_m.astype(np.float32)
        self._columns: dict[Steps, _EdgeColumns | None] = {}
        self._blade = blade
        table = np.arange(TABLE_FROM_M, TABLE_TO_M, TABLE_STEP_M)
        self._setback = face_setback_m(blade, table + blade.bottom_z_m).astype(np.float32)
        self._hollow_m2 = np.cumsum(np.where(table > TABLE_STEP_M / 2, self._setback, 0.0)) * TABLE_STEP_M

    def setback(self, above_edge: npt.NDArray[np.floating]) -> F32:
        """Set-back of the hollow face, standing upright, at heights above its cutting edge (table look-up, 1 mm)."""
        return self._setback.take(self._index(above_edge), mode="clip")

    def hollow_m2(self, above_edge: F64) -> F64:
        """Area between the hollow face and its edges' plane, from the cutting edge up to these heights."""
        return self._hollow_m2.take(self._index(above_edge), mode="clip")

    def _index(self, above_edge: npt.NDArray[np.floating]) -> npt.NDArray[np.intp]:
        """Places in the tables; those beyond an end are to be clipped."""
        place = above_edge - TABLE_FROM_M
        place /= TABLE_STEP_M
        return place.astype(np.intp)

    def upper_edge(self, depth_mm: DepthImage, stance: Stance, ground: Ground) -> UpperEdge | None:
        """Where the upper edge is; None where it cannot be told.

        It is looked for down columns of the picture; one above which something nearer stands is hidden, not low.
        """
        columns = self._edge_columns(stance)
        if columns is None:
            return None
        blade, tall_m = self._blade, stance.tall_m(self._blade)
        z_optical = depth_mm.ravel().take(columns.pixels) * np.float32(0.001)
        at = columns.rays * z_optical
        at += self._position[:, None, None]
        above_edge = at[2] - stance.edge_m(blade)
        cos, sin = cos_sin(stance.angle_deg)
        off = self.setback(above_edge)
        off += cos * at[0]
        off += sin * at[1]
        off -= blade.x_offset_m
        if stance.lean:
            off -= stance.lean * above_edge.clip(0, tall_m)
        face = np.abs(off) < SEARCH_M
        face &= z_optical > 0
        first = face.argmax(axis=1)
        place = first + columns.starts
        edge_m = z_optical.take(place)[:, None]
        over_m = z_optical.take(np.maximum(first[:, None] - ABOVE_PX, 0) + columns.starts[:, None])
        free = (over_m > edge_m + STEP_M).sum(axis=1) >= 2  # what has no depth may be nearer as well
        free &= ((over_m > edge_m - STEP_M) | (over_m == 0)).all(axis=1)
        free &= (first > 0) & face.ravel().take(place)
        place = place[free]
        if place.size < TOP_COLUMNS_N // 3:
            return None
        x, y, z = at.reshape(3, -1).take(place, axis=1).astype(np.float64)
        s = y * cos - x * sin
        over_ground = z - ground.height_at(x, y)
        rise = _median_slope(s, z) if s.max() - s.min() > TOP_SHARE * blade.length_m else stance.rise
        tilted = rise - (ground.slope_y * cos - ground.slope_x * sin)
        return UpperEdge(middle(z - rise * s), rise, middle(over_ground - tilted * s))

    def displaced(self, depth_mm: DepthImage, stance: Stance) -> BladeFix:
        """What stands where the face should be, when :meth:`find` saw no face near: a face further off, or nothing.

        Two pixels a little apart in height, down each column: on a face they are as far ahead as each other, on a
        slope of soil they are not.
        """
        columns = self._edge_columns(stance)
        if columns is None:
            return BladeFix()
        z_optical = depth_mm.ravel()[columns.body] * np.float32(0.001)
        at = columns.body_rays * z_optical[..., None] + self._position
        cos, sin = cos_sin(stance.angle_deg)
        d = at[..., 0] * cos + at[..., 1] * sin - self._blade.x_offset_m
        above_edge = at[..., 2] - stance.edge_m(self._blade)
        face = d + self.setback(above_edge) - stance.lean * above_edge
        valid = (z_optical > 0).all(axis=1)
        if valid.sum() < TOP_COLUMNS_N // 3:
            return BladeFix()
        face = face[valid]
        upright = np.abs(face[:, 0] - face[:, 1]) < UPRIGHT_M
        through = face.max(axis=1) < -THROUGH_M
        elsewhere = through | (upright & (np.abs(face[:, 0]) > SEARCH_M))
        return BladeFix(missing=float(elsewhere.mean()))

    def _edge_columns(self, stance: Stance) -> _EdgeColumns | None:
        """The pixels in which the upper edge is looked for; None where too few are in the picture."""
        steps = stance.steps()
        if steps in self._columns:
            return self._columns[steps]
        stance = stance_of(steps)
        lens, half = self._view.lens, self._blade.length_m / 2 - TOP_MARGIN_M
        edge = self._on_face(stance, np.linspace(-half, half, TOP_COLUMNS_N), 0.0)
        scale = lens.width / NOMINAL_WIDTH_PX
        reach, stride = round(TOP_SEARCH_PX * scale), max(1, round(2 * scale))
        u, v = np.round(edge[np.isfinite(edge).all(axis=1)]).astype(np.intp).T
        inside = (u >= 0) & (u < lens.width) & (v >= reach) & (v < lens.height - reach)
        columns: _EdgeColumns | None = None
        if inside.sum() >= TOP_COLUMNS_N // 3:
            down = np.arange(-reach, reach + 1, stride)
            v = v[inside, None] + down[None, :]
            u = np.broadcast_to(u[inside, None], v.shape)
            rays = np.ascontiguousarray(self._all_rays[v, u].transpose(2, 0, 1))
            columns = _EdgeColumns(v * lens.width + u, rays, np.arange(len(v)) * down.size, *self._body(stance))
        if len(self._columns) >= KEPT_COLUMNS_N:
            self._columns.clear()
        self._columns[steps] = columns
        return columns

    def _on_face(self, stance: Stance, s: F64, below_m: float) -> F64:
        """Pixels of places on the face, so far below its upper edge."""
        blade = self._blade
        above_edge = np.full(s.size, stance.tall_m(blade) - below_m)
        d = stance.lean * above_edge - self.setback(above_edge)
        z = stance.edge_m(blade) + stance.rise * s + above_edge
        return self._view.project(blade_points_m(blade, stance.angle_deg, s, d, z))

    def _body(self, stance: Stance) -> tuple[npt.NDArray[np.intp], F32]:
        lens = self._view.lens
        s = np.linspace(-BODY_SHARE, BODY_SHARE, TOP_COLUMNS_N) * self._blade.length_m
        both = np.round(np.stack([self._on_face(stance, s, below_m) for below_m in BODY_BELOW_M], axis=1))
        seen = np.isfinite(both).all(axis=(1, 2)) & (both >= 0).all(axis=(1, 2))
        seen &= (both[..., 0] < lens.width).all(axis=1) & (both[..., 1] < lens.height).all(axis=1)
        u, v = both[seen].astype(np.intp).transpose(2, 0, 1)
        return v * lens.width + u, self._all_rays[v, u]

    def find(self, s: F32, face: F32, above_edge: F32, tall_m: float) -> BladeFix:
        """Find the face in points: ``s`` along the blade, ``face`` how far ahead of where the face should be,
        ``above_edge`` how far above the cutting edge, of a blade ``tall_m`` from edge to edge."""
        blade = self._blade
        half = blade.length_m / 2
        near = np.flatnonzero(np.abs(face) < SEARCH_M)
        near_s, height = s.take(near), above_edge.take(near)
        upper = height > tall_m - FACE_BAND_M
        upper &= height < tall_m - FACE_BELOW_TOP_M
        upper &= np.abs(near_s) < half + SEARCH_M
        places = np.flatnonzero(upper)
        if places.size < FACE_LEAST_N:
            return BladeFix()
        places = places[:: max(1, places.size // FACE_POINTS_N)]
        near, near_s, below_m = near.take(places), near_s.take(places), tall_m - height.take(places)
        near_face = face.take(near)
        inside = np.flatnonzero(np.abs(near_s) < half)
        column = ((near_s.take(inside) + half) * (COLUMNS_N / blade.length_m)).astype(np.intp)
        below_m = below_m.take(inside)
        face_at, upright = self._upright(np.minimum(column, COLUMNS_N - 1, out=column), near_face.take(inside), below_m)
        s_at = (np.flatnonzero(upright).astype(np.float64) + 0.5) * (blade.length_m / COLUMNS_N) - half
        if s_at.size < SEEN_LEAST_N:
            return BladeFix()
        ahead, slope = _line_of_most(s_at, face_at)
        on_face = np.flatnonzero(np.abs(near_face - ahead - slope * near_s) < ON_FACE_M)
        along = self._ends(near_s.take(on_face))
        return BladeFix(ahead, along, -math.degrees(math.atan(slope)), on_face.size / near.size, 0.0)

    def _upright(self, column: npt.NDArray[np.intp], face: F32, below_m: F32) -> tuple[F64, npt.NDArray[np.bool_]]:
        """Per column where the face stands, for the columns in which something upright is seen, and which those are.

        What stands upright shows at the same place at many heights. Soil that leans on the face, up to the edge where
        the blade casts it aside, shows at each height at another place; hoses and rods are narrow and lie ahead.
        """
        places_n = round(2 * SEARCH_M / PLACE_M)
        place = ((face + SEARCH_M) / PLACE_M).astype(np.intp)
        np.minimum(place, places_n - 1, out=place)
        levels_n = round(FACE_BAND_M / LEVEL_M)
        index = (below_m / LEVEL_M).astype(np.intp)
        np.minimum(index, levels_n - 1, out=index)
        index *= COLUMNS_N
        index += column
        index *= places_n
        index += place
        shown = np.zeros((levels_n, COLUMNS_N, places_n), dtype=np.float32)
        shown.reshape(-1)[index] = 1
        # A face lies across the bound of two places as well as on one.
        tall = np.maximum(shown[..., 1:], shown[..., :-1]).sum(axis=0)
        best = tall.argmax(axis=1)  # the rearmost where several are as tall
        upright = tall.max(axis=1) >= UPRIGHT_LEVELS_N
        best[~upright] = -2
        off = place - best.take(column)
        on_it = np.flatnonzero((off == 0) | (off == 1))
        column = column.take(on_it)
        count = np.bincount(column, minlength=COLUMNS_N)
        total = np.bincount(column, weights=face.take(on_it), minlength=COLUMNS_N)
        return np.asarray(total[upright] / count[upright], dtype=np.float64), upright

    def _ends(self, s: F32) -> float:
        if s.size < ENDS_LEAST_N:
            return 0.0
        rank = int(s.size * ENDS_RANK)
        ranked = np.partition(s, (rank, s.size - 1 - rank))
        low, high = ranked[rank], ranked[s.size - 1 - rank]
        length = self._blade.length_m
        if abs((high - low) - length) > ENDS_LENGTH_M:
            return 0.0  # an end is hidden; the middle of what is seen says nothing
        return float(low + high) / 2


@functools.cache
def _pairs(count: int, apart: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Indices of all pairs that are so far apart at least."""
    first, second = np.triu_indices(count, apart)
    return first, second


def _line_of_most(s: F64, face: F64) -> tuple[float, float]:
    """Place at s = 0 and slope of the line on which most of the places lie, and the rearmost of such lines.

    The flank of a heap stands as upright as the face in a column or two, ahead of it; nothing stands behind it.
    """
    first, second = _pairs(s.size, APART_COLUMNS_N)
    slope = (face[second] - face[first]) / (s[second] - s[first])
    at_0 = face[first] - slope * s[first]
    off = face - at_0[:, None] - slope[:, None] * s
    on_line = np.abs(off) < ON_FACE_M
    votes = on_line - BEHIND_VOTES * (off <= -ON_FACE_M)
    best = int((votes.sum(axis=1) - np.abs(slope) * TURN_VOTES - at_0).argmax())
    s, face = s[on_line[best]], face[on_line[best]]
    s_mean, face_mean = s.sum() / s.size, face.sum() / s.size
    s -= s_mean
    fitted = float(s @ face / (s @ s))
    return float(face_mean - fitted * s_mean), fitted


def _median_slope(s: F64, z: F64) -> float:
    """Slope of a line through points of which some lie elsewhere (Theil and Sen)."""
    first, second = _pairs(s.size, 1)
    apart = s[second] - s[first]
    wide = np.abs(apart) > TOP_APART_M
    return middle((z[second] - z[first])[wide] / apart[wide]) if wide.any() else 0.0
