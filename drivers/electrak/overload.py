"""What follows when an actuator trips its current limit: wait, try again a few times, then give up. Pure."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

RETRY_PAUSE_S: Final = 1.0


class Verdict(StrEnum):
    """What a feedback message means for the overload latch."""

    NOTHING = "nothing"
    RETRY = "retry"
    LATCH = "latch"


class OverloadPolicy:
    """The actuator's own latch is reset by the disabled messages sent meanwhile; this one by :meth:`rearm`."""

    def __init__(self, retries_n: int) -> None:
        self._retries_n = retries_n
        self._left_n = retries_n
        self._tripped = False
        self._paused_since_s: float | None = None
        self.overloads_n = 0

    @property
    def waiting(self) -> bool:
        """Whether motion has to stay disabled before the next try."""
        return self._paused_since_s is not None

    def rearm(self) -> None:
        """All retries are available again."""
        self._left_n = self._retries_n
        self._paused_since_s = None

    def on_feedback(self, tripped: bool, moving_allowed: bool, now_s: float) -> Verdict:
        """Take the flag of one feedback message; a verdict comes with its rising edge."""
        rising, self._tripped = tripped and not self._tripped, tripped
        if rising:
            self.overloads_n += 1
            if not moving_allowed or self._left_n == 0:
                return Verdict.LATCH
            self._left_n -= 1
            self._paused_since_s = now_s
            return Verdict.RETRY
        if not tripped and self._paused_since_s is not None and now_s - self._paused_since_s > RETRY_PAUSE_S:
            self._paused_since_s = None
        return Verdict.NOTHING
