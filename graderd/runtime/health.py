"""Watches the daemon's own process: memory, and steps of the wall clock. Tells faults, changes nothing."""

from __future__ import annotations

import asyncio
import resource
import time
from pathlib import Path

from graderd.config import Config
from graderd.hal.fault import DeviceFault

LOOK_EVERY_S = 1.0
STEP_S = 2.0
FAULT_SHOWN_S = 10.0


class HealthWatch:
    """Control runs on the monotonic clock, so a stepped wall clock moves nothing; it is told because records jump."""

    def __init__(self, config: Config) -> None:
        self._limit_mb = config.control.memory_warn_mb
        self._offset_s = time.time() - time.monotonic()
        self._step: tuple[float, float] | None = None
        self._memory_mb = 0.0

    async def run(self) -> None:
        """Look once a second until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(LOOK_EVERY_S)

    def look(self) -> None:
        """Take one measurement."""
        offset_s = time.time() - time.monotonic()
        if abs(offset_s - self._offset_s) > STEP_S:
            self._step = (offset_s - self._offset_s, time.monotonic())
        self._offset_s = offset_s
        self._memory_mb = _resident_mb()

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """What was seen."""
        found = []
        if self._step is not None and now_s - self._step[1] < FAULT_SHOWN_S:
            detail = f"the wall clock was stepped by {self._step[0]:+.0f} s"
            found.append(DeviceFault("daemon", "clock_stepped", detail, self._step[1]))
        if self._memory_mb > self._limit_mb:
            detail = f"{self._memory_mb:.0f} MB in use, {self._limit_mb:g} MB expected at most"
            found.append(DeviceFault("daemon", "memory_high", detail, now_s))
        return tuple(found)


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6
