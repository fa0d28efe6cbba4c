"""One virtual Electrak: motor, screw and J1939 controller of a single unit, without a wire and without a clock.

The caller moves time (:meth:`VirtualElectrak.advance`), hands in frames (:meth:`VirtualElectrak.on_frame`) and takes
away what the unit sends. Physics and behaviour follow the profile's figures; every doubtful trait is a knob of
:class:`~drivers.electrak.virtual.traits.Behaviour`.
"""

from __future__ import annotations

import math
import random
from typing import Final, Literal

from drivers.electrak.codec import Control, ElectrakCodec, Feedback
from drivers.electrak.j1939.ids import GLOBAL, NULL, Frame, Pgn, destination_of, make_id, pgn_of, source_of
from drivers.electrak.j1939.name import Name
from drivers.electrak.profile import load_profile
from drivers.electrak.virtual.traits import Behaviour, Faults, MotorState

_STEP_S: Final = 0.002
_BRAKE_S: Final = 0.02
"""Time constant with which the tube stops once the motor is braked."""
_INRUSH_FACTOR: Final = 1.6
_OVERRIDE_DUTY_PERCENT: Final = 100.0


class VirtualElectrak:
    """An Electrak HD or MD with option CNO.

    Position and load are millimetres of extension and newtons against extension. ``identity`` is the NAME's identity
    number: equal by default, as a manual's default lets expect of real units.
    """

    def __init__(
        self,
        profile: str = "electrak_hd_b017",
        address: int | None = None,
        position_mm: float = 100.0,
        seed: int = 0,
        *,
        identity: int = 1,
        asleep: bool = True,
    ) -> None:
        self.profile = load_profile(profile)
        self.figures = self.profile.figures
        self.behaviour = Behaviour()
        self.faults = Faults()
        self.address = self.figures.default_address_n if address is None else address
        self.name = Name(
            identity=identity, manufacturer=self.figures.manufacturer_n, function=255, arbitrary_address_capable=1
        )
        self.load_n = 0.0
        self.supply_v = 12.5
        self.temperature_c = 25.0
        self.fatal = False
        self.manual_override: Literal["extend", "retract"] | None = None
        self._home_address = self.address
        self._codec = ElectrakCodec(self.profile.layout)
        self._random = random.Random(f"{seed}/{self.address}")
        self._position_mm = min(max(position_mm, 0.0), self.figures.stroke_mm)
        self._velocity_mm_per_s = 0.0
        self._current_a = 0.0
        self._motion = MotorState(target_mm=self._position_mm)
        self._now_s: float | None = None
        self._powered = True
        self._awake = not asleep
        self._last_activity_s = 0.0
        self._woken_at_s = -math.inf
        self._control_since_wake_n = 0
        self._claim_due_s: float | None = None
        self._afm_due_s = 0.0
        self._babble_due_s = 0.0
        self._frozen: bytes | None = None
        self._out: list[Frame] = []
        self._commanded: bytearray | None = None
        self.received_control: list[Control] = []
        """The newest control messages that the unit heard, at most 50."""

    # -- what a person at the machine could see or measure ---------------------------------------------------------

    @property
    def position_mm(self) -> float:
        """True extension of the tube."""
        return self._position_mm

    @position_mm.setter
    def position_mm(self, value: float) -> None:
        self._position_mm = min(max(value, 0.0), self.figures.stroke_mm)

    @property
    def velocity_mm_per_s(self) -> float:
        """True speed, positive while extending."""
        return self._velocity_mm_per_s

    @property
    def current_a(self) -> float:
        """Motor current."""
        return self._current_a

    @property
    def awake(self) -> bool:
        """Whether the controller runs; a sleeping unit sends nothing and does not move."""
        return self._powered and self._awake

    @property
    def powered(self) -> bool:
        """Whether the supply is on."""
        return self._powered

    @property
    def overloaded(self) -> bool:
        """Whether the overload latch is set."""
        return self._motion.overload

    @property
    def motion_enabled(self) -> bool:
        """Whether the last control message that counted allows motion."""
        return self._motion.enabled

    def cut_power(self) -> None:
        """Take the supply away: motion ends, the holding brake keeps the tube, everything volatile is forgotten."""
        self._powered = False
        self._awake = False
        self._velocity_mm_per_s = self._current_a = 0.0
        self._motion = MotorState(target_mm=self._position_mm)
        self._out.clear()
        self._claim_due_s = None

    def restore_power(self) -> None:
        """Give the supply back: the unit starts, claims its address and reports where the tube is."""
        self.fatal = False
        self._powered = True
        self.address = self._home_address
        if self._now_s is not None:
            self._wake(self._now_s)

    def return_home(self) -> None:
        """Take the address of the select wires again, as after a power cycle."""
        self.address = self._home_address

    # -- time -------------------------------------------------------------------------------------------------------

    def advance(self, now_s: float) -> list[Frame]:
        """Let time pass up to ``now_s`` and return what the unit sent meanwhile."""
        if self._now_s is None:
            self._now_s = now_s
            self._last_activity_s = now_s
            if self._awake:
                self._wake(now_s)
        while self._now_s < now_s:
            step_s = min(_STEP_S, now_s - self._now_s)
            if not self._busy:
                step_s = now_s - self._now_s
            self._now_s += step_s
            self._move(self._now_s, step_s)
        self._talk(now_s)
        out, self._out = self._out, []
        if self.faults.silent:
            return []
        return out

    @property
    def _busy(self) -> bool:
        motion = self._motion
        return bool(
            motion.direction or self._velocity_mm_per_s or motion.enabled or self.manual_override
            or self.faults.drift_mm_per_s or motion.over_limit_since_s is not None
        )  # fmt: skip

    def _talk(self, now_s: float) -> None:
        if not self._powered:
            return
        if self._awake and now_s - self._last_activity_s > self.figures.sleep_after_s and not self.manual_override:
            self._awake = False
            self._motion.enabled = False
            self._claim_due_s = None
        if self._claim_due_s is not None and now_s >= self._claim_due_s:
            self._claim_due_s = None
            self._claim()
        if self.faults.babble_hz > 0:
            while self._babble_due_s <= now_s:
                self._babble_due_s = max(self._babble_due_s, now_s - 0.1) + 1.0 / self.faults.babble_hz
                self._out.append(self._feedback_frame())
        elif self._awake and now_s >= self._afm_due_s:
            jitter_s = self._random.uniform(-1, 1) * self.behaviour.afm_jitter_s
            self._afm_due_s = (
                max(self._afm_due_s, now_s - self.figures.afm_period_s) + self.figures.afm_period_s + jitter_s
            )
            self._out.append(self._feedback_frame())

    def _feedback_frame(self) -> Frame:
        data = self._codec.encode_feedback(self.feedback(), factory_ones=self.behaviour.factory_ones)
        if self.faults.frozen_feedback:
            self._frozen = data = self._frozen or data
        else:
            self._frozen = None
        if self.faults.garbage:
            data = self._random.randbytes(self._random.choice((0, 3, 7, 8, 8)))
        return Frame(make_id(6, Pgn.PROPRIETARY_A2, self.address), data)

    def feedback(self) -> Feedback:
        """What the unit would report now."""
        noise_mm = self._random.choice((-1, 0, 0, 1)) * self.figures.position_noise_mm
        reported_mm = min(max(round(self._position_mm + noise_mm, 1), 0.0), self.figures.stroke_mm)
        motion = self._motion
        return Feedback(
            position_mm=reported_mm,
            current_a=min(round(self._current_a, 1), self.figures.measured_current_max_a),
            duty_percent=5.0 * round(motion.duty_percent / 5.0),
            moving=abs(self._velocity_mm_per_s) > 0.5,
            flags=self._flags(),
        )

    def _flags(self) -> frozenset[str]:
        figures, motion = self.figures, self._motion
        states = {
            "overload": motion.overload,
            "backdrive": motion.backdrive_mm > 0.5,
            "parameter": motion.parameter,
            "saturation": self._current_a >= 0.9 * figures.current_full_load_a and motion.direction != 0,
            "fatal": self.fatal,
            "voltage_low": self.supply_v < figures.supply_min_v,
            "voltage_high": self.supply_v > figures.supply_max_v,
            "temperature_low": self.temperature_c < figures.temperature_min_c,
            "temperature_high": self.temperature_c > figures.temperature_max_c,
        }
        return frozenset(flag for flag, is_set in states.items() if is_set) | self.faults.forced_flags

    # -- motor and screw --------------------------------------------------------------------------------------------

    def _move(self, now_s: float, step_s: float) -> None:
        motion, figures = self._motion, self.figures
        wanted_percent, direction = self._wanted(now_s)
        if direction != motion.direction:
            if direction:
                motion.moving_since_s = now_s
            motion.direction = direction
            motion.duty_percent = 0.0
        if not direction:
            motion.duty_percent = 0.0
        elif wanted_percent > motion.duty_percent:
            ramp_percent = wanted_percent * step_s / figures.soft_start_s
            motion.duty_percent = min(wanted_percent, motion.duty_percent + ramp_percent)
        else:
            motion.duty_percent = wanted_percent
        opposing_n = self.load_n * direction
        blocked = self.faults.stuck or self._at_end(direction)
        speed_mm_per_s = figures.speed_mm_per_s(motion.duty_percent, opposing_n) * self.behaviour.speed_factor
        aim_mm_per_s = 0.0 if blocked else direction * speed_mm_per_s
        # with the motor on, the screw follows the duty; with it off, the brake takes some 20 ms
        slack = 1.0 if blocked else 1.0 - math.exp(-step_s / _BRAKE_S)
        self._velocity_mm_per_s += (aim_mm_per_s - self._velocity_mm_per_s) * slack
        if not direction and abs(self._velocity_mm_per_s) < 0.2:
            self._velocity_mm_per_s = 0.0
        self._position_mm += (self._velocity_mm_per_s + self.faults.drift_mm_per_s) * step_s
        self._position_mm = min(max(self._position_mm, 0.0), figures.stroke_mm)
        drift_mm = abs(self.faults.drift_mm_per_s) * step_s
        motion.backdrive_mm = motion.backdrive_mm + drift_mm if drift_mm and not direction else 0.0
        self._current(now_s, step_s, direction, opposing_n)

    def _current(self, now_s: float, step_s: float, direction: int, opposing_n: float) -> None:
        motion, figures = self._motion, self.figures
        if not direction:
            self._current_a *= math.exp(-step_s / 0.05)
            if self._current_a < 0.05:
                self._current_a = 0.0
            motion.over_limit_since_s = None
            return
        running_a = figures.current_a(opposing_n)
        if self.faults.stuck:
            running_a = 1.5 * figures.current_full_load_a
        starting = now_s - motion.moving_since_s < figures.inrush_s
        self._current_a = running_a * (_INRUSH_FACTOR if starting else 1.0)
        if starting or self.manual_override or running_a <= motion.limit_a:
            motion.over_limit_since_s = None
        elif motion.over_limit_since_s is None:
            motion.over_limit_since_s = now_s
        elif now_s - motion.over_limit_since_s >= figures.overload_hold_s:
            motion.overload = True
            motion.over_limit_since_s = None

    def _wanted(self, now_s: float) -> tuple[float, int]:
        """Duty and direction that the controller asks of the motor."""
        motion, figures = self._motion, self.figures
        if not self._powered or self.fatal:
            return 0.0, 0
        if self.manual_override:
            direction = 1 if self.manual_override == "extend" else -1
            return (0.0, 0) if self._at_end(direction) else (_OVERRIDE_DUTY_PERCENT, direction)
        quiet_s = now_s - self._last_activity_s
        lost = self.behaviour.acm_loss == "stop" and quiet_s > figures.sleep_after_s
        refused = motion.parameter and self.behaviour.parameter_refuses_motion
        if not (self._awake and motion.enabled) or motion.overload or lost or refused:
            return 0.0, 0
        error_mm = motion.target_mm - self._position_mm
        direction = 1 if error_mm > 0 else -1
        if motion.direction == 0:
            if abs(error_mm) <= figures.restart_zone_mm or motion.speed_percent < figures.speed_min_percent:
                return 0.0, 0
            out_of_range = self._flags() & {"voltage_low", "voltage_high", "temperature_low", "temperature_high"}
            if out_of_range:  # a move in progress completes, a new one is refused
                return 0.0, 0
            spread_mm = figures.dead_zone_spread_mm
            motion.stop_short_mm = figures.dead_zone_mm + self._random.uniform(-spread_mm, spread_mm)
        brake_mm = abs(self._velocity_mm_per_s) * _BRAKE_S
        if abs(error_mm) <= motion.stop_short_mm + brake_mm:
            return 0.0, 0
        if self._at_end(direction):
            return 0.0, 0
        if motion.direction and direction != motion.direction:
            return 0.0, 0  # stop first, then turn round
        taper = abs(error_mm) <= figures.taper_from_mm
        cap_percent = figures.taper_speed_percent if taper else 100.0
        return min(motion.speed_percent, cap_percent), direction

    def _at_end(self, direction: int) -> bool:
        if direction > 0:
            return self._position_mm >= self.figures.stroke_mm
        return direction < 0 and self._position_mm <= 0.0

    # -- the wire ---------------------------------------------------------------------------------------------------

    def on_frame(self, frame: Frame, now_s: float) -> None:
        """Hear one frame from the bus."""
        if not self._powered or not frame.extended:
            return
        pgn, destination = pgn_of(frame.can_id), destination_of(frame.can_id)
        mine = destination == self.address
        if (pgn == Pgn.PROPRIETARY_A and mine) or not self.behaviour.only_own_control_keeps_awake:
            self._last_activity_s = now_s
            if not self._awake:
                self._wake(now_s)
                return  # the frame that wakes the unit is lost
        if not self._awake:
            return
        source = source_of(frame.can_id)
        if pgn == Pgn.PROPRIETARY_A and mine and len(frame.data) == 8:
            self._on_control(frame.data, source, now_s)
        elif pgn == Pgn.ADDRESS_CLAIMED and len(frame.data) == 8 and source == self.address:
            self._on_claim(int.from_bytes(frame.data, "little"))
        elif pgn == Pgn.REQUEST and destination in (GLOBAL, self.address) and self.behaviour.answers_requests:
            if frame.data[:3] == Pgn.ADDRESS_CLAIMED.to_bytes(3, "little"):
                self._claim()
        elif pgn in (Pgn.TP_CONNECTION, Pgn.TP_DATA) and destination == GLOBAL:
            self._on_transport(pgn, frame.data)

    def _wake(self, now_s: float) -> None:
        self._awake = True
        self._woken_at_s = now_s
        self._last_activity_s = now_s
        self._control_since_wake_n = 0
        self._motion.enabled = False
        self._motion.direction = 0
        self._claim_due_s = now_s + self.figures.wake_claim_s * self._random.uniform(0.65, 1.0)
        self._afm_due_s = now_s + self.figures.wake_feedback_s * self._random.uniform(0.7, 1.0)

    def _claim(self) -> None:
        self._out.append(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, self.address), self.name.to_bytes()))

    def _on_claim(self, other: int) -> None:
        if other == self.name.value:
            return  # equal NAMEs cannot be told apart: both stay (what a real unit does is not documented)
        if self.name.value < other:
            self._claim()
            return
        first, count = self.figures.default_address_n, self.figures.address_count_n
        self.address = first + (self.address - first + 1) % count
        self._claim()

    def _on_transport(self, pgn: int, data: bytes) -> None:
        """Commanded address (65240): nine bytes by broadcast transport, NAME and new address."""
        if pgn == Pgn.TP_CONNECTION and len(data) == 8 and data[0] == 0x20:
            wanted = int.from_bytes(data[5:8], "little") == Pgn.COMMANDED_ADDRESS and data[1] == 9
            self._commanded = bytearray() if wanted else None
        elif pgn == Pgn.TP_DATA and self._commanded is not None and len(data) == 8:
            self._commanded += data[1:]
            if len(self._commanded) >= 9:
                name, address = bytes(self._commanded[:8]), self._commanded[8]
                self._commanded = None
                if name == self.name.to_bytes() and address < NULL:
                    self.address = address
                    self._claim()

    def _on_control(self, data: bytes, source: int, now_s: float) -> None:
        motion, figures = self._motion, self.figures
        control = self._codec.decode_control(data)
        self.received_control = [*self.received_control[-49:], control]
        self._control_since_wake_n += 1
        if source == self.address:
            motion.overload = True  # the manual: a controller with the actuator's own address gives a false overload
            return
        if not control.motion_enable:
            self._control_since_wake_n = max(self._control_since_wake_n, self.behaviour.wake_control_n + 1)
            motion.enabled = False
            motion.overload = False
            motion.parameter = False
            return
        if now_s - self._woken_at_s < figures.wake_motion_s - 0.1:
            return
        if self._control_since_wake_n <= self.behaviour.wake_control_n:
            return
        motion.parameter = (
            control.target_mm > figures.stroke_mm
            or control.current_limit_a > figures.current_limit_max_a
            or control.speed_percent > 100
        )
        if motion.parameter:
            return
        motion.enabled = True
        motion.target_mm = control.target_mm
        motion.limit_a = control.current_limit_a
        motion.speed_percent = control.speed_percent
