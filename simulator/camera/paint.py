"""Procedural surfaces: soil, plywood and steel, fixed to the world or the blade and repeatable by seed."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from graderd.simulator.camera.appearance import Appearance, BladeMaterial, GroundKind, SoilKind
from graderd.simulator.grader.blade import FACE_HEIGHT_M, LENGTH_M

Image8 = npt.NDArray[np.uint8]
Image32 = npt.NDArray[np.float32]

TEXEL_M = 0.0025

_SOIL_RGB: dict[SoilKind, tuple[int, int, int]] = {
    "loam": (128, 98, 70),
    "sand": (192, 166, 126),
    "clay": (166, 112, 80),
    "gravel": (134, 130, 124),
    "peat": (72, 58, 48),
    "laterite": (156, 78, 50),
}
_GROUND_RGB: dict[GroundKind, tuple[int, int, int]] = {
    "plywood": (190, 158, 116),
    "earth": (112, 96, 80),
    "concrete": (150, 150, 146),
}
_BLADE_RGB: dict[BladeMaterial, tuple[int, int, int]] = {
    "steel": (138, 141, 145),
    "rusty": (126, 82, 56),
    "painted": (214, 160, 32),
}


def noise(rng: np.random.Generator, shape: tuple[int, int], octaves: tuple[tuple[float, float], ...]) -> Image32:
    """Sum of smooth random fields, each ``(wavelength in cells, weight)``; mean 0, standard deviation 1."""
    total = np.zeros(shape, np.float32)
    for wavelength, weight in octaves:
        coarse = (max(2, int(shape[0] / wavelength) + 1), max(2, int(shape[1] / wavelength) + 1))
        field = rng.standard_normal(coarse, np.float32)
        if wavelength > 1:
            field = np.asarray(cv2.resize(field, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)
        field *= np.float32(weight)
        total += field[: shape[0], : shape[1]]
    total -= total.mean()
    total /= np.float32(max(float(total.std()), 1e-6))
    return total


def _sum(base: float, *fields: tuple[float, Image32]) -> Image32:
    """``base`` and the weighted fields, which are used up: each is 10 MB, and what takes time is memory."""
    (weight, total), *others = fields
    total *= np.float32(weight)
    total += np.float32(base)
    for weight, field in others:
        field *= np.float32(weight)
        total += field
    return total


def _lightness(light: Image32) -> Image8:
    return np.asarray(np.clip(light, 0, 255, out=light), np.uint8)


def soil_grain(rng: np.random.Generator, shape: tuple[int, int]) -> Image8:
    """Lightness of a soil surface, 128 in the mean: grains, clods with their small shadows, damp patches."""
    clods = noise(rng, shape, ((5.0, 0.6), (10.0, 1.0), (22.0, 0.8)))
    relief = np.roll(clods, (2, 1), (0, 1))
    np.subtract(clods, relief, out=relief)
    relief /= np.float32(max(float(relief.std()), 1e-6))
    fine = noise(rng, shape, ((1.0, 1.0), (2.0, 1.0)))
    patches = noise(rng, shape, ((90.0, 1.0), (220.0, 1.0)))
    return _lightness(_sum(128.0, (22.0, relief), (9.0, fine), (7.0, clods), (6.0, patches)))


def wood_grain(rng: np.random.Generator, shape: tuple[int, int]) -> Image8:
    """Lightness of plywood boards: long fibres, stains and a joint every 1.2 m."""
    fibres = noise(rng, (max(2, shape[0] // 40), shape[1]), ((1.0, 0.6), (3.0, 1.0), (9.0, 1.0)))
    fibres = np.asarray(cv2.resize(fibres, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)
    stains = noise(rng, shape, ((30.0, 0.6), (70.0, 1.0), (160.0, 1.0)))
    fine = noise(rng, shape, ((1.0, 1.0), (2.0, 1.0)))
    board = _sum(128.0, (6.0, fibres), (9.0, stains), (5.0, fine))
    joint = np.arange(shape[0]) % 480 < 2
    board[joint] *= 0.55
    return _lightness(board)


def palette(rgb: tuple[int, int, int], contrast: float, warm: float) -> Image8:
    """The colour of each lightness (256 x 1 x 3 BGR): dark is a little warmer, light a little greyer."""
    light = (np.arange(256, dtype=np.float32) / 128.0 - 1.0)[:, None]
    bgr = np.array(rgb[::-1], np.float32)[None, :]
    grey = bgr.mean()
    tinted = bgr + np.maximum(light, 0.0) * warm * (grey - bgr)
    return np.asarray(np.clip(tinted * (1.0 + contrast * light), 0, 255)[:, None, :], np.uint8)


def soil_palette(appearance: Appearance) -> Image8:
    """Soil colours by lightness; wet soil is darker and more saturated."""
    rgb = np.array(_SOIL_RGB[appearance.soil], np.float32)
    wet = 1.0 - 0.45 * appearance.wetness
    rgb = (rgb.mean() + (rgb - rgb.mean()) * (1.0 + 0.25 * appearance.wetness)) * wet
    contrast = 1.25 if appearance.soil == "gravel" else 0.95
    red, green, blue = (int(value) for value in np.clip(rgb, 0, 255))
    return palette((red, green, blue), contrast, 0.3)


def ground_palette(appearance: Appearance) -> Image8:
    """Colours of the bed's floor and sides by lightness."""
    return palette(
        _GROUND_RGB[appearance.ground], {"plywood": 0.9, "earth": 0.6, "concrete": 0.3}[appearance.ground], 0.2
    )


def blade_paint(rng: np.random.Generator, material: BladeMaterial) -> Image32:
    """Albedo of the blade's face, rows from the cutting edge up, columns from s = -0.5 m; BGR, 0 to 255."""
    shape = (round(FACE_HEIGHT_M / TEXEL_M), round(LENGTH_M / TEXEL_M))
    paint = np.empty((*shape, 3), np.float32)
    paint[:] = np.array(_BLADE_RGB[material][::-1], np.float32)
    brushed = noise(rng, shape, ((1.0, 1.0),))
    brushed = np.asarray(cv2.blur(brushed, (31, 1)), np.float32)
    blotches = noise(rng, shape, ((14.0, 1.0), (40.0, 1.0), (90.0, 0.7)))[:, :, None]
    paint *= 1.0 + 0.25 * brushed[:, :, None]
    rust = np.array((44.0, 74.0, 128.0), np.float32)
    if material == "rusty":
        paint += np.clip(blotches, -1.5, 1.5) * np.array((10.0, 14.0, 22.0), np.float32)
    else:
        spread = 0.55 if material == "steel" else 0.35
        worn = np.clip((blotches - 1.1) * spread, 0.0, 0.6)
        paint = paint * (1.0 - worn) + worn * rust
    scratches = noise(rng, shape, ((1.0, 1.0),))
    scratches = np.asarray(cv2.blur(scratches, (1, 25)), np.float32)[:, :, None]
    bare = np.array((150.0, 148.0, 145.0), np.float32)
    paint = np.where(scratches > 0.55, 0.5 * (paint + bare), paint)
    edge = round(0.035 / TEXEL_M)
    paint[:edge] = bare * (1.0 + 0.15 * brushed[:edge, :, None]) * 0.92
    paint[edge : edge + 1] *= 0.45
    for column in range(30, shape[1], 48):
        cv2.circle(paint, (column, edge // 2), 3, (52.0, 52.0, 55.0), -1)
    rows = np.linspace(0.0, 1.0, shape[0], dtype=np.float32)[:, None, None]
    dust = np.clip(0.45 - 0.55 * rows + 0.10 * blotches, 0.0, 0.45)
    return np.asarray(paint * (1.0 - dust) + dust * np.array((92.0, 112.0, 130.0), np.float32), np.float32)
