"""A depth camera that hangs over the bed and looks down, with the noise and the holes of a real D455.

The picture's upper side is forward, its left the operator's left.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from graderd.hal.camera import Intrinsics
from graderd.simulator.camera.materials import StereoNoise
from graderd.simulator.camera.optics import DEPTH_INTRINSICS

F64 = npt.NDArray[np.float64]
U16 = npt.NDArray[np.uint16]
Surface = Callable[[F64, F64], F64]
"""Heights (mm) of a bed at x forward and y left of the foot of the camera (mm)."""


def lens_json(lens: Intrinsics) -> dict[str, Any]:
    """A camera file as a frame set has it, without the pose."""
    return {"depth": {**asdict(lens), "scale_m": 0.001}}


@dataclass(frozen=True)
class TopCamera:
    """Where the camera hangs and how well it sees. ``noise_px``: deviation of the disparity; ``hole_share``: of the
    picture, the same places in every scan; the bed has sides at ``wall_y_mm`` to both sides of its middle line."""

    height_mm: float = 1500.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    noise_px: float = 0.2
    hole_share: float = 0.2
    wall_y_mm: float | None = None
    wall_height_mm: float = 500.0
    seed: int = 0
    lens: Intrinsics = DEPTH_INTRINSICS
    rays: F64 = field(init=False)

    def __post_init__(self) -> None:
        u = (np.arange(self.lens.width) - self.lens.cx) / self.lens.fx
        v = (np.arange(self.lens.height) - self.lens.cy) / self.lens.fy
        optical = np.stack((*np.meshgrid(u, v), np.ones((self.lens.height, self.lens.width))), axis=-1)
        a, b = np.radians((self.pitch_deg, self.roll_deg))
        pitch = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        roll = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        down = np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])  # columns: the optical axes in the bed frame
        object.__setattr__(self, "rays", optical @ (down @ pitch @ roll).T)

    def depth_m(self, surface: Surface) -> F64:
        """True depth along the optical axis."""
        dx, dy, dz = (self.rays[..., axis] for axis in range(3))
        depth = np.full(dx.shape, self.height_mm)
        for _ in range(14):  # converges where soil is less steep than the view
            before, depth = depth, (self.height_mm - surface(depth * dx, depth * dy)) / -dz
            if np.abs(depth - before).max() < 0.001:
                break
        if self.wall_y_mm is not None:
            meets = self.wall_y_mm / np.maximum(np.abs(dy), 1e-6)
            up = self.height_mm + meets * dz
            wall = (up < self.wall_height_mm) & (meets < depth)
            beyond = np.abs(depth * dy) > self.wall_y_mm
            depth = np.where(wall, meets, np.where(beyond, self.height_mm / -dz, depth))
        return np.asarray(depth / 1000.0)

    def scans_mm(self, surface: Surface, count: int) -> list[U16]:
        """Repeated depth pictures of one state, millimetres, 0 = no value."""
        depth = self.depth_m(surface).astype(np.float32)
        noise = _noise()
        fx = self.lens.fx
        lost = noise.measure(depth, fx, 0.0, self.hole_share, np.random.default_rng(self.seed), 10.0) == 0
        scans = []
        for number in range(count):
            rng = np.random.default_rng((self.seed, number, 1))
            scan = noise.measure(depth, fx, self.noise_px, 0.0, rng, 10.0)
            scan[lost] = 0
            scans.append(scan)
        return scans


@cache
def _noise() -> StereoNoise:
    return StereoNoise(np.random.default_rng(5))


def save(folder: Path, name: str, scans: list[U16], lens: Intrinsics = DEPTH_INTRINSICS) -> str:
    """Write scans as ``NAME-1.depth.png`` and so on beside a ``camera.json``; the pattern that names them all."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.json").write_text(json.dumps(lens_json(lens)), encoding="utf-8")
    for number, scan in enumerate(scans, 1):
        cv2.imwrite(str(folder / f"{name}-{number}.depth.png"), scan)
    return f"{name}-*.depth.png"
