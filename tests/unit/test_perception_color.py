"""The paper's colour rule, to the letter and quick."""

from __future__ import annotations

import numpy as np
import pytest

from graderd.core.soil import Zone
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.color import (
    brightness_gain,
    coverage_percent,
    fast_color_verdict,
    halved,
    largest_contour,
    paper_steps,
    paper_verdict,
    soil_mask,
)
from graderd.perception.geometry import LEFT, RIGHT, View, blade_region, image_thirds
from graderd.perception.settings import ColorSettings
from harness.perception_scenes import Scene, render

SETTINGS = PerceptionSettings()
CALIBRATION = CameraCalibration()


@pytest.mark.parametrize("zone", [Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE])
def test_brown_soil_before_a_grey_blade(zone: Zone) -> None:
    scene = Scene(zone=zone, angle_deg=10.0, seed=2)
    frame = render(scene, color_size=(640, 400), depth_size=(53, 30))
    assert frame.color_intrinsics is not None
    view = View(frame.color_intrinsics, CALIBRATION.color.pose(CALIBRATION.mounting))
    full, fast = (blade_region(view, scene.blade, scene.angle_deg, n) for n in (0, 1))
    assert full is not None
    assert fast is not None
    assert paper_verdict(frame.color_bgr, full, SETTINGS.color, SETTINGS.decision).zone is zone
    assert fast_color_verdict(frame.color_bgr, fast, SETTINGS.color, SETTINGS.decision).zone is zone


def test_brightness_is_brought_to_the_target_within_its_limits() -> None:
    settings = ColorSettings()
    assert brightness_gain(45 * 2.55, settings) == pytest.approx(1.0)
    assert brightness_gain(1.0, settings) == 2.0
    assert brightness_gain(255.0, settings) == 0.5


def test_window_and_otsu_leave_the_soil() -> None:
    picture = np.full((60, 90, 3), (140, 135, 130), dtype=np.uint8)  # bluish grey
    picture[20:50, 60:85] = (45, 75, 110)  # brown: hue 14 of 180
    mask = soil_mask(picture, ColorSettings())
    assert mask[30, 70] == 255
    assert mask[5, 5] == 0
    narrow = ColorSettings(hue_window_percent=None, hue_window_deg=(0, 12))
    assert not soil_mask(picture, narrow).any()


def test_only_the_largest_contour_counts() -> None:
    mask = np.zeros((50, 90), dtype=np.uint8)
    mask[10:40, 10:40] = 255
    mask[10:15, 70:75] = 255
    shape = largest_contour(mask, 0.5)
    assert shape[20, 20] == 255
    assert shape[12, 72] == 0
    assert not largest_contour(np.zeros((5, 5), dtype=np.uint8), 0.5).any()


def test_coverage_is_of_each_thirds_own_area() -> None:
    region = image_thirds(300, 90, 0, True)
    assert region is not None
    mask = np.zeros((90, 300), dtype=np.uint8)
    mask[:45, 200:] = 255
    cover = coverage_percent(mask, region)
    assert cover[LEFT] == pytest.approx(50, abs=1.5)
    assert cover[RIGHT] == 0


def test_halving_is_the_exact_mean_of_two_by_two() -> None:
    image = np.random.default_rng(1).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    mean = image.reshape(4, 2, 6, 2, 3).mean(axis=(1, 3))
    assert np.abs(halved(image, 1).astype(float) - mean).max() <= 0.51


def test_steps_of_the_paper_can_be_shown() -> None:
    frame = render(Scene(zone=Zone.LEFT, seed=1), color_size=(160, 100), depth_size=(53, 30))
    filtered, mask, contour = paper_steps(frame.color_bgr, SETTINGS.color)
    assert filtered.shape == frame.color_bgr.shape
    assert mask.shape == contour.shape == frame.color_bgr.shape[:2]
    assert mask.any()
