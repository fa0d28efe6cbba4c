"""Step response: a small manoeuvre that shows how the blade follows, and the numbers that tuning needs."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise

from graderd.drivers.dynamixel.ph54 import Ph54Rotator
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
    current_a: float | None
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
    peak_current_a: float | None


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
    return analyse(samples, rotator.settings.tolerance_deg, _settings_used(rotator))


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
        peak_current_a=max((abs(s.current_a) for s in part if s.current_a is not None), default=None),
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
        "velocity": f"{s.profile_velocity_deg_per_s:g} °/s",
        "acceleration": f"{s.profile_acceleration_deg_per_s2:g} °/s²",
        "current limit": f"{rotator.calibration.current_limit_a:g} A",
        "gear ratio": f"{s.gear_ratio:g}",
        "zero and sign": f"{s.zero_deg:g}°, {s.sign:+d}",
        "poll rate": f"{s.poll_hz:g} Hz at {s.baud_n} bit/s",
        "tolerance": f"±{s.tolerance_deg:g}°",
    }


_WIDTH, _HEIGHT = 860, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 24, 30, 30
_STYLE = """
:root{--goal:#c2410c;--measured:#1d4ed8;--current:#15803d;--line:#d8dde2;--note:#5b6670;--ink:#1d2329;--paper:#fff}
@media(prefers-color-scheme:dark){:root{--goal:#fb923c;--measured:#7aa2ff;--current:#4ade80;--line:#39424a;
--note:#9aa6b0;--ink:#e3e7eb;--paper:#15191d}}
body{font:15px/1.5 system-ui,sans-serif;max-width:900px;margin:2em auto;padding:0 1em;color:var(--ink);
background:var(--paper)}
h1{font-size:1.4em}h2{font-size:1.1em;margin-top:1.6em}.note{color:var(--note)}
.wide{overflow-x:auto}svg{width:100%;min-width:600px;height:auto}
table{border-collapse:collapse}td,th{padding:.25em .8em;border-bottom:1px solid var(--line);text-align:right;
white-space:nowrap}th:first-child,td:first-child{text-align:left}
"""


def render(recording: StepRecording, *, title: str = "Step response of the blade rotation", when: str = "") -> str:
    """The report page: plots of angle and current, a table of the steps, the settings used.

    Raises:
        ValueError: the recording has no samples.
    """
    if not recording.samples:
        raise ValueError("a report needs samples")
    samples = recording.samples
    angle = _plot(
        samples,
        "angle, degrees",
        [_Curve("goal", lambda s: s.goal_deg, jumps=True), _Curve("measured", lambda s: s.angle_deg)],
    )
    told = [s for s in samples if s.current_a is not None]
    current = _plot(told, "motor current, ampere", [_Curve("current", lambda s: s.current_a or 0.0)]) if told else ""
    rows = "".join(_row(step) for step in recording.steps)
    used = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in recording.settings.items())
    source = {
        "reference": "play between servo and blade, from an independent angle",
        "encoder": "hysteresis of the servo's own encoder; the gear's play behind it does not show here",
        "none": "not measured: no angle was approached from both sides",
    }[recording.backlash_from]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>'
        f"<h1>{escape(title)}</h1><p class=note>{escape(when)}</p>{angle}{current}"
        "<h2>Steps</h2><div class=wide><table><tr><th>step</th><th>delay</th><th>rise 10–90 %</th><th>overshoot</th>"
        f"<th>settling</th><th>settled error</th><th>peak current</th></tr>{rows}</table></div>"
        f"<p>Backlash: <b>{recording.backlash_deg:.3f}°</b> <span class=note>({source})</span></p>"
        f"<h2>Settings used</h2><div class=wide><table>{used}</table></div></body></html>\n"
    )


def _row(step: StepMetrics) -> str:
    cells = (
        f"{_number(step.from_deg, 1)}° → {_number(step.to_deg, 1)}°",
        _seconds(step.delay_s),
        _seconds(step.rise_s),
        f"{step.overshoot_deg:.2f}°",
        _seconds(step.settling_s),
        f"{_number(step.error_deg, 3)}°",
        "not told" if step.peak_current_a is None else f"{step.peak_current_a:.2f} A",
    )
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _seconds(value: float | None) -> str:
    return "not reached" if value is None else f"{value:.2f} s"


def _number(value: float, digits: int) -> str:
    """With a true minus sign, and no sign on what rounds to zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


@dataclass(frozen=True)
class _Curve:
    """``name`` also names its colour; one that ``jumps`` is dashed, and goes up and down on the spot."""

    name: str
    value: Callable[[StepSample], float]
    jumps: bool = False


def _ticks(low: float, high: float, most_n: int) -> tuple[list[float], int]:
    """The round numbers between two values, ``most_n`` steps of them at most, and the digits to write them with."""
    raw = max(high - low, 1e-6) / most_n
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw * 0.999)
    digits = next(n for n in range(9) if abs(round(step, n) - step) < 1e-9)
    return [n * step for n in range(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)], digits


def _plot(samples: Sequence[StepSample], label: str, curves: Sequence[_Curve]) -> str:
    """One diagram as inline SVG."""
    values = [curve.value(s) for curve in curves for s in samples]
    low, high = min(values), max(values)
    pad = 0.06 * (high - low) or 1.0
    low, high = low - pad, high + pad
    levels, digits = _ticks(low, high, 5)
    start_s, span_s = samples[0].time_s, max(samples[-1].time_s - samples[0].time_s, 1e-9)
    times_s, time_digits = _ticks(0.0, span_s, 10)

    def x(time_s: float) -> float:
        return _LEFT + time_s / span_s * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return _TOP + (high - value) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    drawn = [
        f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(level):.1f}" y2="{y(level):.1f}" stroke="var(--line)"/>'
        f'<text x="{_LEFT - 6}" y="{y(level) + 4:.1f}" text-anchor="end">{_number(level, digits)}</text>'
        for level in levels
    ]
    drawn += [
        f'<text x="{x(time_s):.1f}" y="{_HEIGHT - 10}" text-anchor="middle">{time_s:.{time_digits}f} s</text>'
        for time_s in times_s
    ]
    for i, curve in enumerate(curves):
        look = f'stroke="var(--{curve.name})" stroke-width="1.8"' + (' stroke-dasharray="6 4"' if curve.jumps else "")
        path, former_y = [], y(curve.value(samples[0]))
        for s in samples:
            here_x, here_y = x(s.time_s - start_s), y(curve.value(s))
            if curve.jumps and here_y != former_y:
                path.append(f"{here_x:.1f},{former_y:.2f}")
            path.append(f"{here_x:.1f},{here_y:.2f}")
            former_y = here_y
        drawn.append(f'<polyline fill="none" {look} points="{" ".join(path)}"/>')
        left = _LEFT + 110 * i
        drawn.append(f'<line x1="{left}" x2="{left + 24}" y1="10" y2="10" {look}/>')
        drawn.append(f'<text x="{left + 30}" y="14">{escape(curve.name)}</text>')
    return (
        f'<h2>{escape(label)}</h2><div class=wide><svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(label)}" font-size="12" fill="currentColor">{"".join(drawn)}</svg></div>'
    )
