"""Ground that is no level plane, and what the measured lifts say about it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import SoilObservation, Zone
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.classifier import make_classifier
from graderd.perception.geometry import F64, View
from graderd.perception.ground import Ground, GroundFit
from harness.perception_scenes import CELL_M, ON_GROUND, X0, Y0, Scene, render

Shape = Callable[[F64, F64], F64]


def waves(rms_m: float, seed: int) -> Shape:
    """Undulating ground, some 0.5 m from crest to crest."""
    field = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(400, 400)), (0, 0), 12)
    field *= rms_m / field.std()

    def height(x: F64, y: F64) -> F64:
        i, j = ((x - X0) / CELL_M).astype(int), ((y - Y0) / CELL_M).astype(int)
        return np.asarray(field[i, j], dtype=np.float64)

    return height


def bowl(x: F64, y: F64) -> F64:
    """20 mm deep over 0.6 m, and on like that."""
    return np.asarray(0.020 / 0.36 * (x**2 + y**2), dtype=np.float64)


def crown(_x: F64, y: F64) -> F64:
    """A road's crown of 5 %."""
    return np.asarray(-0.05 * np.abs(y), dtype=np.float64)


def grass(x: F64, y: F64) -> F64:
    """Tufts up to 20 mm high, some 4 cm apart."""
    field = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(400, 400)), (0, 0), 2)
    field = 0.020 * np.clip(0.5 + field / field.std() / 3.0, 0.0, 1.0)
    i, j = ((x - X0) / CELL_M).astype(int), ((y - Y0) / CELL_M).astype(int)
    return np.asarray(field[i, j], dtype=np.float64)


GROUNDS: dict[str, Shape] = {
    "bowl": bowl,
    "crown": crown,
    "grass": grass,
    "waves 8 mm": waves(0.008, 1),
    "waves 15 mm": waves(0.015, 2),
    "12 % up": lambda x, _y: 0.12 * x,
    "12 % down": lambda x, _y: -0.12 * x,
    "12 % to the left": lambda _x, y: -0.12 * y,
    "12 % to the right": lambda _x, y: 0.12 * y,
}


def judged(scene: Scene, attitude: MeasuredAttitude = ON_GROUND) -> SoilObservation:
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry(), live=False)
    # Depth decides: a black colour picture is no matter.
    frame = render(scene, color_size=(32, 20), depth_size=(424, 240))
    return classifier.classify(frame, scene.angle_deg, 0.0, attitude)


@pytest.mark.parametrize("name", GROUNDS)
def test_bare_ground_is_no_soil_and_no_fault(name: str) -> None:
    observation = judged(Scene(angle_deg=15.0, seed=3, ground=GROUNDS[name], noise_px=0.15))
    assert observation.zone in (Zone.NONE, Zone.UNKNOWN), observation.reason
    assert observation.faults == ()


@pytest.mark.parametrize("name", GROUNDS)
def test_a_heap_that_stands_out_is_answered(name: str) -> None:
    zone = Zone.LEFT if name in ("bowl", "waves 15 mm", "12 % up", "12 % to the left") else Zone.RIGHT
    observation = judged(Scene(zone=zone, angle_deg=15.0, seed=4, ground=GROUNDS[name], noise_px=0.15))
    assert observation.zone is zone, observation.reason


@pytest.mark.parametrize("depth_m", [0.02, 0.03])
def test_the_measured_lifts_tell_cut_ground_from_a_layer(depth_m: float) -> None:
    scene = Scene(angle_deg=15.0, seed=3, ground=lambda x, _y: np.full_like(x, depth_m))
    cutting = MeasuredAttitude(2.0 - depth_m * 1000, 0.0, 0.0)
    assert judged(scene, cutting).zone is Zone.NONE
    assert judged(scene, ON_GROUND).zone is Zone.EVEN
    unmeasured = judged(scene, UNMEASURED)
    assert unmeasured.zone is Zone.UNKNOWN
    assert "in the ground" in unmeasured.reason


@pytest.mark.parametrize("height_mm", [20.0, 40.0])
def test_a_blade_that_its_lifts_raised_is_no_fault(height_mm: float) -> None:
    scene = Scene(zone=Zone.LEFT, seed=3, blade=BladeGeometry(bottom_z_m=height_mm / 1000))
    observation = judged(scene, MeasuredAttitude(height_mm, 0.0, 0.0))
    assert observation.faults == ()
    assert observation.zone is Zone.LEFT


@pytest.mark.parametrize("layer_m", [0.025, 0.045])
def test_a_layer_before_a_blade_whose_edge_is_lifted_out_of_sight_is_unknown_and_no_fault(layer_m: float) -> None:
    scene = Scene(
        angle_deg=15.0,
        seed=3,
        blade=BladeGeometry(bottom_z_m=0.12),
        ground=lambda x, y: np.where(np.abs(y) < 0.7, layer_m, 0.0) + 0.0 * x,
    )
    observation = judged(scene, MeasuredAttitude(120.0, 0.0, 0.0))
    assert observation.faults == ()
    assert observation.zone is Zone.UNKNOWN
    assert "lower the blade" in observation.reason


def test_the_surface_is_found_to_the_millimetre() -> None:
    rng = np.random.default_rng(1)
    x, y = (rng.uniform(*span, 20_000).astype(np.float32) for span in ((-1.0, 0.8), (-1.0, 1.0)))
    true = Ground(0.01, 0.05, -0.02, 0.05, 0.0, 0.04)
    z = (true.height_at(x.astype(np.float64), y.astype(np.float64)) + rng.normal(0, 0.002, x.size)).astype(np.float32)
    view = View(CameraCalibration().depth.intrinsics(), CameraCalibration().depth.pose("facing_blade_from_front"))
    found = GroundFit(BladeGeometry(), view.position_m, 0.055, 8.0).fit(np.stack((x, y, z)), 0.0)
    at = np.array([0.0, 0.2, 0.3]), np.array([0.0, -0.3, 0.4])
    assert found.height_at(*at) == pytest.approx(true.height_at(*at), abs=0.002)
    assert 0.001 < found.residual_m < 0.005
