"""Which faults are present, since when. Names only: how bad they are is the fault catalogue's business."""

from __future__ import annotations

from collections.abc import Mapping

from graderd.hal.fault import DeviceFault

_EVENT_S = 1.0
"""An event (a trip, a lost turn) stays visible at least so long after its cause is gone."""


class FaultBook:
    """Present faults of one device."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._faults: dict[str, DeviceFault] = {}
        self._until_s: dict[str, float] = {}

    def present(self, now_s: float) -> tuple[DeviceFault, ...]:
        """All that are present now, oldest first."""
        for condition in [c for c, until_s in self._until_s.items() if now_s > until_s]:
            del self._until_s[condition]
            self._faults.pop(condition, None)
        return tuple(sorted(self._faults.values(), key=lambda f: f.since_s))

    def __contains__(self, condition: object) -> bool:
        return condition in self._faults

    def set(self, condition: str, detail: str, now_s: float) -> bool:
        """It holds until cleared; True where it is new."""
        self._until_s.pop(condition, None)
        return self._put(condition, detail, now_s)

    def event(self, condition: str, detail: str, now_s: float) -> bool:
        """It happened: visible for a moment, or as long as it is told again."""
        new = self._put(condition, detail, now_s)
        self._until_s[condition] = now_s + _EVENT_S
        return new

    def clear(self, *conditions: str) -> None:
        """They are gone."""
        for condition in conditions:
            self._faults.pop(condition, None)
            self._until_s.pop(condition, None)

    def replace(self, conditions: frozenset[str], present: Mapping[str, str], now_s: float) -> None:
        """Of the group ``conditions`` exactly those in ``present`` hold (name to detail)."""
        for condition in conditions:
            if condition in present:
                self.set(condition, present[condition], now_s)
            elif condition in self._faults:
                self.clear(condition)

    def _put(self, condition: str, detail: str, now_s: float) -> bool:
        before = self._faults.get(condition)
        since_s = before.since_s if before is not None else now_s
        self._faults[condition] = DeviceFault(self._device, condition, detail, since_s)
        return before is None
