"""A recording as a table: one row a tick, for spreadsheets, plots and the report."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from graderd.core.axes import AXES, UNITS
from graderd.record.layout import GAP, MARK, SENSED, TICK
from graderd.record.reader import Recording, as_written, said

Row = Mapping[str, Any]
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
    how long it is since the last one.

    Raises:
        ProtocolError: a message is not as graderd writes it.
    """
    sensed: dict[str, Any] = {}
    last_ns: int | None = None
    breaks = False
    for message in recording.messages((SENSED, TICK, MARK, GAP)):
        row: dict[str, Any] | None = None
        with as_written(recording, message):
            told = said(message)
            if message.topic == SENSED:
                sensed = told
            elif message.topic != TICK:
                breaks = breaks or message.topic == GAP or told["kind"] == "lost"
            elif sensed.get("now_s") == told.get("now_s"):
                row = _row(message.log_ns, sensed, told)
                if breaks and last_ns is not None:
                    row["missing_before_s"] = round((message.log_ns - last_ns) / 1e9, 3)
                last_ns, breaks = message.log_ns, False
        if row is not None:
            yield row


def _row(log_ns: int, sensed: dict[str, Any], tick: dict[str, Any]) -> dict[str, Any]:
    state, soil, vehicle = tick["state"], tick.get("soil", {}), sensed.get("vehicle", {})
    decision = state.get("decision", {})
    rotation = sensed["axes"].get("rotation", {}).get("telemetry", {})
    found: dict[str, Any] = {
        "wall_time": datetime.fromtimestamp(log_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
        "now_s": tick["now_s"],
        "mode": state["mode"],
        "reason": state["reason"],
        "zone": soil.get("zone"),
        "confidence": soil.get("confidence"),
        "left_l": soil.get("volume_left_l"),
        "center_l": soil.get("volume_center_l"),
        "right_l": soil.get("volume_right_l"),
        "ahead_zone": soil.get("ahead", {}).get("zone"),
        "ahead_confidence": soil.get("ahead", {}).get("confidence"),
        **{f"ahead_{third}_l": soil.get("ahead", {}).get("litres", {}).get(third) for third in THIRDS},
        "decision": decision.get("zone"),
        "decision_deg": decision.get("angle_deg"),
        "speed_m_per_s": _value(vehicle, "speed_m_per_s"),
        "travelled_m": _value(vehicle, "travelled_m"),
        "torque_nm": _value(rotation, "torque_nm"),
        "temperature_c": _value(rotation, "temperature_c"),
        "faults": "; ".join(fault["name"] for fault in tick["faults"]),
        "commands": "; ".join(f"{c['command']} by {c.get('client') or '?'}" for c in sensed["commands"]),
    }
    for axis, decided in tick["axes"].items():
        unit, told = UNITS[axis], sensed["axes"].get(axis, {}).get("telemetry", {})
        found[f"{axis}_requested_{unit}"] = decided.get("requested")
        found[f"{axis}_limited_{unit}"] = decided.get("limited")
        found[f"{axis}_sent_{unit}"] = decided.get("send")
        found[f"{axis}_measured_{unit}"] = _value(told, "angle_deg" if axis == "rotation" else "position_mm")
        found[f"{axis}_current_a"] = _value(told, "current_a")
        found[f"{axis}_because"] = decided.get("because")
    return {name: value for name, value in found.items() if value is not None}


def _value(told: Mapping[str, Any], name: str) -> Any:
    reading = told.get(name)
    return reading["value"] if reading is not None and reading.get("valid", True) else None


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
