"""A pace: how often something may happen."""

from __future__ import annotations


class Pace:
    """A leaky bucket: at most ``burst_n`` at once and ``rate_hz`` in the long run."""

    def __init__(self, rate_hz: float, burst_n: int) -> None:
        self._interval_s = 1.0 / rate_hz
        self._depth_s = burst_n / rate_hz
        self._next_s = float("-inf")

    def delay_s(self, now_s: float) -> float:
        """Book one turn and say how long to wait for it."""
        self._next_s = max(self._next_s, now_s - self._depth_s) + self._interval_s
        return max(0.0, self._next_s - now_s)

    def take(self, now_s: float) -> bool:
        """Book a turn if it may be had at once, and say whether."""
        if max(self._next_s, now_s - self._depth_s) + self._interval_s > now_s:
            return False
        self.delay_s(now_s)
        return True
