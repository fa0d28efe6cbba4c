"""The gate: the only way out. Every goal passes here, or the axis stays where it is.

Order of the checks, the first that fails decides: mode, lease, finite number, fresh measurement, interlocks, then the
bounds (absolute limits and the working window around the armed pose) and the motion limits (how far the goal may run
ahead of the measured position; speed and acceleration where the device has no profile of its own).
A goal beyond a bound is not "corrected": it is limited to the bound and the result says so.

Of the lifts, the speed is the lift pair's: it is asked with the goals that may be gone to, and what it says passes
bounds and lead once more. A ramp of the gate's own on top of it was a second regulator that worked against the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from pydantic import Field

from graderd.core.axes import AXES, LIFTS, AxisFigures, Goals, Pose
from graderd.core.machine import ARMED, Mode
from graderd.hal.settings import Finite, Settings


class GateSettings(Settings):
    """The interlocks; bounds and motion limits are each axis's own figures."""

    rotation_min_height_mm: Finite | None = Field(
        None,
        ge=-1000,
        le=1000,
        description="no rotation while the cutting edge is lower than this; None: no such interlock",
    )


LONGEST_STEP_S: Final = 0.1
"""A later tick is not made up for: drivers have ended the motion meanwhile, and a goal far off would make them leap."""
STANDING_S: Final = 0.2
"""An axis that does not follow its goal for so long stands. One that sticks and slips in soil moves again before."""
_MOVED_SHARE: Final = 0.02
_STANDING_SHARE: Final = 0.2
"""Parts of the lead: movement that is more than play and noise, and the lead that an axis which stands keeps: enough
to be told as not moving, too little to snap far when it comes free."""


class Setpoint(NamedTuple):
    """Where an axis's goal is now and how fast it moves, per second; ``armed_at`` is the middle of its window.

    ``moved_at``: where the axis was when it last moved; ``standing_s``: since when it has not followed its goal.
    ``held``: it was not let move in the tick before, so that it starts from where it is now.
    """

    position: float
    speed: float
    armed_at: float
    moved_at: float | None = None
    standing_s: float = 0.0
    held: bool = False


@dataclass(frozen=True, slots=True)
class GateState:
    """Setpoints of the axes that may move; an axis without one holds."""

    setpoints: Mapping[str, Setpoint] = field(default_factory=dict)


class GateInputs(NamedTuple):
    """``dt_s``: since the last pass. ``height_mm``: of the cutting edge, None where unknown. ``lease_ok``: the client
    that asked for the motion still holds its lease, or nobody's lease is needed (automatic operation)."""

    settings: GateSettings
    figures: Mapping[str, AxisFigures]
    mode: Mode
    pose: Pose
    dt_s: float
    lease_ok: bool
    height_mm: float | None = None


class AxisPass(NamedTuple):
    """What became of one axis's goal. ``limited`` None: hold. ``reason``: why it is not what was requested.

    ``bounded``: the nearest to what was requested that limits and window let it have; None where it may not move.
    """

    requested: float | None
    limited: float | None
    reason: str = ""
    bounded: float | None = None


def pass_gate(
    state: GateState, goals: Goals, inputs: GateInputs, pace_lifts: Callable[[Goals], Goals] = lambda goals: goals
) -> tuple[GateState, dict[str, AxisPass]]:
    """Pass one tick's goals. Returns the new state and, for every axis, what may be sent.

    ``pace_lifts``: where the lifts go in this tick, on their way to the goals that it is handed.
    """
    dt_s = min(inputs.dt_s, LONGEST_STEP_S)
    pose = dict(inputs.pose.items())
    formers = {axis: _former(state.setpoints.get(axis), measured, inputs.mode) for axis, measured in pose.items()}
    passed = {axis: _permit(axis, goal, formers[axis], pose[axis], inputs) for axis, goal in goals.items()}
    paced = pace_lifts(Goals(lift_left_mm=passed["lift_left"].bounded, lift_right_mm=passed["lift_right"].bounded))
    setpoints: dict[str, Setpoint] = {}
    for axis in AXES:
        result, measured, former = passed[axis], pose[axis], formers[axis]
        if former is None:
            continue
        wanted = paced[axis] if axis in LIFTS else result.bounded
        if result.bounded is None or wanted is None or measured is None:
            # A held axis starts again from where it is measured, at rest: no jump to an old setpoint.
            at = former.position if measured is None or not math.isfinite(measured) else measured
            setpoints[axis] = Setpoint(at, 0.0, former.armed_at, held=True)
            continue
        if former.held:
            former = Setpoint(measured, 0.0, former.armed_at)
        figures = inputs.figures[axis]
        if axis in LIFTS:
            advanced = former._replace(position=_bound(wanted, figures, former.armed_at)[0])
            setpoints[axis] = _lead(advanced, measured, figures, figures.lead)
        else:
            if figures.profile_in_device:  # a second profile before the device's own would only fight it
                advanced = former._replace(position=wanted, speed=0.0)
            else:
                advanced = _fence(_advance(former, wanted, figures, dt_s), former, figures)
            advanced = _watch(advanced, measured, figures, inputs.dt_s)
            setpoints[axis] = _lead(advanced, measured, figures, _lead_of(advanced, figures))
        passed[axis] = AxisPass(result.requested, setpoints[axis].position, result.reason, result.bounded)
    return GateState(setpoints), passed


def _former(former: Setpoint | None, measured: float | None, mode: Mode) -> Setpoint | None:
    """The axis's setpoint, made from where it stands as soon as it is armed; None: there is none, it holds."""
    if mode not in ARMED:
        return None
    if former is None and measured is not None and math.isfinite(measured):
        return Setpoint(measured, 0.0, measured)
    return former


def _permit(
    axis: str, requested: float | None, former: Setpoint | None, measured: float | None, inputs: GateInputs
) -> AxisPass:
    """Whether the axis may move at all, and how far."""
    refusal = _refusal(axis, requested, measured, inputs)
    if refusal or requested is None or former is None:
        return AxisPass(requested, None, refusal)
    bounded, why = _bound(requested, inputs.figures[axis], former.armed_at)
    return AxisPass(requested, None, why, bounded)


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
        return former._replace(position=goal, speed=0.0)
    return former._replace(position=position, speed=speed)


def _fence(setpoint: Setpoint, former: Setpoint, figures: AxisFigures) -> Setpoint:
    """Never out of limits and window; from outside (pushed there while it was held) only further in."""
    bounded, _ = _bound(setpoint.position, figures, former.armed_at)
    low, high = min(bounded, former.position), max(bounded, former.position)
    if low <= setpoint.position <= high:
        return setpoint
    return setpoint._replace(position=min(max(setpoint.position, low), high), speed=0.0)


def _watch(setpoint: Setpoint, measured: float, figures: AxisFigures, dt_s: float) -> Setpoint:
    """Notice whether the axis follows its goal, or stands although it is asked to move."""
    moved = setpoint.moved_at is None or abs(measured - setpoint.moved_at) > _MOVED_SHARE * figures.lead
    if moved or abs(setpoint.position - measured) <= figures.tolerance:
        return setpoint._replace(moved_at=measured, standing_s=0.0)
    return setpoint._replace(standing_s=setpoint.standing_s + dt_s)


def _lead_of(setpoint: Setpoint, figures: AxisFigures) -> float:
    """How far the goal may run ahead: less and less while the axis stands, as fast as it may move."""
    shrunk = figures.lead - figures.speed * max(0.0, setpoint.standing_s - STANDING_S)
    return max(shrunk, _STANDING_SHARE * figures.lead, figures.tolerance)


def _lead(setpoint: Setpoint, measured: float, figures: AxisFigures, lead: float) -> Setpoint:
    """Keep the setpoint near the measured position: what jams and comes free must not jump after a far goal."""
    if abs(setpoint.position - measured) <= lead:
        return setpoint
    position = measured + math.copysign(lead, setpoint.position - measured)
    return setpoint._replace(position=min(max(position, figures.low), figures.high), speed=0.0)
