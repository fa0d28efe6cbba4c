"""Forces of the soil on the blade: what the servo and the lifts feel.

A strip of the blade that moves into soil has to push the heap before it over the ground: friction of the heap's
weight (soil on soil, 0.49 after Table 2 of the paper) plus the passive pressure of the depth it cuts. A strip that
stands still or moves away feels the heap lean on it: active earth pressure (Rankine). For the paper's heap of 240 kg
the friction term alone gives 0.49 m g = 1150 N; its Table 3 has 1140 to 1210 N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from graderd.simulator.grader.blade import LENGTH_M, REACH_M, BladePose, blade_grid
from graderd.simulator.grader.soil import FloatArray, SoilField

GRAVITY_M_PER_S2 = 9.81

TURNTABLE_SHARE = 0.08
"""Part of the soil's moment that reaches the servo: the slewing ring's worm stage and friction take the rest.

A heap at one end gives some 200 N m about the axis; the PH54 has 44.7 N m. Without such a stage it could not hold."""
_SERVO_LIMIT_NM = 18.0
_LOCKED_NM = 2.0
"""More does not get through to a servo without power: the worm locks itself."""
_STRIPS = 20
_CUT_M = 0.04
_FULL_DRAG_M_PER_S = 0.05


@dataclass(frozen=True, slots=True)
class BladeLoad:
    """Soil on the blade.

    ``force_n``: against the face, positive = pushes the blade back. ``torque_nm``: about the rotation axis, positive =
    counter-clockwise. ``left_n`` and ``right_n``: the parts of the force on either half.
    """

    force_n: float = 0.0
    torque_nm: float = 0.0
    left_n: float = 0.0
    right_n: float = 0.0

    def servo_torque_nm(self, powered: bool) -> float:
        """What reaches the servo's shaft."""
        limit = _SERVO_LIMIT_NM if powered else _LOCKED_NM
        return max(-limit, min(limit, TURNTABLE_SHARE * self.torque_nm))


def blade_load(field: SoilField, x_m: float, pose: BladePose, speed_m_per_s: float, turn_rad_per_s: float) -> BladeLoad:
    """Load on a blade whose axis stands at bed ``x_m`` and that moves with the given speeds."""
    half = LENGTH_M / 2.0
    span = half + REACH_M
    window = field.window(x_m - span, x_m + span, -span, span)
    heights = field.heights_m[window.slices]
    s_m, d_m = blade_grid(field, window, x_m, pose.angle_deg)
    above = heights - pose.edge_m(s_m)
    along = (np.abs(s_m) < half) & (above > 0.0)
    ahead = along & (d_m >= 0.0) & (d_m <= REACH_M)
    behind = along & (d_m <= -1.5 * field.cell_m) & (d_m >= -REACH_M)
    middles = (np.arange(_STRIPS) + 0.5) / _STRIPS * LENGTH_M - half
    normal = speed_m_per_s * math.cos(math.radians(pose.angle_deg)) - turn_rad_per_s * middles
    push = _side(field, s_m, d_m, above, ahead, normal) - _side(field, s_m, -d_m, above, behind, -normal)
    return BladeLoad(
        force_n=float(push.sum()),
        torque_nm=float((push * middles).sum()),
        left_n=float(push[middles > 0].sum()),
        right_n=float(push[middles < 0].sum()),
    )


def _side(
    field: SoilField, s_m: FloatArray, d_m: FloatArray, above: FloatArray, where: np.ndarray, normal: FloatArray
) -> FloatArray:
    """Force on each strip from the soil on one side, newtons; ``normal``: its speed towards that side, m/s."""
    width = LENGTH_M / _STRIPS
    strip = np.clip(((s_m[where] + LENGTH_M / 2.0) / width).astype(np.intp), 0, _STRIPS - 1)
    section = np.bincount(strip, above[where], minlength=_STRIPS) * field.cell_m**2 / width
    near = where & (d_m < _CUT_M + 1.5 * field.cell_m)
    strip_near = np.clip(((s_m[near] + LENGTH_M / 2.0) / width).astype(np.intp), 0, _STRIPS - 1)
    counted = np.maximum(np.bincount(strip_near, minlength=_STRIPS), 1)
    depth = np.bincount(strip_near, above[near], minlength=_STRIPS) / counted
    gamma = field.soil.density_kg_per_m3 * GRAVITY_M_PER_S2
    active = math.tan(math.radians(45.0 - field.soil.repose_deg / 2.0)) ** 2
    passive = 1.0 / active
    leaning = 0.5 * active * gamma * depth**2
    cut = np.minimum(depth, _CUT_M)
    pushing = field.soil.soil_friction * gamma * section + 0.5 * passive * gamma * cut**2
    share = np.clip(normal / _FULL_DRAG_M_PER_S, 0.0, 1.0)
    return np.asarray((leaning + share * pushing) * width)
