"""Solid things in the picture: the hollow moldboard, and boxes and ellipsoids for machine parts, stones and boots.

Each is met analytically by the rays inside its bounding rectangle; depths are optical (Z), metres, infinite where the
ray misses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from graderd.hal.camera import Intrinsics, StreamPose
from graderd.simulator.camera.surface import Image32, Rays
from graderd.simulator.grader.blade import CURVATURE_RADIUS_M, EDGE_GAP_M, FACE_HEIGHT_M, LENGTH_M, BladePose

Matrix = npt.NDArray[np.float64]
Rectangle = tuple[slice, slice]

ARC_RAD = 2.0 * math.asin(FACE_HEIGHT_M / 2.0 / CURVATURE_RADIUS_M)
"""Opening angle of the moldboard's circular profile."""


def rotation(azimuth_deg: float, elevation_deg: float = 0.0, roll_deg: float = 0.0) -> Matrix:
    """Rotation by roll about x, then elevation about y, then azimuth about z."""
    a, e, r = (math.radians(angle) for angle in (azimuth_deg, elevation_deg, roll_deg))
    about_z = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[math.cos(e), 0, math.sin(e)], [0, 1, 0], [-math.sin(e), 0, math.cos(e)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    return np.asarray(about_z @ about_y @ about_x)


def rectangle(corners_m: Matrix, intrinsics: Intrinsics, pose: StreamPose, margin_px: int = 3) -> Rectangle | None:
    """The part of the picture that contains the given vehicle-frame points ``(n, 3)``; None where it sees none."""
    local = (corners_m - np.array(pose.position_m)) @ np.array(pose.rotation)
    if (local[:, 2] < 0.02).all():
        return None
    if (local[:, 2] < 0.02).any():
        return slice(0, intrinsics.height), slice(0, intrinsics.width)
    u = local[:, 0] / local[:, 2] * intrinsics.fx + intrinsics.cx
    v = local[:, 1] / local[:, 2] * intrinsics.fy + intrinsics.cy
    u0, u1 = max(math.floor(u.min()) - margin_px, 0), min(math.ceil(u.max()) + margin_px, intrinsics.width)
    v0, v1 = max(math.floor(v.min()) - margin_px, 0), min(math.ceil(v.max()) + margin_px, intrinsics.height)
    return (slice(v0, v1), slice(u0, u1)) if u0 < u1 and v0 < v1 else None


@dataclass(frozen=True, slots=True)
class BladeHit:
    """Where the rays inside ``area`` meet the moldboard: depth, and the place on its face.

    ``s_m``: along the blade, left positive. ``up_m``: height above the cutting edge, along the chord.
    """

    area: Rectangle
    depth_m: Image32
    s_m: Image32
    up_m: Image32


def meet_blade(rays: Rays, intrinsics: Intrinsics, pose: StreamPose, blade: BladePose) -> BladeHit | None:
    """Intersect the stream's rays with the hollow face of the blade; None where it is out of the picture."""
    turn = rotation(blade.angle_deg) @ rotation(0.0, blade.pitch_deg, blade.slope_deg)
    foot = np.array([0.0, 0.0, blade.height_m + EDGE_GAP_M])
    ends = np.array([[d, s, z] for d in (-0.04, 0.005) for s in (-0.5, 0.5) for z in (0.0, 1.0)])
    ends *= np.array([1.0, LENGTH_M, FACE_HEIGHT_M])
    area = rectangle(ends @ turn.T + foot, intrinsics, pose)
    if area is None:
        return None
    origin = turn.T @ (np.array(rays.position_m) - foot)
    local = turn.T.astype(np.float32)
    x, y, z = rays.dx[area], rays.dy[area], rays.dz[area]
    d, s, up = (local[row, 0] * x + local[row, 1] * y + local[row, 2] * z for row in range(3))
    # The profile is an arc through edge and top whose centre lies ahead of the face: the far crossing is the face.
    centre_d = math.sqrt(CURVATURE_RADIUS_M**2 - (FACE_HEIGHT_M / 2.0) ** 2)
    od, ou = np.float32(origin[0] - centre_d), np.float32(origin[2] - FACE_HEIGHT_M / 2.0)
    a = d * d + up * up
    b = od * d + ou * up
    root = b * b - a * (od * od + ou * ou - np.float32(CURVATURE_RADIUS_M**2))
    depth = (np.sqrt(np.maximum(root, 0.0)) - b) / a
    s_hit = np.float32(origin[1]) + depth * s
    up_hit = np.float32(origin[2]) + depth * up
    inside = (root > 0.0) & (depth > 0.0) & (np.abs(s_hit) <= LENGTH_M / 2.0) & (up_hit >= 0.0)
    inside &= (up_hit <= FACE_HEIGHT_M) & (np.float32(origin[0]) + depth * d <= 0.001)
    depth = np.where(inside, depth, np.float32(np.inf))
    return BladeHit(area, depth.astype(np.float32), s_hit.astype(np.float32), up_hit.astype(np.float32))


@dataclass(frozen=True, slots=True)
class Solid:
    """A box or an ellipsoid in the vehicle frame.

    ``half_m``: half its size along its own axes; ``turn``: vehicle-from-own rotation; ``bgr``: its colour.
    """

    kind: Literal["box", "ellipsoid"]
    centre_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    bgr: tuple[int, int, int]
    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def turn(self) -> Matrix:
        """Vehicle-from-own rotation."""
        return rotation(self.azimuth_deg, self.elevation_deg, self.roll_deg)

    def area(self, intrinsics: Intrinsics, pose: StreamPose) -> Rectangle | None:
        """Its bounding rectangle in the picture."""
        cube = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], np.float64)
        return rectangle(
            cube * np.array(self.half_m) @ self.turn.T + np.array(self.centre_m), intrinsics, pose, margin_px=1
        )

    def meet(self, rays: Rays, area: Rectangle) -> tuple[Image32, tuple[Image32, Image32, Image32]]:
        """Depth of the first crossing inside ``area``, and the outward normal there in the vehicle frame."""
        scale = (self.turn / np.array(self.half_m)[None, :]).T
        """Own unit coordinates from the vehicle frame: the solid becomes the unit cube or the unit ball."""
        origin = scale @ (np.array(rays.position_m) - np.array(self.centre_m))
        x, y, z = rays.dx[area], rays.dy[area], rays.dz[area]
        own = [
            np.asarray(np.float32(m[0]) * x + np.float32(m[1]) * y + np.float32(m[2]) * z, np.float32) for m in scale
        ]
        if self.kind == "ellipsoid":
            depth, normal = self._ball(origin, own)
        else:
            depth, normal = self._cube(origin, own)
        back = scale.T.astype(np.float32)
        turned = [back[row, 0] * normal[0] + back[row, 1] * normal[1] + back[row, 2] * normal[2] for row in range(3)]
        length = np.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2) + np.float32(1e-9)
        n_x, n_y, n_z = (np.asarray(part / length, np.float32) for part in turned)
        return depth, (n_x, n_y, n_z)

    @staticmethod
    def _ball(origin: Matrix, own: list[Image32]) -> tuple[Image32, list[Image32]]:
        a = own[0] ** 2 + own[1] ** 2 + own[2] ** 2
        b = own[0] * np.float32(origin[0]) + own[1] * np.float32(origin[1]) + own[2] * np.float32(origin[2])
        root = b * b - a * np.float32(origin @ origin - 1.0)
        depth = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        depth = np.where((root > 0.0) & (depth > 0.0), depth, np.float32(np.inf)).astype(np.float32)
        reach = np.where(np.isfinite(depth), depth, 0.0)
        return depth, [np.asarray(np.float32(origin[i]) + reach * own[i], np.float32) for i in range(3)]

    @staticmethod
    def _cube(origin: Matrix, own: list[Image32]) -> tuple[Image32, list[Image32]]:
        enter = np.full(own[0].shape, -np.inf, np.float32)
        leave = np.full(own[0].shape, np.inf, np.float32)
        face = np.zeros(own[0].shape, np.int8)
        for axis in range(3):
            slow = np.where(np.abs(own[axis]) < 1e-9, np.float32(1e-9), own[axis])
            first, second = (-1.0 - np.float32(origin[axis])) / slow, (1.0 - np.float32(origin[axis])) / slow
            near, far = np.minimum(first, second), np.maximum(first, second)
            face[near > enter] = axis
            enter, leave = np.maximum(enter, near), np.minimum(leave, far)
        depth = np.where((enter < leave) & (enter > 0.0), enter, np.float32(np.inf)).astype(np.float32)
        return depth, [np.asarray(np.where(face == axis, -np.sign(own[axis]), 0.0), np.float32) for axis in range(3)]


_DARK, _YELLOW, _GREY, _RUBBER = (40, 40, 44), (30, 165, 215), (105, 108, 112), (34, 32, 32)
MACHINE: tuple[Solid, ...] = (
    Solid("ellipsoid", (-0.06, 0.0, 0.43), (0.24, 0.24, 0.05), _DARK),  # the circle that carries the blade
    Solid("box", (0.26, 0.0, 0.535), (0.3, 0.03, 0.025), _YELLOW, elevation_deg=-14.0),  # drawbar
    Solid("box", (-0.05, 0.22, 0.36), (0.025, 0.02, 0.10), _DARK),  # the circle's arms down to the blade
    Solid("box", (-0.05, -0.22, 0.36), (0.025, 0.02, 0.10), _DARK),
    Solid("box", (-1.15, 0.0, 0.50), (0.35, 0.30, 0.22), _YELLOW),  # rear body
    Solid("box", (-0.55, 0.0, 0.62), (0.6, 0.07, 0.05), _YELLOW),  # frame
    Solid("ellipsoid", (-0.75, 0.36, 0.17), (0.19, 0.07, 0.19), _RUBBER),  # tandem wheels
    Solid("ellipsoid", (-0.75, -0.36, 0.17), (0.19, 0.07, 0.19), _RUBBER),
    Solid("ellipsoid", (-1.2, 0.36, 0.17), (0.19, 0.07, 0.19), _RUBBER),
    Solid("ellipsoid", (-1.2, -0.36, 0.17), (0.19, 0.07, 0.19), _RUBBER),
    Solid("box", (-0.04, 0.40, 0.46), (0.022, 0.022, 0.2), _GREY),  # lift rods
    Solid("box", (-0.04, -0.40, 0.46), (0.022, 0.022, 0.2), _GREY),
)
"""What of the machine stands in the picture besides the blade; none of it lies in front of the blade's face."""
