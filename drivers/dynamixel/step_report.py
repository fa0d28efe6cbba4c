"""The step-response report: one HTML page that needs nothing else. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from drivers.dynamixel.step import StepMetrics, StepRecording, StepSample

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
    current = _plot(samples, "motor current, ampere", [_Curve("current", lambda s: s.current_a)])
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
        f"{step.peak_current_a:.2f} A",
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
