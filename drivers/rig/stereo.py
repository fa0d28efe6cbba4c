"""What stereo matching makes of true depth: disparity noise, holes, lost edges, a nearest and a farthest distance.

Noise: standard deviation of depth = ``noise_px * z^2 / (f * baseline)``, the usual stereo error propagation, with
0.08 px for the D455 on textured surfaces: 2 mm at 1 m.
"""

from __future__ import annotations

import cv2
import numpy as np

from drivers.rig.optics import BASELINE_M, MAX_DEPTH_M, MIN_DEPTH_M
from drivers.rig.paint import Image32, noise
from graderd.hal.camera import DepthImage

_EDGE_STEP_PX = 0.9
"""A jump in disparity between neighbours above which matching fails."""


class StereoNoise:
    """Turns true depth into measured depth. Its fields of noise and holes are made once and cut anew for each frame."""

    def __init__(self, rng: np.random.Generator) -> None:
        shape = (613, 1103)
        white = rng.standard_normal(shape, np.float32)
        smooth = np.asarray(cv2.GaussianBlur(white, (0, 0), 1.2), np.float32)
        smooth /= float(smooth.std())
        mixed = 0.8 * smooth + 0.6 * white
        self._noise = np.asarray(mixed / mixed.std(), np.float32)
        blobs = noise(rng, shape, ((5.0, 1.0), (11.0, 0.8)))
        ranks = np.argsort(np.argsort(blobs, axis=None)).reshape(shape)
        self._blobs = np.asarray(ranks / blobs.size, np.float32)

    def measure(
        self, depth_m: Image32, fx: float, noise_px: float, hole_share: float, rng: np.random.Generator
    ) -> DepthImage:
        """Depth as the camera gives it: uint16 millimetres along the optical axis, 0 = no value.

        ``depth_m``: true optical depth; ``fx``: focal length in pixels; ``noise_px``: standard deviation of the
        disparity; ``hole_share``: share of pixels lost in blobs, besides those lost at edges; ``rng`` says which cut.
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
        lost |= (measured < MIN_DEPTH_M * 1000.0) | (measured > MAX_DEPTH_M * 1000.0)
        result = np.asarray(measured + np.float32(0.5), np.uint16)
        result[lost] = 0
        return result


def _cut(field: Image32, height: int, width: int, rng: np.random.Generator) -> Image32:
    rows = (np.arange(height) + int(rng.integers(0, field.shape[0]))) % field.shape[0]
    columns = (np.arange(width) + int(rng.integers(0, field.shape[1]))) % field.shape[1]
    return np.asarray(field.take(rows, axis=0).take(columns, axis=1))
