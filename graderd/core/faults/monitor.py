"""Faults: how severe, how long until they count, and what clears them. The rows themselves:
:mod:`graderd.core.faults.catalogue`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum

from graderd.core.axes import ACTUATORS, PARTS
from graderd.hal.fault import DeviceFault

GONE_COUNTS = 3.0
ROUNDING_S = 1e-9
ALL_AXES = frozenset(PARTS.values())


class Reaction(IntEnum):
    """What the machine does, in rising order.

    WARN: tell. HOLD: the axes named stay where they are while the fault lasts. RETREAT: automatic operation ends,
    the blade is held and the operator has it in manual. DISARM: hold, then power off as configured. STOP: motion
    ends at once and stays ended until reset.
    """

    WARN = 0
    HOLD = 1
    RETREAT = 2
    DISARM = 3
    STOP = 4


class Clear(StrEnum):
    """What ends a fault."""

    WHEN_GONE = "when gone"
    ON_REARM = "on re-arm"
    ON_RESET = "on reset"
    NEVER = "never (restart the daemon after repair)"


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One row of the catalogue. ``key`` is ``part.condition``; part ``actuator`` stands for each of the three."""

    key: str
    reads: str
    cause: str
    remedy: str
    reaction: Reaction
    debounce_s: float = 0.0
    clear: Clear = Clear.WHEN_GONE
    axes: frozenset[str] = ALL_AXES
    automatic_only: bool = False
    """The fault holds its axes only while automatic operation turns the blade: an operator sees for himself."""


@dataclass(frozen=True, slots=True)
class ActiveFault:
    """A fault that counts now. ``present`` is False where only its latch keeps it."""

    name: str
    row: FaultRow
    detail: str
    since_s: float
    present: bool


def catalogue_key(device: str, condition: str) -> str:
    """Key of the row for a device's condition: the three actuators share their rows."""
    part = "actuator" if device in ACTUATORS else device
    return f"{part}.{condition}"


@dataclass(frozen=True, slots=True)
class Seen:
    """What speaks for a fault that may not count yet: since when it comes (and goes), and for how long it was there.
    Time without it counts against it, at a third: one that flaps faster than its debounce is told all the same, and
    one that was there for a moment is forgotten."""

    first_s: float
    there_s: float = 0.0
    now: bool = False

    def at(self, later_s: float) -> Seen | None:
        """The same so much later; None: nothing speaks for it any more."""
        there_s = self.there_s + (later_s if self.now else -later_s / GONE_COUNTS)
        return Seen(self.first_s, there_s) if self.now or there_s > 0.0 else None


@dataclass(frozen=True, slots=True)
class FaultState:
    """Memory of the fault monitor between ticks: what was seen of each, and the ones that are latched."""

    seen: Mapping[str, Seen] = field(default_factory=dict)
    now_s: float = 0.0
    active: tuple[ActiveFault, ...] = ()


def update_faults(
    state: FaultState, present: Iterable[DeviceFault], now_s: float, catalogue: Mapping[str, FaultRow]
) -> FaultState:
    """Debounce what is present, keep what is latched, drop what cleared by itself.

    An unknown condition is never ignored: it counts as a STOP until reset, because nobody decided what it means.
    """
    seen = {name: later for name, former in state.seen.items() if (later := former.at(now_s - state.now_s)) is not None}
    active: dict[str, ActiveFault] = {}
    for fault in present:
        row = row_for(fault, catalogue)
        former = seen.get(fault.name, Seen(now_s))
        first_s = former.first_s
        # More than its debounce is not counted: once gone for good, it is forgotten in a bounded time.
        there_s = min(former.there_s, row.debounce_s)
        seen[fault.name] = Seen(first_s, there_s, now=True)
        if there_s >= row.debounce_s - ROUNDING_S:
            active[fault.name] = ActiveFault(fault.name, _axes_of(fault.device, row), fault.detail, first_s, True)
    for old in state.active:
        if old.name not in active and old.row.clear is not Clear.WHEN_GONE:
            active[old.name] = ActiveFault(old.name, old.row, old.detail, old.since_s, False)
    ordered = sorted(active.values(), key=lambda f: (-f.row.reaction, f.since_s, f.name))
    return FaultState(seen, now_s, tuple(ordered))


def clear_faults(state: FaultState, event: Clear) -> FaultState:
    """Drop latched faults that ``event`` (ON_REARM or ON_RESET) clears and that are not present any more.

    A reset also clears what a re-arm would.
    """
    clears = {Clear.ON_REARM: (Clear.ON_REARM,), Clear.ON_RESET: (Clear.ON_REARM, Clear.ON_RESET)}.get(event, ())
    kept = tuple(f for f in state.active if f.present or f.row.clear not in clears)
    return FaultState(state.seen, state.now_s, kept)


def row_for(fault: DeviceFault, catalogue: Mapping[str, FaultRow]) -> FaultRow:
    """The catalogue's row, or a STOP row that says the condition is unknown."""
    key = catalogue_key(fault.device, fault.condition)
    return catalogue.get(key) or FaultRow(
        key,
        f"{fault.device} reports '{fault.condition}', which the fault catalogue does not know",
        "a driver newer than the catalogue",
        "report it; reset and re-arm when you know what it means",
        Reaction.STOP,
        clear=Clear.ON_RESET,
    )


def held_axes(active: Iterable[ActiveFault]) -> dict[str, ActiveFault]:
    """Parts that must stay where they are, each with the worst fault of severity HOLD or above that says so."""
    held: dict[str, ActiveFault] = {}
    for fault in active:
        if fault.row.reaction >= Reaction.HOLD:
            for part in fault.row.axes:
                held[part] = worst((held.get(part, fault), fault)) or fault
    return held


def worst(active: Iterable[ActiveFault]) -> ActiveFault | None:
    """The most severe fault, the oldest among equals."""
    return min(active, key=lambda f: (-f.row.reaction, f.since_s, f.name), default=None)


def _axes_of(device: str, row: FaultRow) -> FaultRow:
    """The lift rows hold both lifts; a fault of the tilt holds the tilt alone, unless the row says otherwise."""
    if row.key.startswith("actuator.") and row.axes == frozenset({"own"}):
        return replace(row, axes=frozenset({PARTS[device]}))
    return row
