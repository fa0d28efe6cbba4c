"""The daemon's behaviour in mid-pass: what its own rule makes of the soil that the blade carries then."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from graderd.core.blade import BladeGeometry, blade_coordinates
from graderd.core.rule import RuleSettings
from graderd.perception.decide import decide
from graderd.perception.settings import DecisionSettings
from graderd.studies.blade_rotation.case import PACKING, Case
from graderd.studies.blade_rotation.lammps import Motion
from graderd.studies.blade_rotation.outcome import Frame

SWING_DEG_PER_S = 25.0
"""How fast the blade turns: the daemon's default (``rotation.speed_deg_per_s``)."""
NONE_BELOW_L = 1.0


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of the pass with one steady motion, up to a step."""

    motion: Motion
    until_step: int


def carried_l(case: Case, frame: Frame) -> tuple[float, float, float]:
    """Soil before the left, middle and right third of the blade, as far ahead as the daemon counts, poured litres."""
    (x, y, _), yaw = frame.blade.place_m, math.degrees(frame.blade.yaw_rad)
    s, d = blade_coordinates(frame.grains[:, 1] - x, frame.grains[:, 2] - y, yaw)
    ours = BladeGeometry()
    near = (d >= 0.0) & (d <= ours.reach_m * case.blade.height_m / ours.height_m)
    volume = 4.0 / 3.0 * math.pi * frame.grains[:, 4] ** 3 / PACKING * 1000.0
    half = case.blade.length_m / 2.0
    edges = np.array((-half, -half / 3.0, half / 3.0, half))
    right, middle, left = np.histogram(s[near], edges, weights=volume[near])[0].tolist()
    return left, middle, right


def decided_again(case: Case, frame: Frame, leg: Leg, frame_steps: int, last_step: int, step_s: float) -> list[Leg]:
    """The rest of the pass after ``leg``: a swing to the angle that the rule has for the soil now before the blade, and
    straight on; only straight on where it is not sure, or wants the same."""
    now = leg.motion.at(leg.until_step * step_s)
    verdict = decide(carried_l(case, frame), NONE_BELOW_L, "l", DecisionSettings())
    wanted_deg = RuleSettings().angle_deg(verdict.zone)
    turn = 0.0 if wanted_deg is None else math.radians(wanted_deg) - now.yaw_rad
    if abs(turn) < 1e-6:
        return [Leg(now, last_step)]
    # Whole frames, so never faster than the servo turns.
    swing = math.ceil(abs(turn) / math.radians(SWING_DEG_PER_S) / step_s / frame_steps) * frame_steps
    turning = replace(now, yaw_rad_per_s=turn / (swing * step_s))
    there = leg.until_step + swing
    if there >= last_step:
        return [Leg(turning, last_step)]
    after = replace(turning.at(there * step_s), yaw_rad_per_s=0.0)
    return [Leg(turning, there), Leg(after, last_step)]
