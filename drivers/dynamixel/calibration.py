"""Servo counts and degrees at the blade: zero, sign, gear ratio and soft limits of our own calibration.

``blade_deg = sign * servo_deg / gear_ratio - zero_deg``; the servo's own Homing Offset stays 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.settings import Ph54Settings

_LIMIT_MARGIN_DEG = 1.0
"""The servo's own position limits lie so far outside the soft limits, so that ours act first."""
_DEG_PER_S_PER_REV_PER_MIN = 6.0
_OVER_RATING = 1.5
"""35 V, the highest supply, over the 24 V of the rating."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Conversions for one servo on one blade; build it with :meth:`of`.

    ``top_deg_per_s``: no output of the servo turns faster, at the highest supply voltage. ``current_limit_a``: the
    setting, or the servo's continuous rating.
    """

    zero_deg: float
    sign: int
    gear_ratio: float
    min_deg: float
    max_deg: float
    pulses_per_turn: int
    velocity_deg_per_s_per_count: float
    acceleration_deg_per_s2_per_count: float
    torque_nm_per_a: float
    current_limit_a: float
    top_deg_per_s: float

    @classmethod
    def of(cls, settings: Ph54Settings, table: ControlTable) -> Calibration:
        """From the settings and the model's profile."""
        motion, rating = table.profile["motion"], table.profile["rating"]
        per_s = motion["velocity_rev_per_min_per_count"] * _DEG_PER_S_PER_REV_PER_MIN
        per_s2 = motion["acceleration_rev_per_min2_per_count"] * _DEG_PER_S_PER_REV_PER_MIN / 60.0
        return cls(
            zero_deg=settings.zero_deg,
            sign=settings.sign,
            gear_ratio=settings.gear_ratio,
            min_deg=settings.min_deg,
            max_deg=settings.max_deg,
            pulses_per_turn=motion["pulses_per_turn"],
            velocity_deg_per_s_per_count=per_s,
            acceleration_deg_per_s2_per_count=per_s2,
            torque_nm_per_a=rating["torque_nm_per_a"],
            current_limit_a=settings.current_limit_a or rating["current_continuous_a"],
            top_deg_per_s=_OVER_RATING * rating["speed_no_load_rev_per_min"] * _DEG_PER_S_PER_REV_PER_MIN,
        )

    def blade_deg(self, counts: int) -> float:
        """Blade angle of a position register."""
        return self.sign * counts * 360.0 / self.pulses_per_turn / self.gear_ratio - self.zero_deg

    def counts(self, blade_deg: float) -> int:
        """Position register of a blade angle."""
        return round(self.sign * (blade_deg + self.zero_deg) * self.gear_ratio * self.pulses_per_turn / 360.0)

    def servo_deg(self, counts: int) -> float:
        """Degrees at the servo's output, in its own frame, of a position register."""
        return counts * 360.0 / self.pulses_per_turn

    def servo_counts(self, servo_deg: float) -> int:
        """Position register of degrees at the servo's output."""
        return round(servo_deg * self.pulses_per_turn / 360.0)

    def blade_deg_per_s(self, counts: int) -> float:
        """Blade velocity of a velocity register."""
        return self.sign * counts * self.velocity_deg_per_s_per_count / self.gear_ratio

    def velocity_counts(self, deg_per_s: float) -> int:
        """Profile velocity register for a blade speed; at least 1, because 0 means "no limit"."""
        return max(1, round(deg_per_s * self.gear_ratio / self.velocity_deg_per_s_per_count))

    def acceleration_counts(self, deg_per_s2: float) -> int:
        """Profile acceleration register for a blade acceleration; at least 1, because 0 means "at once"."""
        return max(1, round(deg_per_s2 * self.gear_ratio / self.acceleration_deg_per_s2_per_count))

    def torque_nm(self, current_ma: int) -> float:
        """Torque estimate at the blade from the motor current, signed like the angle. From ratings, not measured."""
        return self.sign * current_ma / 1000.0 * self.torque_nm_per_a * self.gear_ratio

    @property
    def turn_deg(self) -> float:
        """Blade degrees of one servo turn: what a lost turn shifts the angle by."""
        return 360.0 / self.gear_ratio

    @property
    def needs_turns(self) -> bool:
        """Whether the soft limits reach beyond one servo turn, so that extended position mode is needed."""
        half = self.pulses_per_turn // 2
        return any(abs(c) > half for c in self.servo_limits())

    def servo_limits(self) -> tuple[int, int]:
        """Min and Max Position Limit registers: the soft limits and a margin."""
        ends = (self.counts(self.min_deg - _LIMIT_MARGIN_DEG), self.counts(self.max_deg + _LIMIT_MARGIN_DEG))
        return min(ends), max(ends)

    def within_limits(self, blade_deg: float, tolerance_deg: float = 0.0) -> bool:
        """Whether an angle is finite and inside the soft limits."""
        return math.isfinite(blade_deg) and self.min_deg - tolerance_deg <= blade_deg <= self.max_deg + tolerance_deg
