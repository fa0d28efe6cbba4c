"""How a geared servo moves: profile generator, motor, gear play, friction, heat. Pure, stepped by elapsed time.

Angles are degrees of the servo's output, torques newton metres at the output. One step is at most
:data:`STEP_S`; a caller that was late catches up in as many steps as it takes (at most :data:`CATCH_UP_S`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

STEP_S = 0.002
CATCH_UP_S = 2.0


@dataclass
class Profile:
    """Trapezoid: velocity 0 = no limit but the motor's; acceleration 0 = at once."""

    velocity_deg_per_s: float = 0.0
    acceleration_deg_per_s2: float = 0.0


class Trajectory:
    """The moving set point: runs to ``goal_deg`` within the profile, takes a new goal at any time without a jump."""

    def __init__(self) -> None:
        self.position_deg = 0.0
        self.velocity_deg_per_s = 0.0
        self.goal_deg = 0.0
        self.acceleration_deg_per_s2 = 0.0

    def restart(self, position_deg: float) -> None:
        """Stand still at ``position_deg``, goal there too."""
        self.position_deg = self.goal_deg = position_deg
        self.velocity_deg_per_s = self.acceleration_deg_per_s2 = 0.0

    @property
    def done(self) -> bool:
        """Whether the set point has reached the goal and stands."""
        return self.position_deg == self.goal_deg and self.velocity_deg_per_s == 0.0

    def step(self, dt_s: float, profile: Profile, top_velocity_deg_per_s: float) -> None:
        """Advance towards the goal position."""
        error_deg = self.goal_deg - self.position_deg
        velocity = profile.velocity_deg_per_s or top_velocity_deg_per_s
        velocity = min(velocity, top_velocity_deg_per_s)
        acceleration = profile.acceleration_deg_per_s2 if profile.velocity_deg_per_s else 0.0
        if acceleration == 0.0:
            wanted = math.copysign(min(velocity, abs(error_deg) / dt_s), error_deg)
            self._to_velocity(wanted, math.inf, dt_s)
            return
        slack = acceleration * dt_s
        if abs(error_deg) <= slack * dt_s and abs(self.velocity_deg_per_s) <= 2 * slack:
            self.restart(self.goal_deg)
            return
        # The fastest velocity from which the goal can still be met, half a step ahead.
        meets = math.sqrt(2 * acceleration * abs(error_deg) + slack * slack / 4) - slack / 2
        self._to_velocity(math.copysign(min(velocity, meets), error_deg), acceleration, dt_s)

    def step_velocity(self, dt_s: float, wanted_deg_per_s: float, acceleration_deg_per_s2: float) -> None:
        """Advance at a commanded velocity (velocity mode, or coming to a stop with 0)."""
        self._to_velocity(wanted_deg_per_s, acceleration_deg_per_s2 or math.inf, dt_s)

    def _to_velocity(self, wanted: float, acceleration: float, dt_s: float) -> None:
        before = self.velocity_deg_per_s
        change = max(-acceleration * dt_s, min(acceleration * dt_s, wanted - before))
        self.velocity_deg_per_s = before + change
        self.acceleration_deg_per_s2 = 0.0 if math.isinf(acceleration) else change / dt_s
        self.position_deg += self.velocity_deg_per_s * dt_s
        if abs(self.goal_deg - self.position_deg) < 1e-9:
            self.position_deg = self.goal_deg


@dataclass
class PlantSettings:
    """What hangs on the servo; the defaults are a 1 m steel blade on a 1/4-scale machine.

    ``stops_deg``: mechanical ends of the output's turn on either side, hit without a bounce; infinite: none.
    """

    inertia_kg_m2: float = 0.8
    friction_nm: float = 3.0
    brake_nm_s_per_deg: float = 0.4
    bandwidth_hz: float = 12.0
    integral_s: float = 0.15
    backlash_deg: float = 0.1
    stops_deg: float = math.inf
    torque_nm_per_a: float = 4.806
    no_load_current_a: float = 1.65
    no_load_deg_per_s: float = 198.6
    ambient_c: float = 25.0
    heat_c_per_a2: float = 0.35
    heat_time_s: float = 300.0
    supply_v: float = 24.0
    supply_ohm: float = 0.08


class Plant:
    """Motor, gear and load behind the position loop.

    ``motor_deg`` is what the encoder sees; ``shaft_deg`` is the output behind the gear's play.
    ``load_torque_nm`` is signed: positive pushes counter-clockwise (towards larger angles).
    """

    def __init__(self, settings: PlantSettings) -> None:
        self.settings = settings
        self.motor_deg = 0.0
        self.shaft_deg = 0.0
        self.velocity_deg_per_s = 0.0
        self.load_torque_nm = 0.0
        self.torque_nm = 0.0
        self.temperature_c = settings.ambient_c + 5.0
        self.saturated_s = 0.0
        self.jammed = False
        self.reversed_loop = False
        self._integral_nm = 0.0

    @property
    def current_a(self) -> float:
        """Signed motor current."""
        return self.torque_nm / self.settings.torque_nm_per_a

    @property
    def voltage_v(self) -> float:
        """Supply at the servo's terminals under its own load."""
        return self.settings.supply_v - abs(self.current_a) * self.settings.supply_ohm

    def relax(self) -> None:
        """Forget the loop's memory (torque was switched)."""
        self._integral_nm = 0.0
        self.torque_nm = 0.0
        self.saturated_s = 0.0

    def step_loop(self, dt_s: float, target: Trajectory, limit_nm: float, stiffness: float = 1.0) -> None:
        """One step under the position loop; ``limit_nm`` is the torque the current limit allows."""
        s = self.settings
        omega = 2 * math.pi * s.bandwidth_hz
        per_deg = math.pi / 180 * s.inertia_kg_m2
        error_deg = target.position_deg - self.motor_deg
        slip = target.velocity_deg_per_s - self.velocity_deg_per_s
        feed_nm = per_deg * target.acceleration_deg_per_s2
        if self.reversed_loop:
            error_deg, slip, feed_nm = -error_deg, -self.velocity_deg_per_s, 0.0
        asked = per_deg * stiffness * (omega * omega * error_deg + 2 * omega * slip) + feed_nm + self._integral_nm
        driving = asked * self.velocity_deg_per_s > 0
        limit_nm *= (
            max(0.0, min(1.0, 5.0 * (1.02 - abs(self.velocity_deg_per_s) / s.no_load_deg_per_s))) if driving else 1.0
        )
        self.torque_nm = max(-limit_nm, min(limit_nm, asked))
        if self.torque_nm == asked:
            self.saturated_s = 0.0
            self._integral_nm += per_deg * stiffness * omega * omega * error_deg * dt_s / s.integral_s
            self._integral_nm = max(-limit_nm, min(limit_nm, self._integral_nm))
        else:
            self.saturated_s += dt_s
        self._accelerate(dt_s, self.torque_nm)

    def step_torque(self, dt_s: float, torque_nm: float) -> None:
        """One step with a given motor torque (current and PWM modes)."""
        self.torque_nm = torque_nm
        self._accelerate(dt_s, torque_nm)

    def step_free(self, dt_s: float, *, brake: bool) -> None:
        """One step with torque off: friction, and after a shutdown the dynamic brake."""
        self.torque_nm = 0.0
        drag = self.settings.brake_nm_s_per_deg * self.velocity_deg_per_s if brake else 0.0
        self._accelerate(dt_s, -drag)

    def _accelerate(self, dt_s: float, motor_nm: float) -> None:
        s = self.settings
        if self.jammed:
            self.velocity_deg_per_s = 0.0
        else:
            pushing_nm = motor_nm + self.load_torque_nm
            per_step = math.degrees(dt_s / s.inertia_kg_m2)
            free = self.velocity_deg_per_s + pushing_nm * per_step
            slowed = max(0.0, abs(free) - s.friction_nm * per_step)
            self.velocity_deg_per_s = math.copysign(slowed, free)
            self.motor_deg += self.velocity_deg_per_s * dt_s
            if abs(self.motor_deg) > s.stops_deg:
                self.motor_deg = math.copysign(s.stops_deg, self.motor_deg)
                self.velocity_deg_per_s = 0.0
        half = s.backlash_deg / 2
        self.shaft_deg = max(self.motor_deg - half, min(self.motor_deg + half, self.shaft_deg))
        if abs(self.load_torque_nm) > s.friction_nm:  # the load holds the play on its own side
            self.shaft_deg = self.motor_deg + math.copysign(half, self.load_torque_nm)
        heat_c = s.ambient_c + 5.0 + s.heat_c_per_a2 * self.current_a**2
        self.temperature_c += (heat_c - self.temperature_c) * dt_s / s.heat_time_s
