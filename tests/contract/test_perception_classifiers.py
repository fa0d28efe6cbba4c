"""One conformance suite for all four classifiers."""

from __future__ import annotations

import functools
import json
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import Frame, Intrinsics
from graderd.perception import METHODS, CameraCalibration, Method, PerceptionSettings
from graderd.perception.classifier import make_classifier
from graderd.runtime.app.perception_child import no_wider
from harness.perception_scenes import Scene, render

PILES = [Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE]


@functools.cache
def picture(zone: Zone, angle_deg: float = -15.0) -> Frame:
    return render(Scene(zone=zone, angle_deg=angle_deg, seed=6), color_size=(480, 300), depth_size=(424, 240))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("zone", PILES)
def test_zone_and_form_of_the_observation(method: Method, zone: Zone) -> None:
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BladeGeometry())
    frame = picture(zone)
    said = classifier.classify(frame, -15.0, 0.02)
    assert said.zone is zone
    assert said.method == method
    assert said.blade_angle_deg == -15.0
    assert said.blade_angle_age_s == 0.02
    assert said.capture_s == frame.capture_s
    assert said.frame_number == frame.color_number
    assert 0.0 < said.confidence <= 1.0
    assert said.reason
    assert said.cpu_ms > 0
    shares = said.share_left + said.share_center + said.share_right
    assert shares == pytest.approx(0.0 if zone is Zone.NONE else 1.0)
    has_volumes = said.volume_left_l is not None
    assert has_volumes == (method in ("depth", "fused"))
    json.dumps(asdict(said), allow_nan=False)


@pytest.mark.parametrize("method", METHODS)
def test_the_thirds_turn_with_the_blade(method: Method) -> None:
    """One pile on the axis of travel's left is left of a square blade and ahead of the middle of a turned one."""
    frame = picture(Zone.LEFT, 45.0)
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BladeGeometry())
    assert classifier.classify(frame, 45.0, 0.0).zone is Zone.LEFT
    # The same picture judged at a wrong angle: the thirds lie elsewhere, so the shares do too.
    elsewhere = classifier.classify(frame, 0.0, 0.0)
    assert elsewhere.zone is Zone.UNKNOWN or elsewhere.share_left < 0.9


@pytest.mark.parametrize("method", METHODS)
def test_annotation_leaves_the_frame_alone(method: Method) -> None:
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BladeGeometry())
    frame = picture(Zone.RIGHT)
    before = frame.color_bgr.copy()
    drawn = classifier.annotate(frame, classifier.classify(frame, -15.0, 0.0))
    assert drawn.shape == before.shape
    assert np.array_equal(frame.color_bgr, before)
    assert not np.array_equal(drawn, before)


def test_a_smaller_picture_has_its_thirds_in_the_same_places_and_no_text() -> None:
    """The lens that a frame comes with is of its own size: drawn by the large one's, lines would lie elsewhere."""
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry())
    frame = picture(Zone.RIGHT)
    frame = replace(frame, color_intrinsics=Intrinsics(480, 300, 235.9, 235.9, 239.5, 149.5))
    said = classifier.classify(frame, -15.0, 0.0)
    blank = replace(frame, color_bgr=np.zeros_like(frame.color_bgr))
    large = classifier.annotate(blank, said, labels=False)
    small = classifier.annotate(no_wider(blank, 240), said, labels=False)
    assert small.shape == (150, 240, 3)
    lines = [
        np.asarray(cv2.resize(drawn, (120, 75), interpolation=cv2.INTER_AREA)).max(axis=2) > 12
        for drawn in (large, small)
    ]
    assert lines[0].any()
    assert (lines[0] & lines[1]).sum() > 0.85 * (lines[0] | lines[1]).sum()
    assert not np.array_equal(large, classifier.annotate(blank, said))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [(1, 1), (7, 3), (33, 9), (400, 640), (3000, 200)])
def test_any_picture_is_answered_and_none_raises(method: Method, size: tuple[int, int]) -> None:
    color = np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8)
    for calibration in (None, CameraCalibration()):
        classifier = make_classifier(PerceptionSettings(method=method), calibration, BladeGeometry())
        frame = Frame(color, None, None, None, 1.0)
        said = classifier.classify(frame, 0.0, 0.0)
        assert said.zone in Zone
        classifier.annotate(frame, said)


def test_without_a_calibration_the_pictures_own_thirds_count_and_it_says_so() -> None:
    color = np.full((300, 600, 3), (140, 135, 130), dtype=np.uint8)
    color += np.random.default_rng(1).integers(0, 20, color.shape, dtype=np.uint8)
    color[100:, 420:] = (45, 75, 110)  # brown, at the picture's right
    frame = Frame(color, None, None, None, 0.0)
    for method in ("paper", "fast_color"):
        settings = PerceptionSettings(method="paper" if method == "paper" else "fast_color")
        facing = make_classifier(settings, None, BladeGeometry(), live=False).classify(frame, 0.0, 0.0)
        assert facing.zone is Zone.LEFT
        assert "its right taken as the operator's left" in facing.reason
        along = make_classifier(settings, None, BladeGeometry(), live=False, mounting="facing_blade_from_behind")
        assert along.classify(frame, 0.0, 0.0).zone is Zone.RIGHT
    blind = make_classifier(PerceptionSettings(method="depth"), None, BladeGeometry()).classify(frame, 0.0, 0.0)
    assert blind.zone is Zone.UNKNOWN
