"""What one frame of the empty blade tells about the camera's place: depth points on known surfaces, edges in colour."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from graderd.core.blade import BladeGeometry, blade_coordinates
from graderd.hal.camera import DepthImage, Intrinsics, StreamPose
from graderd.perception.geometry import F64, U8, View, blade_points_m, face_setback_m
from graderd.perception.registration import Stance

MAX_FACE_POINTS_N, MAX_GROUND_POINTS_N = 700, 700
"""Enough for a fit to 1 mm under the noise of one frame; more only cost time."""
EDGE_POINTS_N, ENDS_BANDS_N, TOP_BANDS_N = 48, 10, 16
"""Points on each edge of the outline in colour, and bands in which depth shows where the face ends: as for points."""
TINY = 1e-9
"""Against a division by nothing."""
LEAST_BAND_POINTS_N = 40
"""A band with fewer points says nothing of where the face ends in it."""
NEARBY_M = 0.2
"""What lies this near the face is it or something before it: the measure of how much of it agrees."""
FOOT_M = 0.03
"""Lowest part of the face left out: what lies at its foot, and the rounding of depth over the step to the ground."""
END_M, TOP_M = 0.02, 0.015
"""Margins at the ends and the upper edge, left out of the face: pixels there are half blade, half background."""
CORNER_M = 0.03
"""The upper edge is looked for this far from the corners, which are rounded in depth."""
CLEAR_ASIDE_M, CLEAR_AHEAD_M, CLEAR_BEHIND_M = 0.08, 0.12, 0.25
"""Ground is looked for this far from the ends, the edge and the moldboard's back, where none of their points fall."""
GROUND_NEAR_M = 1.3
"""And not farther from the blade's middle than this: the noise of depth grows with the square of the distance."""
USUAL_PIXEL_M = 0.002
"""What a pixel covers at the blade where no point of the face tells (848 pixels across, 1.2 m away)."""
TOPMOST_ROW = 0.5
"""Of the topmost row's points this share may lie above what is taken for the edge: noise has lifted those."""
MIN_EDGE_GRAY = 6.0
"""An edge weaker than this (grey levels over two pixels) is no edge."""
EDGE_SMOOTHED_PX = 1.2
"""Sigma of the smoothing before edges are looked for: the sensor's noise falls below ``MIN_EDGE_GRAY``."""
EDGE_SHARES = (0.04, 0.96)
"""The upper edge without its corners, where two edges meet."""
END_SHARES = (0.35, 0.95)
"""The ends without corner and foot: soil and shade hide the foot."""
TANGENT_SHARE = 0.01
"""Step along an edge by which its direction in the picture is found."""
EDGE_REACH_PX = (4, 60)
"""An edge is looked for at least and at most so far on both sides of where it should be."""
FORESHORTENED = 0.7
"""A band at the blade, seen from above at about 45 degrees, spans this much less of the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthEvidence:
    """Points in the optical frame (N x 3, m) that lie on the face, the ground, the two ends and the upper edge.

    ``agreement``: of the points anywhere near the face, the share that lie on it; low where the angle is wrong.
    """

    agreement: float
    face: F64
    ground: F64
    left_end: F64
    right_end: F64
    top: F64

    def residuals_m(self, view: View, blade: BladeGeometry, stance: Stance) -> list[F64]:
        """How far each group lies from where it belongs (m)."""
        face = _off_face(*_in_blade(self.face, view, stance.angle_deg), blade, stance)
        ground = _in_blade(self.ground, view, stance.angle_deg)[2]
        left = _in_blade(self.left_end, view, stance.angle_deg)[0] - blade.length_m / 2
        right = _in_blade(self.right_end, view, stance.angle_deg)[0] + blade.length_m / 2
        s, _, z = _in_blade(self.top, view, stance.angle_deg)
        return [face, ground, left, right, z - _edge_m(s, blade, stance) - stance.tall_m(blade)]


def _edge_m(s: F64, blade: BladeGeometry, stance: Stance) -> F64:
    """Height of the cutting edge along the blade."""
    return np.asarray(stance.edge_m(blade) + stance.rise * s, dtype=np.float64)


def _off_face(s: F64, d: F64, z: F64, blade: BladeGeometry, stance: Stance) -> F64:
    """How far points lie ahead of the hollow face, standing or leaning."""
    above_edge = z - _edge_m(s, blade, stance)
    return d - blade.x_offset_m + face_setback_m(blade, above_edge + blade.bottom_z_m) - stance.lean * above_edge


def _in_blade(points: F64, view: View, angle_deg: float) -> tuple[F64, F64, F64]:
    at = points @ view.rotation.T + view.position_m
    s, d = blade_coordinates(at[:, 0], at[:, 1], angle_deg)
    return s, d, at[:, 2]


@functools.lru_cache(maxsize=4)
def _optical_rays(lens: Intrinsics) -> F64:
    """Ray of every pixel in the optical frame, scaled to Z = 1."""
    still = StreamPose((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    return View(lens, still).rays().astype(np.float64)


def collect_depth(
    depth_mm: DepthImage, view: View, blade: BladeGeometry, stance: Stance, band_m: float
) -> DepthEvidence:
    """Find the evidence in one depth picture, within ``band_m`` of where ``view`` and ``blade`` put it."""
    lens = view.lens
    rows, columns = np.nonzero(depth_mm)
    z_optical = depth_mm[rows, columns].astype(np.float64) / 1000.0
    points = _optical_rays(lens)[rows, columns] * z_optical[:, None]
    angle_deg = stance.angle_deg
    s, d, raw_z = _in_blade(points, view, angle_deg)
    half, top = blade.length_m / 2, stance.tall_m(blade)
    face = _off_face(s, d, raw_z, blade, stance)
    z = raw_z - _edge_m(s, blade, stance)  # above the cutting edge
    on_face = np.abs(face) < band_m
    before = (np.abs(s) < half - END_M) & (z > FOOT_M) & (z < top - TOP_M)
    body = on_face & before
    nearby = int(np.count_nonzero(before & (np.abs(face) < NEARBY_M)))
    agreement = np.count_nonzero(body) / nearby if nearby else 0.0
    clear = (np.abs(s) > half + CLEAR_ASIDE_M) | (d > CLEAR_AHEAD_M) | (d < -CLEAR_BEHIND_M)
    ground = (np.abs(raw_z) < band_m) & clear & (np.hypot(s, d) < GROUND_NEAR_M)
    wide = on_face & (np.abs(s) < half + band_m)
    # One pixel covers this much of the blade: an extreme point lies half of it inside the true end.
    pixel_m = float(np.median(z_optical[body])) / lens.fx if body.any() else USUAL_PIXEL_M
    left, right = _ends(points, s, z, wide, blade, 0.5 * pixel_m, view, angle_deg)
    return DepthEvidence(
        float(agreement),
        _thinned(points[body], MAX_FACE_POINTS_N),
        _thinned(points[ground], MAX_GROUND_POINTS_N),
        left,
        right,
        _top(points, s, z, wide & (np.abs(s) < half - END_M) & (z < top + band_m), blade, 0.5 * pixel_m, view),
    )


def _thinned(points: F64, most: int) -> F64:
    """Every n-th point, so that at most about ``most`` remain."""
    return points[:: max(1, -(-len(points) // most))]


def _ends(
    points: F64, s: F64, z: F64, wide: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], blade: BladeGeometry,
    grow_m: float, view: View, angle_deg: float,
) -> tuple[F64, F64]:  # fmt: skip
    """The outermost face points on both sides, per band of height; each moved outwards by half a pixel."""
    lows = np.linspace(FOOT_M, blade.height_m - END_M, ENDS_BANDS_N + 1)
    along = blade_points_m(blade, angle_deg, np.array([1.0]), np.array([0.0]), np.array([0.0]))[0]
    along -= blade_points_m(blade, angle_deg, np.array([0.0]), np.array([0.0]), np.array([0.0]))[0]
    outwards = along @ view.rotation * grow_m
    left, right = [], []
    for low, high in pairwise(lows):
        inside = np.flatnonzero(wide & (z >= low) & (z < high))
        if inside.size < LEAST_BAND_POINTS_N:
            continue
        order = inside[np.argsort(s[inside])]
        right.append(points[order[2]] - outwards)  # the third: a flying pixel or two do no harm
        left.append(points[order[-3]] + outwards)
    return np.reshape(left, (-1, 3)), np.reshape(right, (-1, 3))


def _top(
    points: F64, s: F64, z: F64, near: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], blade: BladeGeometry,
    grow_m: float, view: View,
) -> F64:  # fmt: skip
    """The highest face points, per band along the blade."""
    half = blade.length_m / 2 - CORNER_M
    lows = np.linspace(-half, half, TOP_BANDS_N + 1)
    up = np.array([0.0, 0.0, grow_m]) @ view.rotation
    found = []
    for low, high in pairwise(lows):
        inside = np.flatnonzero(near & (s >= low) & (s < high))
        if inside.size < LEAST_BAND_POINTS_N:
            continue
        row_n = (high - low) / (2 * grow_m)
        rank = max(3, round(TOPMOST_ROW * row_n))
        order = inside[np.argsort(z[inside])]
        found.append(points[order[-min(rank, inside.size)]] + up)
    return np.reshape(found, (-1, 3))


@dataclass(frozen=True, slots=True, eq=False)
class ColorEvidence:
    """Where edges were found near the blade's outline: for outline parameters, the pixel and the outline's normal."""

    side: np.ndarray[tuple[int, ...], np.dtype[np.int8]]
    share: F64
    at_px: F64
    normal: F64

    def residuals_px(self, view: View, blade: BladeGeometry, stance: Stance) -> F64:
        """Distance along the normal between the found edges and the outline as ``view`` and ``blade`` put it (px)."""
        if len(self.at_px) == 0:
            return np.zeros(0)
        there = view.project(_outline_m(blade, stance, self.side, self.share))
        return np.asarray(((there - self.at_px) * self.normal).sum(axis=1), dtype=np.float64)


TOP, LEFT_END, RIGHT_END = 0, 1, 2
"""Sides of the outline."""


def _outline_m(
    blade: BladeGeometry, stance: Stance, side: np.ndarray[tuple[int, ...], np.dtype[np.int8]], share: F64
) -> F64:
    """Points of the face's outline: upper edge (share from right to left), the ends (share from bottom to top)."""
    half, tall = blade.length_m / 2, stance.tall_m(blade)
    s = np.where(side == TOP, (2 * share - 1) * half, np.where(side == LEFT_END, half, -half))
    above_edge = np.where(side == TOP, tall, share * tall)
    d = stance.lean * above_edge - face_setback_m(blade, above_edge + blade.bottom_z_m)
    return blade_points_m(blade, stance.angle_deg, s, d, _edge_m(s, blade, stance) + above_edge)


def collect_color(color_bgr: U8, view: View, blade: BladeGeometry, stance: Stance, band_m: float) -> ColorEvidence:
    """Find the outline's edges in one colour picture, within ``band_m`` (at the blade) of where it should be."""
    gray = cv2.GaussianBlur(cv2.cvtColor(color_bgr, cv2.COLOR_BGR2GRAY), (0, 0), EDGE_SMOOTHED_PX).astype(np.float32)
    share = np.linspace(*EDGE_SHARES, EDGE_POINTS_N)
    side = np.repeat(np.array([TOP, LEFT_END, RIGHT_END], dtype=np.int8), EDGE_POINTS_N)
    shares = np.tile(share, 3)
    shares[EDGE_POINTS_N:] = np.tile(np.linspace(*END_SHARES, EDGE_POINTS_N), 2)
    at = view.project(_outline_m(blade, stance, side, shares))
    nearby = view.project(_outline_m(blade, stance, side, shares + TANGENT_SHARE))
    tangent = nearby - at
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), TINY)
    normal = np.column_stack((-tangent[:, 1], tangent[:, 0]))
    distance = float(np.linalg.norm(view.position_m[:2])) or 1.0
    reach = int(np.clip(band_m * view.lens.fx / distance * FORESHORTENED, *EDGE_REACH_PX))
    offsets = np.arange(-reach - 1, reach + 2, dtype=np.float64)
    spots = at[:, None, :] + normal[:, None, :] * offsets[None, :, None]
    sampled = cv2.remap(gray, spots[..., 0].astype(np.float32), spots[..., 1].astype(np.float32), cv2.INTER_LINEAR)
    slope = np.abs(sampled[:, 2:] - sampled[:, :-2])
    inside = np.isfinite(at).all(axis=1) & (at.min(axis=1) > reach + 2)
    inside &= (at[:, 0] < gray.shape[1] - reach - 2) & (at[:, 1] < gray.shape[0] - reach - 2)
    best = slope.argmax(axis=1)
    strength = slope[np.arange(len(slope)), best]
    keep = inside & (strength > MIN_EDGE_GRAY) & (best > 0) & (best < slope.shape[1] - 1)
    index = np.flatnonzero(keep)
    peak = best[index]
    a, b, c = slope[index, peak - 1], slope[index, peak], slope[index, peak + 1]
    shift = np.clip(0.5 * (a - c) / np.minimum(a - 2 * b + c, -TINY), -0.5, 0.5)  # top of a parabola
    offset = offsets[1 + peak] + shift
    found = at[index] + normal[index] * offset[:, None]
    return ColorEvidence(side[index], shares[index], found, normal[index])
