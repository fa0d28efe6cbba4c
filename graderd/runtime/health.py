"""Watches the daemon's own process: memory, steps of the wall clock, sleep of the computer, where its event loop hangs.
Changes nothing."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

from graderd.config import Config
from graderd.hal.fault import DeviceFault, PresentFaults

MEASURE_EVERY_S = 1.0
STEP_S = 2.0
STEP_SHOWN_S = 10.0


def resident_mb() -> float:
    """The memory of this process that is in RAM, in MB, what it shares with others included."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


class HealthWatch:
    """Control runs on the monotonic clock, so a stepped wall clock moves nothing; it is told because records jump.
    ``resident_mb``: see :func:`resident_mb`."""

    def __init__(self, config: Config, resident_mb: Callable[[], float] = resident_mb) -> None:
        self._limit_mb, self._resident_mb = config.control.memory_warn_mb, resident_mb
        self._offset_s = _wall_offset_s()
        self._faults = PresentFaults("daemon")

    async def run(self) -> None:
        """Measure once a second until cancelled."""
        while True:
            self.measure()
            await asyncio.sleep(MEASURE_EVERY_S)

    def measure(self) -> None:
        """Take one measurement."""
        now_s = time.monotonic()
        offset_s = _wall_offset_s()
        step_s, self._offset_s = offset_s - self._offset_s, offset_s
        if abs(step_s) > STEP_S:
            self._faults.tell("clock_stepped", f"the wall clock was stepped by {step_s:+.0f} s", now_s, STEP_SHOWN_S)
        memory_mb = self._resident_mb()
        detail = f"{memory_mb:.0f} MB in use, {self._limit_mb:g} MB expected at most"
        self._faults.keep("memory_high", memory_mb > self._limit_mb, detail, now_s)

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """What was seen."""
        return self._faults.present(now_s)


def _wall_offset_s() -> float:
    """The wall clock goes on while the computer sleeps, as does the clock since boot: that is no step."""
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)


SLEPT_LEAST_S = 0.01
"""The clocks tell nanoseconds, and what is measured is never more than what was slept: less is nothing."""


def slept_s() -> float:
    """For how long the computer has slept since it was started: CLOCK_MONOTONIC, by which everything here goes, stands
    still meanwhile and CLOCK_BOOTTIME does not. Never too much: a pause between the two readings makes it less."""
    boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return (boot_ns - time.monotonic_ns()) * 1e-9


class SleepWatch:
    """Tells that the computer slept, in the tick after it: by the monotonic clock no time went by, so that readings,
    pictures and leases from before look fresh, however old they are. ``slept_s``: see :func:`slept_s`."""

    def __init__(self, slept_s: Callable[[], float] = slept_s) -> None:
        self._read = slept_s
        self._slept_s = slept_s()
        self._faults = PresentFaults("daemon")

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """What was seen; to be asked in every tick."""
        slept_s = self._read()
        if slept_s > self._slept_s + SLEPT_LEAST_S:
            self._faults.tell("suspended", f"it slept for {slept_s - self._slept_s:.1f} s", now_s)
        self._slept_s = max(self._slept_s, slept_s)
        return self._faults.present(now_s)


HANGS_S = 1.5
"""Less than the unit's WatchdogSec=2, more than any tick takes."""
ARM_EVERY_S = 0.4
"""Arming starts a thread of the interpreter's (about 60 µs): not at every tick. A loop that hangs is told of after
:data:`HANGS_S` less up to this."""


class HangWatch:
    """Armed anew by the control tick; whoever is late finds the stacks printed by a thread that needs no lock of the
    interpreter's, so that a call that never returns to Python is told as well.

    From the start it also tells the stacks on a crash in a library, and on SIGABRT, with which systemd's watchdog ends
    a service.
    """

    def __init__(self) -> None:
        self._due_s = float("-inf")
        # Without a real standard error (a test captures it) there is nobody to tell.
        with contextlib.suppress(OSError, ValueError, RuntimeError):
            faulthandler.enable(sys.stderr, all_threads=True)

    def ticked(self, now_s: float) -> None:
        """The tick is alive at ``now_s`` (monotonic)."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + ARM_EVERY_S
        with contextlib.suppress(OSError, ValueError, RuntimeError):
            faulthandler.dump_traceback_later(HANGS_S, file=sys.stderr)

    def close(self) -> None:
        """Nothing ticks any more, on purpose."""
        faulthandler.cancel_dump_traceback_later()
