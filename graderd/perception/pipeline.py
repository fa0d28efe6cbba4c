"""One frame's way through perception: the step a camera worker takes for every frame. No clock, no I/O of its own."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from graderd.core.zones import PictureFault, SoilObservation, Zone
from graderd.hal.camera import Frame
from graderd.perception.settings import DecisionSettings

if TYPE_CHECKING:
    from graderd.perception.classifier import Classifier  # not at run time: the daemon asks here for `usable` alone

NEVER_S = 3600.0
"""Age given to an angle that was never measured: finite, so that it survives JSON."""


def judge_frame(
    classifier: Classifier,
    frame: Frame,
    blade_angle_deg: float,
    blade_angle_age_s: float,
    now_s: float,
    settings: DecisionSettings,
) -> SoilObservation:
    """The observation of one frame, with an old one never judged.

    ``now_s``: monotonic seconds, on the clock of ``frame.capture_s``. A frame older than ``max_frame_age_s`` gives zone
    UNKNOWN with the fault ``stale`` and no numbers. Who decides on the observation still compares ``capture_s`` with
    its own clock: judging takes time too, see :func:`usable`.
    """
    age_s = now_s - frame.capture_s
    angle_age_s = blade_angle_age_s if math.isfinite(blade_angle_age_s) else NEVER_S
    if age_s > settings.max_frame_age_s:
        detail = f"the frame is {age_s:.3f} s old, at most {settings.max_frame_age_s:.3f} s is accepted"
        return SoilObservation(
            capture_s=frame.capture_s,
            zone=Zone.UNKNOWN,
            confidence=0.0,
            reason=detail,
            blade_angle_deg=blade_angle_deg,
            blade_angle_age_s=angle_age_s,
            frame_number=frame.color_number,
            faults=(PictureFault("stale", detail),),
        )
    return classifier.classify(frame, blade_angle_deg, angle_age_s)


def usable(observation: SoilObservation, now_s: float, settings: DecisionSettings) -> SoilObservation:
    """The observation as a decision may use it at ``now_s``: turned into UNKNOWN where its frame is too old by now."""
    age_s = now_s - observation.capture_s
    if age_s <= settings.max_frame_age_s or observation.zone is Zone.UNKNOWN:
        return observation
    return replace(observation, zone=Zone.UNKNOWN, confidence=0.0, reason=f"the frame is {age_s:.3f} s old by now")
