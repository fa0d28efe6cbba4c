"""What is known of the servo: newest readings, present faults, and why it is not fit to go on. Reads only."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from graderd.drivers.dynamixel.bus import ServoBus
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.device import WATCHDOG_TRIPPED, WITNESS, Ph54Device
from graderd.drivers.dynamixel.motion import ServoMotion, possible
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.clock import Clock
from graderd.hal.fault import PresentFaults
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.settings import Ph54Settings

_CORRUPT_N, _CORRUPT_WINDOW_S = 3, 1.0
_DOUBLED_N, _DOUBLED_WINDOW_S = 3, 1.0
_READS_MOST_N = 3
_DOUBT_S = 0.1
"""Against a reading older than this, a new one is not wrong but only not vouched for."""
_VOLTAGE_HYSTERESIS_V = 0.3
_TEMPERATURE_HYSTERESIS_C = 2.0
SUPPLY_FAULTS = ("voltage_near_limit", "temperature_near_limit")


class ServoObserver:
    """Turns registers into readings and conditions; the rotator decides what follows from them.

    ``torque_on``: as last read. ``tripped``: the servo's bus watchdog has stopped it and is not cleared yet.
    ``turns_unknown``: whole turns were lost where they matter, the angle is ambiguous until a person confirms it.
    ``turns_jumped``: the turn count jumped since :meth:`restart`; a goal in counts is worth nothing any more.
    ``witness_due``: what is still to be written where the servo keeps the witness of its turns.
    ``motion``: the newest reading that was possible after the one before, in the servo's own frame.
    ``implausible_n``: positions with a right CRC that could not be.
    """

    def __init__(
        self, device_name: str, settings: Ph54Settings, table: ControlTable, calibration: Calibration, clock: Clock
    ) -> None:
        self.telemetry = RotatorTelemetry()
        self.faults = PresentFaults(device_name)
        self.torque_on = False
        self.tripped = False
        self.turns_unknown = False
        self.turns_jumped = False
        self.witness_due: dict[str, int] | None = None
        self.motion: ServoMotion | None = None
        self.implausible_n = 0
        self.health_s = self.goals_s = float("-inf")
        self._settings = settings
        self._calibration = calibration
        self._clock = clock
        self._alerts = {int(bit, 16): name for bit, name in table.profile["hardware_error"].items()}
        self._alert_names = frozenset(self._alerts.values())
        self._counts: int | None = None
        self._damaged_n = 0
        self._damaged_s: deque[float] = deque(maxlen=64)
        self._doubled_n = 0
        self._doubled_s: deque[float] = deque(maxlen=_DOUBLED_N)

    def restart(self, *, position_known: bool = False) -> None:
        """A servo just found or armed. ``position_known``: a jump from the last one counts."""
        self.turns_jumped = False
        if not position_known:
            self._counts = None

    def confirm_turns(self) -> None:
        """A person has seen that the angle is right: leave a witness of it with the servo."""
        self.turns_unknown = False
        self.faults.clear("turns_lost")
        if self._calibration.needs_turns:
            self.witness_due = dict(WITNESS)

    # -- readings ---------------------------------------------------------------------------------------------

    async def read_telemetry(self, device: Ph54Device, goal_deg: float | None, *, attempts_n: int = 1) -> None:
        """One telemetry block; ``goal_deg`` is where the servo is driving the blade to, if anywhere.

        A position that cannot come after the last one is asked for again at once: it counts where two agree. Until
        then the readings are the old ones, and age.
        """
        doubted: ServoMotion | None = None
        for _ in range(_READS_MOST_N):
            values, alert = await device.read_block(device.telemetry_block, attempts_n=attempts_n)
            motion = self._motion(values, device.bus.heard_s)
            if any(m and possible(m, motion, self._calibration.top_deg_per_s) for m in (self.motion, doubted)):
                self.motion = motion
                self._take(values, motion.time_s, goal_deg)
                if alert and not self.faults.names(self._clock.now_s()) & self._alert_names:
                    self.health_s = float("-inf")  # read it next
                return
            if self.motion is not None and motion.time_s - self.motion.time_s < _DOUBT_S:
                self.implausible_n += 1
            doubted = motion

    def _motion(self, values: dict[str, int], at_s: float) -> ServoMotion:
        cal = self._calibration
        per_s = cal.velocity_deg_per_s_per_count
        return ServoMotion(
            time_s=at_s,
            position_deg=cal.servo_deg(values["present_position"]),
            velocity_deg_per_s=values["present_velocity"] * per_s,
            setpoint_deg=cal.servo_deg(values["position_trajectory"]),
            setpoint_deg_per_s=values["velocity_trajectory"] * per_s,
        )

    def _take(self, values: dict[str, int], now_s: float, goal_deg: float | None) -> None:
        cal = self._calibration
        angle_deg = cal.blade_deg(self._follow_turns(values["present_position"], now_s))
        velocity = cal.blade_deg_per_s(values["present_velocity"])
        current_ma, volts = values["present_current"], values["present_input_voltage"] / 10.0
        celsius = float(values["present_temperature"])
        self.telemetry = replace(
            self.telemetry,
            angle_deg=Reading(angle_deg, now_s, not self.turns_unknown),
            velocity_deg_per_s=Reading(velocity, now_s),
            current_a=Reading(cal.sign * current_ma / 1000.0, now_s),
            torque_nm=Reading(cal.torque_nm(current_ma), now_s),
            voltage_v=Reading(volts, now_s),
            temperature_c=Reading(celsius, now_s),
            moving=Reading(bool(values["moving"]), now_s),
            in_position=Reading(bool(values["moving_status"] & 1), now_s),
            goal_deg=goal_deg,
        )
        self._watch_supply(volts, celsius, now_s)

    def _follow_turns(self, counts: int, now_s: float) -> int:
        """Notice a jump by whole turns; returns the count to go by."""
        turn, extended = self._calibration.pulses_per_turn, self._calibration.needs_turns
        before, self._counts = self._counts, counts
        if before is not None and abs(counts - before) > turn // 2:
            self.turns_jumped = True
            detail = f"the servo's turn count jumped by {round((counts - before) / turn):+d}"
            if extended:
                self.turns_unknown = True
                self.witness_due = dict.fromkeys(WITNESS, 0)
                self.faults.set("turns_lost", f"{detail}: confirm the blade's angle", now_s)
            else:
                self.faults.tell("turns_lost", f"{detail}; the angle within one turn is known", now_s)
        return counts if extended else (counts + turn // 2) % turn - turn // 2

    async def read_health(self, device: Ph54Device, *, attempts_n: int = 1) -> None:
        """Torque and hardware error. Torque that is otherwise than before is read twice: one wrong reading would leave
        a blade that turns to itself, since nothing is owed to what is not powered."""
        self.health_s = now_s = self._clock.now_s()
        health, _ = await device.read_block(device.health_block, attempts_n=attempts_n)
        if bool(health["torque_enable"]) is not self.torque_on:
            health, _ = await device.read_block(device.health_block, attempts_n=attempts_n)
        bits = health["hardware_error_status"]
        present = {
            name: f"hardware error bit 0x{bit:02X} is set (status 0x{bits:02X}); cleared by a reboot of the servo only"
            for bit, name in self._alerts.items()
            if bits & bit
        }
        self.faults.keep_only(present, now_s, among=self._alert_names)
        self.set_torque(bool(health["torque_enable"]))
        if self._calibration.needs_turns and self.witness_due is None and not self.turns_unknown:
            self._ask_witness(health, now_s)

    def _ask_witness(self, health: dict[str, int], now_s: float) -> None:
        """Without it the servo may have restarted since its turns were known, and lost them unseen."""
        if all(health[name] == value for name, value in WITNESS.items()):
            return
        self.turns_unknown = True
        if self.telemetry.angle_deg is not None:
            self.telemetry = replace(self.telemetry, angle_deg=replace(self.telemetry.angle_deg, valid=False))
        detail = "nothing proves that the servo has not restarted: compare the blade with the angle shown, then confirm"
        self.faults.set("turns_lost", detail, now_s)

    async def read_goals(self, device: Ph54Device, *, attempts_n: int = 1) -> dict[str, int]:
        """Watchdog, profile and goal registers; a trip is told once, however long the register stays tripped. It is
        read twice as well: a servo that has tripped brakes by itself, and is sent no hold."""
        self.goals_s = now_s = self._clock.now_s()
        goals, _ = await device.read_block(device.goal_block, attempts_n=attempts_n)
        if (goals["bus_watchdog"] == WATCHDOG_TRIPPED) is not self.tripped:
            goals, _ = await device.read_block(device.goal_block, attempts_n=attempts_n)
        tripped = goals["bus_watchdog"] == WATCHDOG_TRIPPED
        if tripped and not self.tripped:
            self.faults.tell("watchdog_tripped", "the servo's bus watchdog has stopped it; arm again", now_s)
        self.tripped = tripped
        return goals

    def set_torque(self, on: bool) -> None:
        """Torque as it was written or read."""
        self.torque_on = on
        self.telemetry = replace(self.telemetry, torque_on=Reading(on, self._clock.now_s()))

    def note_sent(self, counts: int) -> None:
        """A goal was taken by the servo."""
        sent = Reading(self._calibration.blade_deg(counts), self._clock.now_s())
        self.telemetry = replace(self.telemetry, goal_sent_deg=sent)

    def _watch_supply(self, volts: float, celsius: float, now_s: float) -> None:
        """Warn ahead of the servo's own limits; a hysteresis keeps a value at the edge from flickering."""
        st, warned = self._settings, self.faults.names(now_s)
        slack_v = _VOLTAGE_HYSTERESIS_V if "voltage_near_limit" in warned else 0.0
        inside = st.voltage_warn_low_v + slack_v <= volts <= st.voltage_warn_high_v - slack_v
        detail = f"{volts:.1f} V, warning outside {st.voltage_warn_low_v:g}…{st.voltage_warn_high_v:g} V"
        self.faults.keep("voltage_near_limit", not inside, detail, now_s)
        slack_c = _TEMPERATURE_HYSTERESIS_C if "temperature_near_limit" in warned else 0.0
        detail = f"{celsius:.0f} °C, warning from {st.temperature_warn_c:g} °C"
        self.faults.keep("temperature_near_limit", celsius >= st.temperature_warn_c - slack_c, detail, now_s)

    # -- judgement --------------------------------------------------------------------------------------------

    def name_torque_loss(self, goals: dict[str, int]) -> None:
        """Torque that was ours is off: say why, as far as the registers tell."""
        now_s = self._clock.now_s()
        if self.faults.names(now_s) & self._alert_names:
            return
        if goals["bus_watchdog"] == 0:
            self.faults.tell("ram_reset", "the servo's RAM registers were reset: its power was cut", now_s)
        else:
            self.faults.tell("torque_off", "torque was found switched off", now_s)

    def count_damage(self, bus: ServoBus) -> None:
        """Several damaged replies within a second are a fault even where others get through."""
        now_s, damaged_n = self._clock.now_s(), bus.damaged_n + self.implausible_n
        self._damaged_s.extend([now_s] * min(max(0, damaged_n - self._damaged_n), 8))
        self._damaged_n = damaged_n
        recent_n = sum(1 for at_s in self._damaged_s if now_s - at_s <= _CORRUPT_WINDOW_S)
        detail = f"{recent_n} damaged or impossible replies within {_CORRUPT_WINDOW_S:g} s"
        self.faults.keep("corrupt_replies", recent_n >= _CORRUPT_N, detail, now_s)

    def count_doubles(self, bus: ServoBus) -> None:
        """Several requests within a second that drew two whole answers: a second servo has the same id, and moves too.

        It is found so only where its answers come one after the other. Where they lie on each other, those that differ
        are damaged, which a disturbed line does as well, and equal ones cannot be told from one.
        """
        now_s, doubled_n = self._clock.now_s(), bus.doubled_n
        self._doubled_s.extend([now_s] * min(max(0, doubled_n - self._doubled_n), _DOUBLED_N))
        self._doubled_n = doubled_n
        recent_n = sum(1 for at_s in self._doubled_s if now_s - at_s <= _DOUBLED_WINDOW_S)
        detail = f"two servos answer to id {self._settings.servo_id_n}: give one of them another id"
        self.faults.keep("wrong_device", recent_n >= _DOUBLED_N, detail, now_s)

    def damaged_lately(self) -> bool:
        """Whether a lost connection was damaged replies rather than silence."""
        return bool(self._damaged_s) and self._clock.now_s() - self._damaged_s[-1] < 2 * _CORRUPT_WINDOW_S

    def new_wire(self) -> None:
        """The damage of another connection does not count."""
        self._damaged_n = self.implausible_n
        self._damaged_s.clear()
        self._doubled_n = 0
        self._doubled_s.clear()
