"""Motor, screw and load of one virtual Electrak: what moves the tube, and what the motor draws. No bus, no clock."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Final, Literal

from graderd.drivers.electrak.profile import Figures


@dataclass(slots=True)
class Behaviour:
    """Traits that the manual leaves open or that differ between units. All may be changed while running."""

    acm_loss: Literal["continue", "stop"] = "continue"
    """What a move does when control messages stop: go on to the target (assumed of real units), or stop after 5 s."""
    factory_ones: bool = True
    """Real units send the feedback's factory bits as 1, the manual says 0."""
    only_own_control_keeps_awake: bool = True
    """The manual says "bus activity"; the careful reading is: control messages for this unit."""
    wake_control_n: int = 2
    """Control messages to be seen after waking before one with motion enabled counts; a disabled one counts at once."""
    answers_requests: bool = True
    """Request (59904) for the address claim is answered; the manual does not list it."""
    parameter_refuses_motion: bool = False
    """False: a bad control message is ignored, the last good target stays (seen). True: motion stops (MD manual)."""
    afm_jitter_s: float = 0.003
    speed_factor: float = 1.0
    """Speed against the model's own: 0.7 is a unit 30 % slower."""


@dataclass(slots=True)
class Faults:
    """Defects that can be switched on one at a time."""

    silent: bool = False
    stuck: bool = False
    drift_mm_per_s: float = 0.0
    garbage: bool = False
    babble_hz: float = 0.0
    frozen_feedback: bool = False
    forced_flags: frozenset[str] = frozenset()

    def clear(self) -> None:
        """All of them off."""
        for name, value in asdict(Faults()).items():
            setattr(self, name, value)


@dataclass(slots=True)
class MotorState:
    """Motor, screw and latches of one unit."""

    target_mm: float = 0.0
    enabled: bool = False
    limit_a: float = 0.0
    speed_percent: float = 0.0
    duty_percent: float = 0.0
    direction: int = 0
    moving_since_s: float = 0.0
    stop_short_mm: float = 0.0
    over_limit_since_s: float | None = None
    overload: bool = False
    parameter: bool = False
    backdrive_mm: float = 0.0


_BRAKE_S: Final = 0.02
"""Time constant with which the tube stops once the motor is braked."""
_INRUSH_FACTOR: Final = 1.6
_OVERRIDE_DUTY_PERCENT: Final = 100.0


class Motor:
    """Follows ``state`` (what the unit's controller was told) as far as load, end stops and defects let it.

    ``load_n`` is newtons against extension. ``manual_override`` is a switch at the unit that moves it past its bus.
    """

    def __init__(
        self, figures: Figures, behaviour: Behaviour, faults: Faults, chance: random.Random, position_mm: float
    ) -> None:
        self.state = MotorState()
        self.load_n = 0.0
        self.manual_override: Literal["extend", "retract"] | None = None
        self.velocity_mm_per_s = 0.0
        self.current_a = 0.0
        self.figures = figures
        self._behaviour = behaviour
        self._faults = faults
        self._random = chance
        self.place(position_mm)
        self.state.target_mm = self.position_mm

    def place(self, position_mm: float) -> None:
        """Put the tube somewhere."""
        self.position_mm = min(max(position_mm, 0.0), self.figures.stroke_mm)

    def cut(self) -> None:
        """The supply is gone: the holding brake keeps the tube, what was told is forgotten."""
        self.velocity_mm_per_s = self.current_a = 0.0
        self.state = MotorState(target_mm=self.position_mm)

    @property
    def busy(self) -> bool:
        """Whether anything may change with time."""
        state = self.state
        return bool(
            state.direction or self.velocity_mm_per_s or state.enabled or self.manual_override
            or self._faults.drift_mm_per_s or state.over_limit_since_s is not None
        )  # fmt: skip

    @property
    def rests(self) -> bool:
        """Whether it stood through the last step, as it does through any further one until it is told otherwise."""
        return not (
            self.state.direction or self.velocity_mm_per_s or self.current_a or self.manual_override
            or self._faults.drift_mm_per_s or self.state.over_limit_since_s is not None
        )  # fmt: skip

    @property
    def saturated(self) -> bool:
        """Within a tenth of what it can do."""
        return self.current_a >= 0.9 * self.figures.current_full_load_a and self.state.direction != 0

    def move(self, now_s: float, step_s: float, *, powered: bool, obeys: bool, may_start: Callable[[], bool]) -> None:
        """One short step of time. ``obeys``: the controller lets it do as told; ``may_start``: also from rest."""
        state, figures = self.state, self.figures
        wanted_percent, direction = self._wanted(powered=powered, obeys=obeys, may_start=may_start)
        if direction != state.direction:
            if direction:
                state.moving_since_s = now_s
            state.direction = direction
            state.duty_percent = 0.0
        if not direction:
            state.duty_percent = 0.0
        elif wanted_percent > state.duty_percent:
            ramp_percent = wanted_percent * step_s / figures.soft_start_s
            state.duty_percent = min(wanted_percent, state.duty_percent + ramp_percent)
        else:
            state.duty_percent = wanted_percent
        opposing_n = self.load_n * direction
        blocked = self._faults.stuck or self._at_end(direction)
        speed_mm_per_s = figures.speed_mm_per_s(state.duty_percent, opposing_n) * self._behaviour.speed_factor
        aim_mm_per_s = 0.0 if blocked else direction * speed_mm_per_s
        # with the motor on, the screw follows the duty; with it off, the brake takes some 20 ms
        slack = 1.0 if blocked else 1.0 - math.exp(-step_s / _BRAKE_S)
        self.velocity_mm_per_s += (aim_mm_per_s - self.velocity_mm_per_s) * slack
        if not direction and abs(self.velocity_mm_per_s) < 0.2:
            self.velocity_mm_per_s = 0.0
        self.position_mm += (self.velocity_mm_per_s + self._faults.drift_mm_per_s) * step_s
        self.position_mm = min(max(self.position_mm, 0.0), figures.stroke_mm)
        drift_mm = abs(self._faults.drift_mm_per_s) * step_s
        state.backdrive_mm = state.backdrive_mm + drift_mm if drift_mm and not direction else 0.0
        self._current(now_s, step_s, direction, opposing_n)

    def _current(self, now_s: float, step_s: float, direction: int, opposing_n: float) -> None:
        state, figures = self.state, self.figures
        if not direction:
            self.current_a *= math.exp(-step_s / 0.05)
            if self.current_a < 0.05:
                self.current_a = 0.0
            state.over_limit_since_s = None
            return
        running_a = figures.current_a(opposing_n)
        if self._faults.stuck:
            running_a = 1.5 * figures.current_full_load_a
        starting = now_s - state.moving_since_s < figures.inrush_s
        self.current_a = running_a * (_INRUSH_FACTOR if starting else 1.0)
        if starting or self.manual_override or running_a <= state.limit_a:
            state.over_limit_since_s = None
        elif state.over_limit_since_s is None:
            state.over_limit_since_s = now_s
        elif now_s - state.over_limit_since_s >= figures.overload_hold_s:
            state.overload = True
            state.over_limit_since_s = None

    def _wanted(self, *, powered: bool, obeys: bool, may_start: Callable[[], bool]) -> tuple[float, int]:
        """Duty and direction that the controller asks of the motor."""
        state, figures = self.state, self.figures
        if not powered:
            return 0.0, 0
        if self.manual_override:
            direction = 1 if self.manual_override == "extend" else -1
            return (0.0, 0) if self._at_end(direction) else (_OVERRIDE_DUTY_PERCENT, direction)
        if not (obeys and state.enabled) or state.overload:
            return 0.0, 0
        error_mm = state.target_mm - self.position_mm
        direction = 1 if error_mm > 0 else -1
        if state.direction == 0:
            if abs(error_mm) <= figures.restart_zone_mm or state.speed_percent < figures.speed_min_percent:
                return 0.0, 0
            if not may_start():
                return 0.0, 0
            spread_mm = figures.dead_zone_spread_mm
            state.stop_short_mm = figures.dead_zone_mm + self._random.uniform(-spread_mm, spread_mm)
        brake_mm = abs(self.velocity_mm_per_s) * _BRAKE_S
        if abs(error_mm) <= state.stop_short_mm + brake_mm:
            return 0.0, 0
        if self._at_end(direction):
            return 0.0, 0
        if state.direction and direction != state.direction:
            return 0.0, 0  # stop first, then turn round
        taper = abs(error_mm) <= figures.taper_from_mm
        cap_percent = figures.taper_speed_percent if taper else 100.0
        return min(state.speed_percent, cap_percent), direction

    def _at_end(self, direction: int) -> bool:
        if direction > 0:
            return self.position_mm >= self.figures.stroke_mm
        return direction < 0 and self.position_mm <= 0.0
