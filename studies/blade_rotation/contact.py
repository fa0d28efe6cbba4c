"""Table 2 of the study as contacts of LAMMPS's granular model. Pure text; SI units.

The study used EDEM's Hertz-Mindlin (no slip) with its standard rolling friction. Both are documented
(https://help.altair.com/edem/topics/creator_tree_physics/the_hertz_mindlin_no_slip_model_r.htm and
``the_standard_rolling_friction_model_r.htm``); LAMMPS's model stands at https://docs.lammps.org/pair_granular.html
and in its ``src/GRANULAR/gran_sub_mod_*.cpp``. Coefficient by coefficient:

shear modulus G, Poisson's ratio nu
    ``hertz/material E e nu`` with E = 2 G (1 + nu). Both take F = 4/3 E* sqrt(R*) d^1.5. LAMMPS mixes a wall as if it
    were of the grains' material; a tool is steel, rigid beside soil, and gets twice the E, which gives E* = E / (1 -
    nu^2).
restitution e
    ``damping coeff_restitution``: EDEM's 2 sqrt(5/6) beta sqrt(S_n m*) v with S_n = 2 E* sqrt(R* d), which is LAMMPS's
    prefactor times sqrt(m* F / d). The force may pull while a contact opens; only so is the impact's restitution e.
static friction
    ``tangential mindlin/force NULL x mu``: S_t = 8 G* sqrt(R* d) and damping smaller than the normal one's by
    x = sqrt(S_t / S_n) = sqrt(2 (1 - nu) / (2 - nu)), both limited together by mu F. See :data:`TANGENTIAL`.
rolling friction
    ``rolling sds k gamma mu_s``. EDEM brakes each grain with mu_r F R_i; LAMMPS's torque is at most mu_s F R_eff, and
    R_eff is R/2 between equal grains and R at a wall. So mu_s = 2 mu_r between grains, mu_r at walls. What remains:
    EDEM brakes every grain against its own spin, LAMMPS the pair against its relative spin, and LAMMPS's torque grows
    over a small angle where EDEM's is there at once. k and gamma of that angle follow Ai et al., Powder Technology
    206 (2011) 269.

Table 1 holds contacts of the multibody program, not of the soil; see ``multibody.py``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

TANGENTIAL: Final = "mindlin/force"
"""Keeps the spring's force from step to step. Plain ``mindlin`` keeps its displacement, and when a sliding contact is
pressed harder multiplies that by the larger stiffness: with damping this close to critical the spring then pushes
*along* with the slip. A third of one impact's friction was so in the wrong direction."""

# Tangential damping is explicit: where a step times a grain's summed damping nears twice the mass that turns with the
# contact (2/7 m), friction changes its sign from step to step. It goes with the fourth root of overlap by radius. At
# the true G and 0.2 of the Rayleigh step a heap's friction on the blade is 0.26 to 0.29 of the load wherever it lies,
# at half the step 0.29 to 0.30; at G / 10 it was 0.23 to 0.32 by chance, and at half that step 0.262 to 0.264.

REFERENCE_OVERLAP: Final = 1e-3
"""Overlap by radius at which the rolling spring is sized: a grain of 35 mm under its own weight has 0.8e-3."""
ROLLING_DAMPING: Final = 0.3
"""Of the rolling spring, as a share of critical."""


@dataclass(frozen=True, slots=True)
class Soil:
    """What grains are made of: Table 2's first rows."""

    shear_modulus_pa: float = 2.26e7
    poisson: float = 0.32
    density_kg_per_m3: float = 2650.0

    @property
    def youngs_modulus_pa(self) -> float:
        """E = 2 G (1 + nu)."""
        return 2.0 * self.shear_modulus_pa * (1.0 + self.poisson)

    def mass_kg(self, radius_m: float) -> float:
        """Of one grain."""
        return 4.0 / 3.0 * math.pi * radius_m**3 * self.density_kg_per_m3


@dataclass(frozen=True, slots=True)
class Contact:
    """Coefficients between two kinds of body, as EDEM defines them."""

    restitution: float
    static_friction: float
    rolling_friction: float


SOIL_SOIL: Final = Contact(0.01, 0.49, 0.5)
SOIL_TOOL: Final = Contact(0.01, 0.37, 0.05)


def pair_model(soil: Soil, contact: Contact, radius_m: float) -> str:
    """Between grains of about ``radius_m``: what follows ``pair_coeff * *``."""
    effective_pa = soil.youngs_modulus_pa / (2.0 * (1.0 - soil.poisson**2))
    return _model(soil, contact, radius_m, soil.youngs_modulus_pa, effective_pa, radius_m / 2.0)


def wall_model(soil: Soil, contact: Contact, radius_m: float, *, rigid: bool) -> str:
    """Between grains and a wall: what follows ``fix ID all wall/gran`` (and ``wall/gran/region``).

    ``rigid``: a tool; otherwise ground of the grains' own material.
    """
    youngs_pa = soil.youngs_modulus_pa * (2.0 if rigid else 1.0)
    effective_pa = youngs_pa / (2.0 * (1.0 - soil.poisson**2))
    return "granular " + _model(soil, contact, radius_m, youngs_pa, effective_pa, radius_m)


def rayleigh_step_s(soil: Soil, radius_m: float) -> float:
    """Time that a Rayleigh wave needs along half a grain's girth; a time step is a part of it."""
    wave_m_per_s = math.sqrt(soil.shear_modulus_pa / soil.density_kg_per_m3) * (0.1631 * soil.poisson + 0.8766)
    return math.pi * radius_m / wave_m_per_s


def _model(
    soil: Soil, contact: Contact, radius_m: float, youngs_pa: float, effective_pa: float, effective_radius_m: float
) -> str:
    nu = soil.poisson
    damping_ratio = math.sqrt(2.0 * (1.0 - nu) / (2.0 - nu))
    text = (
        f"hertz/material {youngs_pa:.8g} {contact.restitution:.8g} {nu:.8g} "
        f"tangential {TANGENTIAL} NULL {damping_ratio:.8g} {contact.static_friction:.8g} damping coeff_restitution"
    )
    rolling = contact.rolling_friction * radius_m / effective_radius_m
    if rolling == 0.0:
        return text
    normal_n_per_m = 2.0 * effective_pa * math.sqrt(effective_radius_m * REFERENCE_OVERLAP * radius_m)
    spring_n_per_m = 2.25 * normal_n_per_m * contact.rolling_friction**2 * (radius_m / effective_radius_m) ** 2
    damping = ROLLING_DAMPING * 2.0 * math.sqrt(0.4 * soil.mass_kg(radius_m) * spring_n_per_m)
    return f"{text} rolling sds {spring_n_per_m:.8g} {damping:.8g} {rolling:.8g}"
