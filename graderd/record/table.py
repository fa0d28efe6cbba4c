"""A recording as a table: one row a tick, for spreadsheets, plots and the report."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from graderd.core.axes import AXES, UNITS
from graderd.record.layout import GAP, MARK, SENSED, TICK, Mark
from graderd.record.reader import Recording, said

Row = Mapping[str, Any]
MOST: Final = 1e12
"""No measurement is so great, in any unit."""
AXIS_COLUMNS: Final = tuple(
    f"{axis}_{name}"
    for axis in AXES
    for name in (
        f"requested_{UNITS[axis]}",
        f"limited_{UNITS[axis]}",
        f"sent_{UNITS[axis]}",
        f"measured_{UNITS[axis]}",
        "current_a",
        "because",
    )
)
THIRDS: Final = ("left", "center", "right")
COLUMNS: Final = (
    "wall_time", "now_s", "mode", "reason", "zone", "confidence", "left_l", "center_l", "right_l",
    "ahead_zone", "ahead_confidence", "ahead_left_l", "ahead_center_l", "ahead_right_l", "decision", "decision_deg",
    "speed_m_per_s", "travelled_m", "torque_nm", "temperature_c", *AXIS_COLUMNS, "faults", "commands",
    "missing_before_s",
)  # fmt: skip


def rows(recording: Recording) -> Iterator[Row]:
    """Every tick, oldest first; what was not known is absent. ``missing_before_s``: where ticks before it are missing,
    how long it is since the last one. What is not as graderd writes it is in ``recording.unreadable`` then.
    """
    sensed: dict[str, Any] | None = None
    last_ns: int | None = None
    breaks = False
    for message in recording.messages((SENSED, TICK, MARK, GAP)):
        if message.topic == SENSED:
            sensed = recording.value_of(message, _sensed)
        elif message.topic == TICK:
            tick = recording.value_of(message, _tick)
            if sensed is None or tick is None:
                breaks = True
            elif sensed["now_s"] == tick["now_s"]:
                wall_time = datetime.fromtimestamp(message.log_ns / 1e9, UTC).isoformat(timespec="milliseconds")
                row = {"wall_time": wall_time, **sensed, **tick}
                if breaks and last_ns is not None:
                    row["missing_before_s"] = round((message.log_ns - last_ns) / 1e9, 3)
                last_ns, breaks = message.log_ns, False
                yield {name: value for name, value in row.items() if value is not None}
        elif message.topic == GAP:
            breaks = True
        else:
            mark = recording.value_of(message, Mark.model_validate_json)
            breaks = breaks or mark is None or mark.kind == "lost"


def _sensed(data: bytes) -> dict[str, Any]:
    """What a tick knew."""
    told = said(data)
    vehicle, axes = told.get("vehicle", {}), told["axes"]
    rotation = axes.get("rotation", {}).get("telemetry", {})
    found: dict[str, Any] = {
        "now_s": _seconds(told["now_s"]),
        "speed_m_per_s": _value(vehicle, "speed_m_per_s"),
        "travelled_m": _value(vehicle, "travelled_m"),
        "torque_nm": _value(rotation, "torque_nm"),
        "temperature_c": _value(rotation, "temperature_c"),
        "commands": "; ".join(f"{c['command']} by {c.get('client') or '?'}" for c in told["commands"]),
    }
    for axis, each in axes.items():
        telemetry = each.get("telemetry", {})
        found[f"{axis}_measured_{UNITS[axis]}"] = _value(
            telemetry, "angle_deg" if axis == "rotation" else "position_mm"
        )
        found[f"{axis}_current_a"] = _value(telemetry, "current_a")
    return found


def _tick(data: bytes) -> dict[str, Any]:
    """What it decided."""
    told = said(data)
    state, soil = told["state"], told.get("soil", {})
    ahead, decision = soil.get("ahead", {}), state.get("decision", {})
    found: dict[str, Any] = {
        "now_s": _seconds(told["now_s"]),
        "mode": _text(state["mode"]),
        "reason": _text(state["reason"]),
        "zone": _text(soil.get("zone")),
        "confidence": _number(soil.get("confidence")),
        "left_l": _number(soil.get("volume_left_l")),
        "center_l": _number(soil.get("volume_center_l")),
        "right_l": _number(soil.get("volume_right_l")),
        "ahead_zone": _text(ahead.get("zone")),
        "ahead_confidence": _number(ahead.get("confidence")),
        **{f"ahead_{third}_l": _number(ahead.get("litres", {}).get(third)) for third in THIRDS},
        "decision": _text(decision.get("zone")),
        "decision_deg": _number(decision.get("angle_deg")),
        "faults": "; ".join(fault["name"] for fault in told["faults"]),
    }
    for axis, decided in told["axes"].items():
        unit = UNITS[axis]
        found[f"{axis}_requested_{unit}"] = _number(decided.get("requested"))
        found[f"{axis}_limited_{unit}"] = _number(decided.get("limited"))
        found[f"{axis}_sent_{unit}"] = _number(decided.get("send"))
        found[f"{axis}_because"] = _text(decided.get("because"))
    return found


def _value(told: Mapping[str, Any], name: str) -> float | None:
    reading = told.get(name)
    return _number(reading["value"]) if reading is not None and reading.get("valid", True) else None


def _number(value: Any) -> float | None:
    """A measurement; None: not known, as what no measurement can be is written (as a word: NaN, Infinity)."""
    if value is None or (isinstance(value, str) and not math.isfinite(float(value))):
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{str(value)[:40]!r} is no number")
    if not abs(value) < MOST:
        raise ValueError("a number in it is no measurement")
    return value


def _seconds(value: Any) -> float:
    found = _number(value)
    if found is None:
        raise ValueError("now_s: no time")
    return found


def _text(value: Any) -> str | None:
    if value is not None and not isinstance(value, str):
        raise TypeError(f"{str(value)[:40]!r} is no text")
    return value


def write_csv(path: Path, found: Iterable[Row]) -> int:
    """Write the rows with a heading; returns how many there were."""
    count_n = 0
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="", extrasaction="raise")
        writer.writeheader()
        for row in found:
            writer.writerow(row)
            count_n += 1
    return count_n
