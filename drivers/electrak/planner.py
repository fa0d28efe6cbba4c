"""From a target to control messages: short look-ahead, approach bias, speed by duty. Pure; the caller brings the time.

An Electrak on J1939 goes on to its last target when control messages stop, rests some 1.1 mm short of it, and does not
start for less than about 2 mm. So the target sent is never further away than the way of 0.3 s plus the dead zone, the
last one lies beyond the wanted position by the dead zone, and a move of less than 1.2 mm is not begun.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from graderd.drivers.electrak.codec import Control
from graderd.drivers.electrak.profile import Figures

LOOK_AHEAD_S: Final = 0.3
_START_MARGIN_MM: Final = 0.3
_FLOOR_MARGIN_PERCENT: Final = 5
"""Breaking away takes more than the lowest duty at which the motor keeps turning."""
_BIAS_GAIN: Final = 0.25
_BIAS_RANGE: Final = (0.4, 1.6)
"""Learned bias, in parts of the profile's dead zone."""
_SLOWER_SHARE: Final = 0.08
"""So much slower than the last message said is told at once: a step of its duty at the usual speed."""
_SETTLED_N: Final = 3
_CREEP_MM: Final = 0.25


class Phase(StrEnum):
    """What the planner is doing."""

    HOLD = "hold"
    REST = "rest"
    MOVE = "move"


@dataclass(frozen=True, slots=True)
class Motion:
    """What feedback says about the axis, as the planner needs it."""

    position_mm: float
    velocity_mm_per_s: float
    moving: bool
    age_s: float


class MotionPlanner:
    """One axis. :meth:`set_target` and :meth:`hold` take commands, :meth:`control` gives the next message."""

    def __init__(self, figures: Figures, *, current_limit_a: float, speed_percent: int) -> None:
        self._figures = figures
        self._current_limit_a = min(current_limit_a, figures.current_limit_max_a)
        self._speed_percent = float(speed_percent)
        self._bias_mm = {1: figures.dead_zone_mm, -1: figures.dead_zone_mm}
        self._start_mm = figures.restart_zone_mm + _START_MARGIN_MM - figures.dead_zone_mm
        self._target_mm: float | None = None
        self._share = 1.0
        self._sent_share = 0.0
        self._duty_carry_percent = 0.0
        self._direction = 0
        self._still_n = 0
        self._rest_sum_mm = 0.0
        self._final_sent_mm: float | None = None
        self.phase = Phase.HOLD

    @property
    def target_mm(self) -> float | None:
        """The commanded position; None while holding."""
        return self._target_mm

    @property
    def direction(self) -> int:
        """1 extending, -1 retracting, 0 at rest."""
        return self._direction if self.phase is Phase.MOVE else 0

    @property
    def bias_mm(self) -> dict[int, float]:
        """How far beyond the target the last message aims, by direction; learned from where the unit rests."""
        return self._bias_mm

    def set_target(self, target_mm: float, speed_share: float) -> None:
        """Walk to a position (checked by the caller)."""
        if self.phase is Phase.HOLD:
            self.phase = Phase.REST
        self._target_mm = target_mm
        self._share = speed_share

    def is_urgent(self, motion: Motion) -> bool:
        """Whether the target is one that the next message should not be waited for: to start, or to go slower. Two
        that start or must keep together then do so by when they are told, not by how their messages fall."""
        if self._target_mm is None:
            return False
        if self.phase is Phase.MOVE:
            return self._share < self._sent_share - _SLOWER_SHARE
        return abs(self._target_mm - motion.position_mm) > self._start_mm

    def hold(self) -> None:
        """Forget the target; motion is disabled from the next message on."""
        self._target_mm = None
        self._final_sent_mm = None
        self._direction = 0
        self.phase = Phase.HOLD

    def disabled(self, position_mm: float) -> Control:
        """A message that forbids motion."""
        position_mm = min(max(position_mm, 0.0), self._figures.stroke_mm)
        return Control(position_mm, self._current_limit_a, float(self._figures.speed_min_percent), motion_enable=False)

    def control(self, motion: Motion, *, may_move: bool = True) -> Control:
        """The next message. ``may_move`` False keeps the target and lets the motor rest."""
        target_mm = self._target_mm
        if target_mm is None or not may_move:
            return self.disabled(motion.position_mm)
        self._advance(motion, target_mm)
        if self.phase is not Phase.MOVE:
            return self.disabled(motion.position_mm)
        figures = self._figures
        duty_percent = self._next_duty_percent()
        here_mm = motion.position_mm + motion.velocity_mm_per_s * min(motion.age_s, figures.afm_period_s)
        reach_mm = figures.speed_mm_per_s(duty_percent) * LOOK_AHEAD_S + figures.dead_zone_mm
        aim_mm = target_mm + self._direction * self._bias_mm[self._direction]
        short_mm = here_mm + self._direction * reach_mm
        final = (aim_mm - short_mm) * self._direction <= 0
        sent_mm = aim_mm if final else short_mm
        sent_mm = min(max(sent_mm, 0.0), figures.stroke_mm)
        self._final_sent_mm = sent_mm if final else None
        self._sent_share = self._share
        return Control(round(sent_mm, 1), self._current_limit_a, duty_percent, motion_enable=True)

    def on_feedback(self, motion: Motion) -> None:
        """Notice arrival, and learn how short of the last target the unit rests."""
        if self.phase is not Phase.MOVE or self._target_mm is None or self._final_sent_mm is None or motion.moving:
            self._still_n, self._rest_sum_mm = 0, 0.0
            return
        short_mm = (self._final_sent_mm - motion.position_mm) * self._direction
        if short_mm > self._figures.restart_zone_mm + _START_MARGIN_MM - _CREEP_MM:
            self._still_n, self._rest_sum_mm = 0, 0.0  # it has not started yet, or was stopped on its way
            return
        self._still_n += 1
        self._rest_sum_mm += short_mm
        if self._still_n >= _SETTLED_N:
            self._learn(self._rest_sum_mm / self._still_n)
            self.phase = Phase.REST
            self._direction = 0
            self._final_sent_mm = None

    def _advance(self, motion: Motion, target_mm: float) -> None:
        error_mm = target_mm - motion.position_mm
        direction = 1 if error_mm > 0 else -1
        if self.phase is Phase.REST and abs(error_mm) > self._start_mm:
            self.phase = Phase.MOVE
            self._direction = direction
            self._still_n, self._rest_sum_mm = 0, 0.0
        elif self.phase is Phase.MOVE and direction != self._direction and abs(error_mm) > self._start_mm:
            self._direction = direction

    def _next_duty_percent(self) -> float:
        """Duty in the message's steps of 5 %; what rounding takes now is given with the next message."""
        floor_percent = self._figures.speed_min_percent + _FLOOR_MARGIN_PERCENT
        wanted_percent = max(float(floor_percent), self._speed_percent * self._share) + self._duty_carry_percent
        duty_percent = min(max(5.0 * round(wanted_percent / 5.0), floor_percent), 100.0)
        self._duty_carry_percent = min(max(wanted_percent - duty_percent, -5.0), 5.0)
        return duty_percent

    def _learn(self, short_mm: float) -> None:
        dead_zone_mm = self._figures.dead_zone_mm
        low, high = _BIAS_RANGE
        bias_mm = self._bias_mm[self._direction]
        bias_mm += _BIAS_GAIN * (short_mm - bias_mm)
        self._bias_mm[self._direction] = min(max(bias_mm, low * dead_zone_mm), high * dead_zone_mm)
