"""The blade-rotation study's cases as data, its pile, and the engine's input as text: no engine is needed."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graderd.evaluation import study
from graderd.studies.blade_rotation import case as cases
from graderd.studies.blade_rotation import lammps, pile
from graderd.studies.blade_rotation.case import Case, Sense, Work
from graderd.studies.blade_rotation.contact import SOIL_SOIL, SOIL_TOOL, Soil
from graderd.studies.blade_rotation.run import plan

LEFT = Case(work=Work.LEFT, angle_deg=30, offset_share=0.2, pile=cases.SCATTERED, grains_n=600)


def test_defaults_are_table_2() -> None:
    table, soil = study.data()["table_2"], Soil()
    assert LEFT.shear_modulus_pa == soil.shear_modulus_pa == table["shear_modulus_pa"][0]
    assert (soil.poisson, soil.density_kg_per_m3) == (table["poisson_ratio"][0], table["solid_density_kg_per_m3"][0])
    for contact, name in ((SOIL_SOIL, "soil_soil"), (SOIL_TOOL, "soil_tool")):
        given = (contact.restitution, contact.static_friction, contact.rolling_friction)
        assert given == tuple(table[name][key][0] for key in ("restitution", "static_friction", "rolling_friction"))
    assert (LEFT.friction, LEFT.rolling_friction) == (SOIL_SOIL.static_friction, SOIL_SOIL.rolling_friction)


def test_the_studys_grain_follows_from_pile_and_number() -> None:
    assert cases.SCATTERED.study_grain_m == pytest.approx(0.0151, abs=1e-4)
    assert cases.LAYER_ACROSS.study_grain_m == cases.LAYER_ALONG.study_grain_m == pytest.approx(0.0193, abs=1e-4)


@given(st.integers(20, 3000), st.integers(0, 2**31))
def test_coarser_grains_hold_the_same_solid(grains_n: int, seed: int) -> None:
    case = LEFT.model_copy(update={"grains_n": grains_n, "seed": seed})
    grains = pile.poured(case)
    solid_m3 = float((4.0 / 3.0 * math.pi * grains[:, 3] ** 3).sum())
    assert solid_m3 == pytest.approx(cases.PACKING * 1.0 * 0.5 * 0.3, rel=1e-9)


@given(st.integers(20, 400), st.integers(0, 2**31))
def test_poured_grains_touch_neither_each_other_nor_the_floor(grains_n: int, seed: int) -> None:
    grains = pile.poured(LEFT.model_copy(update={"grains_n": grains_n, "seed": seed}))
    apart = np.linalg.norm(grains[:, None, :3] - grains[None, :, :3], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert (apart >= grains[:, None, 3] + grains[None, :, 3]).all()
    assert (grains[:, 2] > grains[:, 3]).all()


def test_a_pile_comes_of_its_seed() -> None:
    again, other = pile.poured(LEFT), pile.poured(LEFT.model_copy(update={"seed": 2}))
    assert np.array_equal(pile.poured(LEFT), again)
    assert not np.allclose(again, other)


def test_the_right_is_the_left_mirrored_and_a_symmetric_pile_has_one_sense() -> None:
    right = LEFT.model_copy(update={"work": Work.RIGHT})
    assert right.angle_ccw_deg == -LEFT.angle_ccw_deg
    assert right.blade_y_m == -LEFT.blade_y_m
    assert right.key() == LEFT.key()
    middle = Case(work=Work.MIDDLE, angle_deg=30, pile=cases.SCATTERED, grains_n=600)
    assert middle.key() == middle.model_copy(update={"sense": Sense.LEADS}).key()
    assert LEFT.key() != LEFT.model_copy(update={"sense": Sense.LEADS}).key()


def test_the_rules_sense_lets_the_piles_end_trail() -> None:
    """Section 2.6: soil left, counter-clockwise. The left end then goes behind."""
    assert LEFT.angle_ccw_deg == 30.0
    assert LEFT.blade_y_m < 0.0, "the blade's middle runs to the right of a pile that lies on its left"


def test_every_field_has_a_part_in_the_hash() -> None:
    other = {
        "work": Work.MIDDLE, "angle_deg": 15.0, "sense": Sense.LEADS, "blade": cases.QUARTER_SIZE,
        "pile": cases.LAYER_ALONG, "offset_share": 0.25, "gap_m": 0.1, "speed_m_per_s": 0.5, "travel_m": 2.0,
        "grains_n": 601, "shear_modulus_pa": 1.26e7, "friction": 0.4, "rolling_friction": 0.4, "floor": "soil",
        "step_of_rayleigh": 0.1, "decision": "again", "motion": "coupled", "seed": 2,
    }  # fmt: skip
    assert set(other) == set(Case.model_fields)
    keys = {LEFT.model_copy(update={name: value}).key() for name, value in other.items()}
    assert len(keys | {LEFT.key()}) == len(other) + 1


def test_cases_that_differ_in_the_blade_alone_share_their_pile() -> None:
    turned = LEFT.model_copy(update={"angle_deg": 45.0, "sense": Sense.LEADS, "gap_m": 0.05, "travel_m": 1.0})
    assert turned.pile_key() == LEFT.pile_key()
    assert LEFT.model_copy(update={"friction": 0.4}).pile_key() != LEFT.pile_key()


def test_a_pile_beside_the_middle_is_named_by_its_side() -> None:
    with pytest.raises(ValidationError, match="offset_share must be 0"):
        Case(work=Work.MIDDLE, angle_deg=15, offset_share=0.2, pile=cases.SCATTERED, grains_n=600)
    with pytest.raises(ValidationError, match="needs an offset_share"):
        Case(work=Work.LEFT, angle_deg=15, pile=cases.SCATTERED, grains_n=600)


def test_soft_grains_need_small_steps() -> None:
    soft = LEFT.model_dump() | {"shear_modulus_pa": 2.26e6}
    with pytest.raises(ValidationError, match=r"step_of_rayleigh of 0\.1 or less"):
        Case.model_validate(soft)
    assert Case.model_validate(soft | {"step_of_rayleigh": 0.1})


def test_the_blades_motion_is_one_line_from_leg_to_leg() -> None:
    first = lammps.Motion(0.0, (-1.0, 0.1, 0.0), 0.5, (1.0, 0.0, 0.0), 0.2)
    later = first.at(1.5)
    assert later.place_m == pytest.approx((0.5, 0.1, 0.0))
    assert later.yaw_rad == pytest.approx(0.8)
    assert later.at(2.0).place_m == pytest.approx(first.at(2.0).place_m)


def test_traps_are_kept_out_of_the_deck() -> None:
    motion = lammps.Motion(0.0, (0.0, 0.0, 0.0), 0.0, (1.0, 0.0, 0.0)).text()
    text = lammps.push_deck(LEFT, "settled.restart", motion, True, 600, 6000, "0.0") + lammps.last_lines(6000)
    # side in, the default, catches grains in the blade's body: what grains touch is the outside of each region.
    walls = re.findall(r"wall/gran/region .* region (\w+) ", text)
    assert walls
    for wall in walls:
        assert re.search(rf"^region {wall} .*side out", text, re.MULTILINE)
    # A second run sets the moving region up anew, at rest for a step.
    assert len(re.findall(r"^run ", text, re.MULTILINE)) == 1
    assert "boundary s s s" in text
    assert "neigh_modify delay 0 every 1 check yes" in text


def test_the_blade_starts_clear_of_the_soil_and_its_travel_ends_on_a_frame() -> None:
    grains = np.zeros((200, 8))
    rng = np.random.default_rng(1)
    grains[:, 1:3] = rng.uniform(-0.5, 0.5, (200, 2))
    grains[:, 4] = 0.03
    for angle in (0.0, 15.0, 45.0):
        case = LEFT.model_copy(update={"angle_deg": angle})
        found = plan(case, grains)
        x, y, _ = found.start.place_m
        yaw = found.start.yaw_rad
        ahead = (grains[:, 1] - x) * math.cos(yaw) + (grains[:, 2] - y) * math.sin(yaw) - grains[:, 4]
        along = -(grains[:, 1] - x) * math.sin(yaw) + (grains[:, 2] - y) * math.cos(yaw)
        assert (ahead[np.abs(along) <= case.blade.length_m / 2.0] > 0.0).all()
        assert found.last_step % found.frame_steps == 0
        travel_m = (found.last_step - found.contact_step) * lammps.step_s(case) * case.speed_m_per_s
        assert travel_m == pytest.approx(case.travel_m, abs=1e-3)
