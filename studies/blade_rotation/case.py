"""One run as data: which soil lies where, which blade passes through it and how. The same data, the same hash.

Frame: x in the direction of travel, y to the operator's left, z up, metres; the origin is the middle of the pile on the
floor. Angles are counter-clockwise seen from above; 0 is square to the travel. A blade turned by a positive angle has
its left end behind (it trails).

What the study prints is taken from it (``graderd/evaluation/study.toml``). What it leaves open is an input of its own
here with an assumption for its default: each says so.
"""

from __future__ import annotations

import hashlib
import json
import math
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from graderd.evaluation import study

MODEL = 1
"""Goes into every hash: to be raised where the same case would come out differently."""
PACKING = 0.6
"""Share of a poured pile that is solid; with a pile's size and number of grains it gives the study's grain, which the
study does not print (15 mm for 50,000 grains in 1.0 x 0.5 x 0.3 m). Random loose packing of spheres is 0.55 to 0.6."""
SPREAD_OF_SIZES = 0.1
"""Diameters are uniform within this share of their mean, so that grains do not crystallise; the study has none."""
NEWTON_G_M_PER_S2 = 9.81
SOFT_PA, SOFT_STEP = 1e7, 0.1
"""Softer grains lie in contact so deep and so long that tangential damping, which the engine steps explicitly, grows
unstable at larger steps: at a tenth of Table 2's shear modulus friction on the blade comes out at random (0.11 to 0.32
of the load in one heap)."""


class Work(StrEnum):
    """What lies in front of the blade, and so what the pass is for."""

    FLATTENING = "flattening"
    LEFT = "left"
    MIDDLE = "middle"
    RIGHT = "right"


class Sense(StrEnum):
    """Which way the blade is turned: whether the end on the pile's side trails or leads. The rule of the study's
    section 2.6 (soil left: counter-clockwise) lets it trail; its simulations (2.5) do not say."""

    TRAILS = "trails"
    LEADS = "leads"


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BladeShape(_Data):
    """The blade: a moldboard, hollow over a straight cutting edge, or a flat plate where ``radius_m`` is None."""

    length_m: Annotated[float, Field(gt=0, le=10)]
    height_m: Annotated[float, Field(gt=0, le=2)]
    radius_m: Annotated[float, Field(gt=0, le=5)] | None = None
    edge_share: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Share of the height that is the straight cutting edge."""

    @model_validator(mode="after")
    def _round(self) -> BladeShape:
        if self.radius_m is not None and self.radius_m <= self.height_m * (1.0 - self.edge_share) / 2.0:
            raise ValueError(f"radius_m ({self.radius_m:g}) must exceed half the hollow's height")
        return self


FULL_SIZE = BladeShape(length_m=4.0, height_m=0.61, radius_m=0.413)
"""4 m is the study's, which prints neither height nor radius: 610 mm and 413 mm are what makers print for standard
moldboards of 3.7 to 4.3 m."""
QUARTER_SIZE = BladeShape(length_m=1.0, height_m=0.25, radius_m=0.25)
"""The machine of the study's section 3, with the blade of the daemon's configuration (``graderd.core.blade``)."""


class Pile(_Data):
    """Soil poured into a box of these sides, which then slumps. ``study_grains_n``: how many grains the study pours."""

    length_m: Annotated[float, Field(gt=0, le=20)]
    """Along the travel."""
    width_m: Annotated[float, Field(gt=0, le=20)]
    """Across it."""
    height_m: Annotated[float, Field(gt=0, le=2)]
    study_grains_n: Annotated[int, Field(gt=0)]

    @property
    def study_grain_m(self) -> float:
        """Diameter of the study's grain."""
        solid_m3 = PACKING * self.length_m * self.width_m * self.height_m
        return math.cbrt(6.0 * solid_m3 / (math.pi * self.study_grains_n))

    def coarse_graining(self, grains_n: int) -> float:
        """How many times the study's diameter a grain has if so many of them make the pile."""
        return math.cbrt(self.study_grains_n / grains_n)


class Case(_Data):
    """One run.

    Coarse-graining: ``grains_n`` grains stand for the study's, each ``coarse_graining`` times as wide, of the same
    solid, with Young's modulus, Poisson's ratio and all coefficients as they are. For Hertz-Mindlin contacts without
    cohesion stress and strain then stay what they were (Feng and Owen, *Discrete element modelling of large scale
    particle systems I: exact scaling laws*, Comp. Part. Mech. 1, 2014), while whatever a grain is compared with does
    not: a gap under the blade, the thickness of a thin layer. What that makes of the measures is in the report.
    """

    work: Work
    angle_deg: Annotated[float, Field(ge=0, le=60)]
    sense: Sense = Sense.TRAILS
    blade: BladeShape = FULL_SIZE
    pile: Pile
    offset_share: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """How far beside the blade's middle the pile's lies, in blade lengths. The study says mainly on the left: 0.2 is
    assumed, so that the pile lies before its half of the blade at each angle."""
    gap_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Cutting edge above the floor. Not in the study: on the floor for scattering, where all loads of Table 3 are alike
    and so nothing is left behind; the desired height for flattening."""
    speed_m_per_s: Annotated[float, Field(gt=0, le=5)] = 1.0
    travel_m: Annotated[float, Field(gt=0, le=20)] = 3.0
    """Travel from first contact to the end, where the measures are taken. Not in the study (a space of 10 m)."""
    grains_n: Annotated[int, Field(ge=20, le=1_000_000)]
    shear_modulus_pa: Annotated[float, Field(gt=0)] = 2.26e7
    """Table 2's. Softer is faster, and wrong: a tenth halves the load on a blade with a gap of 1.7 grains."""
    friction: Annotated[float, Field(ge=0, le=2)] = 0.49
    """Table 2, between grains."""
    rolling_friction: Annotated[float, Field(ge=0, le=2)] = 0.5
    """Table 2, between grains, as EDEM counts it."""
    floor: Literal["tool", "soil"] = "tool"
    """Whose coefficients the floor has. The study exports it from RecurDyn beside the blade: tool."""
    step_of_rayleigh: Annotated[float, Field(gt=0, le=0.5)] = 0.2
    """Time step as a share of the smallest grain's Rayleigh time."""
    decision: Literal["held", "again"] = "held"
    """The daemon's behaviour: one decision a pass, or decided again in mid-pass from what the blade then carries."""
    motion: Literal["imposed", "coupled"] = "imposed"
    """Whether the blade is moved as it is told, or hangs in the multibody machine."""
    seed: Annotated[int, Field(ge=0)] = 1

    @model_validator(mode="after")
    def _sides(self) -> Case:
        if self.work in (Work.FLATTENING, Work.MIDDLE) and self.offset_share:
            raise ValueError(f"soil of {self.work} lies in the middle: offset_share must be 0")
        if self.work in (Work.LEFT, Work.RIGHT) and not self.offset_share:
            raise ValueError(f"soil on the {self.work} needs an offset_share")
        if self.shear_modulus_pa < SOFT_PA and self.step_of_rayleigh > SOFT_STEP:
            raise ValueError(f"soil softer than {SOFT_PA:g} Pa needs a step_of_rayleigh of {SOFT_STEP:g} or less")
        return self

    @property
    def canonical(self) -> Case:
        """The case that is computed for this one. Left and right are mirror images, and what lies in the middle is its
        own: the right becomes the left of the same sense, a symmetric pile trails. Both senses of such a pile, and the
        right side, cost nothing and say nothing new; a test compares mirrored runs on the engine."""
        if self.work is Work.RIGHT:
            return self.model_copy(update={"work": Work.LEFT})
        if self.work is not Work.LEFT and self.sense is Sense.LEADS:
            return self.model_copy(update={"sense": Sense.TRAILS})
        return self

    @property
    def angle_ccw_deg(self) -> float:
        """The blade's angle with its sign."""
        left_trails = (self.sense is Sense.TRAILS) is (self.work is not Work.RIGHT)
        return self.angle_deg if left_trails else -self.angle_deg

    @property
    def blade_y_m(self) -> float:
        """Where the blade's middle runs, beside the pile's."""
        side = {Work.LEFT: -1.0, Work.RIGHT: 1.0}.get(self.work, 0.0)
        return side * self.offset_share * self.blade.length_m

    @property
    def grain_m(self) -> float:
        """Mean diameter of the grains."""
        return self.pile.study_grain_m * self.pile.coarse_graining(self.grains_n)

    def key(self) -> str:
        """The hash its result is kept under."""
        return _hash({"run": self.canonical.model_dump(mode="json")})

    def pile_key(self) -> str:
        """The hash of its settled pile, which all cases share that differ in the blade alone."""
        fields = {
            "pile",
            "grains_n",
            "shear_modulus_pa",
            "friction",
            "rolling_friction",
            "floor",
            "step_of_rayleigh",
            "seed",
        }
        return _hash({"pile": self.model_dump(mode="json", include=fields)})


def _hash(data: dict[str, Any]) -> str:
    text = json.dumps({"model": MODEL, **data}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:24]


_TEXT = study.data()["text"]
SCATTERED = Pile(
    **dict(zip(("length_m", "width_m", "height_m"), _TEXT["pile_scattering_m"], strict=True)),
    study_grains_n=_TEXT["particles_scattering_n"],
)
"""Section 3.3's pile, which by its words is the simulation's too; section 2.4's grains."""
_LENGTH_M, _WIDTH_M, _HEIGHT_M = _TEXT["pile_flattening_m"]
LAYER_ALONG = Pile(
    length_m=_LENGTH_M, width_m=_WIDTH_M, height_m=_HEIGHT_M, study_grains_n=_TEXT["particles_flattening_n"]
)
"""Section 3.3's layer, its length along the travel: it fits before the 1 m blade of the field."""
LAYER_ACROSS = Pile(
    length_m=_WIDTH_M, width_m=_LENGTH_M, height_m=_HEIGHT_M, study_grains_n=_TEXT["particles_flattening_n"]
)
"""The same laid across before the 4 m blade: the soil of flattening is spread widely (2.4)."""
