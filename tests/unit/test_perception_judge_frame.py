"""No frame older than allowed is ever used."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.soil import SoilObservation, Zone
from graderd.hal.camera import Frame
from graderd.perception.classifier import NEVER_S, judge_frame
from graderd.perception.geometry import U8
from graderd.perception.settings import DecisionSettings

SETTINGS = DecisionSettings()


class Always:
    """A classifier that answers left and keeps the ages it was asked with."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def classify(
        self,
        frame: Frame,
        blade_angle_deg: float,
        blade_angle_age_s: float,
        attitude: MeasuredAttitude = UNMEASURED,
    ) -> SoilObservation:
        self.asked.append(blade_angle_age_s)
        return SoilObservation(frame.capture_s, Zone.LEFT, 1.0, "", blade_angle_age_s=blade_angle_age_s)

    def annotate(self, frame: Frame, observation: SoilObservation, *, labels: bool = True) -> U8:
        return frame.color_bgr


def frame(capture_s: float) -> Frame:
    return Frame(np.zeros((4, 4, 3), dtype=np.uint8), None, None, None, capture_s, 7)


@given(age_s=st.floats(0, 5))
def test_an_old_frame_is_never_judged(age_s: float) -> None:
    classifier = Always()
    said = judge_frame(classifier, frame(10.0), 3.0, 0.01, 10.0 + age_s, SETTINGS)
    too_old = 10.0 + age_s - 10.0 > SETTINGS.max_frame_age_s
    assert (said.zone is Zone.UNKNOWN) == too_old
    assert [fault.condition for fault in said.faults] == (["stale"] if too_old else [])
    assert bool(classifier.asked) != too_old


@given(age_s=st.floats(0, 5))
def test_an_observation_goes_stale(age_s: float) -> None:
    said = SoilObservation(10.0, Zone.LEFT, 0.9, "")
    now_s = 10.0 + age_s
    assert (said.as_of(now_s, SETTINGS.max_frame_age_s).zone is Zone.LEFT) == (now_s - 10.0 <= SETTINGS.max_frame_age_s)


def test_an_angle_that_was_never_measured_stays_finite() -> None:
    classifier = Always()
    said = judge_frame(classifier, frame(1.0), 0.0, math.inf, 1.0, SETTINGS)
    assert said.blade_angle_age_s == pytest.approx(NEVER_S)
