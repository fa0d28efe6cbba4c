"""A test bed seen from above by a D455, with the noise and the holes of a real one: heights and spread are known.

The camera looks down from a beam over the bed: the picture's upper side is forward, its left the operator's left.
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

from graderd.evaluation.bed import Bed, Points, bed_of
from graderd.evaluation.depth_files import Lens
from graderd.evaluation.measures import Interval, Rules, Spread, height_difference, spread
from graderd.evaluation.uncertainty import Estimate, estimate
from graderd.hal.camera import Intrinsics
from graderd.simulator.camera.materials import StereoNoise
from graderd.simulator.camera.optics import DEPTH_INTRINSICS

F64 = npt.NDArray[np.float64]
U16 = npt.NDArray[np.uint16]
Surface = Callable[[F64, F64], F64]
"""Heights (mm) of a bed at x forward and y left of the foot of the camera (mm)."""

HALF_VIEW = Intrinsics(848, 240, DEPTH_INTRINSICS.fx, DEPTH_INTRINSICS.fy, DEPTH_INTRINSICS.cx, 119.5)
"""The middle rows of the picture: as wide, half as long, half the work."""


def camera_json(lens: Intrinsics) -> dict[str, Any]:
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
            depth = (self.height_mm - surface(depth * dx, depth * dy)) / -dz
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

    def points(self, surface: Surface, count: int) -> list[Points]:
        """The same as points, without the way over files."""
        rays = Lens.model_validate(camera_json(self.lens)["depth"]).rays()
        picture = np.array((0.0, 0.0, -1.0)), np.array((0.0, -1.0, 0.0))
        return [Points(rays[scan > 0] * scan[scan > 0, None], *picture) for scan in self.scans_mm(surface, count)]


@cache
def _noise() -> StereoNoise:
    return StereoNoise(np.random.default_rng(5))


def save(folder: Path, name: str, scans: list[U16], lens: Intrinsics = DEPTH_INTRINSICS) -> str:
    """Write scans as ``NAME-1.depth.png`` and so on beside a ``camera.json``; the pattern that names them all."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.json").write_text(json.dumps(camera_json(lens)), encoding="utf-8")
    for number, scan in enumerate(scans, 1):
        cv2.imwrite(str(folder / f"{name}-{number}.depth.png"), scan)
    return f"{name}-*.depth.png"


def heap(profile: Callable[[F64], F64], x_from_mm: float, x_to_mm: float, foot_mm: float) -> Surface:
    """Soil with the same profile (mm over y) all along a stretch, falling off to nothing over ``foot_mm`` at its
    ends."""

    def surface(x: Any, y: Any) -> F64:
        within = np.clip(np.minimum(x - x_from_mm, x_to_mm - x) / foot_mm, 0.0, 1.0)
        return np.asarray(within * profile(y))

    return surface


def trapezoid(middle_mm: float, top_mm: float, foot_mm: float, height_mm: float) -> Callable[[F64], F64]:
    """A ridge: ``top_mm`` wide on top, ``foot_mm`` wide on the ground."""

    def profile(y: F64) -> F64:
        aside = np.abs(y - middle_mm)
        return np.asarray(height_mm * np.clip((foot_mm / 2.0 - aside) / (foot_mm - top_mm) * 2.0, 0.0, 1.0))

    return profile


TARGET_MM = 100.0
EDGE_MM = 10.0
"""What counts as soil by default."""


@dataclass(frozen=True)
class KnownBed:
    """A flat-topped heap whose width by each definition, and height on top, are known; ``top``: x and y of a part of
    its top (mm), ``camera``: at random within the bars of the evaluation."""

    surface: Surface
    truth: dict[str, float]
    top_x_mm: tuple[float, float]
    top_y_mm: tuple[float, float]
    camera: TopCamera

    def measures(self, bed: Bed, heights_mm: F64) -> dict[str, float]:
        """All that is known of the bed, as the evaluation measures it in a map."""
        spreads = spread(heights_mm, bed.grid, bed.noise_mm, Rules(EDGE_MM), tuple(Spread))
        top = Rules(EDGE_MM, Interval(*self.top_x_mm), Interval(*self.top_y_mm))
        flat = height_difference(heights_mm, bed.grid, TARGET_MM, bed.noise_mm, bed.cell_noise_mm, top)
        return {**spreads, "height_difference_mm": flat["height_difference_mm"]}

    def estimated(self, scans_n: int, cell_mm: float) -> dict[str, Estimate]:
        """The same from so many scans, each with its uncertainty."""
        bed = bed_of(self.camera.points(self.surface, scans_n), cell_mm)
        return estimate([bed], lambda maps: self.measures(bed, maps[0]))


def known_bed(seed: int, half_length_mm: float, lens: Intrinsics = DEPTH_INTRINSICS) -> KnownBed:
    """Widths of 450 to 1000 mm, 60 to 160 mm high; noise of 0.09 to 0.37 px, tilt to 5 degrees, a fifth not seen."""
    rng = np.random.default_rng(seed)
    foot_mm, height_mm, middle_mm = rng.uniform(450.0, 1000.0), rng.uniform(60.0, 160.0), rng.uniform(-250.0, 250.0)
    top_mm = foot_mm * rng.uniform(0.25, 0.6)
    profile = trapezoid(middle_mm, top_mm, foot_mm, height_mm)
    slope_mm = 120.0
    y = np.linspace(-1500.0, 1500.0, 300_001)
    across = profile(y)
    held = np.cumsum(across) / across.sum()
    mean = float(across @ y / across.sum())
    # Along the travel a trapezoid too: the stretch that holds 95 % of it, and the profile as its mean.
    x = np.linspace(-half_length_mm, half_length_mm, 100_001)
    along = np.clip((half_length_mm - np.abs(x)) / slope_mm, 0.0, 1.0)
    inner = np.interp((0.025, 0.975), np.cumsum(along) / along.sum(), x)
    share = float(along.sum() * (x[1] - x[0]) / (inner[1] - inner[0]))
    truth = {
        "height_difference_mm": height_mm - TARGET_MM,
        "spread_extreme_mm": top_mm + (foot_mm - top_mm) * (1.0 - EDGE_MM / (height_mm * share)),
        "spread_mass_90_mm": float(np.diff(np.interp((0.05, 0.95), held, y))[0]),
        "spread_mass_95_mm": float(np.diff(np.interp((0.025, 0.975), held, y))[0]),
        "spread_second_moment_mm": float(np.sqrt(12.0 * (across @ (y - mean) ** 2) / across.sum())),
    }
    tilt, way = rng.uniform(0.0, 5.0), rng.uniform(0.0, 2.0 * np.pi)
    camera = TopCamera(
        height_mm=1300.0,
        pitch_deg=tilt * np.cos(way),
        roll_deg=tilt * np.sin(way),
        noise_px=rng.uniform(0.09, 0.37),
        seed=seed,
        lens=lens,
    )
    clear_mm = half_length_mm - slope_mm - 40.0
    aside_mm = top_mm / 2.0 - 40.0
    top_y_mm = (middle_mm - aside_mm, middle_mm + aside_mm)
    return KnownBed(
        heap(profile, -half_length_mm, half_length_mm, slope_mm), truth, (-clear_mm, clear_mm), top_y_mm, camera
    )
