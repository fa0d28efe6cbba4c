"""How the demonstration is shown: a live panel on a terminal, one line an event elsewhere, or JSON lines."""

from __future__ import annotations

import json
import sys
import time
from types import TracebackType
from typing import Any, Protocol, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from graderd.core.status import AxisStatus, Status

BAR_N = 24
EVENTS_SHOWN_N = 6


class Show(Protocol):
    """Something that shows events and the running status."""

    def event(self, event: str, **fields: Any) -> None:
        """Something happened."""
        ...

    def status(self, status: Status) -> None:
        """The machine's status now."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def make_show(as_json: bool) -> Show:
    """The show that fits where the output goes."""
    if as_json:
        return LineShow(as_json=True)
    return PanelShow() if sys.stdout.isatty() else LineShow(as_json=False)


class LineShow:
    """One line an event; changes of mode, faults and decisions are told too."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._start_s = time.monotonic()
        self._told: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def event(self, event: str, **fields: Any) -> None:
        if self._as_json:
            line = json.dumps({"event": event, **fields})
        else:
            told = ", ".join(f"{key} {_plain(value)}" for key, value in fields.items())
            line = f"{time.monotonic() - self._start_s:6.2f} s  {event.replace('_', ' '):14} {told}"
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    def status(self, status: Status) -> None:
        rotation = status.axes.get("rotation")
        changes = {
            "mode": str(status.mode),
            "soil": str(status.soil.zone),
            "faults": [fault.name for fault in status.faults],
        }
        for name, value in changes.items():
            if self._told.get(name, [] if name == "faults" else None) != value:
                self._told[name] = value
                extra = {"angle_deg": rotation.measured} if rotation and name == "soil" else {}
                self.event(name, **{name: value}, **extra)


class PanelShow:
    """A panel a person can follow."""

    def __init__(self) -> None:
        self._console = Console()
        self._live = Live(console=self._console, refresh_per_second=12, transient=False)
        self._events: list[str] = []
        self._start_s = time.monotonic()

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def event(self, event: str, **fields: Any) -> None:
        if event == "demo_finished":
            self._live.console.print(_passes_table(fields["passes"]))
            if fields["reason"]:
                self._live.console.print(Text(f"failed: {fields['reason']}", "red"))
            return
        told = ", ".join(f"{key} {_plain(value)}" for key, value in fields.items())
        self._events.append(f"{time.monotonic() - self._start_s:6.1f} s  {event}  {told}")
        if event == "starting":
            self._live.update(Panel(f"starting the {fields['what']} …", title="graderd"))

    def status(self, status: Status) -> None:
        body = Group(_soil(status), _axes(status), _faults(status), Text("\n".join(self._events[-EVENTS_SHOWN_N:])))
        self._live.update(Panel(body, title=f"graderd  {status.mode}: {status.reason}", border_style=_color(status)))


def _color(status: Status) -> str:
    return {"stopped": "red", "auto": "green", "manual": "cyan"}.get(str(status.mode), "white")


def _soil(status: Status) -> Table:
    soil = status.soil
    table = Table(title="soil in front of the blade, as the operator sees it (left | center | right)", expand=True)
    for name in ("left", "center", "right"):
        table.add_column(name, justify="center")
    bars = []
    for name in ("left", "center", "right"):
        share = getattr(soil, f"share_{name}")
        litres = getattr(soil, f"volume_{name}_l")
        bar = "█" * round((share or 0.0) * BAR_N)
        style = "bold green" if soil.zone == name else "yellow"
        bars.append(
            Text(
                f"{bar or '·'}\n{'?' if share is None else f'{share:4.0%}'}"
                + (f"  {litres:.1f} l" if litres is not None else ""),
                style,
            )
        )
    table.add_row(*bars)
    age = f"{soil.age_s * 1e3:.0f} ms old, {soil.frames_per_s:.0f} frames/s" if soil.age_s is not None else "no picture"
    table.caption = (
        f"zone {soil.zone} ({soil.confidence:.0%}, {soil.reason}; {age}) — decision: {status.decision.reason}"
    )
    return table


def _axes(status: Status) -> Table:
    table = Table(expand=True)
    for column in ("axis", "requested", "limited", "sent", "measured", "", "state"):
        table.add_column(column, justify="right" if column not in ("axis", "", "state") else "left")
    for axis in status.axes.values():
        table.add_row(
            axis.name,
            *(_number(value) for value in (axis.requested, axis.limited, axis.sent, axis.measured)),
            axis.unit,
            _axis_state(axis),
        )
    return table


def _axis_state(axis: AxisStatus) -> str:
    moving = "?" if axis.moving is None else "moving" if axis.moving else "at rest"
    return f"{axis.lifecycle}, {moving}" + (f", {', '.join(axis.flags)}" if axis.flags else "")


def _faults(status: Status) -> Text:
    lines = [f"{fault.name}: {fault.reads} — {fault.remedy}" for fault in status.faults]
    lines += [f"holding: {reason}" for reason in status.holding]
    return Text("\n".join(lines) if lines else "no faults", style="red" if lines else "green")


def _passes_table(passes: list[dict[str, Any]]) -> Table:
    table = Table(title="passes")
    for column in ("soil", "decided", "requested", "measured", "settled in"):
        table.add_column(column, justify="right")
    for one in passes:
        table.add_row(
            one["zone"],
            one["decided"],
            f"{one['requested_deg']:+.1f}°",
            f"{one['measured_deg']:+.2f}°",
            f"{one['settle_s']:.2f} s",
        )
    return table


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.1f}"


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "; ".join("/".join(_plain(v) for v in item.values()) for item in value)
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)
