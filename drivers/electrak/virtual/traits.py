"""What may differ between virtual actuators, what may be wrong with them, and the state of their motor."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal


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
