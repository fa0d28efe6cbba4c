"""The textures and noise of one rig: made once by seed, sampled for every picture."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from graderd.hal.camera import DepthImage
from graderd.simulator.camera.appearance import Appearance, BladeMaterial
from graderd.simulator.camera.optics import BASELINE_M, MAX_DEPTH_M, MIN_DEPTH_M
from graderd.simulator.camera.paint import (
    TEXEL_M,
    Image8,
    Image32,
    blade_paint,
    ground_palette,
    noise,
    soil_grain,
    soil_palette,
    wood_grain,
)
from graderd.simulator.grader.soil import BED_LENGTH_M, BED_WIDTH_M

_EDGE_STEP_PX = 0.9
"""A jump in disparity between neighbours above which matching fails."""


NOISE_GRAIN_PX = 2.5
"""Matching windows overlap: pixels this near err together."""


class StereoNoise:
    """Turns true depth into measured depth. Its fields of noise and holes are made once and cut anew for each frame."""

    def __init__(self, rng: np.random.Generator) -> None:
        shape = (613, 1103)
        white = rng.standard_normal(shape, np.float32)
        smooth = np.asarray(cv2.GaussianBlur(white, (0, 0), NOISE_GRAIN_PX), np.float32)
        smooth /= float(smooth.std())
        mixed = 0.9 * smooth + 0.44 * white
        self._noise = np.asarray(mixed / mixed.std(), np.float32)
        blobs = noise(rng, shape, ((5.0, 1.0), (11.0, 0.8)))
        ranks = np.empty(blobs.size)
        ranks[np.argsort(blobs, axis=None)] = np.arange(blobs.size)
        self._blobs = np.asarray((ranks / blobs.size).reshape(shape), np.float32)

    def measure(
        self,
        depth_m: Image32,
        fx: float,
        noise_px: float,
        hole_share: float,
        rng: np.random.Generator,
        max_depth_m: float = MAX_DEPTH_M,
    ) -> DepthImage:
        """Depth as the camera gives it: uint16 millimetres along the optical axis, 0 = no value.

        ``depth_m``: true optical depth; ``fx``: focal length in pixels; ``noise_px``: standard deviation of the
        disparity; ``hole_share``: share of pixels lost in blobs, besides those lost at edges; ``rng`` says which cut;
        ``max_depth_m``: what lies farther is not told, as the camera is set.
        """
        height, width = depth_m.shape
        disparity = np.float32(fx * BASELINE_M) / depth_m
        kernel = np.ones((1, 5), np.uint8)
        jump = np.asarray(cv2.dilate(disparity, kernel)) - np.asarray(cv2.erode(disparity, kernel))
        lost = jump > _EDGE_STEP_PX * 4.0
        if hole_share > 0.0:
            lost |= _cut(self._blobs, height, width, rng) < hole_share
        if noise_px > 0.0:
            disparity += _cut(self._noise, height, width, rng) * np.float32(noise_px)
        measured = np.float32(fx * BASELINE_M * 1000.0) / np.maximum(disparity, np.float32(0.5))
        lost |= (measured < MIN_DEPTH_M * 1000.0) | (measured > max_depth_m * 1000.0)
        result = np.asarray(measured + np.float32(0.5), np.uint16)
        result[lost] = 0
        return result


def _cut(field: Image32, height: int, width: int, rng: np.random.Generator) -> Image32:
    rows = (np.arange(height) + int(rng.integers(0, field.shape[0]))) % field.shape[0]
    columns = (np.arange(width) + int(rng.integers(0, field.shape[1]))) % field.shape[1]
    return np.asarray(field.take(rows, axis=0).take(columns, axis=1))


BED_CELLS = (round(BED_LENGTH_M / 0.01), round(BED_WIDTH_M / 0.01))


class Materials:
    """The textures and noise fields of one seed, made once and shared by renderers."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        shape = (round(BED_LENGTH_M / TEXEL_M), round(BED_WIDTH_M / TEXEL_M))
        rng = np.random.default_rng(seed)
        self._grain = soil_grain(rng, shape)
        self._textures = np.ascontiguousarray(np.stack((self._grain, wood_grain(rng, shape)), axis=-1))
        coarse = cv2.resize(self._grain, (BED_CELLS[1], BED_CELLS[0]), interpolation=cv2.INTER_AREA)
        self._rough: Image32 = (np.asarray(coarse, np.float32) - 128.0) * np.float32(0.0035 / 30.0)
        self.grey_noise: Image32 = rng.standard_normal((701, 1511), np.float32)
        self.stereo = StereoNoise(rng)
        self._blades: dict[str, Image32] = {}

    def rough(self, first_row: int, shape: tuple[int, ...]) -> Image32:
        """Millimetres-high relief of the soil (metres), for a ground map that begins at ``first_row``."""
        rows = self._rough[first_row : first_row + shape[0]]
        return rows if rows.shape == shape else np.asarray(cv2.resize(rows, (shape[1], shape[0])), np.float32)

    def paint(self, appearance: Appearance, column: Image32, row: Image32, share: Image8) -> Image8:
        """Colour of the ground at texture coordinates: bed where little soil lies (``share``), soil elsewhere."""
        both = cv2.remap(self._textures, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        clods, board = cv2.split(np.asarray(both))
        # The same texture three and a half times smaller gives the grit that one texel a 2.5 mm cannot.
        grit = cv2.remap(self._grain, column * 3.5, row * 3.5, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP)
        grain = np.asarray(cv2.addWeighted(clods, 0.8, grit, 0.5, -0.3 * 128.0), np.uint8)
        floor = board if appearance.ground == "plywood" else clods
        picture = np.asarray(cv2.applyColorMap(floor, ground_palette(appearance)), np.uint8)
        is_soil = cv2.compare(share, np.maximum(grain, 40) - 40, cv2.CMP_GT)
        cv2.copyTo(cv2.applyColorMap(grain, soil_palette(appearance)), is_soil, picture)
        return picture

    def blade(self, material: BladeMaterial) -> Image32:
        """Albedo of the blade's face."""
        if material not in self._blades:
            self._blades[material] = blade_paint(np.random.default_rng(self._seed + 2), material)
        return self._blades[material]


@lru_cache(maxsize=2)
def materials_of(seed: int) -> Materials:
    """The materials of a seed, made once: half a second of processor time and 50 MB."""
    return Materials(seed)
