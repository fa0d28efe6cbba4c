"""Monotonic time as something that can be handed in, so that tests need not wait; and a pace measured by it."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Anything that tells monotonic seconds."""

    def now_s(self) -> float:
        """Monotonic seconds (CLOCK_MONOTONIC: the same in every process of one machine)."""
        ...


class SystemClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        return time.monotonic()


class ManualClock:
    """A clock that moves only when told; for tests and model checking."""

    def __init__(self, now_s: float = 0.0) -> None:
        self._now_s = now_s

    def now_s(self) -> float:
        return self._now_s

    def advance(self, seconds: float) -> None:
        """Move time forward by ``seconds`` (not negative)."""
        if seconds < 0:
            raise ValueError("a monotonic clock cannot go back")
        self._now_s += seconds


class Pace:
    """A leaky bucket, for what others make us do: at most ``burst_n`` at once and ``rate_hz`` in the long run."""

    def __init__(self, rate_hz: float, burst_n: int) -> None:
        self._interval_s = 1.0 / rate_hz
        self._depth_s = burst_n / rate_hz
        self._next_s = float("-inf")

    def delay_s(self, now_s: float) -> float:
        """Book one and say how long to wait for it."""
        self._next_s = max(self._next_s, now_s - self._depth_s) + self._interval_s
        return max(0.0, self._next_s - now_s)

    def take(self, now_s: float) -> bool:
        """Book one if it may be had at once, and say whether."""
        if max(self._next_s, now_s - self._depth_s) + self._interval_s > now_s:
            return False
        self.delay_s(now_s)
        return True
