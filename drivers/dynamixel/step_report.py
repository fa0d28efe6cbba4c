"""The step-response report: one HTML page that needs nothing else. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

from drivers.dynamixel.step import StepMetrics, StepRecording, StepSample

_WIDTH, _HEIGHT = 860, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 14, 30
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:900px;margin:2em auto;padding:0 1em;color:#1d2329;background:#fff}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.25em .8em;border-bottom:1px solid #d8dde2;text-align:right}
th:first-child,td:first-child{text-align:left}h1{font-size:1.4em}h2{font-size:1.1em;margin-top:1.6em}
svg{width:100%;height:auto}.note{color:#5b6670}
@media(prefers-color-scheme:dark){body{color:#e3e7eb;background:#15191d}td,th{border-color:#39424a}.note{color:#9aa6b0}}
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
        [("goal", "#c2410c", lambda s: s.goal_deg, True), ("measured", "#1d4ed8", lambda s: s.angle_deg, False)],
    )
    current = _plot(samples, "motor current, ampere", [("current", "#15803d", lambda s: s.current_a, False)])
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
        "<h2>Steps</h2><table><tr><th>step</th><th>delay</th><th>rise 10–90 %</th><th>overshoot</th><th>settling</th>"
        f"<th>settled error</th><th>peak current</th></tr>{rows}</table>"
        f"<p>Backlash: <b>{recording.backlash_deg:.3f}°</b> <span class=note>({source})</span></p>"
        f"<h2>Settings used</h2><table>{used}</table></body></html>\n"
    )


def _row(step: StepMetrics) -> str:
    cells = (
        f"{step.from_deg:+.1f}° → {step.to_deg:+.1f}°",
        _seconds(step.delay_s),
        _seconds(step.rise_s),
        f"{step.overshoot_deg:.2f}°",
        _seconds(step.settling_s),
        f"{step.error_deg:+.3f}°",
        f"{step.peak_current_a:.2f} A",
    )
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _seconds(value: float | None) -> str:
    return "not reached" if value is None else f"{value:.2f} s"


_Curve = tuple[str, str, Callable[[StepSample], float], bool]


def _plot(samples: Sequence[StepSample], label: str, curves: Sequence[_Curve]) -> str:
    """One diagram as inline SVG; ``curves`` are (name, colour, value, dashed)."""
    values = [get(s) for _, _, get, _ in curves for s in samples]
    low, high = min(values), max(values)
    pad = 0.06 * (high - low) or 1.0
    low, high = low - pad, high + pad
    start_s, span_s = samples[0].time_s, max(samples[-1].time_s - samples[0].time_s, 1e-9)

    def x(time_s: float) -> float:
        return _LEFT + (time_s - start_s) / span_s * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return _TOP + (high - value) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    grid = []
    for i in range(5):
        value = low + pad + (high - low - 2 * pad) * i / 4
        grid.append(
            f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(value):.1f}" y2="{y(value):.1f}" stroke="#8885"/>'
            f'<text x="{_LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.1f}</text>'
        )
        time_s = start_s + span_s * i / 4
        grid.append(
            f'<text x="{x(time_s):.1f}" y="{_HEIGHT - 10}" text-anchor="middle">{time_s - start_s:.1f} s</text>'
        )
    lines, names = [], []
    for i, (name, color, get, dashed) in enumerate(curves):
        points = " ".join(f"{x(s.time_s):.1f},{y(get(s)):.2f}" for s in samples)
        dash = ' stroke-dasharray="6 4"' if dashed else ""
        lines.append(f'<polyline fill="none" stroke="{color}" stroke-width="1.8"{dash} points="{points}"/>')
        names.append(f'<text x="{_LEFT + 90 * i + 8}" y="{_TOP + 6}" fill="{color}">{escape(name)}</text>')
    return (
        f'<h2>{escape(label)}</h2><svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label)}" '
        f'font-size="12" fill="currentColor">{"".join(grid)}{"".join(lines)}{"".join(names)}</svg>'
    )
