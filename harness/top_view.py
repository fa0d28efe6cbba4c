"""Test beds of which heights and spread are known, seen from above by the simulator's camera over the bed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from graderd.evaluation.bed import Bed, Points, bed_of
from graderd.evaluation.depth_files import Lens
from graderd.evaluation.measures import Interval, Rules, Spread, height_difference, spread
from graderd.evaluation.uncertainty import Estimate, estimate
from graderd.hal.camera import Intrinsics
from graderd.simulator.camera.optics import DEPTH_INTRINSICS
from graderd.simulator.camera.top import F64, Surface, TopCamera, lens_json

HALF_VIEW = Intrinsics(848, 240, DEPTH_INTRINSICS.fx, DEPTH_INTRINSICS.fy, DEPTH_INTRINSICS.cx, 119.5)
"""The middle rows of the picture: as wide, half as long, half the work."""


def points_of(camera: TopCamera, surface: Surface, count: int) -> list[Points]:
    """Repeated scans of one state as points, without the way over files."""
    rays = Lens.model_validate(lens_json(camera.lens)["depth"]).rays()
    picture = np.array((0.0, 0.0, -1.0)), np.array((0.0, -1.0, 0.0))
    return [Points(rays[scan > 0] * scan[scan > 0, None], *picture) for scan in camera.scans_mm(surface, count)]


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
        bed = bed_of(points_of(self.camera, self.surface, scans_n), cell_mm)
        return estimate([bed], lambda maps: self.measures(bed, maps[0]))


def known_bed(seed: int, half_length_mm: float, lens: Intrinsics = DEPTH_INTRINSICS) -> KnownBed:
    """Widths of 450 to 1000 mm, 60 to 160 mm high; noise of 0.09 to 0.37 px, tilt to 5 degrees, a fifth not seen."""
    rng = np.random.default_rng(seed)
    foot_mm, height_mm, middle_mm = rng.uniform(450.0, 1000.0), rng.uniform(60.0, 160.0), rng.uniform(-250.0, 250.0)
    top_mm = foot_mm * rng.uniform(0.25, 0.6)
    profile = trapezoid(middle_mm, top_mm, foot_mm, height_mm)
    slope_mm = 120.0
    y = np.linspace(-1500.0, 1500.0, 30_001)
    across = profile(y)
    held = np.cumsum(across) / across.sum()
    mean = float(across @ y / across.sum())
    # Along the travel a trapezoid too: the stretch that holds 95 % of it, and the profile as its mean.
    x = np.linspace(-half_length_mm, half_length_mm, 10_001)
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
