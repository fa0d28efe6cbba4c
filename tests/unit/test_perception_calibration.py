"""Camera pose and blade geometry from frames of the empty blade."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from graderd.core.attitude import MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import Frame
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.annotate import calibration_picture
from graderd.perception.calibration import (
    GEOMETRY,
    POSE,
    CalibrationError,
    CalibrationResult,
    EmptyBlade,
    calibrate,
    with_pose,
)
from graderd.perception.classifier import make_classifier
from graderd.perception.settings import StreamCalibration
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.optics import knocked
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.soil import SoilField
from harness.empty_blades import empty_blades
from harness.perception_scenes import ON_GROUND, Scene, render

pytestmark = pytest.mark.slow

NOMINAL = CameraCalibration()
POSE_HERE = {
    "position_x_m": 0.84,
    "position_y_m": 0.0,
    "position_z_m": 0.58,
    "pitch_down_deg": 37.0,
    "yaw_deg": 2.0,
    "roll_deg": -1.5,
}
TRUE = with_pose(NOMINAL, POSE_HERE)
ANGLES_DEG = (-40.0, -15.0, 10.0, 40.0)


@functools.cache
def view(angle_deg: float) -> EmptyBlade:
    scene = Scene(angle_deg=angle_deg, seed=int(angle_deg) + 50, blade=BladeGeometry(length_m=1.015))
    return EmptyBlade(render(scene, TRUE, color_size=(640, 400), depth_size=(424, 240)), angle_deg)


@functools.cache
def solved() -> CalibrationResult:
    return calibrate([view(angle) for angle in ANGLES_DEG], NOMINAL, BladeGeometry(), "now")


def test_the_depth_stream_moves_along_with_the_colour_stream() -> None:
    for stream in (NOMINAL, TRUE):
        color, depth = stream.color.pose(stream.mounting), stream.depth.pose(stream.mounting)
        turn = np.asarray(color.rotation).T @ np.asarray(depth.rotation)
        offset = np.asarray(color.rotation).T @ (np.asarray(depth.position_m) - np.asarray(color.position_m))
        assert turn == pytest.approx(np.eye(3), abs=1e-9)
        assert offset == pytest.approx([-0.059, 0, 0], abs=1e-6)


def test_pose_and_blade_are_found() -> None:
    result = solved()
    for name in POSE:
        limit = 0.15 if name.endswith("_deg") else 0.003
        assert getattr(result.calibration.color, name) == pytest.approx(POSE_HERE[name], abs=limit), name
    assert result.blade.length_m == pytest.approx(1.015, abs=0.005)
    assert result.blade.height_m == pytest.approx(0.25, abs=0.005)
    assert result.blade.x_offset_m == pytest.approx(0.0, abs=0.004)


def test_it_says_how_well_it_fits_and_how_sure_it_is() -> None:
    result = solved()
    assert result.residual_mm is not None
    assert 0.3 < result.residual_mm < 4.0
    assert result.residual_px is not None
    assert result.residual_px < 3.0
    assert result.frames_n == len(ANGLES_DEG)
    assert set(result.uncertainty) == {*POSE, *GEOMETRY}
    assert 0 < result.uncertainty["position_z_m"] < 0.005
    assert result.calibration.calibrated_at == "now"
    assert result.calibration.residual_mm == pytest.approx(result.residual_mm, abs=1e-3)


def test_a_calibrated_start_stays_where_it_is() -> None:
    again = calibrate([view(angle) for angle in ANGLES_DEG], solved().calibration, solved().blade)
    for name in POSE:
        assert getattr(again.calibration.color, name) == pytest.approx(
            getattr(solved().calibration.color, name), abs=0.05 if name.endswith("_deg") else 0.001
        )


def rig_view(angle_deg: float) -> EmptyBlade:
    """The rig's picture: its steel has real edges, which colour alone needs."""
    color_pose, depth_pose = knocked((0.015, -0.02, 0.02), (1.5, -2.0, 1.0))
    renderer = Renderer((1280, 800), None, seed=5, color_pose=color_pose, depth_pose=depth_pose)
    field = SoilField()
    state = SceneState(field.heights_m.astype(np.float32), field.cell_m, 2.0, BladePose(angle_deg))
    picture, _ = renderer.render(state, Appearance(ground="earth"))
    return EmptyBlade(Frame(picture, None, renderer.color_intrinsics, None, 0.0), angle_deg)


def test_colour_alone_finds_the_pose_from_near_by() -> None:
    true = StreamCalibration.from_pose(
        NOMINAL.color.intrinsics(), knocked((0.015, -0.02, 0.02), (1.5, -2.0, 1.0))[0], NOMINAL.mounting
    )
    near = {name: float(getattr(true, name)) for name in POSE}
    near["position_z_m"] += 0.005
    near["pitch_down_deg"] -= 0.5
    result = calibrate([rig_view(angle) for angle in (-40.0, 0.0, 40.0)], with_pose(NOMINAL, near), BladeGeometry())
    assert result.residual_mm is None
    assert result.residual_px is not None
    assert result.residual_px < 1.0
    for name in POSE:
        limit = 0.3 if name.endswith("_deg") else 0.006
        assert getattr(result.calibration.color, name) == pytest.approx(getattr(true, name), abs=limit), name


def test_too_few_frames() -> None:
    with pytest.raises(CalibrationError, match="at least 3"):
        calibrate([view(10.0), view(40.0)], NOMINAL, BladeGeometry())


def test_angles_too_close_together() -> None:
    close = [EmptyBlade(view(10.0).frame, angle) for angle in (8.0, 10.0, 12.0)]
    with pytest.raises(CalibrationError, match="span"):
        calibrate(close, NOMINAL, BladeGeometry())


def test_wrong_angles_do_not_fit() -> None:
    mixed = [
        EmptyBlade(view(angle).frame, wrong)
        for angle, wrong in zip(ANGLES_DEG, (40.0, 10.0, -15.0, -40.0), strict=True)
    ]
    with pytest.raises(CalibrationError):
        calibrate(mixed, NOMINAL, BladeGeometry())


def test_no_blade_in_the_picture() -> None:
    blind = [
        EmptyBlade(replace(view(angle).frame, depth_mm=np.zeros((240, 424), dtype=np.uint16)), angle)
        for angle in ANGLES_DEG
    ]
    with pytest.raises(CalibrationError):
        calibrate(blind, with_pose(NOMINAL, {"yaw_deg": 120.0}), BladeGeometry())


def test_picture_of_the_result() -> None:
    frame = view(10.0).frame
    picture = calibration_picture(frame.color_bgr, solved(), 10.0)
    assert picture.shape == frame.color_bgr.shape
    assert not np.array_equal(picture, frame.color_bgr)


def test_a_bed_that_would_not_be_found_empty_is_refused() -> None:
    """Soil before the blade in one of the frames."""
    spoilt = Scene(zone=Zone.LEFT, angle_deg=0.0, seed=3, blade=BladeGeometry(length_m=1.015))
    views = [view(angle) for angle in ANGLES_DEG]
    views.append(EmptyBlade(render(spoilt, TRUE, color_size=(640, 400), depth_size=(424, 240)), 0.0))
    with pytest.raises(CalibrationError, match=r"empty bed at \+0\.0 deg would not be found empty: left"):
        calibrate(views, NOMINAL, BladeGeometry())


@pytest.mark.parametrize("up_mm", [10.0, 50.0])
@pytest.mark.parametrize("measured", [True, False])
def test_a_raised_blade_does_not_become_a_taller_one(up_mm: float, measured: bool) -> None:
    raised = BladeGeometry(bottom_z_m=up_mm / 1000)
    attitude = MeasuredAttitude(up_mm, 0.0, 0.0) if measured else MeasuredAttitude()
    views = []
    for angle in (-40.0, 0.0, 40.0):
        scene = Scene(angle_deg=angle, seed=int(angle) + 50, blade=raised)
        frame = render(scene, NOMINAL, color_size=(640, 400), depth_size=(424, 240))
        views.append(EmptyBlade(frame, angle, attitude))
    assert calibrate(views, NOMINAL, BladeGeometry()).blade.height_m == pytest.approx(0.25, abs=0.005)


def test_a_leaning_blade_becomes_no_lower_one_and_its_bed_is_empty() -> None:
    """Of all of ``benchmarks/calibration.py`` the one whose height comes out worst."""
    views = empty_blades(up_mm=0.0, lean_deg=10.0)
    found = calibrate(views, NOMINAL, BladeGeometry())
    assert found.blade.height_m == pytest.approx(0.25, abs=0.005)
    judge = make_classifier(PerceptionSettings(), found.calibration, found.blade, live=False)
    assert judge.classify(views[2].frame, views[2].blade_angle_deg, 0.0, views[2].attitude).zone is Zone.NONE


def test_a_blade_far_off_its_drawing_is_refused() -> None:
    """The lifts say that it stands on the ground, and it hangs 40 mm above."""
    raised = BladeGeometry(bottom_z_m=0.04)
    views = []
    for angle in (-40.0, 0.0, 40.0):
        scene = Scene(angle_deg=angle, seed=int(angle) + 50, blade=raised)
        frame = render(scene, NOMINAL, color_size=(640, 400), depth_size=(424, 240))
        views.append(EmptyBlade(frame, angle, ON_GROUND))
    with pytest.raises(CalibrationError, match=r"comes out as .* mm off the .* configured"):
        calibrate(views, NOMINAL, BladeGeometry())
