"""The whole virtual machine between its wires and its pictures: bed, vehicle, blade and the loads on them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from graderd.simulator.grader.blade import BladePose, Plough, volumes_in_front_m3
from graderd.simulator.grader.load import BladeLoad, blade_load
from graderd.simulator.grader.piles import SceneZone, lay_scene
from graderd.simulator.grader.soil import FloatArray, SoilField

START_X_M = 1.2
MIN_X_M, MAX_X_M = 0.8, 7.0
"""Where the blade's axis may stand in the bed: the machine keeps clear of the end walls."""
MAX_SPEED_M_PER_S = 1.5
_ACCELERATION_M_PER_S2 = 2.0
_BRAKE_M_PER_S2 = 4.0


@dataclass
class Vehicle:
    """The machine's travel along the bed. ``x_m``: bed x of the blade's axis. ``travelled_m``: what its wheels have
    rolled, backwards counted off; lifting it back to the start turns no wheel."""

    x_m: float = START_X_M
    speed_m_per_s: float = 0.0
    travelled_m: float = 0.0
    _wanted_m_per_s: float = 0.0
    _stop_x_m: float = START_X_M

    @property
    def driving(self) -> bool:
        """Whether it moves or is about to."""
        return self._wanted_m_per_s != 0.0 or self.speed_m_per_s != 0.0

    def drive(self, speed_m_per_s: float, distance_m: float) -> float:
        """Drive ``distance_m`` at ``speed_m_per_s`` (negative: back), or as far as the bed goes; returns how far."""
        end_m = self.x_m + math.copysign(distance_m, speed_m_per_s)
        self._stop_x_m = min(max(end_m, MIN_X_M), MAX_X_M)
        self._wanted_m_per_s = speed_m_per_s
        return abs(self._stop_x_m - self.x_m)

    def halt(self) -> None:
        """Brake."""
        self._wanted_m_per_s = 0.0

    def reset(self) -> None:
        """Back to the start, standing."""
        self.x_m, self.speed_m_per_s, self._wanted_m_per_s = START_X_M, 0.0, 0.0

    def step(self, step_s: float) -> None:
        """Let time pass."""
        wanted = self._wanted_m_per_s
        limit = _ACCELERATION_M_PER_S2
        if wanted == 0.0:
            limit = _BRAKE_M_PER_S2
        else:
            left_m = (self._stop_x_m - self.x_m) * math.copysign(1.0, wanted)
            if left_m <= 1e-4:
                self._wanted_m_per_s = wanted = self.speed_m_per_s = 0.0
            else:
                # Slow down in time to stand at the place; half the brake's power keeps the last centimetres gentle.
                allowed = math.sqrt(_BRAKE_M_PER_S2 * left_m) + 0.005
                wanted = math.copysign(min(abs(wanted), allowed), wanted)
                if abs(self.speed_m_per_s) > allowed:
                    limit = 2.0 * _BRAKE_M_PER_S2
        change = wanted - self.speed_m_per_s
        self.speed_m_per_s += max(-limit * step_s, min(limit * step_s, change))
        move_m = self.speed_m_per_s * step_s
        if self._wanted_m_per_s > 0.0:
            move_m = min(move_m, max(self._stop_x_m - self.x_m, 0.0))
        elif self._wanted_m_per_s < 0.0:
            move_m = max(move_m, min(self._stop_x_m - self.x_m, 0.0))
        before_m, self.x_m = self.x_m, min(max(self.x_m + move_m, MIN_X_M), MAX_X_M)
        self.travelled_m += self.x_m - before_m
        if self.x_m in (MIN_X_M, MAX_X_M) and self._wanted_m_per_s == 0.0:
            self.speed_m_per_s = 0.0


class World:
    """Soil, vehicle and blade, moved on in small steps by whoever owns it."""

    def __init__(self) -> None:
        self.field = SoilField()
        self.vehicle = Vehicle()
        self.blade = BladePose()
        self.load = BladeLoad()
        self.plough = Plough(self.field)

    def step(self, step_s: float, pose: BladePose) -> None:
        """Let ``step_s`` pass, in which the actuators took the blade to ``pose``."""
        before_m = self.vehicle.x_m
        self.vehicle.step(step_s)
        moved = self.plough.move(before_m, self.blade, self.vehicle.x_m, pose)
        turn_rad_per_s = math.radians(pose.angle_deg - self.blade.angle_deg) / step_s
        self.blade = pose
        # Where nothing moved the load is what it was; the first step at rest still counts as one in which soil slides.
        if moved:
            self.load = blade_load(self.field, self.vehicle.x_m, pose, self.vehicle.speed_m_per_s, turn_rad_per_s)

    def lay(self, heights_m: FloatArray) -> None:
        """Replace the soil by ``heights_m`` (the field's shape); it settles round the blade in the next steps."""
        self.field.heights_m[:] = heights_m
        self.plough.restless = True

    def reset_vehicle(self) -> None:
        """Lift the machine back to the start of the bed; the soil stays."""
        self.vehicle.reset()
        self.plough.restless = True

    def volumes_l(self) -> tuple[float, float, float]:
        """Soil in front of the blade, litres: left, center, right third."""
        left, center, right = volumes_in_front_m3(self.field, self.vehicle.x_m, self.blade.angle_deg)
        return left * 1e3, center * 1e3, right * 1e3

    @property
    def soil_kg(self) -> float:
        """All soil in the bed."""
        return self.field.volume_m3 * self.field.soil.density_kg_per_m3


def scene_heights(zone: SceneZone, x_m: float, pose: BladePose, seed: int) -> FloatArray:
    """Heights of a scene laid in front of a blade standing at bed ``x_m``; pure, so that another thread may do it."""
    field = SoilField()
    lay_scene(field, zone, x_m, pose, seed)
    return field.heights_m
