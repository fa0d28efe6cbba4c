"""Says where the event loop hangs: every thread's stack on standard error, before systemd ends the process."""

from __future__ import annotations

import contextlib
import faulthandler
import sys

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
