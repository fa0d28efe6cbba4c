"""Every fault of the picture is named, and none becomes a zone."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from graderd.core.attitude import MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import SoilObservation, Zone
from graderd.hal.camera import Frame
from graderd.hal.settings import CameraSettings
from graderd.perception import METHODS, CameraCalibration, Method, PerceptionSettings
from graderd.perception.classifier import Classifier, make_classifier
from graderd.perception.health import CHECK_EVERY_N
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.world import World, scene_heights
from harness.perception_scenes import ON_GROUND, PoseError, Scene, render

pytestmark = pytest.mark.slow

ANGLE_DEG = 10.0


@functools.cache
def picture(pose: PoseError | None = None, number: int = 5, zone: Zone = Zone.LEFT) -> Frame:
    scene = Scene(zone=zone, angle_deg=ANGLE_DEG, seed=number, pose=pose or PoseError())
    return render(scene, color_size=(480, 300), depth_size=(424, 240), number=number)


def judge(frame: Frame, method: Method = "fused", **more: Any) -> SoilObservation:
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BladeGeometry(), **more)
    return classifier.classify(frame, ANGLE_DEG, 0.01)


def named(observation: SoilObservation) -> list[str]:
    if observation.faults:
        assert observation.zone is Zone.UNKNOWN
        assert observation.confidence == 0.0
    return [fault.condition for fault in observation.faults]


def spoiled(frame: Frame, how: str) -> Frame:
    color = frame.color_bgr
    rng = np.random.default_rng(4)
    if how == "black":
        return replace(frame, color_bgr=(color // 64).astype(np.uint8))
    if how == "blown_out":
        return replace(frame, color_bgr=np.maximum(color, 252).astype(np.uint8))
    if how == "blocked":
        cover = np.full_like(color, (26, 32, 40)) + rng.integers(0, 4, color.shape, dtype=np.uint8)
        return replace(frame, color_bgr=cover)
    if how == "blurred":
        soft = cv2.GaussianBlur(color, (0, 0), 6).astype(np.float64) + rng.normal(0, 2, color.shape)
        return replace(frame, color_bgr=np.clip(soft, 0, 255).astype(np.uint8))
    if how == "torn":
        return replace(frame, depth_number=frame.color_number - 3)
    if how == "wrong_resolution":
        return replace(frame, color_bgr=np.ascontiguousarray(color[::2, ::2]))
    assert frame.depth_mm is not None
    if how == "no depth":
        return replace(frame, depth_mm=None, depth_intrinsics=None, depth_number=-1)
    return replace(
        frame, depth_mm=np.where(rng.random(frame.depth_mm.shape) < 0.8, 0, frame.depth_mm).astype(np.uint16)
    )


def test_a_healthy_picture_has_no_fault() -> None:
    observation = judge(picture())
    assert named(observation) == []
    assert observation.zone is Zone.LEFT


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("how", ["black", "blown_out", "blocked", "blurred", "torn", "wrong_resolution"])
def test_faults_of_the_picture(how: str, method: Method) -> None:
    dark = method == "depth" and how in ("black", "blown_out")
    assert named(judge(spoiled(picture(), how), method)) == ([] if dark else [how])


@pytest.mark.parametrize("how", ["black", "blown_out"])
@pytest.mark.parametrize("zone", [Zone.LEFT, Zone.CENTER, Zone.NONE])
def test_depth_needs_no_light(how: str, zone: Zone) -> None:
    frame = picture(zone=zone)
    unlit = judge(spoiled(frame, how), "depth")
    assert unlit.zone is zone
    assert unlit.volume_left_l == judge(frame, "depth").volume_left_l


@pytest.mark.parametrize("how", ["blocked", "blurred"])
def test_a_colour_picture_that_depth_does_not_need_is_looked_at_three_times_a_second(how: str) -> None:
    classifier = make_classifier(PerceptionSettings(method="depth"), CameraCalibration(), BladeGeometry())
    good, bad = picture(), spoiled(picture(), how)
    said = []
    for number in range(2 * CHECK_EVERY_N + 1):
        still = bad if 1 <= number <= CHECK_EVERY_N else good
        color = still.color_bgr.copy()
        color[0, 0] = number  # or it would be frozen
        said.append(named(classifier.classify(replace(still, color_bgr=color), ANGLE_DEG, 0.0)))
    assert said == [[]] * CHECK_EVERY_N + [[how]] * CHECK_EVERY_N + [[]]


@pytest.mark.parametrize("how", ["no depth", "hardly any depth"])
@pytest.mark.parametrize("method", ["depth", "fused"])
def test_missing_depth_is_a_fault_where_depth_decides(how: str, method: Method) -> None:
    assert named(judge(spoiled(picture(), how), method)) == ["depth_missing"]
    assert named(judge(spoiled(picture(), how), "fast_color")) == []


def test_torn_by_device_times() -> None:
    frame = picture()
    metadata = {"color_device_s": 1.0, "depth_device_s": 1.034}
    assert named(judge(replace(frame, metadata=metadata))) == ["torn"]
    # Counters of two sensors need not agree where their clocks do.
    together = {"color_device_s": 1.0, "depth_device_s": 1.004}
    assert named(judge(replace(frame, metadata=together, depth_number=77))) == []


def test_the_same_picture_again_and_again_is_frozen_under_any_number() -> None:
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry())
    frame = picture()
    seen = [
        named(classifier.classify(replace(frame, color_number=n, depth_number=n), ANGLE_DEG, 0.0)) for n in range(1, 7)
    ]
    assert seen[:3] == [[], [], []]
    assert seen[3:] == [["frozen"]] * 3
    assert named(classifier.classify(picture(number=9), ANGLE_DEG, 0.0)) == []  # clears when gone


def test_equal_stills_are_not_frozen() -> None:
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry(), live=False)
    frame = picture()
    assert all(named(classifier.classify(frame, ANGLE_DEG, 0.0)) == [] for _ in range(6))


def test_another_size_than_asked_for() -> None:
    asked = CameraSettings(color_width_px=1280, color_height_px=800)
    assert named(judge(picture(), camera=asked)) == ["wrong_resolution"]


def test_a_size_that_changes_in_mid_stream() -> None:
    classifier = make_classifier(PerceptionSettings(method="fast_color"), None, BladeGeometry())
    one = picture().color_bgr
    frames = [Frame(one, None, None, None, 0.0), Frame(np.ascontiguousarray(one[::2, ::2]), None, None, None, 0.1)]
    assert [named(classifier.classify(frame, 0.0, 0.0)) for frame in frames] == [[], ["wrong_resolution"]]


@pytest.mark.parametrize(
    "pose",
    [
        PoseError(pitch_deg=5.0),
        PoseError(pitch_deg=-5.0),
        PoseError(roll_deg=5.0),
        PoseError(yaw_deg=6.0),
        PoseError(z_m=0.08),
        PoseError(x_m=0.12),
        PoseError(y_m=0.12),
        PoseError(x_m=0.02, y_m=0.03, pitch_deg=-4.0, yaw_deg=-3.0, roll_deg=2.0),
    ],
)
def test_a_knocked_camera(pose: PoseError) -> None:
    assert named(judge(picture(pose))) == ["knocked"]


def test_a_blade_turned_about_its_axis_is_no_knocked_camera() -> None:
    """Judged at an angle 8 degrees off: the axis, which cannot move, is where it was."""
    frame = picture()
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry())
    assert named(classifier.classify(frame, ANGLE_DEG + 8.0, 0.01)) == ["blade_elsewhere"]


@pytest.mark.parametrize("zone", [Zone.NONE, Zone.CENTER])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_mount_that_gives_a_little_is_not_knocked(zone: Zone, sign: int) -> None:
    pose = PoseError(sign * 0.02, -sign * 0.02, sign * 0.02, sign * 2.0, sign * 2.0, -sign * 2.0)
    observation = judge(picture(pose, zone=zone))
    assert named(observation) == []
    assert observation.zone is zone


@pytest.mark.parametrize("method", ["paper", "fast_color"])
def test_a_knocked_camera_under_a_colour_method(method: Method) -> None:
    """The blade is looked for in the depth picture now and then, although the method does not use it."""
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BladeGeometry())
    assert stream(classifier, PoseError(), 12) == []
    assert stream(classifier, PoseError(y_m=0.12), 12) == ["knocked"]
    assert stream(classifier, PoseError(), 12) == []  # clears when it is back


def stream(classifier: Classifier, pose: PoseError, count: int) -> list[str]:
    """What the last of ``count`` live frames from this camera pose is said to lack."""
    still = picture(pose)
    said: list[str] = []
    for number in range(count):
        color = still.color_bgr.copy()
        color[number % 8 :: 8, number % 16 :: 16] ^= 1  # or it would be frozen
        said = named(classifier.classify(replace(still, color_bgr=color), ANGLE_DEG, 0.0))
    return said


def test_soil_heaped_against_the_face_is_not_taken_for_the_face() -> None:
    """Driving through an even layer at 45 degrees casts soil aside until it hides the trailing end of the blade."""
    angle_deg, world = 45.0, World()
    pose = BladePose(angle_deg=angle_deg)
    world.lay(scene_heights(SceneZone.EVEN, world.vehicle.x_m, BladePose(), 1))
    world.vehicle.drive(0.6, 2.4)
    for _ in range(450):
        world.step(0.01, pose)
    left_l, _, right_l = world.volumes_l()
    assert left_l > 1.7 * right_l
    renderer = Renderer((640, 400), (424, 240), seed=3)
    seen = SceneState(world.field.heights_m.astype(np.float32), world.field.cell_m, world.vehicle.x_m, pose)
    color, depth = renderer.render(seen, Appearance())
    frame = Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0)
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry(), live=False)
    observation = classifier.classify(frame, angle_deg, 0.01, ON_GROUND)
    assert named(observation) == []
    assert observation.volume_left_l == pytest.approx(left_l, rel=0.15)
    # What is cut and a layer of soil look the same: where no lift tells which, nobody knows.
    assert classifier.classify(frame, angle_deg, 0.01).zone is Zone.UNKNOWN


@pytest.mark.parametrize("angle_deg", [0.0, 45.0])
@pytest.mark.parametrize("slope_deg", [-4.0, -2.0, 2.0, 4.0])
def test_lifts_whose_sides_are_swapped_are_found_by_the_slope_of_the_edge(slope_deg: float, angle_deg: float) -> None:
    """The lifts said +2 degrees of a blade at -2, and nothing contradicted them."""
    world, pose = World(), BladePose(angle_deg=angle_deg, slope_deg=slope_deg, height_m=0.04)
    world.lay(scene_heights(SceneZone.EVEN, world.vehicle.x_m, BladePose(), 1))
    world.vehicle.drive(0.6, 1.2)
    for _ in range(150):
        world.step(0.01, pose)
    renderer = Renderer((640, 400), (424, 240), seed=3)
    seen = SceneState(world.field.heights_m.astype(np.float32), world.field.cell_m, world.vehicle.x_m, pose)
    color, depth = renderer.render(seen, Appearance())
    frame = Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0)
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry(), live=False)

    def told(slope_deg: float | None) -> SoilObservation:
        return classifier.classify(frame, angle_deg, 0.01, MeasuredAttitude(40.0, slope_deg, 0.0))

    assert named(told(slope_deg)) == []
    assert named(told(None)) == []
    swapped = told(-slope_deg)
    assert named(swapped) == ["blade_elsewhere"]
    assert "sides swapped" in swapped.faults[0].detail


def test_an_old_blade_angle_is_unknown_without_a_fault_of_the_picture() -> None:
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry())
    observation = classifier.classify(picture(), ANGLE_DEG, 0.6)
    assert observation.zone is Zone.UNKNOWN
    assert observation.faults == ()
    assert "0.60 s old" in observation.reason
    assert observation.blade_angle_age_s == 0.6
