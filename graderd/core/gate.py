"""The gate: the only way out. Every goal passes here, or the axis stays where it is.

Order of the checks, the first that fails decides: mode, lease, finite number, fresh measurement, interlocks, then the
bounds (absolute limits and the working window around the armed pose) and the motion limits (how far the goal may run
ahead of the measured position; speed and acceleration where the device has no profile of its own).
A goal beyond a bound is not "corrected": it is limited to the bound and the result says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pydantic import Field

from graderd.core.axes import AXES, AxisFigures, Goals, Pose
from graderd.core.machine import ARMED, Mode
from graderd.hal.settings import Finite, Settings


class GateSettings(Settings):
    """The interlocks; bounds and motion limits are each axis's own figures."""

    rotation_min_height_mm: Finite | None = Field(
        None, description="no rotation while the cutting edge is lower than this; None: no such interlock"
    )


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
    figures: Mapping[str, AxisFigures]
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
    for axis in AXES:
        requested, measured, figures = goals[axis], inputs.pose[axis], inputs.figures[axis]
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
        bounded, why = _bound(requested, figures, former.armed_at)
        if figures.profile_in_device:  # a second profile before the device's own would only fight it
            advanced = replace(former, position=bounded, speed=0.0)
        else:
            advanced = _fence(_advance(former, bounded, figures, inputs.dt_s), former, figures)
        setpoints[axis] = _lead(advanced, measured, figures)
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


def _bound(requested: float, figures: AxisFigures, armed_at: float) -> tuple[float, str]:
    low, high = figures.low, figures.high
    why = "limit"
    if armed_at - figures.window > low:
        low, why = armed_at - figures.window, "window around the armed pose"
    if requested < low:
        return min(low, high), f"{why}: not below {low:.1f}"
    why = "limit"
    if armed_at + figures.window < high:
        high, why = armed_at + figures.window, "window around the armed pose"
    if requested > high:
        return max(high, low), f"{why}: not above {high:.1f}"
    return requested, ""


def _advance(former: Setpoint, goal: float, figures: AxisFigures, dt_s: float) -> Setpoint:
    """Move the setpoint toward the goal as fast as speed, acceleration and the way to stop allow.

    The new speed v leaves, after this tick, at least the v²/2a that stopping takes: ``d - v dt = v²/2a``, solved for v.
    So a goal that stands is never passed, however unevenly the ticks come; only one that was moved nearer than the way
    to stop is, and come back to.
    """
    if dt_s <= 0.0:
        return former
    distance = goal - former.position
    step_speed = figures.acceleration * dt_s
    stoppable = step_speed * (math.sqrt(1.0 + 2.0 * abs(distance) / (step_speed * dt_s)) - 1.0)
    wanted = math.copysign(min(figures.speed, stoppable), distance)
    speed = min(max(wanted, former.speed - step_speed), former.speed + step_speed)
    position = former.position + speed * dt_s
    near = abs(goal - position) <= step_speed * dt_s and abs(speed) <= 2.0 * step_speed
    if near and abs(distance) <= figures.speed * dt_s:
        return replace(former, position=goal, speed=0.0)
    return replace(former, position=position, speed=speed)


def _fence(setpoint: Setpoint, former: Setpoint, figures: AxisFigures) -> Setpoint:
    """Never out of limits and window; from outside (pushed there while it was held) only further in."""
    bounded, _ = _bound(setpoint.position, figures, former.armed_at)
    low, high = min(bounded, former.position), max(bounded, former.position)
    if low <= setpoint.position <= high:
        return setpoint
    return replace(setpoint, position=min(max(setpoint.position, low), high), speed=0.0)


def _lead(setpoint: Setpoint, measured: float, figures: AxisFigures) -> Setpoint:
    """Keep the setpoint near the measured position: what jams and comes free must not jump after a far goal."""
    if abs(setpoint.position - measured) <= figures.lead:
        return setpoint
    position = measured + math.copysign(figures.lead, setpoint.position - measured)
    return replace(setpoint, position=min(max(position, figures.low), figures.high), speed=0.0)
