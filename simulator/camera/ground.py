"""The ground about the blade as the imagers see it: heights, with the soil parted at the blade, and light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.materials import Materials
from graderd.simulator.camera.paint import Image8, Image32
from graderd.simulator.camera.shapes import Solid
from graderd.simulator.grader.blade import EDGE_GAP_M, FACE_HEIGHT_M, LENGTH_M, BladePose
from graderd.simulator.grader.soil import BED_WIDTH_M

_BEHIND_M, _AHEAD_M = 2.0, 0.9
"""Extent of the ground map about the blade, along the vehicle; the camera stands 0.8 m ahead."""
_BODY_M = 0.032
"""Depth behind the blade's face that soil lying against its hollow fills."""
_SPILL_M = 0.08
"""Where soil stands above the blade's top, it falls off behind it over this distance."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """What there is to be seen at one instant.

    ``heights_m``: the soil, ``(cells along x, cells along y)`` float32, as
    :class:`graderd.simulator.grader.soil.SoilField` has it;
    ``vehicle_x_m``: bed x of the blade's axis. ``props``: further solids, in the vehicle frame.
    """

    heights_m: npt.NDArray[np.float32]
    cell_m: float
    vehicle_x_m: float
    blade: BladePose
    props: tuple[Solid, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """The surroundings of the blade at half the field's cell size, in the vehicle frame.

    ``tone``: two channels, light (0..255 = 0..2) and share of soil (0..255).
    """

    heights_m: Image32
    tone: Image8
    x_first_m: float
    y_first_m: float
    cell_m: float


def ground_map(state: SceneState, appearance: Appearance, materials: Materials) -> GroundMap:
    """Heights, light and share of soil about the blade at one instant."""
    cell = state.cell_m
    first = max(0, math.floor((state.vehicle_x_m - _BEHIND_M) / cell))
    last = min(state.heights_m.shape[0], math.ceil((state.vehicle_x_m + _AHEAD_M) / cell))
    soil = state.heights_m[first:last].astype(np.float32)
    x_first = (first + 0.5) * cell - state.vehicle_x_m
    y_first = (0.5 * cell) - BED_WIDTH_M / 2.0
    fine = _enlarge(soil)
    _lean_on_blade(soil, fine, x_first, y_first, state)
    x_first, y_first, cell = x_first - cell / 4.0, y_first - cell / 4.0, cell / 2.0
    soft = np.clip((fine - 0.001) / 0.010, 0.0, 1.0)
    rough = materials.rough(first * 2, fine.shape)
    fine = np.maximum(fine + soft * rough, 0.0)
    heights = np.where(fine > 0.0015, fine, 0.0).astype(np.float32)
    light = _light(heights, x_first, y_first, cell, state.blade, appearance)
    share = np.clip((fine - 0.001) * (255.0 / 0.008), 0.0, 255.0)
    tone = np.asarray(cv2.merge((np.clip(light * 127.5, 0.0, 255.0), share)))
    return GroundMap(heights, tone.astype(np.uint8), x_first, y_first, cell)


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
    heights: Image32, x_first: float, y_first: float, cell: float, blade: BladePose, appearance: Appearance
) -> Image32:
    """Light on the ground map: sun with shadows of soil and blade, and sky dimmed in hollows."""
    sun = sun_direction(appearance)
    slope_x = np.asarray(cv2.Sobel(heights, cv2.CV_32F, 0, 1, scale=1.0 / (8.0 * cell)))
    slope_y = np.asarray(cv2.Sobel(heights, cv2.CV_32F, 1, 0, scale=1.0 / (8.0 * cell)))
    facing = (sun[2] - sun[0] * slope_x - sun[1] * slope_y) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    sunlit = np.clip(facing, 0.0, None)
    if appearance.shadows:
        sunlit *= 1.0 - _shadow(heights, x_first, y_first, cell, blade, appearance, sun)
    hollow = heights - np.asarray(cv2.blur(heights, (21, 21)))
    sky = appearance.ambient * np.clip(1.0 + 4.0 * hollow, 0.45, 1.15)
    return np.asarray(appearance.sun_strength * sunlit + sky, np.float32)


def _shadow(
    heights: Image32,
    x_first: float,
    y_first: float,
    cell: float,
    blade: BladePose,
    appearance: Appearance,
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
            shift = np.array([[1, 0, -sun[1] / level * step / cell], [0, 1, -sun[0] / level * step / cell]], np.float32)
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
    if appearance.machine_shadow > 0.0:
        border = np.float32(1.0 - 2.0 * appearance.machine_shadow) - 0.15 * x
        np.maximum(shade, np.clip((y - border) / 0.03, 0.0, 1.0), out=shade)
    return np.asarray(cv2.blur(shade, (3, 3)), np.float32)


def sun_direction(appearance: Appearance) -> npt.NDArray[np.float32]:
    """Unit vector towards the sun in the vehicle frame."""
    azimuth, elevation = math.radians(appearance.sun_azimuth_deg), math.radians(appearance.sun_elevation_deg)
    level = math.cos(elevation)
    return np.array((level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)), np.float32)


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
