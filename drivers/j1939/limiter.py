"""A token bucket: what others make us send has a rate, whatever they do."""

from __future__ import annotations


class Limiter:
    """Allows ``burst_n`` events at once and ``rate_hz`` in the long run."""

    def __init__(self, rate_hz: float, burst_n: int) -> None:
        self._rate_hz = rate_hz
        self._burst_n = burst_n
        self._tokens = float(burst_n)
        self._last_s: float | None = None

    def allow(self, now_s: float) -> bool:
        """Take a token if there is one."""
        if self._last_s is not None:
            self._tokens = min(self._burst_n, self._tokens + (now_s - self._last_s) * self._rate_hz)
        self._last_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True
