"""Soil ahead and soil carried: heaps of known litres on a height map, and the same heaps in pictures of the rig."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from graderd.core.blade import BladeGeometry, meeting_point
from graderd.core.soil import PROFILE_BINS_N, Profile, SoilObservation, Zone
from graderd.hal.camera import Frame
from graderd.perception.classifier import make_classifier
from graderd.perception.depth import Cells, SoilSplit
from graderd.perception.geometry import CENTER, LEFT, RIGHT
from graderd.perception.settings import CameraCalibration, Method, PerceptionSettings
from graderd.runtime.perception_protocol import FromChild, Observed
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.world import World, scene_heights
from harness.perception_scenes import ON_GROUND

BLADE = BladeGeometry()
CELL_M = 0.01
CELLS = Cells(np.arange(-0.95, 0.95, CELL_M) + CELL_M / 2, np.arange(0.0, 0.49, CELL_M) + CELL_M / 2, CELL_M**2)
S, D = CELLS.s_m[:, None], CELLS.d_m[None, :]
REPOSE_DEG, TRAVEL_M = 33.0, 0.49


def split(height_m: np.ndarray, angle_deg: float = 0.0) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return SoilSplit(CELLS, BLADE, REPOSE_DEG, TRAVEL_M)(height_m, angle_deg)


def leaning(s_from: float, s_to: float, height_m: float, slope_deg: float = 40.0) -> np.ndarray:
    """A heap that falls away from the face."""
    return np.where((s_from < S) & (s_to > S), np.maximum(height_m - np.tan(np.radians(slope_deg)) * D, 0.0), 0.0)


def litres(height_m: np.ndarray) -> float:
    return float(height_m.sum()) * CELL_M**2 * 1000


def test_what_leans_on_the_face_is_carried() -> None:
    heap = leaning(-0.5, 0.5, 0.2)
    carried, ahead = split(heap)
    assert sum(carried) == pytest.approx(litres(heap), rel=0.01)
    assert sum(ahead) < 0.01 * litres(heap)


def test_a_heap_with_its_crest_off_the_face_is_carried_too() -> None:
    """The camera looks at the crest from ahead; what lies behind it is filled in lower."""
    heap = np.where(D < 0.04, 0.16 + D, np.maximum(0.2 - np.tan(np.radians(40.0)) * (D - 0.04), 0.0)) * (
        np.abs(S) < 0.3
    )
    carried, ahead = split(heap)
    assert sum(carried) == pytest.approx(litres(heap), rel=0.02)
    assert sum(ahead) < 0.02 * litres(heap)


def test_soil_beyond_the_foot_of_the_heap_is_ahead() -> None:
    heap, pile = leaning(-0.5, 0.5, 0.1), 0.15 * (np.hypot(S + 0.33, D - 0.33) < 0.12)
    carried, ahead = split(heap + pile)
    assert sum(carried) == pytest.approx(litres(heap), rel=0.02)
    assert ahead[RIGHT] == pytest.approx(litres(pile), rel=0.02)
    assert ahead[LEFT] < 0.02 * litres(heap)


def test_a_layer_is_ahead_but_for_what_may_lean() -> None:
    layer = np.full((CELLS.s_m.size, CELLS.d_m.size), 0.04)
    carried, ahead = split(layer)
    assert sum(ahead) > 5 * sum(carried)
    assert max(ahead) < 1.05 * min(ahead)


@pytest.mark.parametrize("angle_deg", [-60.0, -45.0, -30.0, 0.0, 30.0, 45.0, 60.0])
def test_soil_is_counted_in_the_third_that_will_meet_it(angle_deg: float) -> None:
    """A round pile straight before each third's middle, at a distance along the travel."""
    for third, middle in ((RIGHT, -1 / 3), (CENTER, 0.0), (LEFT, 1 / 3)):
        met_s, travel_m = meeting_point(S, D, angle_deg)
        pile = 0.1 * ((np.abs(met_s - middle) < 0.12) & (np.abs(travel_m - 0.35) < 0.1))
        carried, ahead = split(pile, angle_deg)
        assert ahead[third] == pytest.approx(litres(pile), rel=0.02)
        assert sum(ahead) == pytest.approx(ahead[third])
        assert sum(carried) == 0.0


def test_what_lies_beyond_the_travel_looked_ahead_does_not_count() -> None:
    angle_deg = 60.0
    _, travel_m = meeting_point(S, D, angle_deg)
    assert sum(split(0.1 * ((travel_m > TRAVEL_M + 0.01) & (S < 2.0)), angle_deg)[1]) == 0.0


@pytest.mark.xdist_group("pictures before a turned blade")
@pytest.mark.parametrize("method", ["depth", "fused"])
@pytest.mark.parametrize("angle_deg", [-45.0, -30.0, 0.0, 30.0, 45.0])
@pytest.mark.parametrize("zone", [Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN])
def test_what_a_turned_blade_will_meet_is_told_from_the_picture(zone: Zone, angle_deg: float, method: Method) -> None:
    """A heap dead ahead of a blade at 45 degrees lies before its right third, square to it."""
    observation = look(zone, angle_deg, method)
    assert observation.ahead is not None
    assert observation.coming.zone is zone, observation.ahead.reason
    if zone is Zone.CENTER and angle_deg == 45.0 and method == "depth":
        assert observation.zone is Zone.RIGHT  # of all soil, in thirds square to the blade


def look(zone: Zone, angle_deg: float, method: Method = "depth") -> SoilObservation:
    classifier = make_classifier(PerceptionSettings(method=method), CameraCalibration(), BLADE, live=False)
    return classifier.classify(picture(zone, angle_deg), angle_deg, 0.01, ON_GROUND)


def picture(zone: Zone, angle_deg: float) -> Frame:
    return scene(zone, angle_deg)[1]


@cache
def scene(zone: Zone, angle_deg: float) -> tuple[World, Frame]:
    """The heap before a blade that was pushed against it, and its picture; made once for all methods."""
    world = World()
    world.blade = BladePose(angle_deg)
    world.lay(scene_heights(SceneZone(zone), world.vehicle.x_m, world.blade, 2))
    for _ in range(30):
        world.step(0.01, world.blade)
    renderer = Renderer((640, 400), (424, 240), seed=3)
    seen = SceneState(world.field.heights_m.astype(np.float32), world.field.cell_m, world.vehicle.x_m, world.blade)
    color, depth = renderer.render(seen, Appearance())
    return world, Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0)


@pytest.mark.xdist_group("pictures before a turned blade")
@pytest.mark.parametrize(("zone", "angle_deg"), [(Zone.LEFT, 0.0), (Zone.CENTER, -30.0), (Zone.RIGHT, 30.0)])
def test_the_profile_is_the_crest_of_what_lies_before_the_blade(zone: Zone, angle_deg: float) -> None:
    profile_mm = look(zone, angle_deg).profile_mm
    assert profile_mm is not None
    assert len(profile_mm) == PROFILE_BINS_N
    assert profile_mm.count(None) <= 2, "only what its own heap hides at the blade's end"
    told = [(mm, true_mm) for mm, true_mm in zip(profile_mm, crests_mm(zone, angle_deg), strict=True) if mm is not None]
    assert max(abs(mm - true_mm) for mm, true_mm in told) < 15.0
    assert max(mm for mm, _ in told) > 200.0
    assert min(mm for mm, _ in told) == 0.0


@pytest.mark.parametrize(
    ("wrong", "because"),
    [
        ((0.0,) * 23, "has 23 heights"),
        ((None,) * 25, "has 25 heights"),
        (23 * (0.0,) + (-0.1,), "not between"),
        (23 * (None,) + (10_000.1,), "not between"),
        (23 * (None,) + (math.nan,), "not finite"),
    ],
)
def test_a_profile_that_cannot_be_is_not_taken_from_the_child(wrong: Profile, because: str) -> None:
    observation = look(Zone.LEFT, 0.0)
    told = FromChild.validate_json(Observed.of(observation).model_dump_json())
    assert isinstance(told, Observed)
    assert told.unpack() == observation
    with pytest.raises(ValueError, match=because):
        Observed.of(replace(observation, profile_mm=wrong)).unpack()


def crests_mm(zone: Zone, angle_deg: float) -> list[float]:
    """How high the soil in the rig's bed truly stands before each part of the blade, from its left end."""
    world, _ = scene(zone, angle_deg)
    s = BLADE.length_m * (np.arange(0.5, 10 * PROFILE_BINS_N) / (10 * PROFILE_BINS_N) - 0.5)
    s, ahead = np.meshgrid(s, BLADE.x_offset_m + np.arange(0.01, BLADE.reach_m, 0.01))
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    heights_m = world.field.height_at(world.vehicle.x_m + cos * ahead - sin * s, sin * ahead + cos * s)
    parts_m = heights_m.max(axis=0)[::-1].reshape(PROFILE_BINS_N, -1)
    return [1000.0 * float(part_m.mean()) for part_m in parts_m]


@pytest.mark.parametrize("method", ["paper", "fast_color"])
def test_colour_cannot_tell_and_says_so(method: Method) -> None:
    observation = look(Zone.LEFT, 0.0, method)
    assert observation.profile_mm is None
    assert observation.ahead is None
    assert observation.carried is None
    assert observation.coming.zone is observation.zone
