"""The evaluation written down: one HTML page that needs nothing beside it, and CSV for spreadsheets."""

from __future__ import annotations

import base64
import csv
import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np

from graderd.evaluation.experiment import Experiment
from graderd.evaluation.ground import F64
from graderd.evaluation.statistics import Difference, Row, interval
from graderd.evaluation.trial import TrialResult

UNITS = {"mm": "mm", "l": "l", "l_per_m": "l/m", "n": "N", "s": "s", "percent": "%"}
DEFINITIONS = {
    "height_difference_mm": "mean height of the layer less the target plane's; negative: too low",
    "height_spread_mm": "standard deviation of the layer's heights from cell to cell, the scans' noise taken off",
    "spread_extreme_mm": "width between the outermost places where the soil, averaged over its length along the travel "
    "(the stretch that holds 95 % of it), is {edge_mm:g} mm high",
    "spread_mass_90_mm": "width that holds 90 % of the soil, 5 % beyond either side",
    "spread_mass_95_mm": "width that holds 95 % of the soil, 2.5 % beyond either side",
    "spread_second_moment_mm": "width of an even layer whose soil is spread as far: √12 times the standard deviation "
    "across the travel",
    "volume_moved_l": "soil gone from where it lay before the pass",
    "volume_balance_l": "what came less what went; far from 0, soil left the view, or was loosened or packed",
    "windrow_height_mm": "highest place of the mean profile across the bed, above the layer",
    "windrow_l_per_m": "what the windrow holds above the layer, for each metre along the travel",
    "windrow_y_mm": "where the windrow lies, to the left positive",
    "blade_load_n": "mean blade load of the pass",
    "blade_load_max_n": "greatest blade load of the pass",
}
WITHOUT_CARRIED = "_without_carried_mm"
COLORS = ("#1f6feb", "#c4622d", "#2d8a4e", "#8250b5", "#a07400", "#5c6670")
STYLE = """
:root { color-scheme: light; font: 15px/1.5 system-ui, sans-serif; color: #1d2329; background: #fff; }
body { max-width: 68rem; margin: 2.5rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; margin: 0; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .2rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .3rem; }
p, figcaption { color: #57606a; margin: .2rem 0; max-width: 48rem; }
.beside { display: flex; flex-wrap: wrap; gap: 0 2rem; align-items: start; }
.wide { overflow-x: auto; } table { border-collapse: collapse; margin: .5rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #e3e7eb; }
th { font-weight: 600; border-bottom-color: #8b949e; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td.mean { font-weight: 600; } .sure { font-weight: 600; }
figure { margin: .6rem 0; display: inline-block; vertical-align: top; }
.maps figure { margin-right: 1.4rem; } .states { display: flex; gap: .5rem; font-size: .8rem; color: #57606a; }
 img { display: block; image-rendering: pixelated; border: 1px solid #d0d7de; }
svg text { font: 12px system-ui, sans-serif; fill: #57606a; }
"""


def unit_of(measure: str) -> str:
    """The unit in a measure's name."""
    return next(UNITS[end] for end in sorted(UNITS, key=len, reverse=True) if measure.endswith(f"_{end}"))


def title_of(measure: str) -> str:
    """A measure's name for people."""
    end = next(end for end in sorted(UNITS, key=len, reverse=True) if measure.endswith(f"_{end}"))
    return f"{measure.removesuffix(f'_{end}').replace('_', ' ')} [{UNITS[end]}]"


def definition_of(measure: str, experiment: Experiment) -> str:
    """How a measure is defined; empty for one that was measured elsewhere."""
    if measure.endswith(WITHOUT_CARRIED):
        base = definition_of(measure.replace(WITHOUT_CARRIED, "_mm"), experiment)
        return f"{base}; without the soil that the blade still carried"
    return DEFINITIONS.get(measure, "").format(edge_mm=experiment.edge_mm)


def write(
    folder: Path,
    experiment: Experiment,
    trials: Sequence[TrialResult],
    rows: Sequence[Row],
    differences: Sequence[Difference],
) -> list[Path]:
    """Write ``index.html``, ``rows.csv``, ``trials.csv`` and ``differences.csv``; the paths.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    level = experiment.confidence_percent / 100.0
    paths = [folder / name for name in ("index.html", "rows.csv", "trials.csv", "differences.csv")]
    paths[0].write_text(html(experiment, trials, rows, differences), encoding="utf-8")
    _table(
        paths[1],
        ("case", "angle_deg", "measure", "value", "deviation", "low", "high", "trials_n"),
        ((r.case, r.angle_deg, r.measure, r.value, r.deviation, r.low, r.high, r.trials_n) for r in rows),
    )
    _table(
        paths[2],
        ("case", "angle_deg", "trial", "measure", "value", "low", "high", "scans_n"),
        (
            (trial.case, trial.angle_deg, trial.number, measure, found.value, *interval(found, level), trial.scans_n)
            for trial in trials
            for measure, found in trial.values.items()
        ),
    )
    _table(
        paths[3],
        ("case", "measure", "angle_deg", "other_deg", "difference", "low", "high", "p", "welch_f", "welch_p"),
        (
            (d.case, d.measure, pair.angle_deg, pair.other_deg, pair.difference, pair.low, pair.high, pair.p, d.f, d.p)
            for d in differences
            for pair in d.pairs
        ),
    )
    return paths


def _table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file)
        out.writerow(header)
        for row in rows:
            out.writerow([f"{cell:.6g}" if isinstance(cell, float) else "" if cell is None else cell for cell in row])


def html(
    experiment: Experiment, trials: Sequence[TrialResult], rows: Sequence[Row], differences: Sequence[Difference]
) -> str:
    """The page."""
    percent = f"{experiment.confidence_percent:g} %"
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"<title>{escape(experiment.name)}</title><style>{STYLE}</style><body><h1>{escape(experiment.name)}</h1>",
        f"<p>{len(trials)} trials. Intervals hold the mean with {percent} (Student's t over the trials; for a single "
        "trial "
        "the measurement's own, where its scans tell it). Angles are compared by Welch's analysis of variance, and "
        "pair by "
        "pair by Games and Howell, whose p and intervals count in the number of pairs.</p>",
    ]
    angles = sorted({row.angle_deg for row in rows})
    for case, measure in dict.fromkeys((row.case, row.measure) for row in rows):
        if not any(f"<h2>{escape(case)}</h2>" in part for part in parts):
            parts.append(f"<h2>{escape(case)}</h2>")
            parts.append(_maps_html([trial for trial in trials if trial.case == case], experiment))
        group = [row for row in rows if (row.case, row.measure) == (case, measure)]
        definition = definition_of(measure, experiment)
        parts.append(f"<h3>{escape(title_of(measure))}</h3>" + (f"<p>{escape(definition)}</p>" if definition else ""))
        tested = [_difference_html(d, percent, group) for d in differences if (d.case, d.measure) == (case, measure)]
        tables = "".join((_rows_html(group, percent), *tested))
        parts.append(f"<div class=beside><div>{tables}</div>{_plot(group, angles)}</div>")
    return "\n".join(parts) + "\n</body></html>\n"


def number(value: float | None) -> str:
    """Four figures, or a dash."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    return f"{value:.0f}" if size >= 10000 else f"{value:.1f}" if size >= 100 else f"{value:.2f}"


def p_text(value: float) -> str:
    """A p value as people write it."""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _rows_html(group: Sequence[Row], percent: str) -> str:
    most = max(row.trials_n for row in group)
    head = "".join(
        f"<th>{text}" for text in ("angle", *(f"#{n}" for n in range(1, most + 1)), "mean", "deviation", percent)
    )
    body = ""
    for row in group:
        cells = [number(value) for value in row.values] + [""] * (most - row.trials_n)
        body += f"<tr><td>{row.angle_deg:g}°" + "".join(f"<td>{cell}" for cell in cells)
        sure = "–" if row.low is None else f"{number(row.low)} to {number(row.high)}"
        body += f"<td class=mean>{number(row.value)}<td>{number(row.deviation)}<td>{sure}"
    return f"<div class=wide><table><tr>{head}{body}</table></div>"


def _difference_html(whole: Difference, percent: str, group: Sequence[Row]) -> str:
    mean = {row.angle_deg: row.value for row in group}
    head = "".join(f"<th>{text}" for text in ("pair", "difference", percent, "of the second", "p"))
    body = ""
    for pair in whole.pairs:
        base = mean[pair.other_deg]
        share = f"{pair.difference / base * 100:+.1f} %" if base > 0 else "–"
        mark = " class=sure" if not pair.low <= 0.0 <= pair.high else ""
        body += (
            f"<tr{mark}><td>{pair.angle_deg:g}° less {pair.other_deg:g}°<td>{number(pair.difference)}"
            f"<td>{number(pair.low)} to {number(pair.high)}<td>{share}<td>{p_text(pair.p)}"
        )
    p = p_text(whole.p) if whole.p < 0.001 else f"= {p_text(whole.p)}"
    sentence = f"Do the angles differ? Welch's F = {whole.f:.3g}, p {p}."
    return f"<p>{sentence}</p><div class=wide><table><tr>{head}{body}</table></div>"


def _plot(group: Sequence[Row], angles_deg: Sequence[float]) -> str:
    """Every trial as a dot, means with their intervals beside them; an angle has one colour on the whole page."""
    every = [v for row in group for v in (*row.values, row.low, row.high) if v is not None and math.isfinite(v)]
    low, high = min(every), max(every)
    step = _step(high - low if high > low else abs(high) or 1.0)
    low, high = math.floor(low / step) * step, math.ceil(high / step) * step
    if high <= low:
        low, high = low - step, high + step
    left, top, tall, slot = 64, 10, 170, 104
    wide = left + slot * len(group) + 12

    def y(value: float) -> float:
        return top + (high - value) / (high - low) * tall

    marks = []
    for n in range(round((high - low) / step) + 1):
        at = low + n * step
        marks.append(
            f"<line x1={left} x2={wide - 12} y1={y(at):.1f} y2={y(at):.1f} stroke='#e3e7eb'/>"
            f"<text x={left - 8} y={y(at) + 4:.1f} text-anchor=end>{at:g}</text>"
        )
    for n, row in enumerate(group):
        x, color = left + slot * (n + 0.5), COLORS[angles_deg.index(row.angle_deg) % len(COLORS)]
        for k, value in enumerate(row.values):
            aside = (k - (row.trials_n - 1) / 2) * min(9.0, 50.0 / row.trials_n)
            marks.append(f"<circle cx={x - 14 + aside:.1f} cy={y(value):.1f} r=3.6 fill='{color}' fill-opacity=.55 />")
        if row.low is not None and row.high is not None:
            marks.append(
                f"<path d='M{x + 30:.1f} {y(row.low):.1f}V{y(row.high):.1f}m-5 0h10M{x + 25:.1f} {y(row.low):.1f}h10' "
                f"stroke='{color}' stroke-width=1.8 fill=none />"
            )
        marks.append(f"<rect x={x + 26:.1f} y={y(row.value) - 4:.1f} width=8 height=8 fill='{color}'/>")
        marks.append(f"<text x={x:.1f} y={top + tall + 20} text-anchor=middle>{row.angle_deg:g}°</text>")
    label = escape(f"{group[0].case}: {title_of(group[0].measure)} by angle")
    caption = "dots: trials; square: mean, with its interval"
    return (
        f"<figure><svg role=img aria-label='{label}' width={wide} height={top + tall + 30}>{''.join(marks)}</svg>"
        f"<figcaption>{escape(unit_of(group[0].measure))} by blade angle;<br>{caption}</figcaption></figure>"
    )


def _step(span: float) -> float:
    """A round step that makes four to nine of a span."""
    raw = span / 5.0
    ten: float = 10.0 ** math.floor(math.log10(raw))
    return next(factor * ten for factor in (1.0, 2.0, 5.0, 10.0) if factor * ten >= raw)


def _maps_html(trials: Sequence[TrialResult], experiment: Experiment) -> str:
    """The maps of a case on one scale, forward up, left on the left."""
    shown = [trial for trial in trials if trial.map_mm is not None]
    if not shown:
        return ""
    case = next(case for case in experiment.case if case.name == shown[0].case)
    flat = case.work == "flattening"
    every = np.concatenate([trial.map_mm[np.isfinite(trial.map_mm)] for trial in shown if trial.map_mm is not None])
    if flat:  # about the target, as far as the layer goes: a few millimetres show
        layer = np.abs(every[every > -(case.target_height_mm or 0.0) / 2.0])
        reach = max(5.0, 1.5 * float(np.percentile(layer, 90))) if layer.size else 5.0
        low, high, what = -reach, reach, "Height above the target plane"
    else:
        low, high, what = 0.0, max(10.0, float(np.percentile(every, 99.5))), "Height above the ground"
    changes = [
        (trial.map_mm - trial.before_mm) if trial.map_mm is not None and trial.before_mm is not None else None
        for trial in shown
    ]
    moved = np.concatenate([change[np.isfinite(change)] for change in changes if change is not None] or [every])
    most = max(10.0, float(np.percentile(np.abs(moved), 99.5)))
    figures = []
    for trial, change in zip(shown, changes, strict=True):
        states = [
            _picture(trial, name, heights, ends, about)
            for name, heights, ends, about in (
                ("before", trial.before_mm, (low, high), flat),
                ("after", trial.map_mm, (low, high), flat),
                ("difference", change, (-most, most), True),
            )
            if heights is not None
        ]
        volume = trial.values.get("volume_moved_l")
        told = "" if volume is None else f", {number(volume.value)} l moved"
        figures.append(
            f"<figure><div class=states>{''.join(states)}</div><figcaption>{trial.angle_deg:g}°, trial {trial.number}, "
            f"{trial.scans_n} scan{'s' * (trial.scans_n != 1)}{told}</figcaption></figure>"
        )
    scales = _scale(what, low, high, flat)
    if any(change is not None for change in changes):
        scales += "; difference, after less before: " + _scale("", -most, most, True)
    return (
        f"<h3>Maps</h3><p>Seen from above, forward up; before the pass where it was scanned, after it, and the "
        f"difference. {scales}; grey: not seen.</p><div class=maps>{''.join(figures)}</div>"
    )


def _scale(what: str, low: float, high: float, about: bool) -> str:
    """What the colours mean; ``about``: a middle that is white."""
    colors = _data(_colored(np.linspace(low, high, 200)[None, :].repeat(10, axis=0), low, high, about))
    image = f"<img src='{colors}' alt='' width=200 height=10 style='display:inline-block'>"
    return f"{what}{': ' * bool(what)}{low:.0f} mm {image} {high:.0f} mm"


def _picture(trial: TrialResult, name: str, heights: F64, ends: tuple[float, float], about: bool) -> str:
    assert trial.grid is not None
    colored = _colored(heights[::-1, ::-1], *ends, about)
    rows, columns = colored.shape[:2]
    width = 120
    wide_m = columns * trial.grid.cell_mm / 1000.0
    label = f"{name}, trial {trial.number} at {trial.angle_deg:g} degrees, {wide_m:.1f} m wide"
    height = max(1, round(width * rows / columns))
    return f"<div>{name}<img src='{_data(colored)}' alt='{label}' width={width} height={height}></div>"


def _colored(heights: F64, low: float, high: float, flat: bool) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    share = np.clip((np.nan_to_num(heights, nan=low) - low) / (high - low), 0.0, 1.0)
    if flat:  # blue too low, white right, red too high
        stops, colors = (0.0, 0.5, 1.0), np.array(((178, 96, 33), (247, 247, 247), (43, 24, 178)), np.float64)
        picture = np.stack([np.interp(share, stops, colors[:, channel]) for channel in range(3)], axis=-1).astype(
            np.uint8
        )
    else:
        picture = np.asarray(cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS))
    picture[~np.isfinite(heights)] = (208, 204, 200)
    return picture


def _data(picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> str:
    _, png = cv2.imencode(".png", picture)
    return "data:image/png;base64," + base64.b64encode(png.tobytes()).decode("ascii")
