"""The blade of the 1/4-scale machine: where the actuators put it, and how it moves soil.

Vehicle frame: x forward, y left, z up, metres, origin = blade rotation axis on the ground. Blade coordinates: ``s``
along the blade (left positive), ``d`` ahead of its face; ``s = -x sin a + y cos a``, ``d = x cos a + y sin a``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from graderd.simulator.grader.soil import BoolArray, FloatArray, SoilField, Wall, Window

LENGTH_M = 1.0
FACE_HEIGHT_M = 0.25
EDGE_GAP_M = 0.002
"""The cutting edge never comes closer to the floor than this; so much soil always stays behind."""
CURVATURE_RADIUS_M = 0.25
REACH_M = 0.35
"""Soil counts as *in front of the blade* from its face to this distance."""

GROUND_LIFT_MM = 100.0
"""Extension of both lifts that puts the cutting edge on the ground; extension raises it."""
LIFT_SPACING_M = 0.80
LEVEL_TILT_MM = 50.0
TILT_DEG_PER_MM = 0.30

STEEL_FRICTION = 0.37
"""Soil on steel, static (Table 2 of the paper)."""
_SLOW_M_PER_S = 1e-4
_MOST_STEPS_N = 8
"""In one call: at 100 calls a second enough for 8 m/s. What is faster (a blade torn round by a fault) moves soil in
coarser steps, rather than let the wires wait for it."""
_SPREAD = ((np.arange(10) + 0.5) / 10.0)[:, None]
"""Where along the heap's slope the parts of a column of carried soil come to lie: 0 at the face, 1 at the foot."""


@dataclass(frozen=True, slots=True)
class BladePose:
    """Where the blade is, relative to the vehicle.

    ``angle_deg``: counter-clockwise seen from above, 0 = square to the travel. ``height_m``: cutting edge above the
    ground at the blade's centre. ``slope_deg``: cross slope, positive = left end higher. ``pitch_deg``: positive =
    top forward.
    """

    angle_deg: float = 0.0
    height_m: float = 0.0
    slope_deg: float = 0.0
    pitch_deg: float = 0.0

    @classmethod
    def from_actuators(cls, angle_deg: float, lift_left_mm: float, lift_right_mm: float, tilt_mm: float) -> BladePose:
        """The pose at given blade angle and extensions."""
        return cls(
            angle_deg=angle_deg,
            height_m=((lift_left_mm + lift_right_mm) / 2.0 - GROUND_LIFT_MM) / 1000.0,
            slope_deg=math.degrees(math.atan2((lift_left_mm - lift_right_mm) / 1000.0, LIFT_SPACING_M)),
            pitch_deg=(tilt_mm - LEVEL_TILT_MM) * TILT_DEG_PER_MM,
        )

    def edge_m(self, s_m: FloatArray) -> FloatArray:
        """Height of the cutting edge above the floor along the blade; never below the floor."""
        edge = self.height_m + EDGE_GAP_M + s_m * math.tan(math.radians(self.slope_deg))
        return np.maximum(edge, EDGE_GAP_M)

    def between(self, other: BladePose, share: float) -> BladePose:
        """The pose ``share`` (0 to 1) of the way to ``other``."""
        return BladePose(
            self.angle_deg + share * (other.angle_deg - self.angle_deg),
            self.height_m + share * (other.height_m - self.height_m),
            self.slope_deg + share * (other.slope_deg - self.slope_deg),
            self.pitch_deg + share * (other.pitch_deg - self.pitch_deg),
        )


@dataclass(frozen=True, slots=True)
class _Footprint:
    """The blade's body on a window of the field: flat cell indices, their blade coordinates and the wall they make."""

    s_m: FloatArray
    d_m: FloatArray
    edge_m: FloatArray
    wall: Wall


class Plough:
    """Moves soil as the blade moves through the field.

    Each sub-step is shorter than half a cell, up to 8 m/s. Soil that the body of the blade now covers, above the
    cutting edge, is carried out on the side the blade moves to and laid on the slope of the heap there. It goes where
    a rough plate drives it: square to the face, dragged sideways by the plate's own sideways motion as far as friction
    holds (soil on steel, 0.37). A blade turned by more than the friction angle (20 degrees) therefore casts soil
    towards its trailing end. Then the neighbourhood slides to the angle of repose, the blade being a wall up to its
    top edge.
    """

    def __init__(self, field: SoilField, passes: int = 3) -> None:
        self._field = field
        self._passes = passes
        self._thickness_m = 1.5 * field.cell_m
        """Of the body behind the face; above sqrt(2) cells no soil slips through diagonally."""
        self._margin_m = 0.5
        self.restless = True
        """Whether soil near the blade is still sliding."""

    def move(self, x_m: float, pose: BladePose, new_x_m: float, new_pose: BladePose, duration_s: float) -> bool:
        """Take the blade from one place (bed x of its axis, pose) to another within ``duration_s``.

        Returns whether anything moved, blade or soil.
        """
        turn_rad = math.radians(new_pose.angle_deg - pose.angle_deg)
        travel_m = new_x_m - x_m
        reach_m = abs(travel_m) + abs(turn_rad) * LENGTH_M / 2.0
        shift_m = max(
            reach_m, abs(new_pose.height_m - pose.height_m), abs(math.radians(new_pose.slope_deg - pose.slope_deg))
        )
        moving = shift_m > 1e-6
        if not (moving or self.restless):
            return False
        if not self._field.heights_m[self._window(new_x_m, new_pose).slices].any():
            self.restless = False
            return True
        count = min(max(1, math.ceil(reach_m / (0.5 * self._field.cell_m))), _MOST_STEPS_N)
        speed_m_per_s, turn_rad_per_s = travel_m / duration_s, turn_rad / duration_s
        for number in range(1, count + 1):
            share = number / count
            self._step(x_m + share * travel_m, pose.between(new_pose, share), speed_m_per_s, turn_rad_per_s, moving)
        return True

    def settle(self, x_m: float, pose: BladePose) -> None:
        """Let the soil round a blade that stands still come to rest."""
        window = self._window(x_m, pose)
        footprint = self._footprint(window, x_m, pose)
        self._carry_out(window, footprint, x_m, pose, 0.0, 0.0)
        self._field.settle(window, footprint.wall)
        self._spill_over(window, footprint, x_m, pose, 0.0, 0.0)
        self.restless = False

    def _step(self, x_m: float, pose: BladePose, speed_m_per_s: float, turn_rad_per_s: float, moving: bool) -> None:
        window = self._window(x_m, pose)
        footprint = self._footprint(window, x_m, pose)
        self._carry_out(window, footprint, x_m, pose, speed_m_per_s, turn_rad_per_s)
        slid_m = self._field.relax(window, footprint.wall, self._passes)
        self._spill_over(window, footprint, x_m, pose, speed_m_per_s, turn_rad_per_s)
        self.restless = moving or slid_m > 2e-5

    def _window(self, x_m: float, pose: BladePose) -> Window:
        angle = math.radians(pose.angle_deg)
        half_x = abs(math.sin(angle)) * LENGTH_M / 2.0 + self._margin_m
        half_y = abs(math.cos(angle)) * LENGTH_M / 2.0 + self._margin_m
        return self._field.window(x_m - half_x, x_m + half_x, -half_y, half_y)

    def _footprint(self, window: Window, x_m: float, pose: BladePose) -> _Footprint:
        s_m, d_m = blade_grid(self._field, window, x_m, pose.angle_deg)
        mask: BoolArray = (d_m <= 0.0) & (d_m >= -self._thickness_m) & (np.abs(s_m) <= LENGTH_M / 2.0)
        flat = np.flatnonzero(mask)
        s_body = s_m.reshape(-1)[flat]
        edge = pose.edge_m(s_body)
        top = edge + FACE_HEIGHT_M * math.cos(math.radians(pose.pitch_deg))
        return _Footprint(s_body, d_m.reshape(-1)[flat], edge, Wall(mask, flat, top))

    def _carry_out(
        self, window: Window, body: _Footprint, x_m: float, pose: BladePose, speed_m_per_s: float, turn_rad_per_s: float
    ) -> None:
        normal, drag = self._motion(body, pose, speed_m_per_s, turn_rad_per_s)
        forward = np.where(np.abs(normal) > _SLOW_M_PER_S, normal > 0.0, body.d_m > -self._thickness_m / 2.0)
        self._throw(window, body, x_m, pose, forward, drag)

    def _spill_over(
        self, window: Window, body: _Footprint, x_m: float, pose: BladePose, speed_m_per_s: float, turn_rad_per_s: float
    ) -> None:
        normal, _ = self._motion(body, pose, speed_m_per_s, turn_rad_per_s)
        self._throw(window, body, x_m, pose, normal < -_SLOW_M_PER_S, np.zeros_like(normal))

    @staticmethod
    def _motion(
        body: _Footprint, pose: BladePose, speed_m_per_s: float, turn_rad_per_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Speed of the face square to itself, and the sideways drag per normal distance, for each body cell."""
        angle = math.radians(pose.angle_deg)
        normal = speed_m_per_s * math.cos(angle) - turn_rad_per_s * body.s_m
        sideways = -speed_m_per_s * math.sin(angle)
        drag = np.clip(sideways / np.maximum(np.abs(normal), _SLOW_M_PER_S), -STEEL_FRICTION, STEEL_FRICTION)
        return normal, drag

    def _throw(
        self, window: Window, body: _Footprint, x_m: float, pose: BladePose, forward: BoolArray, drag: FloatArray
    ) -> None:
        view = self._field.heights_m[window.slices]
        excess = view[body.wall.mask] - body.edge_m
        loaded = excess > 0.0
        if not loaded.any():
            return
        view[body.wall.mask] -= np.where(loaded, excess, 0.0)
        clear_m = 1.45 * self._field.cell_m
        """Beyond sqrt(2) cells none of the four cells that receive a column belongs to the body."""
        carried = excess[loaded]
        # A heap that moves on as a whole rises by the same amount all along its slope: so is the soil spread.
        spread_m = carried / self._field.repose_slope * _SPREAD
        beyond = np.where(forward[loaded], 0.0, -1.0) * self._thickness_m
        outwards = np.where(forward[loaded], 1.0, -1.0)
        d_to = beyond + outwards * (clear_m + spread_m)
        s_to = body.s_m[loaded] + drag[loaded] * np.abs(d_to - body.d_m[loaded])
        angle = math.radians(pose.angle_deg)
        cos, sin = math.cos(angle), math.sin(angle)
        columns = np.broadcast_to(carried / _SPREAD.size, d_to.shape)
        self._field.deposit(
            window, (x_m + d_to * cos - s_to * sin).ravel(), (d_to * sin + s_to * cos).ravel(), columns.ravel()
        )


def blade_grid(field: SoilField, window: Window, x_m: float, angle_deg: float) -> tuple[FloatArray, FloatArray]:
    """Blade coordinates ``(s, d)`` in metres of every cell of ``window``, the blade's axis standing at bed ``x_m``."""
    angle = math.radians(angle_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    along = (field.x_m[window.x0 : window.x1] - x_m)[:, None]
    across = field.y_m[window.y0 : window.y1][None, :]
    return across * cos - along * sin, across * sin + along * cos


def hollow_m2(height_m: FloatArray) -> FloatArray:
    """Area between the hollow face and the plane of its two edges, from the cutting edge up to these heights."""
    half = FACE_HEIGHT_M / 2.0
    t = np.clip(height_m, 0.0, FACE_HEIGHT_M) - half

    def under_arc(t: FloatArray) -> FloatArray:
        root = np.sqrt(CURVATURE_RADIUS_M**2 - t**2)
        return np.asarray((t * root + CURVATURE_RADIUS_M**2 * np.arcsin(t / CURVATURE_RADIUS_M)) / 2.0)

    chord = math.sqrt(CURVATURE_RADIUS_M**2 - half**2)
    return np.asarray(under_arc(t) - under_arc(np.asarray(-half)) - (t + half) * chord)


def volumes_in_front_m3(field: SoilField, x_m: float, angle_deg: float) -> tuple[float, float, float]:
    """Soil in front of the blade per third of its length: left, center, right (the operator's), cubic metres.

    Counted from the hollow face to ``REACH_M`` ahead of its edges; the thirds are blade coordinates and turn with the
    blade. Soil fills the hollow as high as it stands just before it.
    """
    span = LENGTH_M / 2.0 + REACH_M
    window = field.window(x_m - span, x_m + span, -span, span)
    s_m, d_m = blade_grid(field, window, x_m, angle_deg)
    soil = field.heights_m[window.slices]
    third = LENGTH_M / 6.0
    cell = field.cell_m**2
    touching = (d_m >= 0.0) & (d_m < field.cell_m)
    hollow = np.where(touching, hollow_m2(soil) / field.cell_m, 0.0)
    heights = np.where((d_m >= 0.0) & (d_m <= REACH_M), soil, 0.0) + hollow
    left = float(heights[(s_m > third) & (s_m <= LENGTH_M / 2.0)].sum()) * cell
    center = float(heights[np.abs(s_m) <= third].sum()) * cell
    right = float(heights[(s_m < -third) & (s_m >= -LENGTH_M / 2.0)].sum()) * cell
    return left, center, right
