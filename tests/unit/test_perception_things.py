"""What is no soil by its form: legs, foliage, pipes, boxes and stones on empty and loaded beds."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from graderd.core.blade import BladeGeometry
from graderd.core.soil import SoilObservation, Zone
from graderd.hal.camera import Frame
from graderd.perception import CameraCalibration, Method, PerceptionSettings
from graderd.perception.classifier import make_classifier
from graderd.perception.forms import fill_hidden, standing, steep_cells
from graderd.perception.geometry import F32, F64
from graderd.perception.settings import FormSettings
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.camera.shapes import Solid
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.soil import SoilField
from harness.perception_scenes import ON_GROUND
from harness.perception_things import COLOR_SIZE, DEPTH_SIZE, SIDES, VEHICLE_X_M, photograph

pytestmark = pytest.mark.slow


@functools.cache
def renderer() -> Renderer:
    return Renderer(COLOR_SIZE, DEPTH_SIZE, seed=7)


@pytest.fixture(autouse=True)
def same_noise_for_each_test() -> None:
    """Whatever ran before it: the renderer's noise goes on from picture to picture."""
    renderer.cache_clear()


def judged(frame: Frame, angle_deg: float, method: Method = "depth") -> SoilObservation:
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BladeGeometry(), live=False)
    return classifier.classify(frame, angle_deg, 0.0, ON_GROUND)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("loaded", [SceneZone.NONE, SceneZone.CENTER])
def test_legs_are_obstructed_on_a_bare_bed_and_never_soil(side: Zone, loaded: SceneZone) -> None:
    # At 45 degrees a heap dead ahead is no longer before the middle third.
    for number, angle_deg in enumerate((-30.0, 0.0, 45.0) if loaded is SceneZone.NONE else (-30.0, 0.0)):
        frame = photograph(renderer(), "legs", side, loaded, angle_deg, number)
        observation = judged(frame, angle_deg)
        found = [fault.condition for fault in observation.faults] == ["obstructed"]
        if loaded is not SceneZone.NONE and not found:
            # In a heap higher than 20 cm a leg cannot be told from the machine's arms above a full blade.
            assert observation.zone in (Zone.CENTER, Zone.UNKNOWN)
            continue
        assert found
        assert observation.zone is Zone.UNKNOWN
        if side is not Zone.CENTER:
            assert str(side) in observation.faults[0].detail


@pytest.mark.parametrize("kind", ["foliage", "pipe", "box", "crate", "stone"])
@pytest.mark.parametrize("side", [Zone.LEFT, Zone.RIGHT])
def test_what_lies_there_and_is_no_soil_does_not_count(kind: str, side: Zone) -> None:
    opposite = SceneZone.RIGHT if side is Zone.LEFT else SceneZone.LEFT
    for number, angle_deg in ((2, 15.0), (3, -30.0)):
        empty = photograph(renderer(), kind, side, SceneZone.NONE, angle_deg, number)
        assert judged(empty, angle_deg).zone in (Zone.NONE, Zone.UNKNOWN)
        loaded = photograph(renderer(), kind, side, opposite, angle_deg, number)
        assert judged(loaded, angle_deg).zone in (Zone(str(opposite)), Zone.UNKNOWN)


@pytest.mark.parametrize("kind", ["boulder", "chest"])
@pytest.mark.parametrize("side", SIDES)
def test_large_stones_and_walls_lower_than_a_leg_are_no_pile(kind: str, side: Zone) -> None:
    """A wall's points spread over two cells of the map that are no ground: it ends in a step all the same."""
    for number in (0, 4, 6):
        angle_deg = (-30.0, 0.0, 15.0, 45.0)[number // 2 % 4]
        observation = judged(photograph(renderer(), kind, side, SceneZone.NONE, angle_deg, number), angle_deg)
        assert observation.zone in (Zone.NONE, Zone.UNKNOWN), (number, observation.reason)
        assert observation.ahead is not None
        assert observation.ahead.zone in (Zone.NONE, Zone.UNKNOWN), (number, observation.ahead.reason)


@pytest.mark.parametrize(("side", "number"), [(Zone.RIGHT, 23), (Zone.LEFT, 18), (Zone.LEFT, 23)])
def test_a_stone_whose_shadow_meets_the_foot_of_a_heap_adds_no_litres_to_it(side: Zone, number: int) -> None:
    """The two are one lump of the map; the stone's own border tells it from the heap."""
    loaded, angle_deg = (SceneZone.LEFT, 45.0) if side is Zone.RIGHT else (SceneZone.RIGHT, -45.0)
    observation = judged(photograph(renderer(), "stone", side, loaded, angle_deg, number), angle_deg)
    assert observation.zone in (Zone.CENTER, Zone(str(loaded)), Zone.UNKNOWN), observation.reason
    assert observation.ahead is not None
    assert observation.ahead.zone in (Zone(str(loaded)), Zone.UNKNOWN), observation.ahead.reason


def plank_before_the_blade(s_m: float, d_m: float, half_m: tuple[float, float, float], azimuth_deg: float) -> Frame:
    plank = Solid("box", (d_m, s_m, half_m[2]), half_m, (150, 120, 80), azimuth_deg)
    field = SoilField()
    state = SceneState(field.heights_m.astype(np.float32), field.cell_m, VEHICLE_X_M, BladePose(0.0), (plank,))
    color, depth = renderer().render(state, Appearance(ground="earth", disparity_noise_px=0.1))
    return Frame(color, depth, renderer().color_intrinsics, renderer().depth_intrinsics, 0.0)


@pytest.mark.parametrize(("s_m", "half_long_m"), [(0.0, 0.5), (0.33, 0.2), (-0.33, 0.2)])
def test_a_plank_beyond_the_soils_zone_turns_no_blade(s_m: float, half_long_m: float) -> None:
    """Flat on the ground it has no form that is not soil's; before the blade lay no pile, ahead of it was one."""
    observation = judged(plank_before_the_blade(s_m, 0.49, (0.10, half_long_m, 0.03), 0.0), 0.0)
    assert observation.zone is Zone.NONE
    assert observation.ahead is not None
    assert observation.ahead.zone in (Zone.NONE, Zone.UNKNOWN)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_plank_whose_near_edge_is_seen_is_no_pile(side: float) -> None:
    """Its edge is no higher than steep soil with noise on it may rise, but it is so all along."""
    observation = judged(plank_before_the_blade(side * 0.31, 0.22, (0.085, 0.34, 0.026), side * 60.0), 0.0)
    assert observation.zone in (Zone.NONE, Zone.UNKNOWN), observation.reason
    assert observation.ahead is not None
    assert observation.ahead.zone in (Zone.NONE, Zone.UNKNOWN), observation.ahead.reason


def test_a_colour_method_sees_who_stands_there_too() -> None:
    frame = photograph(renderer(), "legs", Zone.LEFT, SceneZone.NONE, 0.0, 1)
    classifier = make_classifier(PerceptionSettings(method="fast_color"), CameraCalibration(), BladeGeometry())
    assert [fault.condition for fault in classifier.classify(frame, 0.0, 0.0, ON_GROUND).faults] == ["obstructed"]


def column(z: F64, s: float = 0.1, d: float = 0.2) -> tuple[F32, F32, F32]:
    """Points of a leg 6 cm wide, at heights ``z``."""
    aside, up = np.meshgrid(np.linspace(0, 0.06, 7), z)
    return (s + aside).ravel().astype(np.float32), np.full(up.size, d, np.float32), up.ravel().astype(np.float32)


def test_what_stands_is_told_from_what_hangs_and_from_a_slope() -> None:
    up = np.arange(0.0, 0.36, 0.01)
    found = standing(*column(up), 0.5, 0.6)
    assert found is not None
    assert found == pytest.approx((0.13, 0.2), abs=0.03)
    assert standing(*column(up[up > 0.22]), 0.5, 0.6) is None  # an arm of the machine
    over_heap = column(up[((up > 0.10) & (up < 0.23)) | (up > 0.265)])  # an arm 4 cm over a full blade's heap
    assert standing(*over_heap, 0.5, 0.6) is None
    s, d, z = column(up)
    assert standing(s, np.float32(0.1) + z, z, 0.5, 0.6) is None  # soil, and steep soil
    assert standing(s + np.float32(0.6), d, z, 0.5, 0.6) is None  # beside the blade


def test_a_steep_cell_is_told_from_a_noisy_one() -> None:
    settings = FormSettings()
    count = np.full((9, 9), 6)
    flat = np.full((9, 9), 5 * 0.004**2)
    assert not steep_cells(flat, count, np.full((9, 9), 0.002), settings)[0].any()
    row = flat.copy()
    row[4] = 5 * 0.014**2
    steep = steep_cells(row, count, np.full((9, 9), 0.002), settings)[0]
    assert steep[4].all()
    assert not steep[0].any()
    assert not steep_cells(row, count, np.full((9, 9), 0.008), settings)[0].any()  # as much is noise there
    row[4, 4] = 5 * 0.1**2
    steep, hanging = steep_cells(row, count, np.full((9, 9), 0.002), settings)
    assert hanging[4, 4]
    assert hanging.sum() == 1
    assert not steep[4, 4]


def test_hidden_cells_fall_from_the_crest() -> None:
    height = np.array([[0.0, 0.0, 0.0, 0.10, 0.05]])
    seen = np.array([[False, False, False, True, True]])
    filled = fill_hidden(height, seen, 0.03, 0.06)
    assert filled[0] == pytest.approx([0.01, 0.04, 0.07, 0.10, 0.05])
