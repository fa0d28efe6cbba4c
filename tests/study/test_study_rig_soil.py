"""The rig's soil fitted to runs: to runs whose soil is known, because the rig itself made them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graderd.simulator.grader.soil import SoilProperties
from graderd.studies.blade_rotation import rig_soil
from graderd.studies.blade_rotation.case import QUARTER_SIZE, SCATTERED, Case, Work
from graderd.studies.blade_rotation.rig_soil import CAST, CELL_M, LOAD, SPREADS, Run

TRUE = SoilProperties(repose_deg=28.0, steel_friction=0.9, slide_m=0.2, soil_friction=0.6)


def made(angle_deg: float, soil: SoilProperties = TRUE) -> Run:
    """A short pass through a small heap, as the rig makes it with this soil."""
    case = Case(work=Work.MIDDLE, angle_deg=angle_deg, blade=QUARTER_SIZE, pile=SCATTERED, grains_n=100, travel_m=0.7)
    heights = np.zeros((130, 120))
    heights[45:65, 50:70] = 0.12
    run = Run(case, heights, 0.6, 1.7, {})
    return Run(case, heights, 0.6, 1.7, rig_soil.driven(run, soil))


def test_a_soil_that_is_known_is_found_again() -> None:
    of = [made(15.0), made(45.0)]
    found = rig_soil.fit(of, 45)
    for run in of:
        rig = rig_soil.driven(run, found)
        for name in SPREADS:
            assert rig[name] == pytest.approx(run.dem[name], rel=0.05)
        assert rig[CAST] == pytest.approx(run.dem[CAST], abs=25.0)
        assert rig[LOAD] == pytest.approx(run.dem[LOAD], rel=0.15)
        assert (
            np.abs(rig_soil.misfit(run, rig)).max()
            < np.abs(rig_soil.misfit(run, rig_soil.driven(run, SoilProperties()))).max()
        )


def test_a_turned_blade_casts_soil_to_its_trailing_end() -> None:
    left, straight = made(45.0).dem[CAST], made(0.0).dem[CAST]
    assert left > 100.0
    assert straight == pytest.approx(0.0, abs=10.0)


def test_the_page_says_where_rig_and_grains_differ() -> None:
    of = [made(15.0), made(45.0)]
    assert "not the same" not in rig_soil.page(of, TRUE)
    assert "| 15° | 1 | " in rig_soil.page(of, TRUE)
    swapped = [Run(one.case, one.heights_m, one.from_x_m, one.to_x_m, other.dem) for one, other in (of, of[::-1])]
    text = rig_soil.page(swapped, TRUE)
    assert "**not the same** on the rig" in text
    assert text.count("**") > 6


def test_the_field_holds_the_heap_that_is_given() -> None:
    run = made(15.0)
    assert run.heights_m.sum() * CELL_M**2 == pytest.approx(0.12 * 0.4 * 0.4)
    assert math.isfinite(run.dem[LOAD])
