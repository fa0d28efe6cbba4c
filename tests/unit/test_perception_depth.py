"""Litres per third from depth pictures whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from graderd.core.soil import Zone
from graderd.hal.camera import DepthImage
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.depth import DepthJudge, HeightMap
from graderd.perception.geometry import LEFT, RIGHT, View
from graderd.perception.registration import Stance
from harness.perception_scenes import PoseError, Scene, height_field, render, volumes_l

SETTINGS = PerceptionSettings()
CALIBRATION = CameraCalibration()
ERRORS = [
    PoseError(),
    PoseError(z_m=0.02, pitch_deg=2.0),
    PoseError(z_m=-0.02, pitch_deg=-2.0),
    PoseError(0.02, -0.02, 0.02, -2.0, 2.0, -2.0),
    PoseError(-0.02, 0.02, -0.02, 2.0, -2.0, 2.0),
]


def judge_of(scene: Scene, spoil: float = 0.0) -> tuple[DepthJudge, DepthImage]:
    frame = render(scene, color_size=(32, 20))
    assert frame.depth_mm is not None
    assert frame.depth_intrinsics is not None
    depth = frame.depth_mm
    if spoil:
        depth[np.random.default_rng(scene.seed).random(depth.shape) < spoil] = 0
    view = View(frame.depth_intrinsics, CALIBRATION.depth.pose(CALIBRATION.mounting))
    return DepthJudge(view, scene.blade, SETTINGS.depth, SETTINGS.decision), depth


def measure(scene: Scene, spoil: float = 0.0) -> tuple[Zone, HeightMap]:
    judge, depth = judge_of(scene, spoil)
    soil = judge.height_map(depth, Stance(scene.angle_deg))
    return judge.verdict(soil).zone, soil


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("zone", [Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE])
def test_zone_and_litres_in_spite_of_pose_errors(zone: Zone, error: PoseError) -> None:
    scene = Scene(zone=zone, angle_deg=(15.0 if zone is Zone.CENTER else -20.0), seed=3, pose=error)
    found, soil = measure(scene)
    assert found is zone
    left, center, right = volumes_l(scene, height_field(scene))
    for measured, true in zip(soil.volumes_l, (right, center, left), strict=True):
        assert measured == pytest.approx(true, abs=1.2 + 0.15 * true)


@pytest.mark.parametrize("angle", [-55, -30, 30, 55])
@pytest.mark.parametrize("zone", [Zone.LEFT, Zone.RIGHT])
def test_sides_over_the_whole_range_of_angles(zone: Zone, angle: float) -> None:
    assert measure(Scene(zone=zone, angle_deg=angle, seed=5))[0] is zone


def test_ground_of_a_displaced_camera_is_found() -> None:
    soil = measure(Scene(pose=PoseError(z_m=0.02, pitch_deg=1.5)))[1]
    # A camera that is higher and looks further down than calibrated puts level ground where this plane says.
    assert soil.ground.support > 0.9
    assert 1.2 < soil.ground.slope_deg() < 1.8
    assert soil.ground.residual_m < 0.005


def test_blade_is_found_where_it_really_is() -> None:
    soil = measure(Scene(angle_deg=20, pose=PoseError(y_m=0.02)))[1]
    assert soil.blade.ahead_m == pytest.approx(-0.02 * np.sin(np.radians(20)), abs=0.006)
    assert soil.blade.along_m == pytest.approx(-0.02 * np.cos(np.radians(20)), abs=0.010)


def test_half_of_the_pixels_missing_changes_nothing() -> None:
    assert measure(Scene(zone=Zone.LEFT, seed=1), spoil=0.5)[0] is Zone.LEFT
    assert measure(Scene(zone=Zone.NONE, seed=1), spoil=0.5)[0] is Zone.NONE


def test_too_little_depth_on_one_third_is_unknown() -> None:
    judge, depth = judge_of(Scene(zone=Zone.LEFT, seed=1))
    depth[:, : depth.shape[1] // 2] = 0  # the machine's right
    verdict = judge.verdict(judge.height_map(depth, Stance(0.0)))
    assert verdict.zone is Zone.UNKNOWN
    assert "has depth" in verdict.reason


def test_an_empty_picture_is_unknown() -> None:
    judge, depth = judge_of(Scene())
    assert judge.verdict(judge.height_map(np.zeros_like(depth), Stance(0.0))).zone is Zone.UNKNOWN


def test_more_noise_invents_no_soil() -> None:
    assert measure(Scene(noise_px=0.3, seed=2))[0] is Zone.NONE


def test_mirrored_soil_gives_mirrored_litres() -> None:
    left = measure(Scene(zone=Zone.LEFT, seed=4, holes=0.0, noise_px=0.0))[1]
    assert left.volumes_l[LEFT] > 10 * max(left.volumes_l[RIGHT], 0.1)


def test_same_picture_same_answer() -> None:
    judge, depth = judge_of(Scene(zone=Zone.CENTER, seed=9))
    assert judge.height_map(depth, Stance(10.0)).volumes_l == judge.height_map(depth, Stance(10.0)).volumes_l


def blobs(shape: tuple[int, int], share: float, size_px: float) -> np.ndarray:
    field = cv2.GaussianBlur(np.random.default_rng(3).normal(size=shape), (0, 0), size_px)
    return np.asarray(field > np.quantile(field, 1 - share))


def spoilt(depth: DepthImage, how: str) -> DepthImage:
    rng = np.random.default_rng(5)
    z = depth.astype(np.float64)
    if how == "flare":
        z[:, z.shape[1] // 3 : 2 * z.shape[1] // 3] = 0
    elif how == "mud":
        z[blobs(depth.shape, 0.35, 25)] = 0
    elif how == "dust":
        near = cv2.GaussianBlur(rng.normal(size=z.shape), (0, 0), 6)
        cloud = blobs(depth.shape, 0.5, 20)
        z[cloud] = np.minimum(z, 700 + 80 * near / near.std())[cloud]
    else:
        for _ in range(12):
            drop = np.zeros(depth.shape, np.uint8)
            at = (int(rng.integers(depth.shape[1])), int(rng.integers(depth.shape[0])))
            cv2.circle(drop, at, int(rng.integers(8, 22)), 1, -1)
            z = np.where(drop > 0, z * rng.uniform(0.85, 1.1) + rng.normal(0, 30, z.shape), z)
    return np.clip(z, 0, 65535).astype(np.uint16)


@pytest.mark.parametrize("how", ["dust", "flare", "drops", "mud"])
@pytest.mark.parametrize("zone", [Zone.NONE, Zone.LEFT, Zone.RIGHT])
def test_dust_flare_drops_and_mud_make_no_other_answer(how: str, zone: Zone) -> None:
    judge, depth = judge_of(Scene(zone=zone, seed=6, noise_px=0.2))
    verdict = judge.verdict(judge.height_map(spoilt(depth, how), Stance(0.0)))
    assert verdict.zone in (zone, Zone.UNKNOWN), verdict.reason
