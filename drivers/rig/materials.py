"""The textures and noise of one rig: made once by seed, sampled for every picture."""

from __future__ import annotations

import cv2
import numpy as np

from drivers.rig.look import BladeMaterial, Look
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
from drivers.rig.soil import BED_LENGTH_M, BED_WIDTH_M
from drivers.rig.stereo import StereoNoise

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

    def paint(self, look: Look, column: Image32, row: Image32, share: Image8) -> Image8:
        """Colour of the ground at texture coordinates: bed where little soil lies (``share``), soil elsewhere."""
        both = cv2.remap(self._textures, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        clods, board = cv2.split(np.asarray(both))
        # The same texture three and a half times smaller gives the grit that one texel a 2.5 mm cannot.
        grit = cv2.remap(self._grain, column * 3.5, row * 3.5, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP)
        grain = np.asarray(cv2.addWeighted(clods, 0.8, grit, 0.5, -0.3 * 128.0), np.uint8)
        floor = board if look.ground == "plywood" else clods
        picture = np.asarray(cv2.applyColorMap(floor, ground_palette(look)), np.uint8)
        is_soil = cv2.compare(share, np.maximum(grain, 40) - 40, cv2.CMP_GT)
        cv2.copyTo(cv2.applyColorMap(grain, soil_palette(look)), is_soil, picture)
        return picture

    def blade(self, material: BladeMaterial) -> Image32:
        """Albedo of the blade's face."""
        if material not in self._blades:
            self._blades[material] = blade_paint(np.random.default_rng(self._seed + 2), material)
        return self._blades[material]
