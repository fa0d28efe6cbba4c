"""A case as input of LAMMPS, pure text: one deck that lets the pile settle, one that pushes the blade through it.

The blade is an axis-aligned body at the origin, its face on x = 0, its edge on z = 0, along y; ``move`` and ``rotate``
carry it (rotation first, about the vertical through the origin). Both follow equal-style variables that are linear in
time, so that the engine sees a steady velocity: a blade that is told its place anew in the midst of a run has an
infinite one for a step. Traps this deck keeps out, each with a test (``tests/study``):

- ``region block`` holds what is inside unless told ``side out``: grains are caught in the blade, and the load is none;
- a second ``run`` sets up the moving region anew, at rest for a step: one run a leg;
- a large fixed box makes bins that nobody needs: the box shrinks to the soil (``boundary s s s``);
- ``neigh_modify every 10`` misses contacts: every step is looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from graderd.studies.blade_rotation.case import NEWTON_G_M_PER_S2, SPREAD_OF_SIZES, Case
from graderd.studies.blade_rotation.contact import (
    SOIL_SOIL,
    SOIL_TOOL,
    Contact,
    Soil,
    pair_model,
    rayleigh_step_s,
    wall_model,
)
from graderd.studies.blade_rotation.pile import F64

SAMPLE_STEPS = 10
"""What takes a look at every grain is looked at every so many steps."""
MEAN_SAMPLES = 10
"""And written as means of so many. Forces are looked at every step: contacts come and go within a few, and a mean of
samples would be off by some percent."""
ALONG_N = 20
"""Parts of the blade's length that the load along it is told in."""
SETTLE_S = 1.0
THICK_M = 0.08
"""Of the blade's body behind its face: no grain passes through it in a step."""
PUSHED = ("time", "dx", "dy", "dz", "theta", "fx", "fy", "fz", "floor_x", "floor_y")
"""Columns of the file of forces after the step: the blade's place (m, rad), force (N) *on the blade*, force on the soil
by the floor."""
TURNED = ("mx", "my", "mz", "touching", "px")
"""And of the file of moments: moment (N m) on the blade about its axis on the floor, grains in contact, the soil's
momentum along the travel."""
FORCES = PUSHED + TURNED


@dataclass(frozen=True, slots=True)
class Motion:
    """Steady motion from ``t0_s`` on: where the blade's axis is then (m, rad), and how fast it goes (m/s, rad/s)."""

    t0_s: float
    place_m: tuple[float, float, float]
    yaw_rad: float
    velocity_m_per_s: tuple[float, float, float]
    yaw_rad_per_s: float = 0.0

    def at(self, time_s: float) -> Motion:
        """The same motion told from a later time."""
        since = time_s - self.t0_s
        x, y, z = (p + v * since for p, v in zip(self.place_m, self.velocity_m_per_s, strict=True))
        yaw = self.yaw_rad + self.yaw_rad_per_s * since
        return Motion(time_s, (x, y, z), yaw, self.velocity_m_per_s, self.yaw_rad_per_s)

    def text(self, style: str = "equal") -> str:
        """The lines that give it to the engine; with style ``internal`` their numbers can be set while it runs."""
        lines = [f"variable t0 {style} {self.t0_s!r}", "variable now equal step*dt"]
        axes = (*zip(("dx", "dy", "dz"), self.place_m, self.velocity_m_per_s, strict=True),)
        for name, start, rate in (*axes, ("theta", self.yaw_rad, self.yaw_rad_per_s)):
            lines += [
                f"variable {name}0 {style} {start!r}",
                f"variable {name}1 {style} {rate!r}",
                f"variable {name} equal v_{name}0+v_{name}1*(v_now-v_t0)",
            ]
        return "\n".join(lines) + "\n"


def soil_of(case: Case) -> Soil:
    """The grains' material."""
    return Soil(shear_modulus_pa=case.shear_modulus_pa)


def between_grains(case: Case) -> Contact:
    """The coefficients between grains."""
    return Contact(SOIL_SOIL.restitution, case.friction, case.rolling_friction)


def step_s(case: Case) -> float:
    """Time step."""
    smallest_m = case.grain_m / 2.0 * (1.0 - SPREAD_OF_SIZES)
    return case.step_of_rayleigh * rayleigh_step_s(soil_of(case), smallest_m)


def settle_steps(case: Case) -> int:
    """Steps until a poured pile is at rest."""
    return math.ceil(SETTLE_S / step_s(case))


def data_file(case: Case, grains: F64) -> str:
    """The poured grains as LAMMPS reads them: number, type, diameter, density, place."""
    density = soil_of(case).density_kg_per_m3
    low, high = grains[:, :3].min(axis=0) - case.grain_m, grains[:, :3].max(axis=0) + case.grain_m
    box = "\n".join(f"{a:.9g} {b:.9g} {n}lo {n}hi" for a, b, n in zip(low, high, "xyz", strict=True))
    rows = "\n".join(
        f"{number} 1 {2.0 * r:.12g} {density:.12g} {x:.12g} {y:.12g} {z:.12g}"
        for number, (x, y, z, r) in enumerate(grains.tolist(), 1)
    )
    return f"poured pile\n\n{len(grains)} atoms\n1 atom types\n\n{box}\n\nAtoms # sphere\n\n{rows}\n"


def settle_deck(case: Case, every_steps: int, start: str = "") -> str:
    """Lets poured grains (``pile.data``, or the restart ``start``) come to rest; leaves ``settled.restart``."""
    begin = f"read_restart {start}" if start else "read_data pile.data"
    return (
        f"{_HEAD}{begin}\n{_soil(case)}{_floor(case)}"
        f"restart {every_steps} at.*.restart\n"
        f"run {settle_steps(case)} upto\n"
        "write_restart settled.tmp\n"
        "write_dump all custom settled.dump.tmp id x y z radius vx vy vz modify format float %.7g sort id\n"
        "shell mv settled.dump.tmp settled.dump\n"
        "shell mv settled.tmp settled.restart\n"
    )


def push_deck(case: Case, restart: str, motion: str, first: bool, frame_steps: int, every_steps: int, name: str) -> str:
    """Everything of a leg but its ``run``: soil from ``restart``, the blade under ``motion`` (lines as of
    :meth:`Motion.text`), what is written down. ``first``: time begins at 0. ``name`` is part of the files' names, for
    what one process wrote to be told from what the one before it did."""
    return (
        f"{_HEAD}read_restart {restart}\n"
        + ("reset_timestep 0\n" if first else "")
        + _soil(case)
        + _floor(case)
        + motion
        + _blade(case)
        + _written(case, frame_steps, name)
        + f"restart {every_steps} at.*.restart\n"
    )


def last_lines(until_steps: int) -> str:
    """The run to a step, counted from the blade's start, and what is left for whoever goes on."""
    return f"run {until_steps} upto\nwrite_restart leg.tmp\nshell mv leg.tmp leg.restart\n"


_HEAD = "units si\natom_style sphere\nboundary s s s\ncomm_modify vel yes\nnewton off\n"


def _soil(case: Case) -> str:
    return (
        "pair_style granular\n"
        f"pair_coeff * * {pair_model(soil_of(case), between_grains(case), case.grain_m / 2.0)}\n"
        f"neighbor {0.15 * case.grain_m:.6g} bin\n"
        "neigh_modify delay 0 every 1 check yes\n"
        f"timestep {step_s(case)!r}\n"
        "fix integrate all nve/sphere\n"
        f"fix weight all gravity {NEWTON_G_M_PER_S2} vector 0 0 -1\n"
        "compute spin all erotate/sphere\n"
        "thermo_style custom step ke c_spin atoms\n"
        "thermo_modify lost error flush yes\n"
        "thermo 500\n"
    )


def _floor(case: Case) -> str:
    tool = case.floor == "tool"
    contact = SOIL_TOOL if tool else between_grains(case)
    model = wall_model(soil_of(case), contact, case.grain_m / 2.0, rigid=tool)
    return f"fix floor all wall/gran {model} zplane 0 NULL contacts\n"


def _blade(case: Case) -> str:
    """Regions and walls of the blade's body, whose outside the grains are on."""
    blade = case.blade
    half, moved = blade.length_m / 2.0, "move v_dx v_dy v_dz rotate v_theta 0 0 0 0 0 1 units box"
    model = wall_model(soil_of(case), SOIL_TOOL, case.grain_m / 2.0, rigid=True)
    if blade.radius_m is None:
        plate = f"block {-THICK_M:.6g} 0 {-half:.6g} {half:.6g} 0 {blade.height_m:.6g}"
        return f"region edge {plate} side out {moved}\nfix edge all wall/gran/region {model} region edge contacts\n"
    edge = blade.edge_share * blade.height_m
    hollow = (blade.height_m - edge) / 2.0
    ahead = math.sqrt(blade.radius_m**2 - hollow**2)
    back = blade.radius_m - ahead + THICK_M
    return (
        f"region edge block {-THICK_M:.6g} 0 {-half:.6g} {half:.6g} 0 {edge:.6g} side out {moved}\n"
        f"region body block {-back:.6g} 0 {-half:.6g} {half:.6g} {edge:.6g} {blade.height_m:.6g} side in {moved}\n"
        f"region scoop cylinder y {ahead:.8g} {edge + hollow:.8g} {blade.radius_m:.8g} "
        f"{-half - 1.0:.6g} {half + 1.0:.6g} "
        f"side out {moved}\n"
        "region face intersect 2 body scoop side out\n"
        f"fix edge all wall/gran/region {model} region edge contacts\n"
        f"fix face all wall/gran/region {model} region face contacts\n"
    )


def _written(case: Case, frame_steps: int, name: str) -> str:
    """Force and moment on the blade, the load along it, where the grains are."""
    walls = ("edge",) if case.blade.radius_m is None else ("edge", "face")

    def both(text: str) -> str:
        return "+".join(text.replace("W", f"f_{wall}") for wall in walls)

    half = case.blade.length_m / 2.0
    x, y, z = ("(W[5]-v_dx)", "(W[6]-v_dy)", "(W[7]-v_dz)")
    atoms = {
        "wmx": both(f"({y}*W[4]-{z}*W[3])"),
        "wmy": both(f"({z}*W[2]-{x}*W[4])"),
        "wmz": both(f"({x}*W[3]-{y}*W[2])"),
        "wn": both("W[1]"),
        "wpx": "mass*vx",
    }
    lines = [f"variable {key} atom {value}" for key, value in atoms.items()]
    lines.append(f"compute on_soil all reduce sum {' '.join(f'v_{key}' for key in atoms)}")
    sums = [f"f_{wall}[{column}]" for wall in walls for column in (2, 3, 4)]
    lines.append(f"compute pushed all reduce sum {' '.join(sums)} f_floor[2] f_floor[3]")
    for number, key in enumerate(("fx", "fy", "fz"), 1):
        parts = "+".join(f"c_pushed[{number + 3 * wall}]" for wall in range(len(walls)))
        lines.append(f"variable {key} equal -({parts})")
    lines += [f"variable {key} equal -c_on_soil[{number}]" for number, key in enumerate(("mx", "my", "mz"), 1)]
    lines += [
        "variable touching equal c_on_soil[4]",
        "variable px equal c_on_soil[5]",
        f"variable floor_x equal c_pushed[{len(sums) + 1}]",
        f"variable floor_y equal c_pushed[{len(sums) + 2}]",
        "variable time equal v_now",
    ]
    window = SAMPLE_STEPS * MEAN_SAMPLES
    for kind, columns, sampled in (
        ("forces", PUSHED, f"1 {window} {window}"),
        ("moments", TURNED, f"{SAMPLE_STEPS} {MEAN_SAMPLES} {window}"),
    ):
        values = " ".join(f"v_{key}" for key in columns)
        lines.append(f'fix {kind} all ave/time {sampled} {values} file {kind}.{name}.txt format " %.9g"')
    # Along the blade: what each part of it is pushed with, square to its face. (fix ave/histo/weight would be shorter;
    # with two variables of atoms it weighs the first by itself, 22 Jul 2025.)
    part = f"(-(x-v_dx)*sin(v_theta)+(y-v_dy)*cos(v_theta)+{half:.6g})*{ALONG_N / case.blade.length_m:.9g}"
    lines += [
        f"variable part atom ceil({part})*(v_wn>0)",
        f"variable push atom ({both('W[2]')})*cos(v_theta)+({both('W[3]')})*sin(v_theta)",
        f"compute parts all chunk/atom v_part limit {ALONG_N} exact discard yes",
        "compute along all reduce/chunk parts sum v_push",
        f"fix along all ave/time {SAMPLE_STEPS} {frame_steps // SAMPLE_STEPS} {frame_steps} c_along mode vector "
        f"file along.{name}.txt",
    ]
    lines += [
        f"dump frames all custom {frame_steps} frames.{name}.dump id x y z radius vx vy vz",
        "dump_modify frames sort id flush yes format float %.7g",
    ]
    return "\n".join(lines) + "\n"
