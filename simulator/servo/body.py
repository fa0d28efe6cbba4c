"""The body of a virtual PH54: control table, motion, bus watchdog, protection, power. Time is handed in.

What instructions do to it stands in :mod:`graderd.simulator.servo.servo`.

Behaviour follows the ROBOTIS e-manual page of the PH54-200-S500-R. Where it is silent the choice is marked
"not documented" here and is to be checked on hardware.
"""

from __future__ import annotations

import math

from graderd.drivers.dynamixel.table import ControlTable, Register
from graderd.simulator.servo.memory import ControlMemory
from graderd.simulator.servo.motion import CATCH_UP_S, STEP_S, Plant, PlantSettings, Profile, Trajectory

CURRENT_MODE, VELOCITY_MODE, POSITION_MODE, EXTENDED_MODE = 0, 1, 3, 4
_WATCHDOG_STEP_S = 0.020
_WATCHDOG_TRIPPED = -1
_TIME_PROFILE, _REVERSE, _TORQUE_BY_GOAL = 0x04, 0x01, 0x08
_OVERLOAD_S = 5.0
"""Torque at its limit for so long is an overload (the time is not documented)."""
_IN_POSITION_DEG = 0.1
_TRIP_DECELERATION_DEG_PER_S2 = 3600.0
"""Braking after a watchdog trip: as hard as the continuous torque can (the value is not documented)."""


def plant_of(table: ControlTable) -> PlantSettings:
    """A blade on the servo that ``table`` is of."""
    rating = table.profile["rating"]
    return PlantSettings(
        torque_nm_per_a=rating["torque_nm_per_a"],
        no_load_current_a=rating["current_no_load_a"],
        no_load_deg_per_s=rating["speed_no_load_rev_per_min"] * 6.0,
    )


class ServoBody:
    """A PH54 as seen from its shaft, and what its registers mean. Use :class:`~graderd.simulator.servo.VirtualServo`.

    Args:
        servo_id: its id on the bus, 0-252.
        profile: firmware profile that gives its control table and ratings.
        seed: for the small noise of its current and voltage readings.
        plant: what hangs on the shaft.
        reboot_s: silence after a reboot (not documented; 0.4 s is a guess on the long side).
    """

    def __init__(
        self,
        servo_id: int = 1,
        profile: str = "ph54_200_s500",
        seed: int = 0,
        *,
        plant: PlantSettings | None = None,
        reboot_s: float = 0.4,
    ) -> None:
        self.table = ControlTable.load(profile)
        self.memory = ControlMemory(self.table)
        self.memory["id"] = servo_id
        self.plant = Plant(plant or plant_of(self.table))
        self.trajectory = Trajectory()
        self.reboot_s = reboot_s
        self.powered = True
        self.braked = False
        self.tripped = False
        self.forced_voltage_v: float | None = None
        self.forced_temperature_c: float | None = None
        self.refused: dict[int, int] = {}
        self.misread_deg, self.misread_n = 0.0, 0
        self.keeps_turns = False
        self._pulses_per_turn = int(self.table.profile["motion"]["pulses_per_turn"])
        self._deg_per_count = 360.0 / self._pulses_per_turn
        self._turn_base_deg = 0.0
        self._registered: bytes | None = None
        self._silent_until_s = -math.inf
        self._now_s: float | None = None
        self._fed_s = -math.inf
        self._noise = seed * 2_654_435_761 + 1
        self._publish()
        self.memory["goal_position"] = self.memory["present_position"]

    # -- what the rig sees ------------------------------------------------------------------------------------

    @property
    def servo_id(self) -> int:
        """Its id on the bus."""
        return self.memory["id"]

    @property
    def shaft_deg(self) -> float:
        """True angle of the output shaft behind the gear's play; never wraps."""
        return self.plant.shaft_deg

    @shaft_deg.setter
    def shaft_deg(self, angle_deg: float) -> None:
        self.plant.motor_deg = self.plant.shaft_deg = angle_deg
        self.plant.velocity_deg_per_s = 0.0
        self.trajectory.restart(angle_deg)
        self._publish()
        self.memory["goal_position"] = self.memory["present_position"]

    def turn_by_hand(self, angle_deg: float, deg_per_s: float) -> None:
        """Somebody turns the output shaft and has it there, at that speed: the encoder tells both."""
        self.shaft_deg, self.plant.velocity_deg_per_s = angle_deg, deg_per_s
        self._publish()

    @property
    def shaft_velocity_deg_per_s(self) -> float:
        """True angular velocity of the output."""
        return self.plant.velocity_deg_per_s

    @property
    def torque_enabled(self) -> bool:
        """Whether the motor is powered."""
        return bool(self.memory["torque_enable"])

    @property
    def load_torque_nm(self) -> float:
        """External torque on the output, signed: positive pushes towards larger angles."""
        return self.plant.load_torque_nm

    @load_torque_nm.setter
    def load_torque_nm(self, torque_nm: float) -> None:
        self.plant.load_torque_nm = torque_nm

    # -- time ---------------------------------------------------------------------------------------------------

    def note_traffic(self, at_s: float) -> None:
        """An instruction packet was on the bus: any packet feeds the watchdog."""
        self._fed_s = max(self._fed_s, at_s)

    def forgive(self, stall_s: float) -> None:
        """The program around the servo stood still for so long: that is not silence on the bus."""
        self._fed_s += stall_s

    def advance(self, now_s: float) -> None:
        """Let time pass up to ``now_s`` (monotonic seconds, never back)."""
        if self._now_s is None:
            self._now_s = now_s
            self._fed_s = max(self._fed_s, now_s)
            return
        start_s = max(self._now_s, now_s - CATCH_UP_S)
        while start_s < now_s - 1e-9:
            dt_s = min(STEP_S, now_s - start_s)
            start_s += dt_s
            self._step(start_s, dt_s)
        self._now_s = max(self._now_s, now_s)
        self._publish()
        self._protect()

    def _step(self, at_s: float, dt_s: float) -> None:
        if not self.powered:
            self.plant.step_free(dt_s, brake=False)
            return
        if not self.torque_enabled:
            self.plant.step_free(dt_s, brake=self.braked)
            return
        watchdog = self.memory["bus_watchdog"]
        if watchdog > 0 and at_s - self._fed_s > watchdog * _WATCHDOG_STEP_S:
            self.memory["bus_watchdog"] = _WATCHDOG_TRIPPED
            self.tripped = True
        mode = self.memory["operating_mode"]
        if self.tripped:
            self.trajectory.step_velocity(dt_s, 0.0, _TRIP_DECELERATION_DEG_PER_S2)
            self.plant.step_loop(dt_s, self.trajectory, self._limit_nm())
        elif mode in (POSITION_MODE, EXTENDED_MODE):
            self.trajectory.step(dt_s, self._profile(), self._top_deg_per_s())
            stiffness = self.memory["position_p_gain"] / max(1, self.table["position_p_gain"].default)
            self.plant.step_loop(dt_s, self.trajectory, self._limit_nm(), stiffness)
        elif mode == VELOCITY_MODE:
            wanted = self._sign * self.memory["goal_velocity"] * self._velocity_unit
            self.trajectory.step_velocity(dt_s, wanted, self._profile().acceleration_deg_per_s2)
            self.plant.step_loop(dt_s, self.trajectory, self._limit_nm())
        else:
            self.plant.step_torque(dt_s, self._open_loop_nm(mode))

    @property
    def _sign(self) -> int:
        return -1 if self.memory["drive_mode"] & _REVERSE else 1

    @property
    def _velocity_unit(self) -> float:
        """Degrees per second for one count of a velocity register."""
        return float(self.table.profile["motion"]["velocity_rev_per_min_per_count"]) * 6.0

    def _profile(self) -> Profile:
        velocity, acceleration = self.memory["profile_velocity"], self.memory["profile_acceleration"]
        if self.memory["drive_mode"] & _TIME_PROFILE:
            total_s = velocity / 1000.0
            rise_s = min(acceleration / 1000.0, total_s / 2)
            if total_s <= 0.0:
                return Profile()
            top = self._time_profile_distance_deg / (total_s - rise_s)
            return Profile(top, top / rise_s if rise_s > 0 else 0.0)
        unit = float(self.table.profile["motion"]["acceleration_rev_per_min2_per_count"]) * 0.1
        return Profile(velocity * self._velocity_unit, acceleration * unit)

    _time_profile_distance_deg = 0.0

    def _top_deg_per_s(self) -> float:
        rating = self.table.profile["rating"]
        no_load = float(rating["speed_no_load_rev_per_min"]) * 6.0 * self.plant.voltage_v / float(rating["voltage_v"])
        return min(self.memory["velocity_limit"] * self._velocity_unit, no_load)

    def _limit_nm(self) -> float:
        limit_a = min(abs(self.memory["goal_current"]), self.memory["current_limit"]) / 1000.0
        return limit_a * self.plant.settings.torque_nm_per_a

    def _open_loop_nm(self, mode: int) -> float:
        k = self.plant.settings.torque_nm_per_a
        if mode == CURRENT_MODE:
            return self._sign * self.memory["goal_current"] / 1000.0 * k
        top = self._top_deg_per_s()
        share = self._sign * self.memory["goal_pwm"] / max(1, self.table["pwm_limit"].default)
        missing = share - self.plant.velocity_deg_per_s / top if top else 0.0
        return max(-1.0, min(1.0, missing)) * self.memory["current_limit"] / 1000.0 * k

    # -- protection ---------------------------------------------------------------------------------------------

    def raise_hardware_error(self, bits: int) -> None:
        """Set bits of Hardware Error Status; torque goes where Shutdown says so."""
        self.memory["hardware_error_status"] |= bits
        if self.memory["hardware_error_status"] & self.memory["shutdown"]:
            self._torque(False)
            self.braked = True

    def _protect(self) -> None:
        if not self.powered:
            return
        volts = self.memory["present_input_voltage"]
        bits = 0
        if not self.memory["min_voltage_limit"] <= volts <= self.memory["max_voltage_limit"]:
            bits |= 0x01
        if self.memory["present_temperature"] > self.memory["temperature_limit"]:
            bits |= 0x04
        if self.plant.saturated_s > _OVERLOAD_S:
            bits |= 0x20
        if bits & ~self.memory["hardware_error_status"]:
            self.raise_hardware_error(bits)

    def power(self, on: bool) -> None:
        """Cut or bring back the supply. RAM is lost, the angle is known within one turn only."""
        if on and not self.powered:
            self.powered = True
            self._boot()
        elif not on:
            self.powered = False
            self.plant.relax()

    def _boot(self) -> None:
        self.memory.reset_ram()
        if self.memory["startup_configuration"] & 0x02 and self.memory.backup is not None:
            self.memory.restore_backup(eeprom=False)
        self.braked = self.tripped = False
        self._registered = None
        self.plant.relax()
        self._wrap()
        self._publish()
        self.memory["goal_position"] = self.memory["present_position"]
        if self.memory["startup_configuration"] & 0x01:
            self._torque(True)

    def _reboot(self, now_s: float) -> None:
        self._boot()
        self._silent_until_s = now_s + self.reboot_s

    def lose_turns(self, turns_n: int) -> None:
        """Shift the multi-turn count, as a reset inside the servo would."""
        self._turn_base_deg += 360.0 * turns_n
        self._publish()

    def switch_torque_off(self) -> None:
        """Torque off without an instruction from the client under test."""
        self._torque(False)

    def _wrap(self) -> None:
        self._turn_base_deg = 360.0 * math.floor((self.plant.motor_deg + 180.0) / 360.0)

    def listens(self, now_s: float) -> bool:
        """Whether it hears and answers (powered, not in the silence of a reboot)."""
        return self.powered and now_s >= self._silent_until_s

    # -- registers ----------------------------------------------------------------------------------------------

    def _offset_counts(self) -> int:
        offset = self.memory["homing_offset"]
        quarter = self._pulses_per_turn // 4
        return 0 if self.memory["operating_mode"] == POSITION_MODE and abs(offset) > quarter else offset

    def _counts(self, motor_deg: float) -> int:
        return round(self._sign * (motor_deg - self._turn_base_deg) / self._deg_per_count) + self._offset_counts()

    def _motor_deg(self, counts: int) -> float:
        return self._sign * (counts - self._offset_counts()) * self._deg_per_count + self._turn_base_deg

    def _publish(self) -> None:
        m, plant, trajectory, sign = self.memory, self.plant, self.trajectory, self._sign
        on = self.torque_enabled and self.powered
        velocity = round(sign * plant.velocity_deg_per_s / self._velocity_unit)
        m["present_velocity"] = velocity
        m["present_position"] = position = self._counts(plant.motor_deg)
        m["velocity_trajectory"] = round(sign * trajectory.velocity_deg_per_s / self._velocity_unit) if on else 0
        m["position_trajectory"] = self._counts(trajectory.position_deg) if on else position
        drawn_a = plant.current_a if on else 0.0
        if on and abs(plant.velocity_deg_per_s) > 0.5:
            drawn_a += math.copysign(plant.settings.no_load_current_a, plant.velocity_deg_per_s) * 0.3
        m["present_current"] = round(sign * drawn_a * 1000.0) + (self._jitter(3) if on else 0)
        share = max(-1.0, min(1.0, plant.velocity_deg_per_s / plant.settings.no_load_deg_per_s))
        m["present_pwm"] = round(sign * self.table["pwm_limit"].default * share) if on else 0
        volts = plant.voltage_v if self.forced_voltage_v is None else self.forced_voltage_v
        m["present_input_voltage"] = round(volts * 10.0)
        hot = plant.temperature_c if self.forced_temperature_c is None else self.forced_temperature_c
        m["present_temperature"] = round(hot)
        m["moving"] = int(abs(velocity) > m["moving_threshold"])
        m["moving_status"] = self._moving_status(position)
        m["realtime_tick"] = int((self._now_s or 0.0) * 1000.0) % 32768
        m["registered_instruction"] = int(self._registered is not None)

    def _jitter(self, width: int) -> int:
        self._noise = (self._noise * 1_103_515_245 + 12_345) & 0x7FFFFFFF
        return (self._noise >> 16) % (2 * width + 1) - width

    def _moving_status(self, position: int) -> int:
        if not self.torque_enabled or self.memory["operating_mode"] not in (POSITION_MODE, EXTENDED_MODE):
            return 0
        profile = self._profile()
        status = 0 if not profile.velocity_deg_per_s else 0x10 if not profile.acceleration_deg_per_s2 else 0x30
        near = abs(self.memory["goal_position"] - position) * self._deg_per_count <= _IN_POSITION_DEG
        return status | int(near and self.trajectory.done)

    def _torque(self, on: bool) -> None:
        if on and not self.torque_enabled:
            if self.memory["operating_mode"] == POSITION_MODE and not self.keeps_turns:
                self._wrap()
            self.plant.relax()
            self.trajectory.restart(self.plant.motor_deg)
            # The goal register counts from here on: a client that did not set it to the measured angle gets a jump.
            self.trajectory.goal_deg = self._motor_deg(self.memory["goal_position"])
            self._fed_s = max(self._fed_s, self._now_s or 0.0)
        elif not on:
            self.plant.relax()
        self.memory["torque_enable"] = int(on)

    def _written(self, register: Register, value: int) -> None:
        name = register.name
        if name == "torque_enable":
            self._torque(bool(value))
        elif name == "bus_watchdog":
            if self.tripped and value == 0:
                self.tripped = False
                self.trajectory.goal_deg = self.trajectory.position_deg
        elif name == "operating_mode":
            if value == POSITION_MODE:
                self._wrap()
            self._publish()
            self.memory["goal_position"] = self.memory["present_position"]
        elif name == "goal_position":
            if self.memory["drive_mode"] & _TORQUE_BY_GOAL:
                self._torque(True)
            if self.torque_enabled:
                self.trajectory.goal_deg = self._motor_deg(value)
                self._time_profile_distance_deg = abs(self.trajectory.goal_deg - self.trajectory.position_deg)
