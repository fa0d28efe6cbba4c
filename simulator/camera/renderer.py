"""What the camera sees of the rig: colour and depth of soil, blade, bed and machine, without a graphics library."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from graderd.hal.camera import ColorImage, DepthImage, Intrinsics, StreamPose
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import GroundMap, SceneState, ground_map, sun_direction
from graderd.simulator.camera.materials import Materials, materials_of
from graderd.simulator.camera.optics import COLOR_INTRINSICS, COLOR_POSE, DEPTH_INTRINSICS, DEPTH_POSE
from graderd.simulator.camera.paint import (
    TEXEL_M,
    Image8,
    Image32,
    ground_palette,
    soil_palette,
)
from graderd.simulator.camera.shapes import ARC_RAD, MACHINE, BladeHit, Solid, meet_blade, rotation
from graderd.simulator.camera.surface import Rays, SurfaceSweep
from graderd.simulator.grader.blade import LENGTH_M, BladePose
from graderd.simulator.grader.soil import BED_WIDTH_M, FloatArray


class _Machine:
    """What an imager sees of the machine besides the blade, in as many of the picture's upper rows as needed."""

    def __init__(self, depth_m: Image32, normals: Image32, paint: Image32) -> None:
        self.depth_m = depth_m
        self._normals = normals
        self._paint = paint
        self._appearance: Appearance | None = None
        self._lit: Image8 = np.zeros(paint.shape, np.uint8)

    def lit(self, appearance: Appearance) -> Image8:
        """Its colours under the light of ``look``."""
        if appearance != self._appearance:
            self._appearance = appearance
            self._lit = _lit(self._paint, self._normals, appearance)
        return self._lit


class _Stream:
    """One imager: its rays, its sweep, and the machine parts it sees."""

    def __init__(self, intrinsics: Intrinsics, pose: StreamPose) -> None:
        self.intrinsics = intrinsics
        self.pose = pose
        self.rays = Rays.of(intrinsics, pose)
        self.sweep = SurfaceSweep(self.rays)
        half = BED_WIDTH_M / 2.0
        y = np.float32(pose.position_m[1])
        side = np.where(self.rays.dy > 0, np.float32(half) - y, np.float32(-half) - y)
        steady = np.where(np.abs(self.rays.dy) < 1e-6, np.float32(1e-6), self.rays.dy)
        self.wall_depth_m = np.asarray(side / steady, np.float32)
        self.machine = self._see_machine()
        self._inverse_horizontal = np.asarray(1.0 / np.maximum(self.rays.horizontal, 1e-6), np.float32)

    def ground_depth_m(self, ground: GroundMap, vehicle_x_m: float) -> Image32:
        """Depth of soil, floor and the bed's sides and end."""
        ranges = self.sweep.ranges_m(ground.heights_m, ground.x_first_m, ground.y_first_m, ground.cell_m)
        depth = ranges * self._inverse_horizontal
        np.minimum(depth, self.wall_depth_m, out=depth)
        end = np.float32(-vehicle_x_m - self.pose.position_m[0]) / np.minimum(self.rays.dx, np.float32(-1e-3))
        np.minimum(depth, end, out=depth)
        return depth

    def _see_machine(self) -> _Machine:
        """Depth, face normals and paint of the machine parts that never move before the camera."""
        shape = self.rays.dx.shape
        depth = np.full(shape, np.inf, np.float32)
        normals = np.zeros((*shape, 3), np.float32)
        paint = np.zeros((*shape, 3), np.float32)
        for solid in MACHINE:
            area = solid.area(self.intrinsics, self.pose)
            if area is None:
                continue
            met, normal = solid.meet(self.rays, area)
            nearer = met < depth[area]
            depth[area][nearer] = met[nearer]
            normals[area][nearer] = np.stack(normal, axis=-1)[nearer]
            paint[area][nearer] = solid.bgr
        rows = np.flatnonzero(np.isfinite(depth).any(axis=1))
        band = slice(0, int(rows[-1]) + 1 if rows.size else 0)
        return _Machine(depth[band], normals[band], paint[band])


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A scene as it was looked at, and what it looks like without the imagers' noise."""

    state: SceneState
    appearance: Appearance
    color: ColorImage
    depth_m: Image32 | None

    def is_of(self, state: SceneState, appearance: Appearance) -> bool:
        """Whether it looks like this one."""
        mine = self.state
        return (
            appearance == self.appearance
            and (state.cell_m, state.vehicle_x_m, state.blade, state.props)
            == (mine.cell_m, mine.vehicle_x_m, mine.blade, mine.props)
            and np.array_equal(state.heights_m, mine.heights_m)
        )


class Renderer:
    """Renders colour and depth as a D455 between the front wheels would.

    Pictures depend on the state, the look, the sizes and the seed, and on how many were rendered before (noise).
    ``color_size`` and ``depth_size``: ``(width, height)``; no depth where that is None.
    """

    def __init__(
        self,
        color_size: tuple[int, int] = (640, 400),
        depth_size: tuple[int, int] | None = (848, 480),
        *,
        seed: int = 0,
        color_pose: StreamPose = COLOR_POSE,
        depth_pose: StreamPose = DEPTH_POSE,
        materials: Materials | None = None,
    ) -> None:
        self.materials = materials or materials_of(seed)
        self._rng = np.random.default_rng(seed + 1)
        self._color = _Stream(COLOR_INTRINSICS.scaled(*color_size), color_pose)
        self._depth = _Stream(DEPTH_INTRINSICS.scaled(*depth_size), depth_pose) if depth_size else None
        self._seen: _Seen | None = None

    @property
    def color_intrinsics(self) -> Intrinsics:
        """Of the colour stream at the size rendered."""
        return self._color.intrinsics

    @property
    def depth_intrinsics(self) -> Intrinsics | None:
        """Of the depth stream at the size rendered."""
        return self._depth.intrinsics if self._depth else None

    def render(self, state: SceneState, appearance: Appearance) -> tuple[ColorImage, DepthImage | None]:
        """Colour (BGR) and depth (uint16 millimetres, 0 = none) of one instant."""
        seen = self._look(state, appearance)
        color = self._with_noise(seen.color, appearance)
        return color, self._measured(seen.depth_m, appearance) if seen.depth_m is not None else None

    def render_depth_m(self, state: SceneState, appearance: Appearance) -> Image32:
        """Depth without any noise, metres; for tests and calibration."""
        if self._depth is None:
            raise ValueError("this renderer has no depth stream")
        return self._true_depth(state, ground_map(state, appearance, self.materials))

    def _look(self, state: SceneState, appearance: Appearance) -> _Seen:
        """What the scene looks like; one in which nothing changed since the last picture looks as it did."""
        if self._seen is None or not self._seen.is_of(state, appearance):
            ground = ground_map(state, appearance, self.materials)
            color = self._render_color(state, appearance, ground)
            depth_m = self._true_depth(state, ground) if self._depth else None
            # Whoever made the state may go on with its heights.
            kept = replace(state, heights_m=state.heights_m.copy())
            self._seen = _Seen(kept, appearance, color, depth_m)
        return self._seen

    # -- colour -----------------------------------------------------------------------------------------------------

    def _render_color(self, state: SceneState, appearance: Appearance, ground: GroundMap) -> ColorImage:
        stream = self._color
        rays = stream.rays
        depth = stream.ground_depth_m(ground, state.vehicle_x_m)
        x = np.float32(rays.position_m[0]) + depth * rays.dx
        y = np.float32(rays.position_m[1]) + depth * rays.dy
        cell = np.float32(1.0 / ground.cell_m)
        tone = np.asarray(
            cv2.remap(
                ground.tone,
                (y - np.float32(ground.y_first_m)) * cell,
                (x - np.float32(ground.x_first_m)) * cell,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=(255.0 * min(appearance.ambient * 0.5 + 0.2, 1.0), 0.0),
            )
        )
        light, share = cv2.split(tone)
        # The bed's sides are seen where the rays meet them: unfold their height beyond the edge of the floor.
        on_wall = depth >= stream.wall_depth_m
        rise = np.where(on_wall, np.float32(rays.position_m[2]) + depth * rays.dz, np.float32(0.0))
        texel = np.float32(1.0 / TEXEL_M)
        row = (x + np.float32(state.vehicle_x_m)) * texel
        column = (np.abs(y + np.float32(BED_WIDTH_M / 2.0)) + rise) * texel
        picture = self.materials.paint(appearance, column, row, np.asarray(share, np.uint8))
        picture = np.asarray(cv2.multiply(picture, cv2.merge((light, light, light)), scale=1.0 / 127.5))
        self._paint_machine(picture, depth, stream, appearance)
        self._paint_solids(picture, depth, stream, state.props, appearance)
        self._paint_blade(picture, depth, stream, state.blade, appearance)
        return self._develop(picture, appearance)

    @staticmethod
    def _paint_machine(picture: Image8, depth: Image32, stream: _Stream, appearance: Appearance) -> None:
        met = stream.machine.depth_m
        view = depth[: met.shape[0]]
        cv2.copyTo(stream.machine.lit(appearance), (met < view).view(np.uint8), picture[: met.shape[0]])
        np.minimum(view, met, out=view)

    @staticmethod
    def _paint_solids(
        picture: Image8, depth: Image32, stream: _Stream, solids: tuple[Solid, ...], appearance: Appearance
    ) -> None:
        for solid in solids:
            area = solid.area(stream.intrinsics, stream.pose)
            if area is None:
                continue
            met, normal = solid.meet(stream.rays, area)
            nearer = met < depth[area]
            if nearer.any():
                shown = _lit(np.array(solid.bgr, np.float32), np.stack(normal, axis=-1), appearance)
                picture[area][nearer] = shown[nearer]
                depth[area][nearer] = met[nearer]

    def _paint_blade(
        self, picture: Image8, depth: Image32, stream: _Stream, blade: BladePose, appearance: Appearance
    ) -> None:
        hit = meet_blade(stream.rays, stream.intrinsics, stream.pose, blade)
        if hit is None:
            return
        nearer = (hit.depth_m < depth[hit.area]).astype(np.uint8)
        face = self._lit_face(blade, appearance)
        painted = cv2.remap(
            face,
            (hit.s_m + np.float32(LENGTH_M / 2.0)) * np.float32(1.0 / TEXEL_M),
            hit.up_m * np.float32(1.0 / TEXEL_M),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(np.asarray(painted), nearer, picture[hit.area])
        _merge_depth(depth, hit)

    def _lit_face(self, blade: BladePose, appearance: Appearance) -> Image8:
        """The blade's paint under the present light: the hollow turns its upper half to the ground, its lower up."""
        paint = self.materials.blade(appearance.blade)
        rows = paint.shape[0]
        sine = np.linspace(-1.0, 1.0, rows) * math.sin(ARC_RAD / 2.0)
        normals = np.stack((np.sqrt(1.0 - sine**2), np.zeros(rows), -sine), axis=1)
        turn = rotation(blade.angle_deg) @ rotation(0.0, blade.pitch_deg, blade.slope_deg)
        normals = normals @ turn.T
        sun = sun_direction(appearance)
        facing = np.maximum(normals @ sun, 0.0)
        view = np.array([0.82, 0.0, 0.57])
        half = sun + view
        shine = np.maximum(normals @ (half / np.linalg.norm(half)), 0.0) ** 24
        gloss = {"steel": 110.0, "rusty": 12.0, "painted": 60.0}[appearance.blade]
        light = appearance.sun_strength * facing + appearance.ambient * (0.7 + 0.3 * normals[:, 2])
        lit = paint * light[:, None, None].astype(np.float32)
        lit += (gloss * appearance.sun_strength * shine)[:, None, None].astype(np.float32)
        return np.clip(lit, 0.0, 255.0).astype(np.uint8)

    def _develop(self, picture: Image8, appearance: Appearance) -> ColorImage:
        """What the colour imager makes of it, but for its noise: lens blur, exposure, colour cast."""
        picture = np.asarray(cv2.GaussianBlur(picture, (3, 3), 0.6))
        gain = np.array((1.0 - 0.5 * appearance.red_cast, 1.0, 1.0 + appearance.red_cast)) * appearance.exposure
        steps = np.arange(256, dtype=np.float32)[:, None]
        curve = np.clip(255.0 * (steps * gain / 255.0) ** 0.95, 0.0, 255.0)
        return np.asarray(cv2.LUT(picture, curve.astype(np.uint8)[:, None, :]), np.uint8)

    def _with_noise(self, picture: ColorImage, appearance: Appearance) -> ColorImage:
        """A picture of its own with another draw of the imager's noise."""
        if appearance.color_noise <= 0.0:
            return picture.copy()
        tile = self._noise_tile(*picture.shape[:2]) * np.float32(appearance.color_noise)
        return np.asarray(cv2.add(picture, cv2.merge((tile, tile, tile)), dtype=cv2.CV_8U), np.uint8)

    def _noise_tile(self, height: int, width: int) -> Image32:
        """A new cut out of one large noise field."""
        field = self.materials.grey_noise
        shift_y = int(self._rng.integers(0, field.shape[0]))
        shift_x = int(self._rng.integers(0, field.shape[1]))
        rows = (np.arange(height) + shift_y) % field.shape[0]
        columns = (np.arange(width) + shift_x) % field.shape[1]
        return np.asarray(field.take(rows, axis=0).take(columns, axis=1))

    # -- depth ------------------------------------------------------------------------------------------------------

    def _true_depth(self, state: SceneState, ground: GroundMap) -> Image32:
        stream = self._depth
        assert stream is not None
        depth = stream.ground_depth_m(ground, state.vehicle_x_m)
        view = depth[: stream.machine.depth_m.shape[0]]
        np.minimum(view, stream.machine.depth_m, out=view)
        for solid in state.props:
            area = solid.area(stream.intrinsics, stream.pose)
            if area is not None:
                met, _ = solid.meet(stream.rays, area)
                np.minimum(depth[area], met, out=depth[area])
        hit = meet_blade(stream.rays, stream.intrinsics, stream.pose, state.blade)
        if hit is not None:
            _merge_depth(depth, hit)
        return depth

    def _measured(self, depth_m: Image32, appearance: Appearance) -> DepthImage:
        assert self._depth is not None
        return self.materials.stereo.measure(
            depth_m, self._depth.intrinsics.fx, appearance.disparity_noise_px, appearance.hole_share, self._rng
        )


def _merge_depth(depth: Image32, hit: BladeHit) -> None:
    view = depth[hit.area]
    np.minimum(view, hit.depth_m, out=view)


def _lit(paint: Image32, normals: Image32, appearance: Appearance) -> Image8:
    """Colours of matt surfaces with the given normals, ``(..., 3)``."""
    light = appearance.sun_strength * 0.8 * np.maximum(normals @ sun_direction(appearance), 0.0)
    light = light + appearance.ambient * (0.75 + 0.25 * normals[..., 2])
    return np.asarray(np.clip(light[..., None] * paint, 0.0, 255.0), np.uint8)


CAMERA_HEIGHT_M = 2.5
"""Height of the imagined camera above the bed's floor; depth is measured along the vertical."""
_SCALE = 4


def top_depth(heights_m: FloatArray) -> npt.NDArray[np.uint16]:
    """Millimetres from the camera to the surface, one pixel a cell; up is forward, left is the operator's left."""
    depth = np.rint((CAMERA_HEIGHT_M - heights_m) * 1000.0).astype(np.uint16)
    return np.ascontiguousarray(depth[::-1, ::-1])


def top_view(
    heights_m: FloatArray, cell_m: float, vehicle_x_m: float, blade: BladePose, appearance: Appearance
) -> npt.NDArray[np.uint8]:
    """A shaded colour picture of the bed with the blade drawn in, oriented as :func:`top_depth`."""
    size = (heights_m.shape[1] * _SCALE, heights_m.shape[0] * _SCALE)
    fine = cv2.resize(heights_m.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    slope_x, slope_y = np.gradient(fine, cell_m / _SCALE)
    light = np.clip(1.0 - 0.45 * slope_x + 0.45 * slope_y, 0.4, 1.5)
    soil = soil_palette(appearance)[128, 0].astype(np.float32)
    floor = ground_palette(appearance)[128, 0].astype(np.float32)
    share = np.clip((fine - 0.002) / 0.01, 0.0, 1.0)[:, :, None]
    picture = np.clip((floor + (soil - floor) * share) * light[:, :, None], 0, 255).astype(np.uint8)
    picture = np.ascontiguousarray(picture[::-1, ::-1])
    angle = math.radians(blade.angle_deg)
    ends = []
    for s in (-LENGTH_M / 2.0, LENGTH_M / 2.0):
        x, y = vehicle_x_m - s * math.sin(angle), s * math.cos(angle)
        column = (heights_m.shape[1] * cell_m / 2.0 - y) / cell_m * _SCALE
        row = (heights_m.shape[0] * cell_m - x) / cell_m * _SCALE
        ends.append((round(column), round(row)))
    cv2.line(picture, ends[0], ends[1], (40, 200, 255), 5, cv2.LINE_AA)
    return picture
