"""How the demonstration is shown: a live panel on a terminal, one line an event elsewhere, or JSON lines."""

from __future__ import annotations

import json
import sys
import time
from types import TracebackType
from typing import Any, Protocol, Self

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from graderd.core.status import Status
from graderd.view import LEAST_COLUMNS_N, LEAST_LINES_N, STYLES, Line, fitting, lines

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
    """What a person can follow, in whatever room the terminal has; what came of it stays on the screen at the end."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console()
        self._live = Live(console=self._console, refresh_per_second=12, transient=True)
        self._events: list[str] = []
        self._start_s = time.monotonic()
        self._finished: dict[str, Any] | None = None

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)
        if self._finished is not None:
            self._console.print(_passes_table(self._finished["passes"]))
            reason = self._finished["reason"]
            self._console.print(
                Text(f"failed: {reason}", "red") if reason else Text("all passes as they must", "green")
            )

    def event(self, event: str, **fields: Any) -> None:
        if event == "demo_finished":
            self._finished = fields
            return
        told = ", ".join(f"{key} {_plain(value)}" for key, value in fields.items())
        self._events.append(f"{time.monotonic() - self._start_s:6.1f} s  {event}  {told}")
        if event == "starting":
            self._live.update(Text(f"starting the {fields['what']} …"))

    def status(self, status: Status) -> None:
        self._live.update(self.frame(status))

    def frame(self, status: Status) -> Text:
        """The screen: soil as bars, the status, what happened last. A line stays free below it."""
        columns_n = max(self._console.width, LEAST_COLUMNS_N)
        lines_n = max(self._console.height, LEAST_LINES_N) - 1
        bars = _bars(status, columns_n)
        events = self._events[-min(EVENTS_SHOWN_N, lines_n // 4) :]
        room_n = lines_n - len(bars) - len(events)
        shown = lines(status.model_dump(mode="json"), columns_n, room_n)
        told = [Line(fitting(event, columns_n), "dim") for event in events]
        return Text("\n").join(Text(line.text, STYLES[line.kind], no_wrap=True) for line in [*bars, *shown, *told])


def _bars(status: Status, columns_n: int) -> list[Line]:
    """The soil by thirds as the operator sees it, one bar each."""
    width_n = columns_n - len("center 100 % ")
    found = []
    for name in ("left", "center", "right"):
        share = getattr(status.soil, f"share_{name}")
        told = "   ?  " if share is None else f"{share:4.0%}  "
        bar = "█" * round((share or 0.0) * width_n)
        found.append(Line(f"{name:6} {told}{bar}", "title" if status.soil.zone == name else "plain"))
    return found


def _passes_table(passes: list[dict[str, Any]]) -> Table:
    table = Table(title="passes", box=SIMPLE_HEAD)
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


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "; ".join("/".join(_plain(v) for v in item.values()) for item in value)
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)
