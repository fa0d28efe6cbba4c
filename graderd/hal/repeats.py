"""Says the same thing less and less often: what keeps a log readable while a device is absent for a day."""

from __future__ import annotations

import logging
import re
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

SECOND_S = 60.0
THEN_EVERY_S = 3600.0
QUIET_S = 600.0
"""What has not come for so long and comes again is news, and told at once."""
KEYS_MOST_N = 500
BURST_N = 60
PER_S = 1 / 60
_NUMBERS = re.compile(r"0x[0-9a-f]+|\d+(\.\d+)?")


@dataclass(slots=True)
class _Told:
    """What is known of one message. ``times_n``: how often it came since it was told last."""

    told_s: float
    came_s: float
    told_n: int = 1
    times_n: int = 0


class _Budget:
    """So many lines at once and so many in the long run, whatever comes; counts those that were too many."""

    def __init__(self, now_s: float) -> None:
        self._left_n = float(BURST_N)
        self._at_s = now_s
        self._too_many_n = 0

    def spend(self, now_s: float) -> int | None:
        """None: there is nothing left. Else how many were left out since the last one that was not."""
        self._left_n = min(float(BURST_N), self._left_n + (now_s - self._at_s) * PER_S)
        self._at_s = now_s
        if self._left_n < 1.0:
            self._too_many_n += 1
            return None
        self._left_n -= 1.0
        too_many_n, self._too_many_n = self._too_many_n, 0
        return too_many_n


class RepeatFilter(logging.Filter):
    """Lets a message through at once, again after a minute, then hourly with a count of what came between.

    Two messages are the same where they differ in numbers alone: retry loops count, and name ports and times. One that
    carries the attribute ``event`` (a change of mode) tells what somebody did and is never taken for a repetition.
    Neither what is new nor what is an event can fill a disk: of each, :data:`BURST_N` go through at once and one a
    minute in the long run, and the next one that does says how many did not.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now_s = now_s
        self._told: OrderedDict[tuple[str, int, str], _Told] = OrderedDict()
        self._news = _Budget(now_s())
        self._events = _Budget(now_s())

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is told now; its message then carries the count."""
        now_s = self._now_s()
        event = getattr(record, "event", False)
        left_out_n = self._events.spend(now_s) if event else self._repetition(record, now_s)
        if left_out_n is None:
            return False
        if left_out_n:
            record.msg, record.args = f"{record.getMessage()} ({left_out_n} more not told)", None
        return True

    def _repetition(self, record: logging.LogRecord, now_s: float) -> int | None:
        key = (record.name, record.levelno, _NUMBERS.sub("#", record.getMessage()))
        told = self._told.pop(key, None)
        if told is None or now_s - told.came_s >= QUIET_S:
            left_out_n = self._news.spend(now_s)
            if left_out_n is not None:
                self._told[key] = _Told(now_s, now_s)
                if len(self._told) > KEYS_MOST_N:
                    self._told.popitem(last=False)
            return left_out_n
        self._told[key] = told
        told.came_s = now_s
        if now_s < told.told_s + (SECOND_S if told.told_n == 1 else THEN_EVERY_S):
            told.times_n += 1
            return None
        left_out_n, told.times_n = told.times_n, 0
        told.told_s, told.told_n = now_s, told.told_n + 1
        return left_out_n
