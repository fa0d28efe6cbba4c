"""Settings of perception: the hue window's unit, and poses in words against rotation matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graderd.core.soil import Mounting
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.settings import ColorSettings, angles_from_rotation, rotation_from_angles


@pytest.mark.parametrize(
    ("window", "hue"),
    [
        ({"hue_window_percent": (0, 12)}, (0, 21)),
        ({"hue_window_percent": None, "hue_window_deg": (0, 12)}, (0, 6)),
        ({"hue_window_percent": None, "hue_window_half_deg": (0, 12)}, (0, 12)),
    ],
)
def test_three_readings_of_the_papers_window(window: dict[str, object], hue: tuple[int, int]) -> None:
    low, high = ColorSettings.model_validate(window).opencv_window()
    assert (low[0], high[0]) == hue
    assert low[1:] == (0, 0)
    assert high[1:] == (255, 255)


@pytest.mark.parametrize("window", [{"hue_window_deg": (0, 43)}, {"hue_window_percent": None}])
def test_exactly_one_reading_is_set(window: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match="exactly one"):
        ColorSettings.model_validate(window)


def test_a_window_runs_upwards() -> None:
    with pytest.raises(ValidationError, match="from low to high"):
        ColorSettings(hue_window_percent=(12, 0))


def test_unknown_keys_are_errors() -> None:
    with pytest.raises(ValidationError, match="extra"):
        PerceptionSettings.model_validate({"methode": "paper"})


@pytest.mark.parametrize("mounting", ["facing_blade_from_front", "facing_blade_from_behind"])
@given(pitch=st.floats(-80, 80), yaw=st.floats(-170, 170), roll=st.floats(-170, 170))
def test_pose_in_words_and_back(mounting: Mounting, pitch: float, yaw: float, roll: float) -> None:
    rotation = rotation_from_angles(mounting, pitch, yaw, roll)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert angles_from_rotation(mounting, rotation) == pytest.approx((pitch, yaw, roll), abs=1e-6)


def test_nominal_pose_looks_back_at_the_blade() -> None:
    calibration = CameraCalibration()
    rotation = np.asarray(calibration.color.pose(calibration.mounting).rotation)
    right, _, ahead = rotation.T
    assert ahead[0] < -0.8  # along the machine, backwards
    assert ahead[2] == pytest.approx(-np.sin(np.radians(35.0)))
    assert right == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)  # the picture's right is the operator's left
