"""The machine's status as lines for a terminal of a given size: ``graderd status`` prints them, ``watch`` keeps them.

Faults come first, each with its remedy. A number is never cut: words are, at their end, and lines that say least go
first where there is no room.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from graderd.hal.text import printable

Kind = Literal["title", "fault", "stop", "warn", "plain", "dim"]
Status = Mapping[str, Any]
THIRDS: Final = ("left", "center", "right")
LEAST_COLUMNS_N: Final = 60
LEAST_LINES_N: Final = 20
NARROW_N: Final = 80
BADLY: Final = ("stop", "disarm")
BARS: Final = "▁▂▃▄▅▆▇█"
LEVEL: Final = "·"
UNSEEN: Final = "?"
TALL_MM: Final = 100.0
"""A profile's bars are as tall as its highest, which is told beside them; one lower than this looks low."""
MARK: Final = "…"
LEAST_REASON_N: Final = 12
STYLES: Final[Mapping[Kind, str]] = {
    "title": "bold",
    "fault": "bold red",
    "stop": "bold white on red",
    "warn": "yellow",
    "plain": "",
    "dim": "dim",
}
"""How rich shows each kind; what is dim or coloured says the same in its words."""


@dataclass(frozen=True)
class Line:
    """One line. ``weight``: what has less goes first where there is no room; 0 stays. ``goes_on``: its sentence ends in
    the next one."""

    text: str
    kind: Kind = "plain"
    weight: int = field(default=0, compare=False)
    goes_on: bool = field(default=False, compare=False)


def lines(status: Status, columns_n: int, lines_n: int) -> list[Line]:
    """The status in so much room."""
    found = [*_head(status), *_faults(status, columns_n), *_axes(status, columns_n), *_soil(status), *_rest(status)]
    found = [replace(line, text=fitting(printable(line.text), columns_n)) for line in found]
    for weight in sorted({line.weight for line in found if line.weight}, reverse=True):
        for place in reversed([place for place, line in enumerate(found) if line.weight == weight]):
            if len(found) > lines_n:
                _leave_out(found, place, columns_n)
    if len(found) > lines_n:
        left_out = len(found) - lines_n + 1
        found = [*found[: lines_n - 1], Line(f"{MARK} {left_out} more lines: graderd status --json", "warn")]
    return found


def _leave_out(found: list[Line], place: int, columns_n: int) -> None:
    """Take a line out; the sentence that it ends says by a mark that it goes on."""
    gone = found.pop(place)
    before = found[place - 1] if place else None
    if before is not None and before.goes_on:
        found[place - 1] = replace(before, text=fitting(f"{before.text} {gone.text.strip()}", columns_n), goes_on=False)


def fitting(text: str, columns_n: int) -> str:
    """The text in so many columns, cut between words where it is too long, and never in a number."""
    if len(text) <= columns_n:
        return text
    kept = text[: columns_n - len(MARK)]
    if text[len(kept)] != " ":
        kept = kept[: kept.rfind(" ") + 1] if " " in kept.strip() else kept
    kept = kept.rstrip()
    # A number stands with its unit: "3.1" alone would say less than it did.
    words = kept.split(" ")
    while len(words) > 1 and words[-1].rstrip(",;:")[-1:].isdigit():
        words.pop()
    return " ".join(words).rstrip(" ,;:") + MARK


def number(value: float | None, unit: str, digits: int = 1) -> str:
    """``12.3 deg``; what is not known is a dash, and never a number."""
    return "-" if value is None else f"{value:z.{digits}f} {unit}"


def profile(heights_mm: Sequence[float | None]) -> str:
    """Heights along the blade as bars, with the highest as a number; ``·`` no soil, ``?`` not seen."""
    highest_mm = max((height_mm for height_mm in heights_mm if height_mm is not None), default=None)
    full_mm = max(highest_mm or 0.0, TALL_MM)
    bars = "".join(_bar(height_mm, full_mm) for height_mm in heights_mm)
    told = "none of it seen" if highest_mm is None else f"{number(highest_mm, 'mm', 0)} high"
    return f"left {bars} right, {told}"


def _bar(height_mm: float | None, full_mm: float) -> str:
    if height_mm is None:
        return UNSEEN
    return LEVEL if height_mm < 1.0 else BARS[min(int(height_mm / full_mm * len(BARS)), len(BARS) - 1)]


def _head(status: Status) -> Iterator[Line]:
    mode, arming = status["mode"], " (arming)" if status["arming"] else ""
    kind: Kind = "stop" if mode == "stopped" else "title"
    yield Line(f"{str(mode).upper()}{arming}: {status['reason']}", kind)
    lease = status["lease"]
    if lease is not None:
        yield Line(f"moved by {lease['client']}, {lease['remaining_s']:.1f} s left", "warn")
    for reason in status["holding"]:
        yield Line(f"holding: {reason}", "warn", 2)
    if status["last_stop"] and mode != "stopped":
        yield Line(f"last stop: {status['last_stop']}", "dim", 7)


def _faults(status: Status, columns_n: int) -> Iterator[Line]:
    for fault in status["faults"]:
        over = "" if fault["present"] else " (over)"
        kind: Kind = "fault" if fault["reaction"] in BADLY else "warn"
        yield Line(f"! {fault['name']}{over}, {fault['reaction']}: {fault['reads']}", kind)
        parts = _wrapped(fault["remedy"], columns_n - 4, 2)
        for number_n, part in enumerate(parts, start=1):
            yield Line(f"{'  >' if number_n == 1 else '   '} {part}", kind, 1, goes_on=number_n < len(parts))
        if fault["detail"]:
            yield Line(f"    {fault['detail']}", kind, 5)
    if not status["faults"]:
        yield Line("no faults", "dim", 3)
    told = {fault["name"] for fault in status["faults"]}
    for need in status["readiness"]:
        if not need["met"] and need["name"] not in told:
            yield Line(_unmet(need, columns_n), "warn", 1 if need["mandatory"] else 4)


def _unmet(need: Mapping[str, Any], columns_n: int) -> str:
    """A requirement in one line: where there is no room for both, the reason gives way to the remedy."""
    begin, end = f"{'not ready' if need['mandatory'] else 'missing'}: {need['name']}", f" > {need['remedy']}"
    room_n = columns_n - len(begin) - len(", ") - len(end)
    return f"{begin}, {fitting(need['reason'], room_n)}{end}" if room_n >= LEAST_REASON_N else f"{begin}{end}"


def _wrapped(text: str, columns_n: int, lines_n: int) -> list[str]:
    """Words in at most so many lines."""
    found: list[str] = []
    rest = text
    while rest and len(found) < lines_n:
        if len(found) == lines_n - 1:
            found.append(rest)
            break
        kept = rest if len(rest) <= columns_n else rest[: columns_n + 1].rpartition(" ")[0] or rest[:columns_n]
        found.append(kept)
        rest = rest[len(kept) :].strip()
    return found


def _axes(status: Status, columns_n: int) -> Iterator[Line]:
    wide = columns_n > NARROW_N
    header = ["axis", "state", "wanted", "measured", "age"]
    header += ["limited", "sent", "current", "temp."] if wide else []
    rows = [[*header, "" if columns_n < NARROW_N else "notes"]]
    for axis in status["axes"].values():
        unit = axis["unit"]
        row = [
            axis["name"],
            axis["lifecycle"],
            number(axis["requested"], unit),
            number(axis["measured"], unit),
            number(axis["measured_age_s"], "s", 2),
        ]
        if wide:
            row += [number(axis["limited"], unit), number(axis["sent"], unit)]
            row += [number(axis["current_a"], "A"), number(axis["temperature_c"], "°C", 0)]
        rows.append([*row, _note(axis)])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]) - 1)]
    for place, row in enumerate(rows):
        cells = [
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row[:-1], widths, strict=True))
        ]
        moving = place > 0 and row[-1].startswith("moving")
        yield Line("  ".join([*cells, row[-1]]).rstrip(), "dim" if place == 0 else "warn" if moving else "plain")


def _note(axis: Mapping[str, Any]) -> str:
    notes = ["moving"] if axis["moving"] else []
    notes += [axis["limited_because"], *(axis["flags"] or ())]
    return ", ".join(note for note in notes if note)


def _soil(status: Status) -> Iterator[Line]:
    soil = status["soil"]
    sure = f", {soil['confidence']:.0%} sure" if soil["zone"] != "unknown" else ""
    age = "" if soil["age_s"] is None else f", {number(soil['age_s'], 's old', 2)}"
    yield Line(f"soil {soil['zone']}{sure}{age}: {soil['reason']}")
    thirds = [f"{third} {soil[f'share_{third}']:.0%}" for third in THIRDS if soil[f"share_{third}"] is not None]
    if thirds:
        yield Line(f"  shares   {'  '.join(thirds)}", "plain", 6)
    for name in ("ahead", "carried"):
        litres = soil[name]
        if litres is not None:
            told_l = "  ".join(f"{third} {litres[third + '_l']:.1f} l" for third in THIRDS)
            yield Line(f"  {name.ljust(8)} {told_l}")
    if soil["profile_mm"] is not None:
        yield Line(f"  profile  {profile(soil['profile_mm'])}", "plain", 6)
    decision = status["decision"]
    angle = "none" if decision["zone"] is None else number(decision["angle_deg"], "deg")
    because = f": {decision['reason']}" if decision["reason"] else ""
    yield Line(f"decision {angle}{because}")


def _rest(status: Status) -> Iterator[Line]:
    blade, vehicle, camera = status["attitude"], status["vehicle"], status["camera"]
    parts = (
        f"height {number(blade['height_mm'], 'mm', 0)}",
        f"slope {number(blade['slope_deg'], 'deg')}",
        f"pitch {number(blade['pitch_deg'], 'deg')}",
    )
    yield Line(f"blade    {'  '.join(parts)}")
    drives = number(vehicle["speed_m_per_s"], "m/s", 2)
    yield Line(f"drives   {drives}" if vehicle["age_s"] is not None else "drives   not told", "plain", 4)
    where, tick = "simulated" if status["simulated"] else "machine", status["tick"]
    late = f"p99 {tick['lateness_p99_ms']:.1f} ms late, {tick['overruns_n']} overruns"
    yield Line(f"graderd  {status['version']} ({where}), {tick['rate_hz']:.0f} Hz, {late}", "dim", 8)
    restarts = f", restarted {camera['restarts_n']} times" if camera["restarts_n"] else ""
    described = f", {camera['description']}" if camera["description"] else ""
    yield Line(f"camera   {camera['lifecycle']}{restarts}{described}", "plain", 5)


def shown(found: Sequence[Line]) -> str:
    """As plain text."""
    return "\n".join(line.text for line in found)
