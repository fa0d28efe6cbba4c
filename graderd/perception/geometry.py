"""From the vehicle frame to pixels and back: the blade, its thirds and the ground before it, as a stream sees them.

Everything here depends only on the calibration, the picture's size and the blade angle, so it is computed once and
kept; a frame costs a look-up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from graderd.core.blade import BladeGeometry, third_bounds_m
from graderd.hal.camera import Intrinsics, StreamPose

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]

LEFT, CENTER, RIGHT = 0, 1, 2
"""Index of a third: the operator's left to right, as everywhere in graderd (that is along falling s)."""

NOMINAL_WIDTH_PX = 848
"""Numbers in pixels of the depth picture are meant for one so wide."""
TOP_EDGE_POINTS_N = 33
"""A straight edge needs two; a lens that bends it in the picture, some more."""
LEAST_REGION_PX = 8
"""A region narrower or lower than this, at its reduced scale, shows nothing."""
FRACTION_BITS_N = 4
"""Of a pixel, in which outlines are filled: sixteenths."""
NEAR_M = 0.05
"""Nothing nearer than this to the camera is projected."""


def middle(values: npt.NDArray[np.floating]) -> float:
    """The median of at least one value, the upper one of two; a tenth of what ``np.median`` costs on a few values."""
    half = values.size // 2
    return float(np.partition(values, half)[half])


def cos_sin(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine of one angle; a quarter of what numpy's cost on a number."""
    angle = math.radians(angle_deg)
    return math.cos(angle), math.sin(angle)


@dataclass(frozen=True, slots=True)
class View:
    """One stream: lens and place."""

    lens: Intrinsics
    pose: StreamPose

    @property
    def rotation(self) -> F64:
        """Optical to vehicle, 3x3."""
        return np.asarray(self.pose.rotation, dtype=np.float64)

    @property
    def position_m(self) -> F64:
        """Optical centre in the vehicle frame."""
        return np.asarray(self.pose.position_m, dtype=np.float64)

    def project(self, points_m: F64) -> F64:
        """Vehicle points (N x 3, m) to pixels (N x 2); NaN where a point is not ahead of the camera."""
        optical = (points_m - self.position_m) @ self.rotation
        z = np.where(optical[:, 2] > NEAR_M, optical[:, 2], np.nan)
        x, y = optical[:, 0] / z, optical[:, 1] / z
        k1, k2, p1, p2, k3 = self.lens.coeffs
        if any(self.lens.coeffs):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            x, y = (
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            )
        return np.column_stack((self.lens.fx * x + self.lens.cx, self.lens.fy * y + self.lens.cy))

    def rays(self, stride_px: int = 1) -> F32:
        """Directions (rows x columns x 3, vehicle frame) of every ``stride_px``-th pixel, scaled to Z = 1 m.

        The vehicle point of a pixel with depth Z is ``position_m + Z * ray``.
        """
        u = np.arange(stride_px // 2, self.lens.width, stride_px, dtype=np.float64)
        v = np.arange(stride_px // 2, self.lens.height, stride_px, dtype=np.float64)
        grid = np.stack(np.meshgrid(u, v), axis=-1)
        if any(self.lens.coeffs):
            camera = np.array([[self.lens.fx, 0, self.lens.cx], [0, self.lens.fy, self.lens.cy], [0, 0, 1.0]])
            flat = cv2.undistortPoints(grid.reshape(-1, 1, 2), camera, np.asarray(self.lens.coeffs))
            plane = np.asarray(flat, dtype=np.float64).reshape(grid.shape)
        else:
            plane = (grid - (self.lens.cx, self.lens.cy)) / (self.lens.fx, self.lens.fy)
        optical = np.concatenate((plane, np.ones((*plane.shape[:2], 1))), axis=-1)
        return np.asarray(optical @ self.rotation.T, dtype=np.float32)


def face_setback_m(blade: BladeGeometry, z_m: F64) -> F64:
    """How far the hollow face lies behind the cutting edge's plane at height ``z_m``; 0 at both edges."""
    half = blade.height_m / 2
    radius = max(blade.curvature_radius_m, half)
    t = np.clip(z_m - blade.bottom_z_m - half, -half, half)
    return np.asarray(np.sqrt(radius**2 - t**2) - np.sqrt(radius**2 - half**2), dtype=np.float64)


def blade_points_m(blade: BladeGeometry, angle_deg: float, s_m: F64, d_m: F64, z_m: F64) -> F64:
    """Blade coordinates (s along, d ahead of the edge's plane, z up) to vehicle points, N x 3."""
    angle = np.deg2rad(angle_deg)
    cos, sin = np.cos(angle), np.sin(angle)
    d = d_m + blade.x_offset_m
    return np.column_stack((d * cos - s_m * sin, d * sin + s_m * cos, z_m))


def top_edge_m(blade: BladeGeometry, angle_deg: float) -> F64:
    """Points along the moldboard's upper edge from right to left, :data:`TOP_EDGE_POINTS_N` x 3."""
    s = np.linspace(-blade.length_m / 2, blade.length_m / 2, TOP_EDGE_POINTS_N)
    return blade_points_m(blade, angle_deg, s, np.zeros(s.size), np.full(s.size, blade.bottom_z_m + blade.height_m))


def strip_outline_m(blade: BladeGeometry, angle_deg: float, s_from_m: float, s_to_m: float) -> F64:
    """Outline of the strip between two s: down the blade's face, then forward over the ground to ``reach_m``."""
    top, bottom = blade.bottom_z_m + blade.height_m, max(blade.bottom_z_m, 0.0)
    s = np.array([s_from_m, s_from_m, s_from_m, s_to_m, s_to_m, s_to_m])
    d = np.array([0.0, 0.0, blade.reach_m, blade.reach_m, 0.0, 0.0])
    z = np.array([top, bottom, 0.0, 0.0, bottom, top])
    return blade_points_m(blade, angle_deg, s, d, z)


def third_outlines_px(view: View, blade: BladeGeometry, angle_deg: float) -> tuple[F64, F64, F64]:
    """Outlines of the three strips in the picture: left, center, right (operator's)."""
    low, high = third_bounds_m(blade.length_m)
    half = blade.length_m / 2
    borders = ((high, half), (low, high), (-half, low))
    outlines = [view.project(strip_outline_m(blade, angle_deg, a, b)) for a, b in borders]
    return outlines[0], outlines[1], outlines[2]


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """The blade's region in a picture, as masks at a reduced scale.

    ``rows`` and ``columns`` cut it out of the full picture (sizes are multiples of 2**``halvings``); ``masks``
    are the thirds at the reduced scale, 255 inside: left, center, right; ``areas_px`` their sizes;
    ``blade`` is their union.
    """

    rows: slice
    columns: slice
    halvings: int
    masks: tuple[U8, U8, U8]
    areas_px: tuple[int, int, int]
    blade: U8


def blade_region(view: View, blade: BladeGeometry, angle_deg: float, halvings: int) -> Region | None:
    """The region of the three strips, or None where the blade is not in the picture at all."""
    return region_of(third_outlines_px(view, blade, angle_deg), view.lens.width, view.lens.height, halvings)


def image_thirds(width_px: int, height_px: int, halvings: int, image_right_is_left: bool) -> Region | None:
    """The whole picture in three upright strips, where no geometry is known; None for a picture too small."""
    border = [0.0, width_px / 3, 2 * width_px / 3, float(width_px)]
    strips = [np.array([[a, 0.0], [b, 0.0], [b, height_px], [a, height_px]]) for a, b in pairwise(border)]
    if image_right_is_left:
        strips.reverse()
    return region_of((strips[0], strips[1], strips[2]), width_px, height_px, halvings)


def region_of(outlines_px: tuple[F64, F64, F64], width_px: int, height_px: int, halvings: int) -> Region | None:
    """Masks of three outlines (pixels of the full picture); None where nothing of them is in the picture."""
    every = np.concatenate(outlines_px)
    if not np.isfinite(every).all():
        return None
    step = 1 << halvings
    left, top = np.floor(np.clip(every.min(axis=0), 0, (width_px, height_px))).astype(int)
    right, bottom = np.ceil(np.clip(every.max(axis=0), 0, (width_px, height_px))).astype(int)
    columns = (int(right) - int(left)) // step
    rows = (int(bottom) - int(top)) // step
    if columns < LEAST_REGION_PX or rows < LEAST_REGION_PX:
        return None
    taken = np.zeros((rows, columns), dtype=np.uint8)
    masks: list[U8] = []
    for outline in outlines_px:
        mask = np.zeros((rows, columns), dtype=np.uint8)
        shifted = (outline - (left, top)) / step
        cv2.fillPoly(mask, [np.round(shifted * (1 << FRACTION_BITS_N)).astype(np.int32)], 255, shift=FRACTION_BITS_N)
        mask[taken > 0] = 0  # borders belong to one third only
        taken |= mask
        masks.append(mask)
    areas = [int(cv2.countNonZero(mask)) for mask in masks]
    if min(areas) == 0:
        return None
    return Region(
        slice(int(top), int(top) + rows * step),
        slice(int(left), int(left) + columns * step),
        halvings,
        (masks[0], masks[1], masks[2]),
        (areas[0], areas[1], areas[2]),
        taken,
    )
