"""The rig's soil: mass, repose, and what the blade does to it."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graderd.core.blade import meeting_point
from graderd.simulator.grader.blade import FACE_HEIGHT_M, BladePose, Plough, blade_grid, volumes_in_front_m3
from graderd.simulator.grader.load import blade_load
from graderd.simulator.grader.piles import SceneZone, heap, lay_scene, layer
from graderd.simulator.grader.soil import MOIST_LOAM, FloatArray, SoilField

pytestmark = pytest.mark.slow

X_M = 3.0


def moved(field: SoilField, pose: BladePose, travel_m: float, step_m: float = 0.01) -> float:
    """Drive the blade ``travel_m`` forward from X_M; returns where it stands then."""
    plough = Plough(field)
    plough.settle(X_M, pose)
    x_m = X_M
    for _ in range(round(travel_m / step_m)):
        plough.move(x_m, pose, x_m + step_m, pose)
        x_m += step_m
    return x_m


def turned(field: SoilField, from_deg: float, to_deg: float) -> None:
    """Turn a standing blade."""
    plough = Plough(field)
    plough.settle(X_M, BladePose(from_deg))
    count = math.ceil(abs(to_deg - from_deg) / 0.3)
    angles = np.linspace(from_deg, to_deg, count + 1)
    for before, after in pairwise(angles):
        plough.move(X_M, BladePose(float(before)), X_M, BladePose(float(after)))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height_m=st.floats(0.01, 0.4),
    moves=st.lists(
        st.tuples(
            st.floats(-0.05, 0.05),
            st.floats(-60, 60),
            st.floats(-0.05, 0.25),
            st.floats(-10, 10),
            st.floats(-15, 15),
        ),
        min_size=1,
        max_size=8,
    ),
)
def test_rig_mass_is_conserved_whatever_the_blade_does(
    seed: int, height_m: float, moves: list[tuple[float, float, float, float, float]]
) -> None:
    field = SoilField(cell_m=0.04)
    rng = np.random.default_rng(seed)
    field.heights_m += rng.uniform(0, height_m, field.heights_m.shape)
    before_m3 = field.volume_m3
    plough = Plough(field)
    x_m, pose = float(rng.uniform(0.0, 8.0)), BladePose()
    for travel_m, angle_deg, blade_height_m, slope_deg, pitch_deg in moves:
        new_x_m, new_pose = x_m + travel_m, BladePose(angle_deg, blade_height_m, slope_deg, pitch_deg)
        plough.move(x_m, pose, new_x_m, new_pose)
        x_m, pose = new_x_m, new_pose
    assert field.volume_m3 == pytest.approx(before_m3, rel=1e-12)
    assert field.heights_m.min() >= -1e-12


def test_rig_soil_comes_to_rest_at_the_angle_of_repose() -> None:
    field = SoilField()
    field.heights_m[200, 50] = 60.0
    before_m3 = field.volume_m3
    field.settle(field.whole)
    steepest = math.tan(math.radians(MOIST_LOAM.repose_deg))
    for axis in (0, 1):
        slope = np.abs(np.diff(field.heights_m, axis=axis)) / field.cell_m
        assert slope.max() < steepest * 1.02
    diagonal = np.abs(field.heights_m[1:, 1:] - field.heights_m[:-1, :-1]) / (field.cell_m * math.sqrt(2))
    assert diagonal.max() < steepest * 1.02
    # and it is a cone, not a pancake: the slopes are near the angle of repose, alike in all directions
    flank = field.heights_m[200, 55:62]
    assert np.mean(-np.diff(flank)) / field.cell_m == pytest.approx(steepest, rel=0.1)
    assert field.volume_m3 == pytest.approx(before_m3, rel=1e-12)


def test_rig_soil_does_not_pass_through_a_standing_blade() -> None:
    for angle_deg in (0.0, 17.0, 45.0, -60.0):
        field = SoilField()
        pose = BladePose(angle_deg)
        angle = math.radians(angle_deg)
        field.heights_m += heap(field, X_M + 0.15 * math.cos(angle), 0.15 * math.sin(angle), 0.2, 0.2, 0.22)
        Plough(field).settle(X_M, pose)
        s = -(field.x_m[:, None] - X_M) * math.sin(angle) + field.y_m[None, :] * math.cos(angle)
        d = (field.x_m[:, None] - X_M) * math.cos(angle) + field.y_m[None, :] * math.sin(angle)
        assert field.heights_m[(np.abs(s) < 0.45) & (d < -0.04)].max() == 0.0


def test_rig_soil_higher_than_the_blade_spills_over_it() -> None:
    field = SoilField()
    field.heights_m[round(X_M / 0.02) : round((X_M + 0.3) / 0.02), 40:60] = 0.6
    Plough(field).settle(X_M, BladePose())
    behind = field.heights_m[: round((X_M - 0.06) / 0.02), 45:55]
    assert behind.max() > 0.05


def test_rig_blade_pushes_soil_ahead_and_leaves_the_floor_clean() -> None:
    field = SoilField()
    field.add(layer(field, X_M, X_M + 2.0, 0.9, 0.03))  # a blade holds 37 l a metre under its top edge
    x_m = moved(field, BladePose(), 1.0)
    left, center, right = (1e3 * volume for volume in volumes_in_front_m3(field, x_m, 0.0))
    assert left + center + right > 25.0
    assert abs(left - right) < 0.15 * (left + right)
    cleaned = field.heights_m[round((X_M + 0.2) / 0.02) : round((x_m - 0.2) / 0.02), 35:65]
    assert cleaned.mean() <= 0.0025


def test_rig_a_raised_edge_leaves_soil_behind() -> None:
    field = SoilField()
    field.add(layer(field, X_M, X_M + 2.0, 0.9, 0.05))
    x_m = moved(field, BladePose(height_m=0.02), 1.0)
    trail = field.heights_m[round((X_M + 0.2) / 0.02) : round((x_m - 0.2) / 0.02), 35:65]
    assert trail.mean() == pytest.approx(0.022, abs=0.003)


def test_rig_a_cross_slope_leaves_more_under_the_higher_end() -> None:
    field = SoilField()
    field.add(layer(field, X_M, X_M + 2.0, 0.9, 0.05))
    x_m = moved(field, BladePose(height_m=0.02, slope_deg=3.0), 1.0)
    trail = field.heights_m[round((X_M + 0.3) / 0.02) : round((x_m - 0.2) / 0.02)].mean(axis=0)
    assert trail[62:68].mean() > trail[32:38].mean() + 0.01


@pytest.mark.parametrize("angle_deg", [30.0, 45.0])
def test_rig_soil_is_cast_towards_the_trailing_end(angle_deg: float) -> None:
    middles = {}
    for sign in (1.0, -1.0):
        field = SoilField()
        field.add(heap(field, X_M + 0.5, 0.0, 0.4, 0.4, 0.2))
        moved(field, BladePose(sign * angle_deg), 1.5)
        middles[sign] = float((field.heights_m.sum(axis=0) * field.y_m).sum() / field.heights_m.sum())
    # counter-clockwise: the left end trails, so soil goes to the left (+y)
    assert middles[1.0] > 0.12
    assert middles[-1.0] < -0.12
    assert middles[1.0] == pytest.approx(-middles[-1.0], abs=0.03)


def pushed(
    angle_deg: float, *, cell_m: float = 0.02, step_m: float = 0.005, pitch_deg: float = 0.0, height_m: float = 0.14
) -> SoilField:
    """A heap 0.45 m wide, the same on every grid, after a blade pushed it for 0.8 m and stopped."""
    field = SoilField(cell_m=cell_m)
    along, across = (field.x_m - X_M - 0.5)[:, None] / 0.3, field.y_m[None, :] / 0.225
    field.add(height_m * np.sqrt(np.clip(1.0 - along**2 - across**2, 0.0, None)))
    plough, pose = Plough(field), BladePose(angle_deg, pitch_deg=pitch_deg)
    plough.settle(X_M, pose)
    places = X_M + np.linspace(0.0, 0.8, round(0.8 / step_m) + 1)
    for here, there in pairwise(places):
        plough.move(float(here), pose, float(there), pose)
    end_m = float(places[-1])
    while plough.move(end_m, pose, end_m, pose):
        pass
    return field


def cast_mm(field: SoilField) -> float:
    """How far to the left the soil's centre of mass lies of the middle line."""
    return float((field.heights_m.sum(axis=0) * field.y_m).sum() / field.heights_m.sum()) * 1e3


def width_mm(field: SoilField) -> float:
    """Width of an even layer that is spread as far across the bed."""
    across = field.heights_m.sum(axis=0)
    variance = (across * (field.y_m - cast_mm(field) / 1e3) ** 2).sum() / across.sum()
    return math.sqrt(12.0 * variance) * 1e3


def test_rig_casting_grows_smoothly_with_the_angle() -> None:
    """With friction that lets go all at once it jumped at 20 degrees, and 15 did as 0 does."""
    cast = np.array([cast_mm(pushed(angle_deg)) for angle_deg in range(0, 50, 5)])
    more = np.diff(cast)
    assert more.min() > 0.0
    assert np.abs(np.diff(more)).max() < 0.4 * more.max()
    assert 0.2 * cast[9] < cast[3] < 0.4 * cast[9]


@pytest.mark.parametrize("angle_deg", [15.0, 30.0])
def test_rig_soil_goes_by_the_way_and_not_by_speed_or_grid(angle_deg: float) -> None:
    """A tick is 10 ms: 1 mm of way is 0.1 m/s, 10 mm is 1 m/s."""
    reference = pushed(angle_deg)
    for step_m in (0.001, 0.01):
        other = pushed(angle_deg, step_m=step_m)
        assert cast_mm(other) == pytest.approx(cast_mm(reference), rel=0.01)
        assert width_mm(other) == pytest.approx(width_mm(reference), rel=0.01)
    for cell_m in (0.01, 0.04):
        other = pushed(angle_deg, cell_m=cell_m)
        assert cast_mm(other) == pytest.approx(cast_mm(reference), rel=0.05)
        assert width_mm(other) == pytest.approx(width_mm(reference), rel=0.05)


def test_rig_pitch_lowers_the_top_edge_and_does_nothing_else() -> None:
    straight, pitched = (pushed(30.0, pitch_deg=pitch_deg, height_m=0.1) for pitch_deg in (0.0, 15.0))
    assert np.array_equal(straight.heights_m, pitched.heights_m)
    over = [pushed(0.0, pitch_deg=pitch_deg, height_m=0.4).heights_m for pitch_deg in (0.0, 15.0)]
    behind = [heights[: round((X_M + 0.74) / 0.02), 40:60].sum() for heights in over]
    assert behind[1] > 1.02 * behind[0]


def test_rig_soil_spills_round_the_ends() -> None:
    field = SoilField()
    field.add(layer(field, X_M, X_M + 2.0, 0.95, 0.08))
    x_m = moved(field, BladePose(), 1.5)
    strip = slice(round((X_M + 0.5) / 0.02), round((x_m - 0.3) / 0.02))
    beside = field.heights_m[strip, 76:82].mean()
    assert beside > 0.09  # windrows grow beside the blade's path


def test_rig_a_turning_blade_pushes_soil_with_its_advancing_half() -> None:
    field = SoilField()
    field.add(layer(field, X_M - 0.7, X_M + 0.9, 0.9, 0.05))
    turned(field, 0.0, 40.0)
    left, center, right = volumes_in_front_m3(field, X_M, 40.0)
    assert right > 1.5 * left  # counter-clockwise: the right end swings forward into the soil
    assert right > center


@pytest.mark.parametrize(
    ("zone", "angle_deg"), [(SceneZone.LEFT, 30.0), (SceneZone.CENTER, 15.0), (SceneZone.RIGHT, -30.0)]
)
def test_rig_a_heap_keeps_its_zone_while_the_blade_turns_to_meet_it(zone: SceneZone, angle_deg: float) -> None:
    """Else a standing machine would see its own answer change the question."""
    field = SoilField()
    lay_scene(field, zone, X_M, BladePose(), seed=3)
    index = [SceneZone.LEFT, SceneZone.CENTER, SceneZone.RIGHT].index(zone)
    at = 0.0
    for to in np.linspace(0.0, angle_deg, 5)[1:]:
        turned(field, at, float(to))
        at = float(to)
        volumes = volumes_in_front_m3(field, X_M, at)
        assert volumes[index] == max(volumes)
        assert volumes[index] > 1.6 * sorted(volumes)[1]


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("start_deg", [-30.0, 0.0, 30.0, 45.0])
def test_rig_even_soil_lies_evenly_ahead_while_the_blade_turns_to_45_and_drives(seed: int, start_deg: float) -> None:
    """What it carries does not: the end that swings forward gathers soil, and then it runs to the trailing end."""
    field = SoilField()
    lay_scene(field, SceneZone.EVEN, 1.2, BladePose(start_deg), seed)
    plough = Plough(field)
    plough.settle(1.2, BladePose(start_deg))
    x_m, angle_deg = 1.2, start_deg
    shares = []
    for tick in range(450):
        new_deg = min(45.0, angle_deg + 0.3)
        new_x_m = x_m + (0.01 if tick > 250 else 0.0)
        plough.move(x_m, BladePose(angle_deg), new_x_m, BladePose(new_deg))
        x_m, angle_deg = new_x_m, new_deg
        if tick % 50 == 49:
            shares.append(ahead_of_the_heap(field, x_m, angle_deg))
    parts = np.array([volumes / volumes.sum() for volumes in shares])
    assert parts.min() > 0.27
    assert parts.max() < 0.40


def ahead_of_the_heap(field: SoilField, x_m: float, angle_deg: float) -> FloatArray:
    """Soil that each third of the blade will meet between 0.6 and 0.9 m of travel, beyond all it carries."""
    s, d = blade_grid(field, field.whole, x_m, angle_deg)
    met_s, travel_m = meeting_point(s, d, angle_deg)
    soil = np.where((travel_m > 0.6) & (travel_m < 0.9), field.heights_m, 0.0)
    borders = np.linspace(-0.5, 0.5, 4)
    return np.array([soil[(met_s > low) & (met_s < high)].sum() for low, high in pairwise(borders)])


def test_rig_the_same_heap_is_laid_wherever_the_machine_stands() -> None:
    heaps = []
    for x_m in (0.8, 1.2, 4.0, 7.0):
        field = SoilField()
        lay_scene(field, SceneZone.RIGHT, x_m, BladePose(), seed=8)
        heaps.append(volumes_in_front_m3(field, x_m, 0.0)[2])
    assert heaps == pytest.approx([heaps[0]] * 4, rel=0.1)  # a row of cells more or less, by rounding
    assert heaps[0] > 8e-3


def test_rig_scene_none_is_an_empty_bed() -> None:
    field = SoilField()
    field.add(heap(field, 3.0, 0.0, 1.0, 0.5, 0.3))
    lay_scene(field, SceneZone.NONE, 1.2, BladePose())
    assert field.volume_m3 == 0.0


def test_rig_a_poured_heap_is_as_large_as_the_papers() -> None:
    field = SoilField()
    field.add(heap(field, 4.0, 0.0, 1.0, 0.5, 0.3))
    assert 0.05 < field.volume_m3 < 0.15
    along = field.x_m[field.heights_m.max(axis=1) > 0.01]
    assert 0.95 < along[-1] - along[0] < 1.5


# -- loads ------------------------------------------------------------------------------------------------------


def test_rig_load_is_nothing_without_soil() -> None:
    load = blade_load(SoilField(), X_M, BladePose(), 1.0, 0.0)
    assert (load.force_n, load.torque_nm) == (0.0, 0.0)


def test_rig_load_pushes_back_and_turns_towards_the_loaded_end() -> None:
    field = SoilField()
    field.add(heap(field, X_M + 0.2, 0.35, 0.3, 0.25, 0.2))
    Plough(field).settle(X_M, BladePose())
    driving = blade_load(field, X_M, BladePose(), 1.0, 0.0)
    standing = blade_load(field, X_M, BladePose(), 0.0, 0.0)
    # soil at the left end holds it back: the blade wants to turn counter-clockwise
    assert driving.force_n > 0
    assert driving.torque_nm > 0
    assert driving.left_n > 10 * driving.right_n
    assert 0.0 <= standing.force_n < 0.2 * driving.force_n


def test_rig_load_brakes_a_turning_blade_either_way() -> None:
    field = SoilField()
    field.add(layer(field, X_M - 0.7, X_M + 0.7, 0.9, 0.08))
    Plough(field).settle(X_M, BladePose())
    assert blade_load(field, X_M, BladePose(), 0.0, 0.5).torque_nm < -1.0
    assert blade_load(field, X_M, BladePose(), 0.0, -0.5).torque_nm > 1.0


def test_rig_load_of_the_papers_heap_is_of_the_papers_size() -> None:
    """240 kg ahead of the blade: 0.49 m g = 1150 N; Table 3 has 1140 to 1210 N."""
    field = SoilField()
    wide = 240.0 / 1600.0
    # a wedge before the whole face, within reach
    d = field.x_m - X_M
    profile = np.where((d > 0) & (d < 0.35), 1.0, 0.0)[:, None] * (np.abs(field.y_m) < 0.5)[None, :]
    field.heights_m += profile * wide / (profile.sum() * field.cell_m**2)
    force_n = blade_load(field, X_M, BladePose(), 1.0, 0.0).force_n
    assert 900.0 < force_n < 2500.0  # friction of the weight, plus what the wall of earth adds


def test_rig_servo_feels_a_share_of_the_moment_and_little_without_power() -> None:
    field = SoilField()
    field.add(heap(field, X_M + 0.25, 0.35, 0.6, 0.3, 0.28))
    Plough(field).settle(X_M, BladePose())
    load = blade_load(field, X_M, BladePose(), 1.0, 0.0)
    assert 2.0 < load.servo_torque_nm(powered=True) < 44.7
    assert abs(load.servo_torque_nm(powered=False)) <= 2.0


def test_rig_blade_pose_follows_the_actuators() -> None:
    assert BladePose.from_actuators(30.0, 100.0, 100.0, 50.0) == BladePose(30.0, 0.0, 0.0, 0.0)
    raised = BladePose.from_actuators(0.0, 150.0, 150.0, 60.0)
    assert raised.height_m == pytest.approx(0.05)
    assert raised.pitch_deg == pytest.approx(3.0)
    canted = BladePose.from_actuators(0.0, 110.0, 90.0, 50.0)
    assert canted.slope_deg == pytest.approx(math.degrees(math.atan(0.02 / 0.8)))
    assert canted.edge_m(np.array([0.4]))[0] > canted.edge_m(np.array([-0.4]))[0]
    assert FACE_HEIGHT_M == 0.25
