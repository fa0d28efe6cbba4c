"""Time for tests that run in real time on a machine that may be busy."""

from __future__ import annotations

import threading
import time

_LONGEST_STEP_S = 0.05


class AwakeClock:
    """Monotonic seconds, less what the machine withheld from this process.

    Device, driver and test share it, and something in each of them looks every few milliseconds. Where nobody did for
    more than 50 ms the process had no processor, and of that time only 50 ms count: a deadline is then missed by what
    one of them does, not by what the machine does to all of them.
    """

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._withheld_s = 0.0
        self._lock = threading.Lock()

    def now_s(self) -> float:
        """Seconds, never back."""
        with self._lock:
            now_s = time.monotonic()
            self._withheld_s += max(0.0, now_s - self._looked_s - _LONGEST_STEP_S)
            self._looked_s = now_s
            return now_s - self._withheld_s
