"""A recording as a page for people: one HTML file that needs nothing else, and tables for spreadsheets beside it."""

from __future__ import annotations

import base64
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import catalogue_key
from graderd.record.export import gaps_of, raw_frames
from graderd.record.layout import MARK, PREVIEW, Gap, Mark, Unreadable
from graderd.record.reader import Recording, new_folder, picture_data
from graderd.record.table import Row, rows, write_csv

PICTURE_WITHIN_S: Final = 2.0
"""A picture or depth so near to a decision is shown with it."""
BUCKETS_N: Final = 1000
WIDTH_PX, HEIGHT_PX = 960, 150
MODES: Final = {"disarmed": "#9aa0a6", "manual": "#4c8bd6", "auto": "#3f9b57", "stopped": "#c8403a"}
COLORS: Final = ("#2f6fb3", "#d1852c", "#3f9b57", "#8a56a8")
PLOTS: Final[tuple[tuple[str, str, tuple[tuple[str, str], ...]], ...]] = (
    ("Blade angle", "deg", (("rotation_requested_deg", "asked for"), ("rotation_measured_deg", "measured"))),
    ("Lifts and tilt", "mm", (
        ("lift_left_measured_mm", "lift left"), ("lift_right_measured_mm", "lift right"),
        ("tilt_measured_mm", "tilt"),
    )),
    ("Loads", "A", (
        ("rotation_current_a", "rotation"), ("lift_left_current_a", "lift left"),
        ("lift_right_current_a", "lift right"), ("tilt_current_a", "tilt"),
    )),
    ("Soil ahead", "l", (("ahead_left_l", "left"), ("ahead_center_l", "center"), ("ahead_right_l", "right"))),
    ("Speed", "m/s", (("speed_m_per_s", "speed"),)),
)  # fmt: skip


@dataclass(slots=True)
class Span:
    """Something that lasted: a mode, a fault. Seconds after the beginning."""

    name: str
    from_s: float
    to_s: float
    why: str = ""
    wall_time: str = ""


@dataclass(slots=True)
class Decided:
    """A decision of automatic operation, and what it was taken from."""

    at_s: float
    wall_time: str
    zone: str
    angle_deg: float
    row: Row
    picture: str = ""
    depth: str = ""


@dataclass(slots=True)
class Story:
    """What there is to tell of a recording. ``began_s``: its first tick, by the wall clock (epoch). ``missing_s``: how
    long ticks are missing between others."""

    began_s: float = 0.0
    duration_s: float = 0.0
    ticks_n: int = 0
    missing_s: float = 0.0
    gaps: list[Gap] = field(default_factory=list)
    unreadable: tuple[Unreadable, ...] = ()
    modes: list[Span] = field(default_factory=list)
    faults: list[Span] = field(default_factory=list)
    decisions: list[Decided] = field(default_factory=list)
    stops: list[Span] = field(default_factory=list)
    notes: list[Span] = field(default_factory=list)
    series: dict[str, Series] = field(default_factory=dict)

    def time_in(self, mode: str) -> float:
        """Seconds in a mode."""
        return sum(span.to_s - span.from_s for span in self.modes if span.name == mode)


class Series:
    """One number against time, as least and greatest of each of :data:`BUCKETS_N` stretches."""

    def __init__(self, duration_s: float) -> None:
        self._per_s = BUCKETS_N / max(duration_s, 1e-9)
        self._low = np.full(BUCKETS_N, np.nan)
        self._high = np.full(BUCKETS_N, np.nan)

    def add(self, at_s: float, value: float) -> None:
        """A value."""
        index = min(max(int(at_s * self._per_s), 0), BUCKETS_N - 1)
        self._low[index] = np.fmin(self._low[index], value)
        self._high[index] = np.fmax(self._high[index], value)

    def points(self) -> list[tuple[float, float] | None]:
        """Share of the time and value, in order; None where nothing was known for long: the line breaks there."""
        known = np.flatnonzero(~np.isnan(self._low))
        found: list[tuple[float, float] | None] = []
        former = -1
        for index in map(int, known):
            if found and index - former > BUCKETS_N // 50:
                found.append(None)
            for value in dict.fromkeys((self._low[index], self._high[index])):
                found.append(((index + 0.5) / BUCKETS_N, float(value)))
            former = index
        return found

    def bounds(self) -> tuple[float, float] | None:
        """Least and greatest; None without a value."""
        if np.isnan(self._low).all():
            return None
        return float(np.nanmin(self._low)), float(np.nanmax(self._high))


def tell(recording: Recording) -> tuple[Story, Iterator[Row]]:
    """The story, which grows while the rows are taken: take them all first."""
    story = Story(duration_s=recording.extent.duration_s)
    story.series = {name: Series(story.duration_s) for _, _, lines in PLOTS for name, _ in lines}
    return story, _told(recording, story)


def _told(recording: Recording, story: Story) -> Iterator[Row]:
    first_s: float | None = None
    open_faults: dict[str, Span] = {}
    decided: tuple[Any, Any] = (None, None)
    for row in rows(recording):
        if first_s is None:
            first_s = row["now_s"]
            story.began_s = datetime.fromisoformat(row["wall_time"]).timestamp()
        at_s = row["now_s"] - first_s
        story.ticks_n += 1
        if "missing_before_s" in row:  # nobody knows what was meanwhile
            story.missing_s += row["missing_before_s"]
            open_faults.clear()
        _mode(story, row, at_s)
        present = set(filter(None, row["faults"].split("; ")))
        for name in present - open_faults.keys():
            open_faults[name] = Span(name, at_s, at_s, wall_time=row["wall_time"])
            story.faults.append(open_faults[name])
        for name in list(open_faults):
            open_faults[name].to_s = at_s
            if name not in present:
                del open_faults[name]
        zone, angle_deg = row.get("decision"), row.get("decision_deg")
        # One that a hold has taken the angle from is none.
        if (zone, angle_deg) != decided and zone is not None and angle_deg is not None:
            story.decisions.append(Decided(at_s, row["wall_time"], zone, angle_deg, row))
        decided = (zone, angle_deg)
        for name, series in story.series.items():
            if (value := row.get(name)) is not None:
                series.add(at_s, value)
        yield row
    story.duration_s = max(story.duration_s, story.modes[-1].to_s if story.modes else 0.0)


def _mode(story: Story, row: Row, at_s: float) -> None:
    last = story.modes[-1] if story.modes else None
    is_known = last is not None and "missing_before_s" not in row
    if last is not None and is_known:
        last.to_s = at_s
    changed = last is None or last.name != row["mode"]
    if changed or not is_known:
        story.modes.append(Span(row["mode"], at_s, at_s, row["reason"], row["wall_time"]))
        if changed and last is not None and row["mode"] in ("stopped", "disarmed"):
            story.stops.append(story.modes[-1])


def write(recording: Recording, folder: Path) -> Story:
    """``index.html``, ``ticks.csv``, ``decisions.csv`` and ``faults.csv`` in a new folder.

    Raises:
        FileExistsError: the folder is there already.
        OSError: it cannot be written; nothing of it is left.
    """
    with new_folder(folder):
        story, told = tell(recording)
        story.gaps = gaps_of(recording)
        write_csv(folder / "ticks.csv", told)
        _add_pictures(recording, story)
        story.unreadable = recording.unreadable
        _table_csv(folder / "decisions.csv", _DECISION_COLUMNS, map(_decision_cells, story.decisions))
        _table_csv(
            folder / "faults.csv",
            ("wall_time", "fault", "from_s", "lasted_s"),
            ((s.wall_time, s.name, f"{s.from_s:.3f}", f"{s.to_s - s.from_s:.3f}") for s in story.faults),
        )
        (folder / "index.html").write_text(page(recording, story), encoding="utf-8")
    return story


def _add_pictures(recording: Recording, story: Story) -> None:
    """The nearest annotated picture and depth picture to each decision."""
    nearest: dict[int, float] = {}
    for message in recording.messages((PREVIEW, MARK)):
        at_s = message.log_ns / 1e9 - story.began_s
        if message.topic == MARK:
            if (mark := recording.value_of(message, Mark.model_validate_json)) is None:
                continue
            text = " ".join(filter(None, (mark.kind, mark.text, mark.client)))
            story.notes.append(Span(mark.kind, at_s, at_s, text))
            continue
        for number, decision in enumerate(story.decisions):
            apart_s = abs(at_s - decision.at_s)
            if apart_s > min(PICTURE_WITHIN_S, nearest.get(number, PICTURE_WITHIN_S)):
                continue
            if (picture := recording.value_of(message, picture_data)) is not None:
                nearest[number], decision.picture = apart_s, base64.b64encode(picture).decode()
    nearest.clear()
    for _, judged in raw_frames(recording):
        depth = judged.frame.depth_mm
        for number, decision in enumerate(story.decisions):
            apart_s = abs(judged.frame.capture_s - decision.row["now_s"])
            if depth is not None and apart_s <= min(PICTURE_WITHIN_S, nearest.get(number, PICTURE_WITHIN_S)):
                nearest[number], decision.depth = apart_s, _depth_picture(depth)


def _depth_picture(depth_mm: Any) -> str:
    """Near is warm, far is cold, black is unknown."""
    known = depth_mm > 0
    low, high = np.percentile(depth_mm[known], (2, 98)) if known.any() else (0.0, 1.0)
    scaled = np.clip((high - depth_mm) / max(high - low, 1.0), 0.0, 1.0) * 255.0
    picture = cv2.applyColorMap(scaled.astype(np.uint8), cv2.COLORMAP_TURBO)
    picture[~known] = 0
    ok, data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, 80))
    return base64.b64encode(data.tobytes()).decode() if ok else ""


# ---- tables ----------------------------------------------------------------------------------------------------------

_DECISION_COLUMNS: Final = (
    "wall_time", "at_s", "zone", "angle_deg", "ahead_confidence", "ahead_left_l", "ahead_center_l", "ahead_right_l",
    "left_l", "center_l", "right_l", "travelled_m",
)  # fmt: skip


def _decision_cells(decided: Decided) -> tuple[Any, ...]:
    row = decided.row
    first = (decided.wall_time, f"{decided.at_s:.3f}", decided.zone, decided.angle_deg)
    return (*first, *(_short(row.get(name)) for name in _DECISION_COLUMNS[4:]))


def _short(value: Any) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _table_csv(path: Path, columns: Sequence[str], lines: Iterator[tuple[Any, ...]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(lines)


# ---- the page --------------------------------------------------------------------------------------------------------

_STYLE: Final = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#202124}
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em;border-bottom:1px solid #dadce0}
table{border-collapse:collapse}td,th{padding:.2em .8em .2em 0;text-align:left;vertical-align:top}
th{font-weight:600;color:#5f6368}svg{width:100%;height:auto}.note{color:#5f6368}
.decision{display:grid;grid-template-columns:15em 1fr 1fr;gap:1em;margin:1em 0;align-items:start}
.decision img{width:100%;border-radius:4px}.big{font-size:1.3em;font-weight:600}
.missing{border-left:4px solid #c8403a;padding-left:.6em}
"""


def page(recording: Recording, story: Story) -> str:
    """The page."""
    head = recording.head
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>{escape(recording.path.name)}</title><style>{_STYLE}</style>",
        f"<h1>{escape(recording.path.name)}</h1>",
        _facts(
            {
                "began": head.get("started", "") + (f", {head['reason']}" if "reason" in head else ""),
                "length": _duration(story.duration_s) + ("" if recording.extent.is_ended else ", without an end"),
                "time in automatic": f"{_duration(story.time_in('auto'))} "
                f"({story.time_in('auto') / max(story.duration_s, 1e-9):.0%})",
                "decisions": str(len(story.decisions)),
                "graderd": head.get("version", "") + (", simulated" if head.get("simulated") == "true" else ""),
                "configuration": head.get("config_sha256", "")[:16],
                "calibration": head.get("calibration_id", ""),
                **({"missing before": head["gap_before"]} if "gap_before" in head else {}),
                **({"missing within": f"{_duration(story.missing_s)}, in no sum below"} if story.missing_s else {}),
            }
        ),
        *(f"<p class=missing>{escape(str(each))}</p>" for each in (*story.gaps, *story.unreadable)),
        "<h2>Modes</h2>",
        _strip(story),
        _rows(
            ("mode", "time", "share"),
            [
                (mode, _duration(story.time_in(mode)), f"{story.time_in(mode) / max(story.duration_s, 1e-9):.0%}")
                for mode in MODES
                if any(span.name == mode for span in story.modes)
            ],
        ),
        "<h2>Stops and disarms, and why</h2>",
        _rows(("when", "mode", "why"), [(_at(s), s.name, s.why) for s in story.stops]),
        "<h2>Faults</h2>",
        _rows(
            ("when", "fault", "lasted", "what it says"),
            [(_at(s), s.name, _duration(s.to_s - s.from_s), _reads(s.name)) for s in story.faults],
        ),
        "<h2>Angles, positions and loads</h2>",
        *(_plot(title, unit, lines, story) for title, unit, lines in PLOTS),
        "<h2>Decisions</h2>",
        *([_decision(decided) for decided in story.decisions] or ["<p class=note>None was taken.</p>"]),
        "<h2>Notes</h2>",
        _rows(("when", "what"), [(f"{s.from_s:.1f} s", s.why) for s in story.notes]),
        "</html>",
    ]
    return "\n".join(part for part in parts if part)


def _facts(facts: Mapping[str, str]) -> str:
    return "<table>" + "".join(f"<tr><th>{n}<td>{escape(v)}" for n, v in facts.items() if v) + "</table>"


def _rows(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    if not lines:
        return "<p class=note>None.</p>"
    head = "".join(f"<th>{name}" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}" for cell in line) for line in lines)
    return f"<table><tr>{head}{body}</table>"


def _at(span: Span) -> str:
    return f"{span.wall_time[11:19]} ({span.from_s:.1f} s)"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60.0)
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:.0f} s" if minutes else f"{rest:.1f} s"


def _reads(name: str) -> str:
    device, _, condition = name.partition(".")
    row = CATALOGUE.get(catalogue_key(device, condition))
    return row.reads if row is not None else ""


def _strip(story: Story) -> str:
    """The modes one after the other, to scale."""
    scale = WIDTH_PX / max(story.duration_s, 1e-9)
    bars = "".join(
        f"<rect x='{s.from_s * scale:.1f}' y=0 width='{max((s.to_s - s.from_s) * scale, 1.0):.1f}' height=22 "
        f"fill='{MODES.get(s.name, '#000')}'><title>{escape(s.name)}: {escape(s.why)}</title></rect>"
        for s in story.modes
    )
    marks = "".join(
        f"<path d='M{d.at_s * scale:.1f} 22 l-5 9 h10z' fill='#202124'><title>{escape(d.zone)}</title></path>"
        for d in story.decisions
    )
    names = "".join(
        f"<tspan fill='{color}'>&#9632; {mode} &#160; </tspan>"
        for mode, color in MODES.items()
        if any(span.name == mode for span in story.modes)
    )
    text = f"<text x=0 y=50 font-size=13>{names}<tspan fill='#202124'>&#9650; decision</tspan></text>"
    return f"<svg viewBox='0 0 {WIDTH_PX} 56'>{bars}{marks}{text}</svg>"


def _plot(title: str, unit: str, lines: Sequence[tuple[str, str]], story: Story) -> str:
    """One diagram; empty where nothing of it was measured."""
    known = [(story.series[name], label) for name, label in lines]
    bounds = [found for series, _ in known if (found := series.bounds()) is not None]
    if not bounds:
        return ""
    low, high = min(b[0] for b in bounds), max(b[1] for b in bounds)
    if high - low < 1e-6:
        low, high = low - 0.5, high + 0.5
    left, top, width, height = 52, 8, WIDTH_PX - 60, HEIGHT_PX - 30

    def y(value: float) -> float:
        return top + height * (1.0 - (value - low) / (high - low))

    grid = "".join(
        f"<line x1={left} x2={left + width} y1='{y(v):.1f}' y2='{y(v):.1f}' stroke='#e8eaed'/>"
        f"<text x={left - 6} y='{y(v) + 4:.1f}' font-size=11 text-anchor=end fill='#5f6368'>{v:.4g}</text>"
        for v in np.linspace(low, high, 4)
    )
    seconds = "".join(
        f"<text x='{left + width * share:.0f}' y={HEIGHT_PX - 6} font-size=11 fill='#5f6368' "
        f"text-anchor={'start' if share == 0 else 'end' if share == 1 else 'middle'}>"
        f"{_duration(story.duration_s * share)}</text>"
        for share in (0.0, 0.25, 0.5, 0.75, 1.0)
    )
    drawn, legend = [], []
    for (series, label), color in zip(known, COLORS, strict=False):
        points = series.points()
        if not points:
            continue
        path, pen = [], "M"
        for point in points:
            if point is None:
                pen = "M"
                continue
            path.append(f"{pen}{left + width * point[0]:.1f} {y(point[1]):.1f}")
            pen = "L"
        drawn.append(f"<path d='{''.join(path)}' fill=none stroke='{color}' stroke-width=1.4 />")
        legend.append(f"<span style='color:{color}'>&#9473; {label}</span>")
    return (
        f"<p><b>{title}</b>, {unit} &#160; {' &#160; '.join(legend)}</p>"
        f"<svg viewBox='0 0 {WIDTH_PX} {HEIGHT_PX}'>{grid}{seconds}{''.join(drawn)}</svg>"
    )


def _decision(decided: Decided) -> str:
    row = decided.row
    angle = f" &rarr; {decided.angle_deg:g}&deg;"
    thirds = [(third, row.get(f"ahead_{third}_l"), row.get(f"{third}_l")) for third in ("left", "center", "right")]
    litres = _rows(
        ("third", "ahead", "in all"),
        [(third, *("" if v is None else f"{v:.1f} l" for v in values)) for third, *values in thirds],
    )
    sure = row.get("ahead_confidence", row.get("confidence"))
    words = (
        f"<div class=big>{escape(decided.zone)}{angle}</div><div>{decided.wall_time[11:23]} ({decided.at_s:.1f} s)"
        f"{'' if sure is None else f', {sure:.0%} sure'}</div>{litres}"
    )
    picture = (
        f"<img alt='picture' src='data:image/jpeg;base64,{decided.picture}'>" if decided.picture else "<div></div>"
    )
    depth = f"<img alt='depth' src='data:image/jpeg;base64,{decided.depth}'>" if decided.depth else "<div></div>"
    return f"<div class=decision><div>{words}</div>{picture}{depth}</div>"
