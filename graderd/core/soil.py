"""Where the soil lies in front of the blade: thirds of the blade's length, in blade coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Zone(StrEnum):
    """What the picture says. LEFT and RIGHT are the operator's, facing forward.

    EVEN: soil spread over the whole blade. NONE: no soil in front of the blade. UNKNOWN: not sure, never a guess.
    """

    LEFT = "left"
    CENTER = "center"
    RIGHT = "right"
    EVEN = "even"
    NONE = "none"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class PictureFault:
    """Something wrong with the picture: ``condition`` is a row of the fault catalogue's ``camera`` part."""

    condition: str
    detail: str


@dataclass(frozen=True, slots=True)
class SoilObservation:
    """What one frame says about the soil.

    ``capture_s``: monotonic time of the picture. ``share_*``: parts of the soil in each third, sum 1 (all 0 where
    there is none). ``volume_*_l``: litres per third, None where the method has no depth. ``confidence``: 0 to 1.
    ``reason``: one line why. ``blade_angle_deg``: the angle the thirds were laid at, ``blade_angle_age_s`` its age
    at capture. ``faults``: what is wrong with the picture; with any of them ``zone`` is UNKNOWN.
    """

    capture_s: float
    zone: Zone
    confidence: float
    reason: str
    share_left: float = 0.0
    share_center: float = 0.0
    share_right: float = 0.0
    volume_left_l: float | None = None
    volume_center_l: float | None = None
    volume_right_l: float | None = None
    blade_angle_deg: float = 0.0
    blade_angle_age_s: float = 0.0
    frame_number: int = -1
    method: str = ""
    cpu_ms: float = 0.0
    faults: tuple[PictureFault, ...] = ()

    def share_of(self, zone: Zone) -> float:
        """Share of the soil in one third; 0 for zones that are no third."""
        return {Zone.LEFT: self.share_left, Zone.CENTER: self.share_center, Zone.RIGHT: self.share_right}.get(zone, 0.0)

    def as_of(self, now_s: float, max_age_s: float) -> SoilObservation:
        """The observation as it counts at ``now_s``: where its picture is older than ``max_age_s`` by now, UNKNOWN, and
        how much soil lay where is unknown too."""
        age_s = now_s - self.capture_s
        if age_s <= max_age_s:
            return self
        return SoilObservation(
            self.capture_s,
            Zone.UNKNOWN,
            0.0,
            f"the frame is {age_s:.3f} s old by now",
            blade_angle_deg=self.blade_angle_deg,
            blade_angle_age_s=self.blade_angle_age_s,
            frame_number=self.frame_number,
            method=self.method,
            cpu_ms=self.cpu_ms,
            faults=self.faults,
        )
