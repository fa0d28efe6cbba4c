"""The gate: the only way out. Every goal passes here, or the axis stays where it is.

Order of the checks, the first that fails decides: mode, lease, finite number, fresh measurement, interlocks, then the
bounds (absolute limits and the working window around the armed pose) and the motion limits (speed, acceleration, and
how far the goal may run ahead of the measured position).
A goal beyond a bound is not "corrected": it is limited to the bound and the result says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

from pydantic import Field, model_validator

from graderd.core.machine import ARMED, Goals, Mode, Pose
from graderd.hal.settings import Finite, NotNegative, Positive, Settings

AXES = ("rotation", "lift_left", "lift_right", "tilt")


class AxisLimits(Settings):
    """Bounds and motion limits of one axis; deg for the rotation, mm for the others (see the config keys' names)."""

    low: Finite
    high: Finite
    window: Positive = Field(description="largest distance from where the axis stood when it was armed")
    speed: Positive = Field(description="largest speed of the goal, per second")
    acceleration: Positive = Field(description="largest change of that speed, per second squared")
    lead: Positive = Field(description="largest distance of the goal ahead of the measured position")

    @model_validator(mode="after")
    def _order(self) -> AxisLimits:
        if self.low >= self.high:
            raise ValueError(f"low ({self.low}) must be below high ({self.high})")
        return self


class GateSettings(Settings):
    """Limits of every axis and the interlocks."""

    rotation_min_deg: Finite = -60.0
    rotation_max_deg: Finite = 60.0
    rotation_window_deg: Positive = 120.0
    rotation_speed_deg_per_s: Positive = 25.0
    rotation_acceleration_deg_per_s2: Positive = 50.0
    rotation_lead_deg: Positive = Field(10.0, description="how far the goal may run ahead of a blade that is held back")
    lift_min_mm: NotNegative = 5.0
    lift_max_mm: Positive = 295.0
    lift_window_mm: Positive = 290.0
    lift_speed_mm_per_s: Positive = 60.0
    lift_acceleration_mm_per_s2: Positive = 200.0
    lift_lead_mm: Positive = 30.0
    tilt_min_mm: NotNegative = 3.0
    tilt_max_mm: Positive = 97.0
    tilt_window_mm: Positive = 94.0
    tilt_speed_mm_per_s: Positive = 25.0
    tilt_acceleration_mm_per_s2: Positive = 100.0
    tilt_lead_mm: Positive = 15.0
    rotation_min_height_mm: Finite | None = Field(
        None, description="no rotation while the cutting edge is lower than this; None: no such interlock"
    )

    def limits(self) -> Mapping[str, AxisLimits]:
        """The limits by axis name."""
        return _limits_of(self)

    @model_validator(mode="after")
    def _build(self) -> GateSettings:
        self.limits()
        return self


@lru_cache(maxsize=8)
def _limits_of(settings: GateSettings) -> dict[str, AxisLimits]:
    lift = AxisLimits(
        low=settings.lift_min_mm,
        high=settings.lift_max_mm,
        window=settings.lift_window_mm,
        speed=settings.lift_speed_mm_per_s,
        acceleration=settings.lift_acceleration_mm_per_s2,
        lead=settings.lift_lead_mm,
    )
    return {
        "rotation": AxisLimits(
            low=settings.rotation_min_deg,
            high=settings.rotation_max_deg,
            window=settings.rotation_window_deg,
            speed=settings.rotation_speed_deg_per_s,
            acceleration=settings.rotation_acceleration_deg_per_s2,
            lead=settings.rotation_lead_deg,
        ),
        "lift_left": lift,
        "lift_right": lift,
        "tilt": AxisLimits(
            low=settings.tilt_min_mm,
            high=settings.tilt_max_mm,
            window=settings.tilt_window_mm,
            speed=settings.tilt_speed_mm_per_s,
            acceleration=settings.tilt_acceleration_mm_per_s2,
            lead=settings.tilt_lead_mm,
        ),
    }


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Where an axis's goal is now and how fast it moves, per second; ``armed_at`` is the middle of its window."""

    position: float
    speed: float
    armed_at: float


@dataclass(frozen=True, slots=True)
class GateState:
    """Setpoints of the axes that may move; an axis without one holds."""

    setpoints: Mapping[str, Setpoint] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class GateInputs:
    """``dt_s``: since the last pass. ``height_mm``: of the cutting edge, None where unknown. ``lease_ok``: the client
    that asked for the motion still holds its lease, or nobody's lease is needed (automatic operation)."""

    settings: GateSettings
    mode: Mode
    pose: Pose
    dt_s: float
    lease_ok: bool
    height_mm: float | None = None


@dataclass(frozen=True, slots=True)
class AxisPass:
    """What became of one axis's goal. ``limited`` None: hold. ``reason``: why it is not what was requested."""

    requested: float | None
    limited: float | None
    reason: str = ""


def pass_gate(state: GateState, goals: Goals, inputs: GateInputs) -> tuple[GateState, dict[str, AxisPass]]:
    """Pass one tick's goals. Returns the new state and, for every axis, what may be sent."""
    setpoints: dict[str, Setpoint] = {}
    passed: dict[str, AxisPass] = {}
    limits = inputs.settings.limits()
    for axis in AXES:
        requested = _goal_of(goals, axis)
        measured = _measured(inputs.pose, axis)
        former = state.setpoints.get(axis)
        if inputs.mode in ARMED and former is None and measured is not None and math.isfinite(measured):
            former = Setpoint(measured, 0.0, measured)
        refusal = _refusal(axis, requested, measured, inputs)
        if former is None or inputs.mode not in ARMED:
            passed[axis] = AxisPass(requested, None, refusal)
            continue
        if refusal or requested is None or measured is None:
            # A held axis starts again from where it is measured, at rest: no jump to an old setpoint.
            at = former.position if measured is None or not math.isfinite(measured) else measured
            setpoints[axis] = replace(former, position=at, speed=0.0)
            passed[axis] = AxisPass(requested, None, refusal)
            continue
        bounded, why = _bound(requested, limits[axis], former.armed_at)
        advanced = _fence(_advance(former, bounded, limits[axis], inputs.dt_s), former, limits[axis])
        setpoints[axis] = _leash(advanced, measured, limits[axis])
        passed[axis] = AxisPass(requested, setpoints[axis].position, why)
    return GateState(setpoints), passed


def _refusal(axis: str, requested: float | None, measured: float | None, inputs: GateInputs) -> str:
    """Why this axis must stay where it is, or an empty string."""
    if requested is None:
        return ""
    if inputs.mode not in ARMED:
        return f"{inputs.mode}: only staying is allowed"
    if not inputs.lease_ok:
        return "the lease of the client that asked has lapsed"
    if not math.isfinite(requested):
        return "the goal is not a finite number"
    if measured is None:
        return "no fresh measurement of this axis"
    if not math.isfinite(measured):
        return "the measurement of this axis is not a finite number"
    minimum = inputs.settings.rotation_min_height_mm
    if axis == "rotation" and minimum is not None:
        if inputs.height_mm is None:
            return "rotation needs the blade's height, which is not known"
        if inputs.height_mm < minimum:
            return f"rotation needs a blade height of {minimum:g} mm; it is {inputs.height_mm:.0f} mm"
    return ""


def _bound(requested: float, limits: AxisLimits, armed_at: float) -> tuple[float, str]:
    low, high = limits.low, limits.high
    why = "limit"
    if armed_at - limits.window > low:
        low, why = armed_at - limits.window, "window around the armed pose"
    if requested < low:
        return min(low, high), f"{why}: not below {low:.1f}"
    why = "limit"
    if armed_at + limits.window < high:
        high, why = armed_at + limits.window, "window around the armed pose"
    if requested > high:
        return max(high, low), f"{why}: not above {high:.1f}"
    return requested, ""


def _advance(former: Setpoint, goal: float, limits: AxisLimits, dt_s: float) -> Setpoint:
    """Move the setpoint toward the goal as fast as speed, acceleration and the way to stop allow.

    The new speed v leaves, after this tick, at least the v²/2a that stopping takes: ``d - v dt = v²/2a``, solved for v.
    So a goal that stands is never passed, however unevenly the ticks come; only one that was moved nearer than the way
    to stop is, and come back to.
    """
    if dt_s <= 0.0:
        return former
    distance = goal - former.position
    step_speed = limits.acceleration * dt_s
    stoppable = step_speed * (math.sqrt(1.0 + 2.0 * abs(distance) / (step_speed * dt_s)) - 1.0)
    wanted = math.copysign(min(limits.speed, stoppable), distance)
    speed = min(max(wanted, former.speed - step_speed), former.speed + step_speed)
    position = former.position + speed * dt_s
    near = abs(goal - position) <= step_speed * dt_s and abs(speed) <= 2.0 * step_speed
    if near and abs(distance) <= limits.speed * dt_s:
        return replace(former, position=goal, speed=0.0)
    return replace(former, position=position, speed=speed)


def _fence(setpoint: Setpoint, former: Setpoint, limits: AxisLimits) -> Setpoint:
    """Never out of limits and window; from outside (pushed there while it was held) only further in."""
    bounded, _ = _bound(setpoint.position, limits, former.armed_at)
    low, high = min(bounded, former.position), max(bounded, former.position)
    if low <= setpoint.position <= high:
        return setpoint
    return replace(setpoint, position=min(max(setpoint.position, low), high), speed=0.0)


def _leash(setpoint: Setpoint, measured: float, limits: AxisLimits) -> Setpoint:
    """Keep the setpoint near the measured position: what jams and comes free must not jump after a far goal."""
    if abs(setpoint.position - measured) <= limits.lead:
        return setpoint
    position = measured + math.copysign(limits.lead, setpoint.position - measured)
    return replace(setpoint, position=min(max(position, limits.low), limits.high), speed=0.0)


def _goal_of(goals: Goals, axis: str) -> float | None:
    return goals.rotation_deg if axis == "rotation" else getattr(goals, f"{axis}_mm")


def _measured(pose: Pose, axis: str) -> float | None:
    return pose.rotation_deg if axis == "rotation" else getattr(pose, f"{axis}_mm")
