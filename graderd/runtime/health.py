"""Watches the daemon's own process: memory, and steps of the wall clock. Tells faults, changes nothing."""

from __future__ import annotations

import asyncio
import resource
import time
from pathlib import Path

from graderd.config import Config
from graderd.hal.fault import DeviceFault, PresentFaults

LOOK_EVERY_S = 1.0
STEP_S = 2.0
STEP_SHOWN_S = 10.0


class HealthWatch:
    """Control runs on the monotonic clock, so a stepped wall clock moves nothing; it is told because records jump."""

    def __init__(self, config: Config) -> None:
        self._limit_mb = config.control.memory_warn_mb
        self._offset_s = time.time() - time.monotonic()
        self._faults = PresentFaults("daemon")

    async def run(self) -> None:
        """Look once a second until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(LOOK_EVERY_S)

    def look(self) -> None:
        """Take one measurement."""
        now_s = time.monotonic()
        offset_s = time.time() - now_s
        step_s, self._offset_s = offset_s - self._offset_s, offset_s
        if abs(step_s) > STEP_S:
            self._faults.tell("clock_stepped", f"the wall clock was stepped by {step_s:+.0f} s", now_s, STEP_SHOWN_S)
        memory_mb = _resident_mb()
        detail = f"{memory_mb:.0f} MB in use, {self._limit_mb:g} MB expected at most"
        self._faults.keep("memory_high", memory_mb > self._limit_mb, detail, now_s)

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """What was seen."""
        return self._faults.present(now_s)


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6
