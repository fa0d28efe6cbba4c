"""What the camera sees of the rig: colour and depth of soil, blade, bed and machine, without a graphics library."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from drivers.rig.blade import EDGE_GAP_M, FACE_HEIGHT_M, LENGTH_M, BladePose
from drivers.rig.look import BladeMaterial, Look
from drivers.rig.optics import COLOR_INTRINSICS, COLOR_POSE, DEPTH_INTRINSICS, DEPTH_POSE
from drivers.rig.paint import (
    TEXEL_M,
    Image8,
    Image32,
    blade_paint,
    ground_palette,
    soil_grain,
    soil_palette,
    wood_grain,
)
from drivers.rig.shapes import ARC_RAD, MACHINE, BladeHit, Solid, meet_blade, rotation
from drivers.rig.soil import BED_LENGTH_M, BED_WIDTH_M
from drivers.rig.stereo import StereoNoise
from drivers.rig.surface import Rays, SurfaceSweep
from graderd.hal.camera import ColorImage, DepthImage, Intrinsics, StreamPose

_BEHIND_M, _AHEAD_M = 2.0, 0.9
"""Extent of the ground map about the blade, along the vehicle; the camera stands 0.8 m ahead."""
_BODY_M = 0.032
"""Depth behind the blade's face that soil lying against its hollow fills."""
_SPILL_M = 0.08
"""Where soil stands above the blade's top, it falls off behind it over this distance."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """What there is to be seen at one instant.

    ``heights_m``: the soil, ``(cells along x, cells along y)`` float32, as :class:`drivers.rig.soil.SoilField` has it;
    ``vehicle_x_m``: bed x of the blade's axis. ``props``: further solids, in the vehicle frame.
    """

    heights_m: npt.NDArray[np.float32]
    cell_m: float
    vehicle_x_m: float
    blade: BladePose
    props: tuple[Solid, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _GroundMap:
    """The surroundings of the blade at half the field's cell size, in the vehicle frame.

    ``tone``: two channels, light (0..255 = 0..2) and share of soil (0..255).
    """

    heights_m: Image32
    tone: Image8
    x_first_m: float
    y_first_m: float
    cell_m: float


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
        self._inverse_horizontal = np.asarray(1.0 / np.maximum(self.rays.horizontal, 1e-6), np.float32)

    def ground_depth_m(self, ground: _GroundMap, vehicle_x_m: float) -> Image32:
        """Depth of soil, floor and the bed's sides and end."""
        ranges = self.sweep.ranges_m(ground.heights_m, ground.x_first_m, ground.y_first_m, ground.cell_m)
        depth = ranges * self._inverse_horizontal
        np.minimum(depth, self.wall_depth_m, out=depth)
        end = np.float32(-vehicle_x_m - self.pose.position_m[0]) / np.minimum(self.rays.dx, np.float32(-1e-3))
        np.minimum(depth, end, out=depth)
        return depth


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
        self.materials = materials or Materials(seed)
        self._rng = np.random.default_rng(seed + 1)
        self._color = _Stream(COLOR_INTRINSICS.scaled(*color_size), color_pose)
        self._depth = _Stream(DEPTH_INTRINSICS.scaled(*depth_size), depth_pose) if depth_size else None

    @property
    def color_intrinsics(self) -> Intrinsics:
        """Of the colour stream at the size rendered."""
        return self._color.intrinsics

    @property
    def depth_intrinsics(self) -> Intrinsics | None:
        """Of the depth stream at the size rendered."""
        return self._depth.intrinsics if self._depth else None

    def render(self, state: SceneState, look: Look) -> tuple[ColorImage, DepthImage | None]:
        """Colour (BGR) and depth (uint16 millimetres, 0 = none) of one instant."""
        ground = self._ground_map(state, look)
        color = self._render_color(state, look, ground)
        return color, self._render_depth(state, look, ground) if self._depth else None

    def render_depth_m(self, state: SceneState, look: Look) -> Image32:
        """Depth without any noise, metres; for tests and calibration."""
        if self._depth is None:
            raise ValueError("this renderer has no depth stream")
        return self._true_depth(state, self._ground_map(state, look))

    # -- ground -----------------------------------------------------------------------------------------------------

    def _ground_map(self, state: SceneState, look: Look) -> _GroundMap:
        cell = state.cell_m
        first = max(0, math.floor((state.vehicle_x_m - _BEHIND_M) / cell))
        last = min(state.heights_m.shape[0], math.ceil((state.vehicle_x_m + _AHEAD_M) / cell))
        soil = state.heights_m[first:last].astype(np.float32)
        x_first = (first + 0.5) * cell - state.vehicle_x_m
        y_first = (0.5 * cell) - BED_WIDTH_M / 2.0
        fine = _enlarge(soil)
        self._lean_on_blade(soil, fine, x_first, y_first, state)
        x_first, y_first, cell = x_first - cell / 4.0, y_first - cell / 4.0, cell / 2.0
        soft = np.clip((fine - 0.001) / 0.010, 0.0, 1.0)
        rough = self.materials.rough(first * 2, fine.shape)
        fine = np.maximum(fine + soft * rough, 0.0)
        heights = np.where(fine > 0.0015, fine, 0.0).astype(np.float32)
        light = self._light(heights, x_first, y_first, cell, state.blade, look)
        share = np.clip((fine - 0.001) * (255.0 / 0.008), 0.0, 255.0)
        tone = np.asarray(cv2.merge((np.clip(light * 127.5, 0.0, 255.0), share)))
        return _GroundMap(heights, tone.astype(np.uint8), x_first, y_first, cell)

    @staticmethod
    def _lean_on_blade(soil: Image32, fine: Image32, x_first: float, y_first: float, state: SceneState) -> None:
        """Part the soil along the blade's face in ``fine``: the field knows the blade only as a wall of whole cells.

        Soil ahead goes on into the hollow of the face, and over the top where it stands higher than the blade.
        """
        cell = state.cell_m
        _, ahead = _blade_coordinates(soil.shape, x_first, y_first, cell, state.blade)
        front = _enlarge(_extrapolate(soil, ahead > 0.0))
        back = _enlarge(_extrapolate(soil, ahead < -1.5 * cell))
        s, ahead = _blade_coordinates(fine.shape, x_first - cell / 4.0, y_first - cell / 4.0, cell / 2.0, state.blade)
        near = (np.abs(s) <= LENGTH_M / 2.0) & (ahead <= 0.045) & (ahead >= -_SPILL_M)
        top = np.float32(state.blade.height_m + FACE_HEIGHT_M)
        spilt = np.where(front > top, front + np.minimum(ahead, 0.0), np.float32(0.0))
        parted = np.where(ahead > -_BODY_M, np.minimum(front, np.maximum(top - 0.004, spilt)), np.maximum(back, spilt))
        np.copyto(fine, np.where(ahead > 0.0, front, parted), where=near)

    def _light(
        self, heights: Image32, x_first: float, y_first: float, cell: float, blade: BladePose, look: Look
    ) -> Image32:
        """Light on the ground map: sun with shadows of soil and blade, and sky dimmed in hollows."""
        sun = sun_direction(look)
        slope_x = np.asarray(cv2.Sobel(heights, cv2.CV_32F, 0, 1, scale=1.0 / (8.0 * cell)))
        slope_y = np.asarray(cv2.Sobel(heights, cv2.CV_32F, 1, 0, scale=1.0 / (8.0 * cell)))
        facing = (sun[2] - sun[0] * slope_x - sun[1] * slope_y) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
        sunlit = np.clip(facing, 0.0, None)
        if look.shadows:
            sunlit *= 1.0 - self._shadow(heights, x_first, y_first, cell, blade, look, sun)
        hollow = heights - np.asarray(cv2.blur(heights, (21, 21)))
        sky = look.ambient * np.clip(1.0 + 4.0 * hollow, 0.45, 1.15)
        return np.asarray(look.sun_strength * sunlit + sky, np.float32)

    @staticmethod
    def _shadow(
        heights: Image32,
        x_first: float,
        y_first: float,
        cell: float,
        blade: BladePose,
        look: Look,
        sun: npt.NDArray[np.float32],
    ) -> Image32:
        rows, columns = heights.shape
        x = (x_first + np.arange(rows, dtype=np.float32) * np.float32(cell))[:, None]
        y = (y_first + np.arange(columns, dtype=np.float32) * np.float32(cell))[None, :]
        shade = np.zeros(heights.shape, np.float32)
        level = math.hypot(float(sun[0]), float(sun[1]))
        if level > 1e-3:
            climb = float(sun[2]) / level
            for step in (0.03, 0.06, 0.11, 0.18):
                shift = np.array(
                    [[1, 0, -sun[1] / level * step / cell], [0, 1, -sun[0] / level * step / cell]], np.float32
                )
                upwind = np.asarray(cv2.warpAffine(heights, shift, (columns, rows), borderMode=cv2.BORDER_REPLICATE))
                np.maximum(shade, np.clip((upwind - heights - step * climb) / 0.008, 0.0, 1.0), out=shade)
        angle = math.radians(blade.angle_deg)
        cos, sin = np.float32(math.cos(angle)), np.float32(math.sin(angle))
        towards = float(sun[0] * cos + sun[1] * sin)
        if abs(towards) > 1e-3:
            along = float(sun[1] * cos - sun[0] * sin)
            reach = -(x * cos + y * sin) / np.float32(towards)
            s = y * cos - x * sin + reach * np.float32(along)
            up = heights + reach * sun[2] - np.float32(blade.height_m + EDGE_GAP_M)
            blocked = (reach > 0.0) & (np.abs(s) < LENGTH_M / 2.0) & (up > 0.0) & (up < FACE_HEIGHT_M)
            np.maximum(shade, blocked.astype(np.float32), out=shade)
        if look.machine_shadow > 0.0:
            border = np.float32(1.0 - 2.0 * look.machine_shadow) - 0.15 * x
            np.maximum(shade, np.clip((y - border) / 0.03, 0.0, 1.0), out=shade)
        return np.asarray(cv2.blur(shade, (3, 3)), np.float32)

    # -- colour -----------------------------------------------------------------------------------------------------

    def _render_color(self, state: SceneState, look: Look, ground: _GroundMap) -> ColorImage:
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
                borderValue=(255.0 * min(look.ambient * 0.5 + 0.2, 1.0), 0.0),
            )
        )
        light, share = cv2.split(tone)
        # The bed's sides are seen where the rays meet them: unfold their height beyond the edge of the floor.
        on_wall = depth >= stream.wall_depth_m
        rise = np.where(on_wall, np.float32(rays.position_m[2]) + depth * rays.dz, np.float32(0.0))
        texel = np.float32(1.0 / TEXEL_M)
        row = (x + np.float32(state.vehicle_x_m)) * texel
        column = (np.abs(y + np.float32(BED_WIDTH_M / 2.0)) + rise) * texel
        picture = self.materials.floor(look, column, row)
        soil, grain = self.materials.soil(look, column, row)
        is_soil = np.asarray(cv2.compare(share, np.maximum(grain, 40) - 40, cv2.CMP_GT))
        cv2.copyTo(soil, is_soil, picture)
        picture = np.asarray(cv2.multiply(picture, cv2.merge((light, light, light)), scale=1.0 / 127.5))
        self._paint_solids(picture, depth, stream, (*MACHINE, *state.props), look)
        self._paint_blade(picture, depth, stream, state.blade, look)
        return self._develop(picture, look)

    def _paint_solids(
        self, picture: Image8, depth: Image32, stream: _Stream, solids: tuple[Solid, ...], look: Look
    ) -> None:
        sun = sun_direction(look)
        for solid in solids:
            area = solid.area(stream.intrinsics, stream.pose)
            if area is None:
                continue
            met, normal = solid.meet(stream.rays, area)
            nearer = met < depth[area]
            if not nearer.any():
                continue
            facing = normal[0] * sun[0] + normal[1] * sun[1] + normal[2] * sun[2]
            light = look.sun_strength * 0.8 * np.maximum(facing, 0.0) + look.ambient * (0.75 + 0.25 * normal[2])
            shaded = light[:, :, None] * np.array(solid.bgr, np.float32)
            picture[area][nearer] = np.clip(shaded, 0.0, 255.0).astype(np.uint8)[nearer]
            depth[area][nearer] = met[nearer]

    def _paint_blade(self, picture: Image8, depth: Image32, stream: _Stream, blade: BladePose, look: Look) -> None:
        hit = meet_blade(stream.rays, stream.intrinsics, stream.pose, blade)
        if hit is None:
            return
        nearer = (hit.depth_m < depth[hit.area]).astype(np.uint8)
        face = self._lit_face(blade, look)
        painted = cv2.remap(
            face,
            (hit.s_m + np.float32(LENGTH_M / 2.0)) * np.float32(1.0 / TEXEL_M),
            hit.up_m * np.float32(1.0 / TEXEL_M),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(np.asarray(painted), nearer, picture[hit.area])
        _merge_depth(depth, hit)

    def _lit_face(self, blade: BladePose, look: Look) -> Image8:
        """The blade's paint under the present light: the hollow turns its upper half to the ground, its lower up."""
        paint = self.materials.blade(look.blade)
        rows = paint.shape[0]
        sine = np.linspace(-1.0, 1.0, rows) * math.sin(ARC_RAD / 2.0)
        normals = np.stack((np.sqrt(1.0 - sine**2), np.zeros(rows), -sine), axis=1)
        turn = rotation(blade.angle_deg) @ rotation(0.0, blade.pitch_deg, blade.slope_deg)
        normals = normals @ turn.T
        sun = sun_direction(look)
        facing = np.maximum(normals @ sun, 0.0)
        view = np.array([0.82, 0.0, 0.57])
        half = sun + view
        shine = np.maximum(normals @ (half / np.linalg.norm(half)), 0.0) ** 24
        gloss = {"steel": 110.0, "rusty": 12.0, "painted": 60.0}[look.blade]
        light = look.sun_strength * facing + look.ambient * (0.7 + 0.3 * normals[:, 2])
        lit = paint * light[:, None, None].astype(np.float32)
        lit += (gloss * look.sun_strength * shine)[:, None, None].astype(np.float32)
        return np.clip(lit, 0.0, 255.0).astype(np.uint8)

    def _develop(self, picture: Image8, look: Look) -> ColorImage:
        """What the colour imager makes of it: lens blur, exposure, colour cast and noise."""
        height, width = picture.shape[:2]
        picture = np.asarray(cv2.GaussianBlur(picture, (3, 3), 0.6))
        gain = np.array((1.0 - 0.5 * look.red_cast, 1.0, 1.0 + look.red_cast)) * look.exposure
        steps = np.arange(256, dtype=np.float32)[:, None]
        curve = np.clip(255.0 * (steps * gain / 255.0) ** 0.95, 0.0, 255.0)
        picture = np.asarray(cv2.LUT(picture, curve.astype(np.uint8)[:, None, :]))
        if look.color_noise > 0.0:
            tile = self._noise_tile(height, width) * np.float32(look.color_noise)
            picture = np.asarray(cv2.add(picture, cv2.merge((tile, tile, tile)), dtype=cv2.CV_8U))
        return picture.astype(np.uint8, copy=False)

    def _noise_tile(self, height: int, width: int) -> Image32:
        """A new cut out of one large noise field."""
        field = self.materials.grey_noise
        shift_y = int(self._rng.integers(0, field.shape[0]))
        shift_x = int(self._rng.integers(0, field.shape[1]))
        rows = (np.arange(height) + shift_y) % field.shape[0]
        columns = (np.arange(width) + shift_x) % field.shape[1]
        return np.asarray(field.take(rows, axis=0).take(columns, axis=1))

    # -- depth ------------------------------------------------------------------------------------------------------

    def _true_depth(self, state: SceneState, ground: _GroundMap) -> Image32:
        stream = self._depth
        assert stream is not None
        depth = stream.ground_depth_m(ground, state.vehicle_x_m)
        for solid in (*MACHINE, *state.props):
            area = solid.area(stream.intrinsics, stream.pose)
            if area is not None:
                met, _ = solid.meet(stream.rays, area)
                np.minimum(depth[area], met, out=depth[area])
        hit = meet_blade(stream.rays, stream.intrinsics, stream.pose, state.blade)
        if hit is not None:
            _merge_depth(depth, hit)
        return depth

    def _render_depth(self, state: SceneState, look: Look, ground: _GroundMap) -> DepthImage:
        assert self._depth is not None
        depth = self._true_depth(state, ground)
        return self.materials.stereo.measure(
            depth, self._depth.intrinsics.fx, look.disparity_noise_px, look.hole_share, self._rng
        )


class Materials:
    """The textures and noise fields of one seed, made once and shared by renderers."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        shape = (round(BED_LENGTH_M / TEXEL_M), round(BED_WIDTH_M / TEXEL_M))
        rng = np.random.default_rng(seed)
        self._grain = soil_grain(rng, shape)
        self._wood = wood_grain(rng, shape)
        coarse = cv2.resize(self._grain, (BED_CELLS[1], BED_CELLS[0]), interpolation=cv2.INTER_AREA)
        self._rough: Image32 = (np.asarray(coarse, np.float32) - 128.0) * np.float32(0.0035 / 30.0)
        self.grey_noise: Image32 = rng.standard_normal((701, 1511), np.float32)
        self.stereo = StereoNoise(rng)
        self._blades: dict[str, Image32] = {}

    def rough(self, first_row: int, shape: tuple[int, ...]) -> Image32:
        """Millimetres-high relief of the soil (metres), for a ground map that begins at ``first_row``."""
        rows = self._rough[first_row : first_row + shape[0]]
        return rows if rows.shape == shape else np.asarray(cv2.resize(rows, (shape[1], shape[0])), np.float32)

    def soil(self, look: Look, column: Image32, row: Image32) -> tuple[Image8, Image8]:
        """Soil colour at texture coordinates, and the lightness it comes from."""
        clods = cv2.remap(self._grain, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        # The same texture three and a half times smaller gives the grit that one texel a 2.5 mm cannot.
        grit = cv2.remap(self._grain, column * 3.5, row * 3.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        grain = np.asarray(cv2.addWeighted(clods, 0.8, grit, 0.5, -0.3 * 128.0), np.uint8)
        return np.asarray(cv2.LUT(cv2.merge((grain, grain, grain)), soil_palette(look)), np.uint8), grain

    def floor(self, look: Look, column: Image32, row: Image32) -> Image8:
        """Colour of the bed's floor and sides at texture coordinates."""
        texture = self._wood if look.ground == "plywood" else self._grain
        board = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(cv2.LUT(cv2.merge((board, board, board)), ground_palette(look)))

    def blade(self, material: BladeMaterial) -> Image32:
        """Albedo of the blade's face."""
        if material not in self._blades:
            self._blades[material] = blade_paint(np.random.default_rng(self._seed + 2), material)
        return self._blades[material]


BED_CELLS = (round(BED_LENGTH_M / 0.01), round(BED_WIDTH_M / 0.01))


def sun_direction(look: Look) -> npt.NDArray[np.float32]:
    """Unit vector towards the sun in the vehicle frame."""
    azimuth, elevation = math.radians(look.sun_azimuth_deg), math.radians(look.sun_elevation_deg)
    level = math.cos(elevation)
    return np.array((level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)), np.float32)


def _merge_depth(depth: Image32, hit: BladeHit) -> None:
    view = depth[hit.area]
    np.minimum(view, hit.depth_m, out=view)


def _enlarge(field: Image32) -> Image32:
    size = (field.shape[1] * 2, field.shape[0] * 2)
    return np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_CUBIC), np.float32)


def _extrapolate(field: Image32, known: npt.NDArray[np.bool_]) -> Image32:
    """``field`` smoothed where ``known``, elsewhere the mean of the known cells nearby (0 where there are none)."""
    weight = known.astype(np.float32)
    # The row of cells next to a slanting wall is ragged by the grid; its mean is what soil would look like.
    smooth = np.asarray(cv2.blur(np.asarray(cv2.blur(field * weight, (3, 3))), (3, 3)), np.float32)
    result = smooth / np.maximum(np.asarray(cv2.blur(np.asarray(cv2.blur(weight, (3, 3))), (3, 3))), np.float32(1e-6))
    result *= weight
    for size in (3, 9):
        total = np.asarray(cv2.blur(weight, (size, size)), np.float32)
        mean = np.asarray(cv2.blur(result * weight, (size, size)), np.float32) / np.maximum(total, np.float32(1e-6))
        fresh = (weight == 0.0) & (total > 1e-6)
        result = np.where(fresh, mean, result)
        weight = np.where(fresh, np.float32(1.0), weight)
    return np.asarray(result, np.float32)


def _blade_coordinates(
    shape: tuple[int, ...], x_first: float, y_first: float, cell_m: float, blade: BladePose
) -> tuple[Image32, Image32]:
    """Blade coordinates ``(s, d)`` of the cells of a map in the vehicle frame, metres."""
    angle = math.radians(blade.angle_deg)
    cos, sin = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    x = (np.float32(x_first) + np.arange(shape[0], dtype=np.float32) * np.float32(cell_m))[:, None]
    y = (np.float32(y_first) + np.arange(shape[1], dtype=np.float32) * np.float32(cell_m))[None, :]
    return y * cos - x * sin, y * sin + x * cos
