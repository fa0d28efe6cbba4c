"""Blade attitude: height, cross slope and pitch of the cutting edge from the actuators' extensions, and back.

Two lifts carry the blade left and right of its centre, the tilt actuator pitches it. Height is that of the cutting
edge's centre above the ground (mm), slope is positive when the left end is higher (deg), pitch is positive when the
moldboard's top leans forward (deg). Small-angle geometry of a 1/4-scale machine; all numbers are settings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pydantic import Field, field_validator

from graderd.core.axes import Pose
from graderd.hal.settings import Finite, NotNegative, Positive, Settings


class AttitudeGeometry(Settings):
    """How extensions become attitude."""

    lift_ground_mm: NotNegative = Field(100.0, description="extension of both lifts with the edge on the ground")
    lift_spacing_mm: Positive = Field(800.0, description="between the two lifts, across the machine")
    lift_raises_by_extending: bool = True
    lift_height_ratio: Positive = Field(1.0, description="mm of edge height for one mm of lift extension")
    tilt_level_mm: NotNegative = Field(50.0, description="extension of the tilt actuator with pitch 0")
    tilt_deg_per_mm: Finite = Field(
        0.30, ge=-10, le=10, description="pitch for one mm; negative where extending leans it back"
    )

    @field_validator("tilt_deg_per_mm")
    @classmethod
    def _tilts(cls, value: float) -> float:
        if abs(value) < 1e-3:
            raise ValueError("the tilt actuator must pitch the blade by 0.001 deg for one mm at least, or back")
        return value


class Preset(Settings):
    """A pose named by what the operator means; axes not named stay where they are."""

    rotation_deg: Finite | None = None
    height_mm: Finite | None = None
    slope_deg: Finite | None = None
    pitch_deg: Finite | None = None
    lift_before_rotation: bool = False


_STEEPEST_DEG = 89.999


@dataclass(frozen=True, slots=True)
class Attitude:
    """Height of the cutting edge's centre (mm) and cross slope (deg)."""

    height_mm: float
    slope_deg: float


def lift_attitude(geometry: AttitudeGeometry, left_mm: float, right_mm: float) -> Attitude:
    """Height and slope from the two lifts' extensions."""
    sign = 1.0 if geometry.lift_raises_by_extending else -1.0
    left_height = sign * geometry.lift_height_ratio * (left_mm - geometry.lift_ground_mm)
    right_height = sign * geometry.lift_height_ratio * (right_mm - geometry.lift_ground_mm)
    slope_deg = math.degrees(math.atan2(left_height - right_height, geometry.lift_spacing_mm))
    return Attitude((left_height + right_height) / 2.0, slope_deg)


def lift_extensions(geometry: AttitudeGeometry, attitude: Attitude) -> tuple[float, float]:
    """Left and right lift extension (mm) for a height and slope; the inverse of :func:`lift_attitude`. What is as steep
    as upright or more is out of any lift's reach."""
    sign = 1.0 if geometry.lift_raises_by_extending else -1.0
    # Beyond upright the tangent begins anew: 180 deg would be level.
    slope_deg = min(max(attitude.slope_deg, -_STEEPEST_DEG), _STEEPEST_DEG)
    half = math.tan(math.radians(slope_deg)) * geometry.lift_spacing_mm / 2.0
    scale = sign / geometry.lift_height_ratio
    return (
        geometry.lift_ground_mm + scale * (attitude.height_mm + half),
        geometry.lift_ground_mm + scale * (attitude.height_mm - half),
    )


def pitch_deg(geometry: AttitudeGeometry, tilt_mm: float) -> float:
    """Pitch from the tilt actuator's extension."""
    return (tilt_mm - geometry.tilt_level_mm) * geometry.tilt_deg_per_mm


def tilt_extension(geometry: AttitudeGeometry, pitch: float) -> float:
    """Tilt extension (mm) for a pitch (deg); the inverse of :func:`pitch_deg`."""
    return geometry.tilt_level_mm + pitch / geometry.tilt_deg_per_mm


@dataclass(frozen=True, slots=True)
class MeasuredAttitude:
    """The blade's attitude as far as it is known: height (mm) of the edge's centre, cross slope and pitch (deg)."""

    height_mm: float | None = None
    slope_deg: float | None = None
    pitch_deg: float | None = None


UNMEASURED = MeasuredAttitude()


def measured_attitude(geometry: AttitudeGeometry, pose: Pose) -> MeasuredAttitude:
    """From measured extensions; None where one is not known."""
    pitch = None if pose.tilt_mm is None else pitch_deg(geometry, pose.tilt_mm)
    if pose.lift_left_mm is None or pose.lift_right_mm is None:
        return MeasuredAttitude(pitch_deg=pitch)
    attitude = lift_attitude(geometry, pose.lift_left_mm, pose.lift_right_mm)
    return MeasuredAttitude(attitude.height_mm, attitude.slope_deg, pitch)
