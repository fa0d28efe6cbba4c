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

_STILL_M = 1e-6
_STEP_CELLS = 0.45
"""Soil is moved each time the blade has gone so far: what comes of it does not depend on the speed. Not a half: rows of
cells would come under a blade at 0 degrees in pairs."""
_RESTING_PASSES_N = 3
_RESTING_M = 2e-5
"""Soil beside a standing blade slides on, so many passes a call, until no more than this moves between two cells."""
_LIFT_WEIGHT = 4.0
"""An edge that goes up or down counts so many times its way: it bares or meets soil along its whole length."""
_MOST_STEPS_N = 8
"""In one call: at 100 calls a second enough for 8 m/s. What is faster (a blade torn round by a fault) moves soil in
coarser steps, rather than let the wires wait for it."""
_CLEAR_CELLS = 0.3
"""So far off its face the blade's body lays the soil that it displaces."""
_PARTS_N = 32
"""A column of carried soil is laid down in so many parts at most, one for each cell of the heap's slope."""


@dataclass(frozen=True, slots=True)
class BladePose:
    """Where the blade is, relative to the vehicle.

    ``angle_deg``: counter-clockwise seen from above, 0 = square to the travel. ``height_m``: cutting edge above the
    ground at the blade's centre. ``slope_deg``: cross slope, positive = left end higher. ``pitch_deg``: positive =
    top forward; it lowers the top edge, over which soil spills, and has no other effect on the soil.
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


def _way_m(x_m: float, pose: BladePose, to_x_m: float, to: BladePose) -> float:
    """How far the blade's parts go at most, the edge's height counting :data:`_LIFT_WEIGHT` times."""
    turn_m = abs(math.radians(to.angle_deg - pose.angle_deg)) * LENGTH_M / 2.0
    edge_m = abs(to.height_m - pose.height_m) + abs(math.radians(to.slope_deg - pose.slope_deg)) * LENGTH_M / 2.0
    return abs(to_x_m - x_m) + turn_m + _LIFT_WEIGHT * edge_m


class Plough:
    """Moves soil as the blade moves through the field, by its way and not by the clock: every speed does the same.

    Each step is shorter than half a cell, up to 8 m/s. Soil that the body of the blade now covers, above the cutting
    edge, is carried out on the side the blade moves to and laid along the slope of the heap there. It goes where a
    rough plate drives it: square to the face, and dragged along the face by the plate's own sideways motion as far as
    friction holds. A rigid block would stick to the plate up to the angle of friction (20 degrees) and slide beyond it.
    A heap gives way by and by: what holds differs from place to place on the face, so that of its friction ``f`` the
    share ``1 - exp(-t / f)`` is mobilised (the mean over places whose coefficients are spread exponentially about
    ``f``); ``t`` is the plate's way along its face for each way square to it: while driving, the tangent of the blade's
    angle. What slips runs to the trailing end and past it. Then the neighbourhood slides to the angle of repose, the
    blade being a wall up to its top edge.
    """

    def __init__(self, field: SoilField) -> None:
        self._field = field
        self._thickness_m = 1.5 * field.cell_m
        """Of the body behind the face; above sqrt(2) cells no soil slips through diagonally."""
        self._margin_m = 0.5
        self._step_m = _STEP_CELLS * field.cell_m
        self._at: tuple[float, BladePose] | None = None
        """Where the last call left the blade."""
        self._soil_at = (0.0, BladePose())
        """Where it was when the soil was moved last."""
        self.restless = True
        """Whether soil near the blade is still sliding."""

    def move(self, x_m: float, pose: BladePose, new_x_m: float, new_pose: BladePose) -> bool:
        """Take the blade from one place (bed x of its axis, pose) to another; how fast makes no difference.

        Returns whether anything moved, blade or soil.
        """
        if self._at != (x_m, pose):  # set down elsewhere
            self._soil_at = (x_m, pose)
        self._at = (new_x_m, new_pose)
        moving = _way_m(x_m, pose, new_x_m, new_pose) > _STILL_M
        way_m = _way_m(*self._soil_at, new_x_m, new_pose)
        if not (moving or self.restless):
            return False
        if not self._field.heights_m[self._window(new_x_m, new_pose).slices].any():
            self._soil_at, self.restless = self._at, moving
        elif moving:
            self.restless = True
            if way_m >= self._step_m:
                self._steps(new_x_m, new_pose, way_m)
        elif way_m > _STILL_M:  # come to rest: the last part of a step
            self._step(new_x_m, new_pose)
        else:
            self._rest(new_x_m, new_pose)
        return True

    def _steps(self, new_x_m: float, new_pose: BladePose, way_m: float) -> None:
        """As many whole steps as the way to there holds; what is left is for the next call."""
        x_m, pose = self._soil_at
        whole_n = int(way_m / self._step_m)
        whole = whole_n * self._step_m / way_m
        count = min(whole_n, _MOST_STEPS_N)
        for number in range(1, count + 1):
            share = whole * number / count
            self._step(x_m + share * (new_x_m - x_m), pose.between(new_pose, share))

    def _step(self, x_m: float, pose: BladePose) -> None:
        """Move the soil for the way from where it was moved last."""
        from_x_m, from_pose = self._soil_at
        self._soil_at = (x_m, pose)
        travel_m, turn_rad = x_m - from_x_m, math.radians(pose.angle_deg - from_pose.angle_deg)
        window = self._window(x_m, pose)
        body = self._footprint(window, x_m, pose)
        self._carry_out(window, body, x_m, pose, travel_m, turn_rad)
        self._field.follow(window, body.wall, _way_m(from_x_m, from_pose, x_m, pose))
        self._spill_over(window, body, x_m, pose, travel_m, turn_rad)

    def _rest(self, x_m: float, pose: BladePose) -> None:
        """Soil beside a blade that stands slides on."""
        window = self._window(x_m, pose)
        body = self._footprint(window, x_m, pose)
        self._carry_out(window, body, x_m, pose, 0.0, 0.0)
        self.restless = self._field.relax(window, body.wall, _RESTING_PASSES_N) > _RESTING_M
        self._fall_over(window, body, x_m, pose)

    def settle(self, x_m: float, pose: BladePose) -> None:
        """Let the soil round a blade that stands still come to rest."""
        window = self._window(x_m, pose)
        footprint = self._footprint(window, x_m, pose)
        self._carry_out(window, footprint, x_m, pose, 0.0, 0.0)
        self._field.settle(window, footprint.wall)
        self._fall_over(window, footprint, x_m, pose)
        self.restless = False

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
        self, window: Window, body: _Footprint, x_m: float, pose: BladePose, travel_m: float, turn_rad: float
    ) -> None:
        normal, drag = self._motion(body, pose, travel_m, turn_rad)
        forward = np.where(np.abs(normal) > _STILL_M, normal > 0.0, body.d_m > -self._thickness_m / 2.0)
        self._throw(window, body, x_m, pose, forward, drag)

    def _spill_over(
        self, window: Window, body: _Footprint, x_m: float, pose: BladePose, travel_m: float, turn_rad: float
    ) -> None:
        normal, _ = self._motion(body, pose, travel_m, turn_rad)
        self._throw(window, body, x_m, pose, normal < -_STILL_M, np.zeros_like(normal))

    def _fall_over(self, window: Window, body: _Footprint, x_m: float, pose: BladePose) -> None:
        """What came to lie on a blade that stands falls down on the side where the soil is lower: it does not climb up
        there again."""
        angle = math.radians(pose.angle_deg)
        heights = []
        for d_m in (1.5 * self._field.cell_m, -self._thickness_m - 1.5 * self._field.cell_m):
            beside_x_m = x_m + d_m * math.cos(angle) - body.s_m * math.sin(angle)
            heights.append(self._field.height_at(beside_x_m, d_m * math.sin(angle) + body.s_m * math.cos(angle)))
        self._throw(window, body, x_m, pose, heights[0] < heights[1], np.zeros_like(body.s_m))

    def _motion(
        self, body: _Footprint, pose: BladePose, travel_m: float, turn_rad: float
    ) -> tuple[FloatArray, FloatArray]:
        """Way of the face square to itself, and the sideways drag per normal distance, for each body cell."""
        angle = math.radians(pose.angle_deg)
        normal = travel_m * math.cos(angle) - turn_rad * body.s_m
        sideways = -travel_m * math.sin(angle)
        ratio = sideways / np.maximum(np.abs(normal), _STILL_M)
        friction = self._field.soil.steel_friction
        drag = -friction * np.sign(ratio) * np.expm1(-np.abs(ratio) / friction)
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
        clear_m = _CLEAR_CELLS * self._field.cell_m
        carried = excess[loaded]
        # A heap that moves on as a whole rises by the same amount all along its slope: so is the soil spread.
        slope_m = carried / self._field.soil.repose_slope
        parts_n = min(max(math.ceil(float(slope_m.max()) / self._field.cell_m), 4), _PARTS_N)
        spread_m = slope_m * ((np.arange(parts_n) + 0.5) / parts_n)[:, None]
        beyond = np.where(forward[loaded], 0.0, -1.0) * self._thickness_m
        outwards = np.where(forward[loaded], 1.0, -1.0)
        d_to = beyond + outwards * (clear_m + spread_m)
        s_to = body.s_m[loaded] + drag[loaded] * np.abs(d_to - body.d_m[loaded])
        angle = math.radians(pose.angle_deg)
        cos, sin = math.cos(angle), math.sin(angle)
        columns = np.broadcast_to(carried / parts_n, d_to.shape)
        self._field.deposit(
            window,
            body.wall,
            (x_m + d_to * cos - s_to * sin).ravel(),
            (d_to * sin + s_to * cos).ravel(),
            columns.ravel(),
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
