"""Step response: a small manoeuvre that shows how the blade follows, the numbers that tuning needs, and their page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from html import escape
from itertools import pairwise

from graderd.hal.errors import DeviceMissingError
from graderd.hal.rotator import Rotator
from graderd.runtime.control import ControlLoop
from graderd.runtime.maneuver import Maneuver

SHARES = (0.0, 1.0, 0.5, 0.0, 0.5, 0.0)
"""Of the step: up, half-way down, down, half-way up, back. Half-way is reached from both sides, which shows play."""
_SETTLED_TAIL_S = 0.3
"""The settled angle is the mean over the last part of a dwell."""


@dataclass(frozen=True, slots=True)
class StepSample:
    """One telemetry read of the manoeuvre; times from its start."""

    time_s: float
    goal_deg: float
    angle_deg: float
    current_a: float | None


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

    ``backlash_deg``: at one and the same goal, what differs between arriving from above and from below: hysteresis as
    the rotator's own encoder sees it, which may sit on the motor's side of the gear. ``backlash_from``: ``encoder``,
    or ``none`` where no angle was reached from both sides.
    """

    samples: tuple[StepSample, ...]
    steps: tuple[StepMetrics, ...]
    backlash_deg: float
    backlash_from: str
    settings: dict[str, str] = field(default_factory=dict)


async def step_samples(loop: ControlLoop, rotator: Rotator, step_deg: float, dwell_s: float) -> list[StepSample]:
    """Run the manoeuvre through machine and gate: what is measured is what the blade does in operation.

    It arms, starts and ends at the present angle, stays ``dwell_s`` from the start of each move, and disarms.

    Raises:
        DeviceMissingError: no fresh angle to start from.
        DeviceRefusedError: not ready, or an angle of the manoeuvre is beyond a limit.
        DeviceLostError: the machine left manual mode (stop, fault) under way.
    """
    samples: list[StepSample] = []
    async with Maneuver(loop) as blade:
        start_deg = loop.tick.pose.rotation_deg
        if start_deg is None:
            raise DeviceMissingError("rotation", "no fresh measurement to start from")
        began_s = loop.tick.now_s

        def sample(goal_deg: float) -> None:
            told = rotator.telemetry()
            if told.angle_deg:
                samples.append(
                    StepSample(
                        told.angle_deg.time_s - began_s,
                        goal_deg,
                        told.angle_deg.value,
                        told.current_a.value if told.current_a else None,
                    )
                )

        for share in SHARES:
            goal_deg = start_deg + share * step_deg
            await blade.rotate_to(goal_deg, dwell_s, partial(sample, goal_deg))
    return samples


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
            return abs(_mean([s.angle_deg for s in below]) - _mean([s.angle_deg for s in above])), "encoder"
    return 0.0, "none"


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
        style = f'stroke="var(--{curve.name})" stroke-width="1.8"' + (' stroke-dasharray="6 4"' if curve.jumps else "")
        path, former_y = [], y(curve.value(samples[0]))
        for s in samples:
            here_x, here_y = x(s.time_s - start_s), y(curve.value(s))
            if curve.jumps and here_y != former_y:
                path.append(f"{here_x:.1f},{former_y:.2f}")
            path.append(f"{here_x:.1f},{here_y:.2f}")
            former_y = here_y
        drawn.append(f'<polyline fill="none" {style} points="{" ".join(path)}"/>')
        left = _LEFT + 110 * i
        drawn.append(f'<line x1="{left}" x2="{left + 24}" y1="10" y2="10" {style}/>')
        drawn.append(f'<text x="{left + 30}" y="14">{escape(curve.name)}</text>')
    return (
        f'<h2>{escape(label)}</h2><div class=wide><svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(label)}" font-size="12" fill="currentColor">{"".join(drawn)}</svg></div>'
    )
