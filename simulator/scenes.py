"""Random scenes for judging perception: soil, machine, light and camera varied as one seed says.

Every scene has a class that it was made for, but its label comes from the true volumes per third of the height field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeVar, get_args

import numpy as np

from graderd.simulator.camera.appearance import Appearance, BladeMaterial, GroundKind, SoilKind
from graderd.simulator.camera.shapes import Solid, rotation
from graderd.simulator.grader.blade import LENGTH_M, BladePose, Plough, blade_grid, volumes_in_front_m3
from graderd.simulator.grader.piles import lumps
from graderd.simulator.grader.soil import FloatArray, SoilField

Label = Literal["left", "center", "right", "even", "none"]
_Choice = TypeVar("_Choice", bound=str)

NONE_BELOW_L = 1.2
EVEN_MIN_SHARE, EVEN_MAX_SHARE = 0.20, 0.48
_VEHICLE_X_M = 3.0
_MAX_ANGLE_DEG = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class RandomScene:
    """One scene, ready to be rendered. ``shift_m`` and ``turn_deg``: how far the camera is from its nominal pose."""

    field: SoilField
    vehicle_x_m: float
    blade: BladePose
    appearance: Appearance
    props: tuple[Solid, ...]
    occluders: str
    shift_m: tuple[float, float, float]
    turn_deg: tuple[float, float, float]
    volumes_l: tuple[float, float, float]
    intended: Label

    @property
    def label(self) -> Label:
        """What the true volumes say."""
        return label_of(self.volumes_l)[0]

    @property
    def ambiguous(self) -> bool:
        """Whether the true volumes lie near a border between two labels."""
        return label_of(self.volumes_l)[1]


def label_of(volumes_l: tuple[float, float, float]) -> tuple[Label, bool]:
    """Label of volumes (left, center, right; litres), and whether a little more or less soil would change it.

    None: less than 1.2 l in all. Even: every third holds 20 to 48 % of the soil. Else the fullest third.
    """
    total = sum(volumes_l)
    shares = sorted((volume / max(total, 1e-9) for volume in volumes_l), reverse=True)
    near_none = 0.4 < total < 2.8
    if total < NONE_BELOW_L:
        return "none", near_none
    near_even = shares[2] > EVEN_MIN_SHARE - 0.06 and shares[0] < EVEN_MAX_SHARE + 0.06
    if shares[2] >= EVEN_MIN_SHARE and shares[0] <= EVEN_MAX_SHARE:
        well_inside = shares[2] > EVEN_MIN_SHARE + 0.05 and shares[0] < EVEN_MAX_SHARE - 0.05
        return "even", near_none or not well_inside
    names: tuple[Label, Label, Label] = ("left", "center", "right")
    fullest = names[int(np.argmax(volumes_l))]
    return fullest, near_none or near_even or shares[0] < 1.5 * shares[1]


def random_scene(seed: int, number: int) -> RandomScene:
    """Scene ``number`` of the set that ``seed`` names; the same pair gives the same scene."""
    rng = np.random.default_rng((seed, number))
    intended: Label = ("left", "center", "right", "even", "none")[number % 5]
    if rng.random() < 0.08:
        intended = _pick(rng, get_args(Label))
    blade = _blade(rng)
    field = SoilField()
    _pour(rng, field, intended, blade)
    _scatter(rng, field, blade)
    _press(rng, field, blade)
    left, center, right = volumes_in_front_m3(field, _VEHICLE_X_M, blade.angle_deg)
    props, occluders = _occluders(rng, blade)
    return RandomScene(
        field=field,
        vehicle_x_m=_VEHICLE_X_M,
        blade=blade,
        appearance=_appearance(rng),
        props=props,
        occluders=occluders,
        shift_m=_triple(rng, 0.02),
        turn_deg=_triple(rng, 2.0),
        volumes_l=(left * 1e3, center * 1e3, right * 1e3),
        intended=intended,
    )


def _pick(rng: np.random.Generator, choices: tuple[_Choice, ...]) -> _Choice:
    return choices[int(rng.integers(len(choices)))]


def _triple(rng: np.random.Generator, limit: float) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in rng.uniform(-limit, limit, 3))
    return x, y, z


def _blade(rng: np.random.Generator) -> BladePose:
    angle_deg = float(rng.uniform(-_MAX_ANGLE_DEG, _MAX_ANGLE_DEG))
    if rng.random() < 0.3:
        angle_deg = float(rng.choice([-30.0, 0.0, 15.0, 30.0, 45.0]))
    return BladePose(
        angle_deg,
        height_m=float(rng.uniform(0.0, 0.006)),
        slope_deg=float(rng.uniform(-0.6, 0.6)),
        pitch_deg=float(rng.uniform(-3.0, 3.0)),
    )


def _pour(rng: np.random.Generator, field: SoilField, intended: Label, blade: BladePose) -> None:
    """Soil in front of the blade, laid out in blade coordinates."""
    s, d = blade_grid(field, field.whole, _VEHICLE_X_M, blade.angle_deg)
    bumps = lumps(field, int(rng.integers(2**31)), depth=float(rng.uniform(0.05, 0.25)))
    if intended == "none":
        if rng.random() < 0.35:  # soil that the blade will only reach later
            middle = float(rng.uniform(-0.3, 0.3))
            field.add(
                _dome(s - middle, d - float(rng.uniform(0.85, 1.1)), 0.3, 0.25, float(rng.uniform(0.08, 0.2))) * bumps
            )
        return
    if intended == "even":
        height_m = float(rng.uniform(0.045, 0.11))
        depth_m = float(rng.uniform(0.35, 1.2))
        half_m = float(rng.uniform(0.52, 0.8))
        field.add(np.where((np.abs(s) < half_m) & (d > -0.05) & (d < depth_m), height_m, 0.0) * bumps)
        return
    middle = {"left": 0.36, "center": 0.0, "right": -0.36}[intended] + float(rng.uniform(-0.05, 0.05))
    ahead = float(rng.uniform(0.02, 0.24))
    half_s, half_d = float(rng.uniform(0.10, 0.20)), float(rng.uniform(0.12, 0.45))
    field.add(_dome(s - middle, d - ahead, half_s, half_d, float(rng.uniform(0.07, 0.26))) * bumps)
    if rng.random() < 0.25:  # a second, smaller heap beside it
        field.add(_dome(s + float(rng.uniform(-0.4, 0.4)), d - 0.2, 0.08, 0.1, float(rng.uniform(0.02, 0.07))) * bumps)


def _dome(s: FloatArray, d: FloatArray, half_s_m: float, half_d_m: float, height_m: float) -> FloatArray:
    return np.asarray(height_m * np.sqrt(np.clip(1.0 - (s / half_s_m) ** 2 - (d / half_d_m) ** 2, 0.0, None)))


def _scatter(rng: np.random.Generator, field: SoilField, blade: BladePose) -> None:
    """What lies about on a site: a thin dusting, windrows behind the blade."""
    s, d = blade_grid(field, field.whole, _VEHICLE_X_M, blade.angle_deg)
    if rng.random() < 0.5:
        dusting = np.clip(lumps(field, int(rng.integers(2**31)), depth=1.0) - 1.0, 0.0, None)
        field.heights_m += dusting * float(rng.uniform(0.0005, 0.003))
    if rng.random() < 0.3:
        side = float(rng.choice([-1.0, 1.0]))
        windrow = np.clip(0.10 - 0.7 * np.abs(s - side * float(rng.uniform(0.4, 0.7))), 0.0, None)
        field.heights_m += np.where(d < -0.15, windrow * float(rng.uniform(0.3, 1.0)), 0.0)


def _press(rng: np.random.Generator, field: SoilField, blade: BladePose) -> None:
    """Set the blade into the soil, in some scenes after a short push; keep what lies behind it low."""
    s, d = blade_grid(field, field.whole, _VEHICLE_X_M, blade.angle_deg)
    field.heights_m[(d < 0.0) & (d > -0.12) & (np.abs(s) < LENGTH_M / 2.0 + 0.02)] = 0.0
    plough = Plough(field)
    if rng.random() < 0.4:
        travel_m = float(rng.uniform(0.02, 0.15))
        start_m = _VEHICLE_X_M - travel_m
        for step in range(15):
            here, there = (start_m + travel_m * share / 15.0 for share in (step, step + 1))
            plough.move(here, blade, there, blade)
    for _ in range(12):
        plough.move(_VEHICLE_X_M, blade, _VEHICLE_X_M, blade)


def _appearance(rng: np.random.Generator) -> Appearance:
    red_cast = float(rng.uniform(0.08, 0.35)) if rng.random() < 0.4 else float(rng.uniform(-0.06, 0.06))
    return Appearance(
        sun_azimuth_deg=float(rng.uniform(-180.0, 180.0)),
        sun_elevation_deg=float(rng.uniform(15.0, 80.0)),
        sun_strength=float(rng.uniform(0.4, 1.25)),
        ambient=float(rng.uniform(0.25, 0.65)),
        red_cast=red_cast,
        exposure=float(rng.uniform(0.75, 1.3)),
        shadows=bool(rng.random() < 0.85),
        machine_shadow=float(rng.uniform(0.1, 0.8)) if rng.random() < 0.35 else 0.0,
        soil=_pick(rng, get_args(SoilKind)),
        wetness=float(rng.uniform(0.0, 1.0)),
        blade=_pick(rng, get_args(BladeMaterial)),
        ground=_pick(rng, get_args(GroundKind)),
        color_noise=float(rng.uniform(1.0, 5.0)),
        disparity_noise_px=float(rng.uniform(0.09, 0.37)),
        hole_share=float(rng.uniform(0.12, 0.3)) if rng.random() < 0.1 else float(rng.uniform(0.02, 0.08)),
    )


def _occluders(rng: np.random.Generator, blade: BladePose) -> tuple[tuple[Solid, ...], str]:
    """Things that are no soil: stones anywhere, hoses and a rod before the camera, a boot beside the work."""
    solids: list[Solid] = []
    names: list[str] = []
    if rng.random() < 0.4:
        names.append("stones")
        for _ in range(int(rng.integers(1, 5))):
            half = float(rng.uniform(0.012, 0.035))
            x, y = float(rng.uniform(0.05, 0.5)), float(rng.uniform(-0.6, 0.6))
            grey = int(rng.uniform(90, 170))
            half_m = (half, half * float(rng.uniform(0.6, 1.0)), half * float(rng.uniform(0.5, 0.8)))
            solids.append(
                Solid("ellipsoid", (x, y, half * 0.4), half_m, (grey, grey, grey), float(rng.uniform(0, 180)))
            )
    if rng.random() < 0.25:
        names.append("hose")
        solids += _hose(rng)
    if rng.random() < 0.12:
        names.append("rod")
        z, y = float(rng.uniform(0.34, 0.44)), float(rng.uniform(-0.25, 0.25))
        tilt_deg = float(rng.uniform(-25.0, 25.0))
        solids.append(Solid("box", (0.45, y, z), (0.011, 0.45, 0.011), (60, 62, 66), roll_deg=tilt_deg))
    if rng.random() < 0.12:
        names.append("boot")
        solids += _boot(rng, blade)
    return tuple(solids), "+".join(names)


def _hose(rng: np.random.Generator) -> list[Solid]:
    """A hydraulic hose that hangs from the frame to one side of the blade's top, as a chain of short pieces."""
    side = float(rng.choice([-1.0, 1.0]))
    start = np.array([0.55, side * float(rng.uniform(0.1, 0.3)), 0.50])
    end = np.array([-0.02, side * float(rng.uniform(0.1, 0.45)), 0.34])
    sag = np.array([0.0, side * float(rng.uniform(-0.1, 0.15)), -float(rng.uniform(0.06, 0.2))])
    middle = (start + end) / 2.0 + sag
    places = [
        (1 - t) ** 2 * start + 2 * t * (1 - t) * middle + t**2 * end for t in (float(k) / 12.0 for k in range(13))
    ]
    pieces = []
    for here, there in pairwise(places):
        along = there - here
        length = float(np.linalg.norm(along))
        azimuth = math.degrees(math.atan2(along[1], along[0]))
        elevation = -math.degrees(math.asin(along[2] / length))
        x, y, z = (float(value) for value in (here + there) / 2.0)
        pieces.append(Solid("ellipsoid", (x, y, z), (length * 0.7, 0.009, 0.009), (28, 28, 30), azimuth, elevation))
    return pieces


def _boot(rng: np.random.Generator, blade: BladePose) -> list[Solid]:
    """A person's boot standing beside the reach of the blade: sole, upper and shaft."""
    side = float(rng.choice([-1.0, 1.0]))
    along, ahead = side * float(rng.uniform(0.62, 0.8)), float(rng.uniform(0.05, 0.5))
    x, y, _ = rotation(blade.angle_deg) @ np.array([ahead, along, 0.0])
    azimuth = float(rng.uniform(-180.0, 180.0))
    colour = (30, 40, 60) if rng.random() < 0.5 else (35, 35, 35)
    forward = rotation(azimuth) @ np.array([0.06, 0.0, 0.0])
    heel = (float(x - forward[0]), float(y - forward[1]))
    return [
        Solid("box", (float(x), float(y), 0.012), (0.14, 0.048, 0.012), (20, 20, 20), azimuth),
        Solid("ellipsoid", (float(x), float(y), 0.045), (0.135, 0.046, 0.05), colour, azimuth),
        Solid("ellipsoid", (heel[0], heel[1], 0.16), (0.06, 0.052, 0.16), colour, azimuth),
    ]
