"""Projection, rays and the thirds in the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.core.blade import BladeGeometry
from graderd.hal.camera import Intrinsics
from graderd.perception import CameraCalibration
from graderd.perception.geometry import (
    CENTER,
    LEFT,
    RIGHT,
    View,
    blade_points_m,
    blade_region,
    face_setback_m,
    image_thirds,
    third_outlines_px,
)

CALIBRATION = CameraCalibration()
COLOR = View(CALIBRATION.color.intrinsics(), CALIBRATION.color.pose(CALIBRATION.mounting))


@pytest.mark.parametrize("coeffs", [(0.0, 0.0, 0.0, 0.0, 0.0), (-0.0557, 0.0603, -0.00098, -0.00085, -0.0161)])
def test_rays_and_projection_are_inverse(coeffs: tuple[float, float, float, float, float]) -> None:
    lens = Intrinsics(320, 200, 157.0, 157.0, 159.5, 99.5, coeffs)
    view = View(lens, COLOR.pose)
    rays = view.rays().astype(np.float64)
    points = view.position_m + rays.reshape(-1, 3) * 0.9
    pixels = view.project(points).reshape(200, 320, 2)
    u, v = np.meshgrid(np.arange(320), np.arange(200))
    assert np.abs(pixels - np.stack((u, v), axis=-1)).max() < 0.02


def test_projection_agrees_with_opencv() -> None:
    coeffs = (-0.05, 0.06, -0.001, -0.0008, -0.016)
    view = View(Intrinsics(1280, 800, 629.0, 628.0, 639.0, 398.0, coeffs), COLOR.pose)
    points = np.random.default_rng(1).uniform((-0.2, -0.5, 0.0), (0.3, 0.5, 0.3), (50, 3))
    camera = np.array([[629.0, 0, 639.0], [0, 628.0, 398.0], [0, 0, 1]])
    turn = view.rotation.T
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], -turn @ view.position_m, camera, np.array(coeffs))
    assert view.project(points) == pytest.approx(np.asarray(expected).reshape(-1, 2), abs=1e-6)


def test_a_point_behind_the_camera_is_nowhere() -> None:
    assert np.isnan(COLOR.project(np.array([[2.0, 0.0, 0.5]]))).all()


@given(angle=st.floats(-60, 60))
def test_left_is_the_operators_left(angle: float) -> None:
    left, center, right = third_outlines_px(COLOR, BladeGeometry(), angle)
    assert right[:, 0].mean() < center[:, 0].mean() < left[:, 0].mean()  # the camera faces the blade


@pytest.mark.parametrize("angle", [-60, -30, 0, 15, 45])
def test_thirds_share_the_region_without_overlap(angle: float) -> None:
    region = blade_region(COLOR, BladeGeometry(), angle, 2)
    assert region is not None
    total = np.sum([mask > 0 for mask in region.masks], axis=0)
    assert total.max() == 1
    assert np.array_equal(total > 0, region.blade > 0)
    assert region.areas_px[CENTER] > 1000


def test_no_region_where_the_blade_is_out_of_sight() -> None:
    away = CALIBRATION.color.model_copy(update={"yaw_deg": 180.0})
    assert blade_region(View(away.intrinsics(), away.pose(CALIBRATION.mounting)), BladeGeometry(), 0, 0) is None


def test_image_thirds_follow_the_mounting() -> None:
    facing, along = image_thirds(300, 90, 0, True), image_thirds(300, 90, 0, False)
    assert facing is not None
    assert along is not None
    assert facing.masks[LEFT][45, 290]
    assert along.masks[LEFT][45, 10]
    assert along.masks[RIGHT][45, 290]
    assert image_thirds(9, 5, 0, True) is None


def test_hollow_face_is_34_mm_deep() -> None:
    blade = BladeGeometry()
    middle = face_setback_m(blade, np.array([blade.bottom_z_m + blade.height_m / 2]))
    assert middle[0] == pytest.approx(0.0335, abs=1e-4)
    edges = face_setback_m(blade, np.array([blade.bottom_z_m, blade.bottom_z_m + blade.height_m]))
    assert edges == pytest.approx([0.0, 0.0], abs=1e-12)


def test_blade_turns_counter_clockwise() -> None:
    left_end = blade_points_m(BladeGeometry(), 30.0, np.array([0.5]), np.array([0.0]), np.array([0.0]))[0]
    assert left_end[0] < 0  # seen from above, the left end goes back
    assert left_end[1] > 0
