"""Heat of a motor as an I²t budget, and rests before the budget is used up."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Final

from graderd.drivers.electrak.profile import Figures

DERATE_FROM: Final = 0.8
"""Thermal load from which on rests are inserted."""
RESUME_BELOW: Final = 0.8
"""After the limit was reached, motion is allowed again below this load."""
_WINDOW_S: Final = 4.0
_MIN_ON_SHARE: Final = 0.05


class ThermalGuard:
    """Tracks ``d(load)/dt = ((I / I_continuous)² - load) / time constant``; a load of 1.0 is the limit.

    ``I_continuous`` is the full-load current times the square root of the catalogue's duty cycle: a motor that may run
    25 % of the time at full load may carry half that current all the time. A permanent-magnet motor at lower duty draws
    the same current for the same load, so a slower move would heat it for longer: derating here means *rests*. From
    :data:`DERATE_FROM` on, motion is allowed for a share of each four-second window that falls to nothing at the
    limit, so that the load settles below it. Where the load reaches 1.0 nonetheless, motion ends until it is cooler.
    """

    def __init__(self, figures: Figures) -> None:
        self._continuous_a = figures.current_full_load_a * math.sqrt(figures.duty_cycle_percent / 100.0)
        self._time_constant_s = figures.thermal_time_constant_s
        self._last_s: float | None = None
        self._limited = False
        self.load = 0.0

    @property
    def derating(self) -> bool:
        """Whether rests are being inserted."""
        return self.load > DERATE_FROM

    @property
    def limited(self) -> bool:
        """Whether motion is refused until the motor is cooler."""
        return self._limited

    def update(self, current_a: float, now_s: float) -> None:
        """Take a current reading; it is held to have flowed since the reading before."""
        if self._last_s is not None:
            elapsed_s = max(0.0, now_s - self._last_s)
            aim = (current_a / self._continuous_a) ** 2
            self.load += (aim - self.load) * (1.0 - math.exp(-elapsed_s / self._time_constant_s))
        self._last_s = now_s
        if self.load >= 1.0:
            self._limited = True
        elif self.load < RESUME_BELOW:
            self._limited = False

    def may_move(self, now_s: float) -> bool:
        """Whether the motor may run at this moment."""
        if self._limited:
            return False
        if not self.derating:
            return True
        on_share = max(_MIN_ON_SHARE, (1.0 - self.load) / (1.0 - DERATE_FROM))
        return now_s % _WINDOW_S < on_share * _WINDOW_S


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
