"""Time for tests that run in real time on a machine that may be busy."""

from __future__ import annotations

import threading
import time

_LONGEST_STEP_S = 0.05


class PatientClock:
    """Monotonic seconds, less what the machine withheld from this process.

    Device, driver and test share it. Where nobody looked for more than 50 ms (something ticks every few milliseconds
    in each of them), the process had no processor; had that time passed, deadlines that both ends keep to the letter
    would be missed by neither of them.
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
