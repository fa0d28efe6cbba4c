"""The four classifiers behind one contract: a frame and a blade angle in, one observation out."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Mounting, PictureFault, Profile, SoilAhead, SoilObservation, Thirds, Zone
from graderd.hal.camera import Frame, Intrinsics
from graderd.hal.settings import CameraSettings
from graderd.perception import annotate as drawing
from graderd.perception.color import fast_color_verdict, paper_verdict
from graderd.perception.decide import Verdict, fuse
from graderd.perception.depth import DepthJudge, HeightMap
from graderd.perception.geometry import CENTER, LEFT, RIGHT, U8, Region, View, blade_region, image_thirds
from graderd.perception.health import HealthMonitor, NowAndThen, obstructed
from graderd.perception.registration import Stance
from graderd.perception.settings import (
    CameraCalibration,
    ColorSettings,
    DecisionSettings,
    PerceptionSettings,
)

ByColor = Callable[[U8, Region, ColorSettings, DecisionSettings], Verdict]
BY_COLOR: Mapping[str, ByColor] = {"paper": paper_verdict, "fast_color": fast_color_verdict}
"""The methods that look at the colour picture alone, by ``perception.method``."""
ANGLE_STEP_DEG = 0.25
"""The blade's ends move by 2 mm in such a step, a pixel of the colour picture."""
KEPT_REGIONS_N = 64
"""Regions of so many steps are kept: the blade's swing of 15 degrees is not worked out again and again."""
ASPECT_TOLERANCE = 0.02
"""Lens data of another size apply where the picture has their shape but for rows that a scaler rounded away."""
HALVED_FROM_PX, QUARTERED_FROM_PX = 500, 1000
"""Widths from which colour is averaged over 2 x 2 and 4 x 4 pixels: about 250 across are left, 4 mm each."""


class Classifier(Protocol):
    """Says where the soil lies. Holds state (the frame before): one instance per stream of frames, one thread."""

    def classify(
        self,
        frame: Frame,
        blade_angle_deg: float,
        blade_angle_age_s: float,
        attitude: MeasuredAttitude = UNMEASURED,
    ) -> SoilObservation:
        """Judge one frame with the thirds laid at ``blade_angle_deg``, measured ``blade_angle_age_s`` before capture.

        ``attitude``: height, cross slope and pitch of the blade, as far as its lifts and its tilt are measured.
        Never raises for what a picture shows: a bad picture gives zone UNKNOWN and names its faults.
        """
        ...

    def annotate(self, frame: Frame, observation: SoilObservation, *, labels: bool = True) -> U8:
        """The colour picture (BGR) with the thirds drawn into it, and with ``labels`` LEFT and RIGHT, numbers and
        decision."""
        ...


@dataclass(frozen=True, slots=True)
class _Judged:
    """What a healthy picture says: all soil, and where the method has depth that ahead, that carried (litres), and how
    high it stands along the blade."""

    verdict: Verdict
    ahead: Verdict | None = None
    carried_l: tuple[float, float, float] | None = None
    profile_mm: Profile | None = None

    def unknown(self, reason: str) -> _Judged:
        """The same numbers, not believed."""
        ahead = self.ahead and self.ahead.unknown(reason)
        return _Judged(self.verdict.unknown(reason), ahead, self.carried_l, self.profile_mm)


class SoilClassifier:
    """The one implementation; ``settings.method`` chooses what it does with a healthy frame."""

    def __init__(
        self,
        settings: PerceptionSettings,
        calibration: CameraCalibration | None,
        blade: BladeGeometry,
        live: bool = True,
        mounting: Mounting = "facing_blade_from_front",
        camera: CameraSettings | None = None,
    ) -> None:
        self._settings = settings
        self._calibration = calibration
        self._mounting = calibration.mounting if calibration is not None else mounting
        self._blade = blade
        self._health = HealthMonitor(settings.health, blade, live, camera)
        self._views: dict[tuple[str, Intrinsics], View] = {}
        self._judges: dict[Intrinsics, DepthJudge] = {}
        self._regions: OrderedDict[tuple[object, ...], Region | None] = OrderedDict()
        # Stills have nothing to do with each other, and a look at one in ten says nothing about the next.
        self._watch = NowAndThen() if live else None

    @property
    def settings(self) -> PerceptionSettings:
        """The settings it was made with."""
        return self._settings

    def classify(
        self,
        frame: Frame,
        blade_angle_deg: float,
        blade_angle_age_s: float,
        attitude: MeasuredAttitude = UNMEASURED,
    ) -> SoilObservation:
        """See :class:`Classifier`."""
        start_s = time.thread_time()
        method = self._settings.method
        faults = self._health.check(frame, needs_depth=method in ("depth", "fused"), needs_color=method != "depth")
        judged = _Judged(Verdict(Zone.UNKNOWN, 0.0, ""))
        if not faults:
            judged, more = self._judge(frame, Stance(blade_angle_deg, attitude))
            faults += more
        if faults:
            judged = judged.unknown("; ".join(f"{fault.condition}: {fault.detail}" for fault in faults))
        elif blade_angle_age_s > self._settings.decision.max_angle_age_s:
            judged = judged.unknown(f"the blade angle was {blade_angle_age_s:.2f} s old at capture")
        return self._observation(frame, judged, blade_angle_deg, blade_angle_age_s, faults, start_s)

    def annotate(self, frame: Frame, observation: SoilObservation, *, labels: bool = True) -> U8:
        """See :class:`Classifier`."""
        mirrored = drawing.image_right_is_left(self._mounting)
        return drawing.annotate(
            frame.color_bgr, observation, self.color_view(frame), self._blade, mirrored, labels=labels
        )

    def color_view(self, frame: Frame) -> View | None:
        """Lens and place of the colour stream for this frame; None without a calibration that applies."""
        height, width = frame.color_bgr.shape[:2]
        return self._view("color", frame.color_intrinsics, width, height)

    def depth_view(self, frame: Frame) -> View | None:
        """Lens and place of the depth stream for this frame; None without depth or calibration."""
        if frame.depth_mm is None:
            return None
        height, width = frame.depth_mm.shape
        return self._view("depth", frame.depth_intrinsics, width, height)

    def height_map(self, frame: Frame, stance: Stance) -> HeightMap | None:
        """The soil's height map of a frame, for pictures and studies; None where the frame or calibration has none."""
        judge = self._depth_judge(frame)
        if judge is None or frame.depth_mm is None:
            return None
        return judge.height_map(frame.depth_mm, stance)

    def _view(self, stream: str, lens: Intrinsics | None, width: int, height: int) -> View | None:
        if self._calibration is None:
            return None
        calibrated = self._calibration.color if stream == "color" else self._calibration.depth
        if lens is None:
            lens = calibrated.intrinsics()
            if abs(lens.width * height - lens.height * width) > ASPECT_TOLERANCE * lens.width * height:
                return None  # another aspect ratio is another read-out of the sensor: the lens data do not apply
            lens = lens.scaled(width, height)
        key = (stream, lens)
        if key not in self._views:
            self._views[key] = View(lens, calibrated.pose(self._calibration.mounting))
        return self._views[key]

    def _region(self, frame: Frame, angle_deg: float) -> Region | None:
        height, width = frame.color_bgr.shape[:2]
        view = self.color_view(frame)
        step = round(angle_deg / ANGLE_STEP_DEG)
        key = (width, height, view and view.lens, step if view else 0)
        if key in self._regions:
            self._regions.move_to_end(key)
            return self._regions[key]
        # The paper's letter works on the full picture; what else needs the region is content with its corners.
        halvings = (width >= HALVED_FROM_PX) + (width >= QUARTERED_FROM_PX)
        if self._settings.method == "paper":
            halvings = 0
        if view is None:
            region = image_thirds(width, height, halvings, drawing.image_right_is_left(self._mounting))
        else:
            region = blade_region(view, self._blade, step * ANGLE_STEP_DEG, halvings)
        self._regions[key] = region
        if len(self._regions) > KEPT_REGIONS_N:
            self._regions.popitem(last=False)
        return region

    def _depth_judge(self, frame: Frame) -> DepthJudge | None:
        view = self.depth_view(frame)
        if view is None:
            return None
        if view.lens not in self._judges:
            self._judges[view.lens] = DepthJudge(view, self._blade, self._settings.depth, self._settings.decision)
        return self._judges[view.lens]

    def _judge(self, frame: Frame, stance: Stance) -> tuple[_Judged, list[PictureFault]]:
        settings = self._settings
        region: Region | None = None
        if self._health.lit:
            region = self._region(frame, stance.angle_deg)
            if region is None:
                reason = "the blade is not in the picture at this angle, or the picture is too small"
                return _Judged(Verdict(Zone.UNKNOWN, 0.0, reason)), []
            faults = self._health.blurred(frame.color_bgr, region)
            if faults:
                return _Judged(Verdict(Zone.UNKNOWN, 0.0, "")), faults
        by_color = BY_COLOR.get(settings.method)
        if by_color is not None:
            assert region is not None  # an unlit picture is a fault where colour is needed
            verdict = by_color(frame.color_bgr, region, settings.color, settings.decision)
            return _Judged(self._said(frame, verdict)), self._seen_meanwhile(frame, stance)
        judge = self._depth_judge(frame)
        if judge is None or frame.depth_mm is None:
            return _Judged(Verdict(Zone.UNKNOWN, 0.0, "no calibration of the depth picture applies")), []
        soil = judge.height_map(frame.depth_mm, stance)
        by_depth = judge.verdict(soil)
        ahead = judge.verdict_ahead(soil, by_depth)
        faults = self._seen(soil, stance)
        if region is None or settings.method == "depth" or faults:
            return _Judged(by_depth, ahead, soil.carried_l, soil.profile_mm), faults
        cross_check = fast_color_verdict(frame.color_bgr, region, settings.color, settings.decision)
        # Colour cannot tell ahead from carried: what it sees before the blade objects to either.
        told = fuse(by_depth, cross_check), fuse(ahead, cross_check)
        return _Judged(*told, soil.carried_l, soil.profile_mm), []

    def _seen(self, soil: HeightMap, stance: Stance) -> list[PictureFault]:
        return self._health.misplaced(soil, stance) or obstructed(soil)

    def _seen_meanwhile(self, frame: Frame, stance: Stance) -> list[PictureFault]:
        if self._watch is None:
            return []

        def judge() -> list[PictureFault]:
            soil = self.height_map(frame, stance)
            return self._seen(soil, stance) if soil is not None else []

        return self._watch.check(judge)

    def _said(self, frame: Frame, verdict: Verdict) -> Verdict:
        if self.color_view(frame) is not None:
            return verdict
        side = "right" if drawing.image_right_is_left(self._mounting) else "left"
        note = f"thirds of the whole picture, its {side} taken as the operator's left (no calibration applies)"
        return Verdict(
            verdict.zone, 0.5 * verdict.confidence, f"{verdict.reason}; {note}", verdict.shares, verdict.volumes_l
        )

    def _observation(
        self,
        frame: Frame,
        judged: _Judged,
        angle_deg: float,
        angle_age_s: float,
        faults: list[PictureFault],
        start_s: float,
    ) -> SoilObservation:
        verdict, ahead = judged.verdict, judged.ahead
        volumes = verdict.volumes_l
        return SoilObservation(
            capture_s=frame.capture_s,
            zone=verdict.zone,
            confidence=min(max(verdict.confidence, 0.0), 1.0),
            reason=verdict.reason,
            share_left=verdict.shares[LEFT],
            share_center=verdict.shares[CENTER],
            share_right=verdict.shares[RIGHT],
            volume_left_l=volumes[LEFT] if volumes else None,
            volume_center_l=volumes[CENTER] if volumes else None,
            volume_right_l=volumes[RIGHT] if volumes else None,
            blade_angle_deg=angle_deg,
            blade_angle_age_s=angle_age_s,
            frame_number=frame.color_number,
            method=self._settings.method,
            cpu_ms=(time.thread_time() - start_s) * 1000.0,
            faults=tuple(faults),
            ahead=SoilAhead(ahead.zone, min(max(ahead.confidence, 0.0), 1.0), ahead.reason, _thirds(ahead.volumes_l))
            if ahead
            else None,
            carried=_thirds(judged.carried_l) if judged.carried_l else None,
            profile_mm=judged.profile_mm,
        )


def _thirds(amounts: tuple[float, float, float] | None) -> Thirds:
    return Thirds(amounts[LEFT], amounts[CENTER], amounts[RIGHT]) if amounts else Thirds()


def make_classifier(
    settings: PerceptionSettings,
    calibration: CameraCalibration | None,
    blade: BladeGeometry,
    live: bool = True,
    mounting: Mounting = "facing_blade_from_front",
    camera: CameraSettings | None = None,
) -> Classifier:
    """A classifier for one stream of frames.

    ``calibration`` None: thirds of the whole picture (colour methods only), left and right after ``mounting``.
    ``live`` False: the frames are stills, so equal pictures and changing sizes are no fault. ``camera``: what was asked
    of it; a colour picture of another size is then a fault.
    """
    return SoilClassifier(settings, calibration, blade, live, mounting, camera)


NEVER_S = 3600.0
"""Age given to an angle that was never measured: finite, so that it survives JSON."""


def judge_frame(
    classifier: Classifier,
    frame: Frame,
    blade_angle_deg: float,
    blade_angle_age_s: float,
    now_s: float,
    settings: DecisionSettings,
    attitude: MeasuredAttitude = UNMEASURED,
) -> SoilObservation:
    """The observation of one frame, with an old one never judged.

    ``now_s``: monotonic seconds, on the clock of ``frame.capture_s``. A frame older than ``max_frame_age_s`` gives zone
    UNKNOWN with the fault ``stale`` and no numbers. Who decides on the observation still compares ``capture_s`` with
    its own clock: judging takes time too, see :meth:`graderd.core.soil.SoilObservation.as_of`.
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
    return classifier.classify(frame, blade_angle_deg, angle_age_s, attitude)
