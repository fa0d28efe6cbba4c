"""One virtual Electrak: the J1939 controller of a single unit over its motor, without a wire and without a clock.

The caller moves time (:meth:`VirtualElectrak.advance`), hands in frames (:meth:`VirtualElectrak.on_frame`) and takes
away what the unit sends. Physics and behaviour follow the profile's figures; every doubtful trait is a knob of
:class:`~graderd.simulator.actuators.motor.Behaviour`.
"""

from __future__ import annotations

import math
import random
from typing import Final, Literal

from graderd.drivers.electrak.codec import Control, ElectrakCodec, Feedback
from graderd.drivers.electrak.profile import Figures, load_profile
from graderd.drivers.j1939.ids import GLOBAL, NULL, Frame, Pgn, destination_of, make_id, pgn_of, source_of
from graderd.drivers.j1939.name import Name
from graderd.simulator.actuators.motor import Behaviour, Faults, Motor

_STEP_S: Final = 0.002


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
        figures = self.profile.figures
        self.behaviour = Behaviour()
        self.faults = Faults()
        self.address = figures.default_address_n if address is None else address
        self.name = Name(
            identity=identity, manufacturer=figures.manufacturer_n, function=255, arbitrary_address_capable=1
        )
        self.supply_v = 12.5
        self.temperature_c = 25.0
        self.fatal = False
        self._home_address = self.address
        self._codec = ElectrakCodec(self.profile.layout)
        self._random = random.Random(f"{seed}/{self.address}")
        self._motor = Motor(figures, self.behaviour, self.faults, self._random, position_mm)
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
        return self._motor.position_mm

    @position_mm.setter
    def position_mm(self, value: float) -> None:
        self._motor.place(value)

    @property
    def velocity_mm_per_s(self) -> float:
        """True speed, positive while extending."""
        return self._motor.velocity_mm_per_s

    @property
    def current_a(self) -> float:
        """Motor current."""
        return self._motor.current_a

    @property
    def figures(self) -> Figures:
        """What this unit can do; another one's may be put in while it runs."""
        return self._motor.figures

    @figures.setter
    def figures(self, value: Figures) -> None:
        self._motor.figures = value

    @property
    def load_n(self) -> float:
        """Newtons against extension."""
        return self._motor.load_n

    @load_n.setter
    def load_n(self, value: float) -> None:
        self._motor.load_n = value

    @property
    def manual_override(self) -> Literal["extend", "retract"] | None:
        """The switch at the unit that moves it past its bus."""
        return self._motor.manual_override

    @manual_override.setter
    def manual_override(self, value: Literal["extend", "retract"] | None) -> None:
        self._motor.manual_override = value

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
        return self._motor.state.overload

    @property
    def motion_enabled(self) -> bool:
        """Whether the last control message that counted allows motion."""
        return self._motor.state.enabled

    def cut_power(self) -> None:
        """Take the supply away: motion ends, the holding brake keeps the tube, everything volatile is forgotten."""
        self._powered = False
        self._awake = False
        self._motor.cut()
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
        stood = not self._motor.busy
        while self._now_s < now_s:
            step_s = now_s - self._now_s
            if not stood:
                step_s = min(_STEP_S, step_s)
            self._now_s += step_s
            self._move(self._now_s, step_s)
            stood = self._motor.rests or not self._motor.busy
        self._talk(now_s)
        out, self._out = self._out, []
        if self.faults.silent:
            return []
        return out

    def _move(self, now_s: float, step_s: float) -> None:
        """Let the motor do what the controller allows."""
        powered = self._powered and not self.fatal
        quiet_s = now_s - self._last_activity_s
        lost = self.behaviour.acm_loss == "stop" and quiet_s > self.figures.sleep_after_s
        refused = self._motor.state.parameter and self.behaviour.parameter_refuses_motion
        obeys = self._awake and not lost and not refused
        self._motor.move(now_s, step_s, powered=powered, obeys=obeys, may_start=self._in_range)

    def _in_range(self) -> bool:
        """Out of range a move in progress is completed, and a new one refused."""
        return not self._flags() & {"voltage_low", "voltage_high", "temperature_low", "temperature_high"}

    def _talk(self, now_s: float) -> None:
        if not self._powered:
            return
        if self._awake and now_s - self._last_activity_s > self.figures.sleep_after_s and not self.manual_override:
            self._awake = False
            self._motor.state.enabled = False
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
        reported_mm = min(max(round(self._motor.position_mm + noise_mm, 1), 0.0), self.figures.stroke_mm)
        motion = self._motor.state
        return Feedback(
            position_mm=reported_mm,
            current_a=min(round(self._motor.current_a, 1), self.figures.measured_current_max_a),
            duty_percent=5.0 * round(motion.duty_percent / 5.0),
            moving=abs(self._motor.velocity_mm_per_s) > 0.5,
            flags=self._flags(),
        )

    def _flags(self) -> frozenset[str]:
        figures, motion = self.figures, self._motor.state
        states = {
            "overload": motion.overload,
            "backdrive": motion.backdrive_mm > 0.5,
            "parameter": motion.parameter,
            "saturation": self._motor.saturated,
            "fatal": self.fatal,
            "voltage_low": self.supply_v < figures.supply_min_v,
            "voltage_high": self.supply_v > figures.supply_max_v,
            "temperature_low": self.temperature_c < figures.temperature_min_c,
            "temperature_high": self.temperature_c > figures.temperature_max_c,
        }
        return frozenset(flag for flag, is_set in states.items() if is_set) | self.faults.forced_flags

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
        self._motor.state.enabled = False
        self._motor.state.direction = 0
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
        motion, figures = self._motor.state, self.figures
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
