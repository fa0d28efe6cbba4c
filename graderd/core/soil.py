"""Where the soil lies in front of the blade: thirds of the blade's length, in blade coordinates.

Soil that the blade carries leans on its face and turns with it; soil that lies ahead stays where it is until the blade
comes. Which of the thirds holds most is therefore asked of each by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

ColorMethod = Literal["paper", "fast_color"]
"""The methods that see no depth: the study's own, and the same decision for a fraction of its time."""
Method = Literal["paper", "fast_color", "depth", "fused"]
"""How a picture is judged."""
Mounting = Literal["facing_blade_from_front", "facing_blade_from_behind"]
"""Which way the camera faces: from the front, the operator's left is on the right of the picture."""


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


PROFILE_BINS_N = 24
"""A profile along the blade has so many values: 42 mm each on a blade of 1 m, eight a third."""
Profile = tuple[float | None, ...]
"""One value for each of ``PROFILE_BINS_N`` equal parts of the blade, from its left end to its right; None where it is
not known."""

OPPOSITE = {Zone.LEFT: Zone.RIGHT, Zone.RIGHT: Zone.LEFT}
"""The side that a side must never be taken for."""


@dataclass(frozen=True, slots=True)
class PictureFault:
    """Something wrong with the picture: ``condition`` is a row of the fault catalogue's ``camera`` part."""

    condition: str
    detail: str


@dataclass(frozen=True, slots=True)
class Thirds:
    """Litres per third of the blade, the operator's left and right."""

    left: float = 0.0
    center: float = 0.0
    right: float = 0.0

    @property
    def total(self) -> float:
        """All three."""
        return self.left + self.center + self.right

    def share_of(self, zone: Zone) -> float:
        """Share of one third, 0 to 1; 0 where there is nothing, and for zones that are no third."""
        part = {Zone.LEFT: self.left, Zone.CENTER: self.center, Zone.RIGHT: self.right}.get(zone, 0.0)
        return part / self.total if self.total > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class SoilAhead:
    """The soil that the blade does not carry yet, by the third that will *meet* it if the machine goes straight on.

    ``zone``, ``confidence``, ``reason`` as in :class:`SoilObservation`, of this soil alone: NONE where nothing lies
    ahead, whatever the blade carries.
    """

    zone: Zone
    confidence: float
    reason: str
    litres: Thirds = Thirds()


@dataclass(frozen=True, slots=True)
class SoilObservation:
    """What one frame says about the soil.

    ``zone``, ``share_*`` and ``volume_*_l`` are of all soil in front of the blade, in thirds square to it. ``ahead``
    and ``carried`` tell it apart (``carried``: litres that lean on the face, by the third they lean on); both are None
    where the method has no depth and cannot.

    ``capture_s``: monotonic time of the picture. ``share_*``: parts of the soil in each third, sum 1 (all 0 where
    there is none). ``volume_*_l``: litres per third, None where the method has no depth. ``profile_mm``: how
    high the soil before each part of the blade stands above the ground, at its highest; 0 where there is none, None
    where less than half of that part was seen, and as a whole where the method has no depth. ``confidence``: 0 to 1.
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
    ahead: SoilAhead | None = None
    carried: Thirds | None = None
    profile_mm: Profile | None = None

    def share_of(self, zone: Zone) -> float:
        """Share of the soil in one third; 0 for zones that are no third."""
        return {Zone.LEFT: self.share_left, Zone.CENTER: self.share_center, Zone.RIGHT: self.share_right}.get(zone, 0.0)

    @property
    def coming(self) -> SoilAhead:
        """What a decision is taken from: the soil ahead, or all that is seen where the method cannot tell."""
        if self.ahead is not None:
            return self.ahead
        shares = Thirds(self.share_left, self.share_center, self.share_right)
        return SoilAhead(self.zone, self.confidence, self.reason, shares)

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
