"""What is wrong with a device: a name and its detail, and the book that keeps which are present. No judgement.

How bad a fault is, what the operator reads and what clears it stands in the fault catalogue (``graderd.core.faults``);
latching belongs to it alone. Whoever reports faults says what he sees now.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

EVENT_SHOWN_S = 1.0
"""What is over in an instant (a trip, a restart) counts as present for so long, so that nobody who looks misses it."""


@dataclass(frozen=True, slots=True)
class DeviceFault:
    """One present fault of one device.

    ``device``: ``camera``, ``rotation``, ``lift_left``, ``lift_right``, ``tilt``, ``can``, ``servo_bus``,
    ``stop_input`` or ``daemon``.
    ``condition``: the catalogue's name of the condition, for example ``no_reply``.
    ``detail``: one line with the numbers, for example ``no status packet for 0.21 s (7 requests)``.
    ``since_s``: monotonic time at which it was first seen.
    """

    device: str
    condition: str
    detail: str
    since_s: float

    @property
    def name(self) -> str:
        """``device.condition``, the name used in status, records and ``graderd explain``."""
        return f"{self.device}.{self.condition}"


class PresentFaults:
    """The conditions of one device that are present now, each with the time it began.

    A *state* holds from :meth:`set` to :meth:`clear`; an *event*, over in an instant, is shown for a while after
    :meth:`tell` and longer where it is told again. One thread may write and another read.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._entries: Mapping[str, tuple[DeviceFault, float]] = {}  # replaced as a whole, never changed

    def present(self, now_s: float) -> tuple[DeviceFault, ...]:
        """All that are present now, oldest first."""
        if not self._entries:
            return ()
        shown = (fault for fault, until_s in self._entries.values() if now_s <= until_s)
        return tuple(sorted(shown, key=lambda f: f.since_s))

    def names(self, now_s: float) -> frozenset[str]:
        """The conditions that are present now."""
        return frozenset(name for name, (_, until_s) in self._entries.items() if now_s <= until_s)

    def set(self, condition: str, detail: str, now_s: float) -> bool:
        """It is there until cleared; True where it was not."""
        return self._put(condition, detail, now_s, float("inf"))

    def tell(self, condition: str, detail: str, now_s: float, shown_s: float = EVENT_SHOWN_S) -> bool:
        """It happened: present for ``shown_s`` from now, whatever was told of it before; True where it was not."""
        return self._put(condition, detail, now_s, now_s + shown_s)

    def keep(self, condition: str, present: bool, detail: str, now_s: float) -> None:
        """Set or clear by a truth value."""
        if present:
            self.set(condition, detail, now_s)
        else:
            self.clear(condition)

    def keep_only(self, present: Mapping[str, str], now_s: float, *, among: frozenset[str] | None = None) -> None:
        """Exactly those in ``present`` (condition to detail) are there; ``among``: the others are left as they are."""
        self.clear(*((self._entries.keys() if among is None else among) - present.keys()))
        for condition, detail in present.items():
            self.set(condition, detail, now_s)

    def clear(self, *conditions: str) -> None:
        """They are gone."""
        if not self._entries.keys().isdisjoint(conditions):
            self._entries = {name: entry for name, entry in self._entries.items() if name not in conditions}

    def clear_all(self) -> None:
        """Nothing is known to be wrong."""
        self._entries = {}

    def _put(self, condition: str, detail: str, now_s: float, until_s: float) -> bool:
        former = self._entries.get(condition)
        new = former is None or now_s > former[1]
        since_s = now_s if former is None or new else former[0].since_s
        fault = DeviceFault(self._device, condition, detail, since_s)
        self._entries = {**self._entries, condition: (fault, until_s)}
        return new
