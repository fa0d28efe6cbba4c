"""Step response: a small manoeuvre that shows how the blade follows, and the numbers that tuning needs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from drivers.dynamixel.ph54 import Ph54Rotator
from graderd.hal.errors import CommandRangeError, DeviceLostError, LifecycleError
from graderd.hal.lifecycle import Lifecycle

_RENEW_S = 0.02
_SETTLED_TAIL_S = 0.3
"""The settled angle is the mean over the last part of a dwell."""


@dataclass(frozen=True, slots=True)
class StepSample:
    """One telemetry read of the manoeuvre; times from its start. ``reference_deg``: an independent angle, if any."""

    time_s: float
    goal_deg: float
    angle_deg: float
    velocity_deg_per_s: float
    current_a: float
    reference_deg: float | None = None


@dataclass(frozen=True, slots=True)
class StepMetrics:
    """How one step went. A time is None where it was not reached within the dwell.

    ``rise_s``: 10 % to 90 % of the way. ``delay_s``: until 2 % of the way. ``settling_s``: until it stays within the
    tolerance. ``overshoot_deg``: beyond the goal. ``error_deg``: settled angle minus goal.
    """

    start_s: float
    from_deg: float
    to_deg: float
    delay_s: float | None
    rise_s: float | None
    overshoot_deg: float
    settling_s: float | None
    error_deg: float
    peak_current_a: float


@dataclass(frozen=True, slots=True)
class StepRecording:
    """A whole manoeuvre: samples, the settings in force, and what was made of it.

    ``backlash_deg``: at one and the same goal, what differs between arriving from above and from below. With a
    reference (rig shaft, camera) it is the play between servo and blade; without one it is the servo's own hysteresis,
    because its encoder sits on the motor's side of the gear.
    """

    samples: tuple[StepSample, ...]
    steps: tuple[StepMetrics, ...]
    backlash_deg: float
    backlash_from: str
    settings: dict[str, str] = field(default_factory=dict)


async def step_response(
    rotator: Ph54Rotator,
    amplitude_deg: float = 10.0,
    dwell_s: float = 2.0,
    *,
    reference_deg: Callable[[], float] | None = None,
) -> StepRecording:
    """Run the manoeuvre on an armed rotator: up, half-way down, down, half-way up, back. The caller has consent.

    It starts and ends at the present angle; ``amplitude_deg`` may be negative. Any fault of the wire ends it with
    the driver's own reaction; leaving early (cancel, error) holds.

    Raises:
        LifecycleError: not active, or no longer.
        CommandRangeError: an angle of the manoeuvre is outside the soft limits; nothing was moved.
        DeviceLostError: the servo was lost under way.
    """
    if rotator.lifecycle is not Lifecycle.ACTIVE:
        raise LifecycleError(
            "rotation", f"a step response needs the state active, it is {rotator.lifecycle}", "Arm first"
        )
    first = (await rotator.wait_telemetry()).angle_deg
    if first is None or amplitude_deg == 0 or dwell_s <= _SETTLED_TAIL_S:
        raise CommandRangeError("rotation", f"no step of {amplitude_deg}° with a dwell of {dwell_s} s is possible")
    start_deg = first.value
    goals = [start_deg + share * amplitude_deg for share in (0.0, 1.0, 0.5, 0.0, 0.5, 0.0)]
    for goal_deg in goals:
        if not rotator.calibration.within_limits(goal_deg):
            raise CommandRangeError(
                "rotation", f"the manoeuvre goes to {goal_deg:.1f}°, outside the limits", "Start elsewhere"
            )
    samples: list[StepSample] = []
    began_s = first.time_s
    try:
        for goal_deg in goals:
            await _dwell(rotator, goal_deg, dwell_s, began_s, samples, reference_deg)
    finally:
        rotator.hold()
    return analyse(samples, rotator.settings.in_position_deg, _settings_used(rotator))


async def _dwell(
    rotator: Ph54Rotator,
    goal_deg: float,
    dwell_s: float,
    began_s: float,
    samples: list[StepSample],
    reference_deg: Callable[[], float] | None,
) -> None:
    loop = asyncio.get_running_loop()
    until_s = loop.time() + dwell_s
    while loop.time() < until_s:
        rotator.set_goal_deg(goal_deg)
        try:
            async with asyncio.timeout(_RENEW_S * 5):
                t = await rotator.wait_telemetry()
        except TimeoutError:
            continue
        if t.angle_deg is None or t.velocity_deg_per_s is None or t.current_a is None:
            raise DeviceLostError("rotation", "no telemetry during the step response")
        reference = reference_deg() if reference_deg is not None else None
        at_s = t.angle_deg.time_s - began_s
        samples.append(
            StepSample(at_s, goal_deg, t.angle_deg.value, t.velocity_deg_per_s.value, t.current_a.value, reference)
        )


def analyse(samples: Sequence[StepSample], tolerance_deg: float, settings: dict[str, str]) -> StepRecording:
    """Numbers from samples; pure.

    Raises:
        ValueError: there is no step in the samples.
    """
    parts: list[list[StepSample]] = []
    for sample in samples:
        if not parts or parts[-1][-1].goal_deg != sample.goal_deg:
            parts.append([])
        parts[-1].append(sample)
    if len(parts) < 2:
        raise ValueError("no step in these samples")
    steps = tuple(_measure(before, part, tolerance_deg) for before, part in pairwise(parts))
    backlash_deg, source = _backlash(parts)
    return StepRecording(tuple(samples), steps, backlash_deg, source, settings)


def _measure(before: Sequence[StepSample], part: Sequence[StepSample], tolerance_deg: float) -> StepMetrics:
    goal_deg, start_deg, start_s = part[0].goal_deg, before[-1].angle_deg, before[-1].time_s
    way_deg = goal_deg - start_deg

    def share(s: StepSample) -> float:
        return (s.angle_deg - start_deg) / way_deg if way_deg else 1.0

    def first_s(level: float) -> float | None:
        return next((s.time_s - start_s for s in part if share(s) >= level), None)

    low_s, high_s = first_s(0.1), first_s(0.9)
    outside = [s.time_s for s in part if abs(s.angle_deg - goal_deg) > tolerance_deg]
    settled = outside == [] or outside[-1] < part[-1].time_s
    beyond = max(share(s) for s in part) - 1.0
    return StepMetrics(
        start_s=start_s,
        from_deg=start_deg,
        to_deg=goal_deg,
        delay_s=first_s(0.02),
        rise_s=high_s - low_s if low_s is not None and high_s is not None else None,
        overshoot_deg=max(0.0, beyond * abs(way_deg)),
        settling_s=(outside[-1] - start_s if outside else 0.0) if settled else None,
        error_deg=_mean([s.angle_deg for s in _tail(part)]) - goal_deg,
        peak_current_a=max(abs(s.current_a) for s in part),
    )


def _tail(part: Sequence[StepSample]) -> list[StepSample]:
    return [s for s in part if s.time_s >= part[-1].time_s - _SETTLED_TAIL_S]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _backlash(parts: Sequence[Sequence[StepSample]]) -> tuple[float, str]:
    """Compare the arrivals at the same goal from either side."""
    sides: dict[float, dict[bool, Sequence[StepSample]]] = {}
    for before, part in pairwise(parts):
        sides.setdefault(part[0].goal_deg, {})[part[0].goal_deg > before[0].goal_deg] = part
    for both in sides.values():
        if len(both) == 2:
            below, above = _tail(both[True]), _tail(both[False])
            if all(s.reference_deg is not None for s in (*below, *above)):
                slack = [_mean([s.angle_deg - (s.reference_deg or 0.0) for s in tail]) for tail in (below, above)]
                return abs(slack[0] - slack[1]), "reference"
            return abs(_mean([s.angle_deg for s in below]) - _mean([s.angle_deg for s in above])), "encoder"
    return 0.0, "none"


def _settings_used(rotator: Ph54Rotator) -> dict[str, str]:
    s = rotator.settings
    return {
        "servo": f"{rotator.table.title}, firmware {rotator.firmware_version}",
        "velocity": f"{s.velocity_deg_per_s:g} °/s",
        "acceleration": f"{s.acceleration_deg_per_s2:g} °/s²",
        "current limit": f"{s.current_limit_a:g} A",
        "gear ratio": f"{s.gear_ratio:g}",
        "zero and sign": f"{s.zero_deg:g}°, {s.sign:+d}",
        "poll rate": f"{s.poll_hz:g} Hz at {s.baud_n} bit/s",
        "tolerance": f"±{s.in_position_deg:g}°",
    }
