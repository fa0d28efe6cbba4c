"""Maps of heights above the ground, and their measures, against beds whose heights and widths are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from graderd.evaluation.bed import Grid, Points, bed_of, common_grid, fill
from graderd.evaluation.ground import F64, NoGroundError, find_plane
from graderd.evaluation.measures import (
    Blade,
    Interval,
    NothingThereError,
    Rules,
    Spread,
    height_difference,
    layer_cells,
    spread,
    volume_moved,
    windrow,
)
from graderd.evaluation.statistics import interval
from graderd.evaluation.uncertainty import estimate
from graderd.simulator.camera.top import TopCamera
from harness.top_view import HALF_VIEW, heap, known_bed, points_of, trapezoid

ALL = tuple(Spread)
UP, AHEAD = np.array((0.0, 0.0, 1.0)), np.array((1.0, 0.0, 0.0))
GRID = Grid(10.0, -80, -100, 160, 200)
SPREADS = ("spread_extreme_mm", "spread_mass_90_mm", "spread_mass_95_mm", "spread_second_moment_mm")


def map_of(surface: object) -> F64:
    x, y = np.meshgrid(GRID.x_mm, GRID.y_mm, indexing="ij")
    return np.asarray(surface(x, y), dtype=np.float64)  # type: ignore[operator]


def cloud(surface: object, step_mm: float = 12.0) -> F64:
    """Points on a surface as a scanner gives them that sees every place alike."""
    x, y = np.meshgrid(np.arange(-800, 800, step_mm), np.arange(-1000, 1000, step_mm), indexing="ij")
    return np.column_stack((x.ravel(), y.ravel(), np.asarray(surface(x, y)).ravel()))  # type: ignore[operator]


# -- the bars --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_height_within_a_millimetre_and_spread_within_a_hundredth(seed: int) -> None:
    known = known_bed(seed, 500.0)
    tilt = (5.0, 0.0, -3.5, 3.5)[seed]
    noise_px = (0.37, 0.37, 0.25, 0.09)[seed]
    camera = replace(known.camera, pitch_deg=tilt, roll_deg=math.sqrt(25.0 - tilt**2), noise_px=noise_px)
    scans = points_of(camera, known.surface, 10)
    assert len(scans[0].points_mm) < 0.81 * 848 * 480  # a fifth is missing, in the same places every time
    bed = bed_of(scans, 10.0)
    found = known.measures(bed, bed.heights_mm)
    assert abs(found["height_difference_mm"] - known.truth["height_difference_mm"]) <= 1.0
    for name in SPREADS:
        assert found[name] == pytest.approx(known.truth[name], rel=0.01), name


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_stated_interval_holds_the_truth_in_ninety_of_a_hundred() -> None:
    """A quarter of the beds in the small cells that take three times as long."""
    held = dict.fromkeys((*SPREADS, "height_difference_mm"), 0)
    for seed in range(100):
        known = known_bed(seed, 270.0, HALF_VIEW)
        for name, each in known.estimated(4, 20.0 if seed % 4 else 10.0).items():
            low, high = interval(each, 0.95)
            assert low is not None
            assert high is not None
            held[name] += low <= known.truth[name] <= high
    assert min(held.values()) >= 90, held


def test_an_interval_is_not_wide_for_safety() -> None:
    known = known_bed(7, 270.0, HALF_VIEW)
    found = known.estimated(4, 20.0)
    low, high = interval(found["height_difference_mm"], 0.95)
    assert low is not None
    assert high is not None
    assert high - low < 6.0
    low, high = interval(found["spread_mass_95_mm"], 0.95)
    assert low is not None
    assert high is not None
    assert high - low < 0.08 * known.truth["spread_mass_95_mm"]


# -- the ground ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, -9.0])
def test_a_layer_of_soil_is_not_taken_for_the_ground(tilt_deg: float) -> None:
    layer = cloud(heap(trapezoid(0.0, 1500.0, 1600.0, 80.0), -700.0, 700.0, 50.0))
    angle = math.radians(tilt_deg)
    turn = np.array([[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])
    plane = find_plane((layer + np.array((0.0, 0.0, -1400.0))) @ turn.T, UP)
    assert plane.offset_mm == pytest.approx(1400.0, abs=3.0)
    assert np.linalg.norm(np.cross(plane.normal, turn @ UP)) < math.sin(math.radians(0.2))


def test_points_far_off_do_no_harm() -> None:
    rng = np.random.default_rng(2)
    points = cloud(heap(trapezoid(100.0, 200.0, 600.0, 120.0), -400.0, 400.0, 100.0))
    clean = bed_of([Points(points, UP, AHEAD)], 20.0)
    points[rng.integers(0, len(points), len(points) // 200), 2] += rng.uniform(-400.0, 400.0, len(points) // 200)
    bed = bed_of([Points(points, UP, AHEAD)], 20.0)
    one, other = (spread(each.heights_mm, each.grid, each.noise_mm, Rules(), ALL) for each in (clean, bed))
    for name in ("spread_extreme_mm", "spread_mass_95_mm"):
        assert other[name] == pytest.approx(one[name], rel=0.02)


def test_no_ground_is_said_not_guessed() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(NoGroundError, match="heights scatter"):
        find_plane(rng.uniform(-500.0, 500.0, (20_000, 3)), UP)
    with pytest.raises(NoGroundError, match="few points"):
        find_plane(np.zeros((0, 3)), UP)
    pit = cloud(heap(trapezoid(0.0, 1960.0, 2100.0, 80.0), -790.0, 790.0, 10.0), 10.0)
    pit[::50, 2] -= rng.uniform(20.0, 400.0, len(pit[::50]))
    with pytest.raises(NoGroundError, match=r"bare|lies under|clear of soil"):
        bed_of([Points(pit[pit[:, 2] < 70.0], UP, AHEAD)], 20.0)


def test_scans_of_the_empty_bed_say_where_the_ground_is_when_soil_lies_everywhere() -> None:
    empty = Points(cloud(lambda x, _: 0.0 * x), UP, AHEAD)
    full = Points(cloud(lambda x, _: 0.0 * x + 63.0), UP, AHEAD)
    bed = bed_of([full], 20.0, bare=[empty])
    found = height_difference(bed.heights_mm, bed.grid, 60.0, bed.noise_mm, bed.cell_noise_mm, Rules())
    assert found["height_difference_mm"] == pytest.approx(3.0, abs=0.01)
    assert found["height_spread_mm"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("cell_mm", [10.0, 20.0])
@pytest.mark.parametrize(("scans_n", "noise_px"), [(4, 0.2), (2, 0.37)])
def test_the_sides_of_the_bed_end_it(cell_mm: float, scans_n: int, noise_px: float) -> None:
    surface = heap(trapezoid(150.0, 250.0, 640.0, 70.0), -500.0, 480.0, 100.0)
    camera = TopCamera(height_mm=1300.0, pitch_deg=-2.0, roll_deg=3.0, seed=12, noise_px=noise_px)
    free, walled = (
        bed_of(points_of(each, surface, scans_n), cell_mm) for each in (camera, replace(camera, wall_y_mm=1000.0))
    )
    one, other = (spread(each.heights_mm, each.grid, each.noise_mm, Rules(), ALL) for each in (free, walled))
    seen = walled.grid.y_mm[np.isfinite(walled.heights_mm).any(axis=0)]
    assert 860.0 < seen.max() < 1000.0
    assert -1000.0 < seen.min() < -860.0
    for name in SPREADS:
        assert other[name] == pytest.approx(one[name], rel=0.03), name


def test_holes_are_filled_smoothly_and_what_was_not_seen_stays_unknown() -> None:
    truth = map_of(lambda x, y: 0.1 * x + 0.05 * y + 40.0)
    seen = truth.copy()
    seen[40:52, 60:75] = np.nan
    inside = np.ones_like(truth, dtype=bool)
    inside[:, :10] = False
    seen[:, :10] = np.nan
    filled = fill(seen, inside)
    assert np.abs(filled - truth)[40:52, 60:75].max() < 1.5
    assert np.isnan(filled[:, :10]).all()


# -- definitions -----------------------------------------------------------------------------------------------------


def test_each_definition_of_spread_on_a_box() -> None:
    box = map_of(lambda x, y: 50.0 * ((np.abs(x) < 400.0) & (np.abs(y - 100.0) < 300.0)))
    found = spread(box, GRID, 0.0, Rules(), ALL)
    assert found["spread_extreme_mm"] == pytest.approx(600.0, abs=10.0)
    assert found["spread_mass_90_mm"] == pytest.approx(540.0, abs=3.0)
    assert found["spread_mass_95_mm"] == pytest.approx(570.0, abs=3.0)
    assert found["spread_second_moment_mm"] == pytest.approx(600.0, abs=1.0)


def test_where_soil_lies_and_how_much_does_not_change_a_spread() -> None:
    one = spread(map_of(heap(trapezoid(0.0, 200.0, 700.0, 100.0), -300.0, 300.0, 100.0)), GRID, 0.0, Rules(), ALL)
    moved = spread(map_of(heap(trapezoid(-150.0, 200.0, 700.0, 100.0), -100.0, 500.0, 100.0)), GRID, 0.0, Rules(), ALL)
    double = spread(
        map_of(heap(trapezoid(0.0, 200.0, 700.0, 200.0), -300.0, 300.0, 100.0)), GRID, 0.0, Rules(20.0), ALL
    )
    for name in SPREADS:
        assert moved[name] == pytest.approx(one[name], rel=0.003)
        assert double[name] == pytest.approx(one[name], rel=0.003)


def test_a_clod_far_aside_is_no_spread() -> None:
    field = heap(trapezoid(0.0, 200.0, 600.0, 100.0), -300.0, 300.0, 100.0)
    lone = map_of(lambda x, y: field(x, y) + 40.0 * (np.hypot(x, y - 800.0) < 50.0))
    assert spread(lone, GRID, 0.0, Rules(), ALL) == spread(map_of(field), GRID, 0.0, Rules(), ALL)


def test_soil_still_carried_is_told_apart_by_the_blade() -> None:
    left_behind = heap(trapezoid(0.0, 200.0, 500.0, 60.0), -600.0, 150.0, 80.0)
    carried = heap(trapezoid(0.0, 800.0, 960.0, 90.0), 230.0, 480.0, 60.0)
    ahead = heap(trapezoid(0.0, 1500.0, 1700.0, 90.0), 600.0, 780.0, 30.0)
    field = map_of(lambda x, y: left_behind(x, y) + carried(x, y) + ahead(x, y))
    blade = Blade(200.0, 0.0, 0.0, 1000.0, 350.0)
    rules = Rules(10.0, Interval(-np.inf, 560.0))  # the blade has not met what lies ahead, beside its length too
    found = spread(field, GRID, 0.0, rules, ALL, blade)
    without = spread(map_of(left_behind), GRID, 0.0, Rules(), ALL)
    both = spread(map_of(lambda x, y: left_behind(x, y) + carried(x, y)), GRID, 0.0, Rules(), ALL)
    for name in SPREADS:
        assert found[name.replace("_mm", "_without_carried_mm")] == pytest.approx(without[name], rel=0.002)
        assert found[name] == pytest.approx(both[name], rel=0.002)
    assert found["spread_mass_95_mm"] > 1.3 * found["spread_mass_95_without_carried_mm"]


def test_a_turned_blade_carries_along_its_face() -> None:
    """At 30 degrees counter-clockwise the left end is farther back: soil there is behind the axis and carried all the
    same."""
    blade = Blade(0.0, 0.0, 30.0, 1000.0, 350.0)
    on_face = map_of(lambda x, y: 80.0 * (np.hypot(x + 0.5 * 400.0 - 90.0, y - 0.866 * 400.0 - 52.0) < 70.0))
    behind = map_of(heap(trapezoid(0.0, 100.0, 300.0, 60.0), -700.0, -450.0, 60.0))
    found = spread(on_face + behind, GRID, 0.0, Rules(), (Spread.MASS_95,), blade)
    assert found["spread_mass_95_without_carried_mm"] == pytest.approx(
        spread(behind, GRID, 0.0, Rules(), (Spread.MASS_95,))["spread_mass_95_mm"], rel=0.001
    )
    assert found["spread_mass_95_mm"] > 1.5 * found["spread_mass_95_without_carried_mm"]


def test_height_difference_is_that_of_the_layer_without_its_edges() -> None:
    layer = map_of(
        lambda x, y: np.where((np.abs(x) < 500) & (np.abs(y) < 600), 46.0 + 3.0 * np.sign(np.sin(x / 25.0)), 0.0)
    )
    found = height_difference(layer, GRID, 50.0, 0.5, float("nan"), Rules())
    assert found["height_difference_mm"] == pytest.approx(-4.0, abs=0.15)
    assert found["height_spread_mm"] == pytest.approx(3.0, abs=0.1)
    noisy = layer + np.random.default_rng(0).normal(0.0, 4.0, layer.shape)
    assert height_difference(noisy, GRID, 50.0, 0.5, 4.0, Rules())["height_spread_mm"] == pytest.approx(3.0, abs=0.2)
    assert not layer_cells(layer, GRID, 0.5, Rules())[:, 0].any()


def test_a_named_area_is_looked_at_and_nothing_else() -> None:
    field = map_of(lambda x, y: np.where(x > 0.0, 60.0, 40.0) + 0.0 * y)
    rules = Rules(10.0, Interval(100.0, 500.0), Interval(-300.0, 300.0))
    assert height_difference(field, GRID, 50.0, 0.0, 0.0, rules)["height_difference_mm"] == pytest.approx(10.0)


def test_volume_moved_from_one_place_to_another() -> None:
    before = map_of(heap(trapezoid(-300.0, 100.0, 400.0, 100.0), -300.0, 300.0, 50.0))
    after = map_of(heap(trapezoid(300.0, 100.0, 400.0, 100.0), -300.0, 300.0, 50.0))
    litres = before.sum() * GRID.cell_l_per_mm
    found = volume_moved(before, after, GRID, 0.0, Rules())
    assert found["volume_moved_l"] == pytest.approx(litres, rel=0.005)
    assert found["volume_balance_l"] == pytest.approx(0.0, abs=0.1)
    gone = volume_moved(before, np.zeros_like(before), GRID, 0.0, Rules())
    assert gone["volume_balance_l"] == pytest.approx(-litres, rel=0.005)
    rng = np.random.default_rng(1)
    still = [before + rng.normal(0.0, 5.0, before.shape) for _ in range(2)]
    assert volume_moved(still[0], still[1], GRID, 1.0, Rules())["volume_moved_l"] < 0.3  # noise moves nothing


def test_a_windrow_stands_above_the_layer() -> None:
    layer = heap(trapezoid(0.0, 1200.0, 1300.0, 40.0), -500.0, 500.0, 50.0)
    ridge = heap(trapezoid(450.0, 40.0, 240.0, 60.0), -500.0, 500.0, 50.0)
    found = windrow(map_of(lambda x, y: layer(x, y) + ridge(x, y)), GRID, 0.0, Rules())
    assert found["windrow_y_mm"] == pytest.approx(450.0, abs=12.0)
    assert found["windrow_height_mm"] == pytest.approx(60.0 * 950.0 / 1000.0, rel=0.06)
    above_edge_l = (60.0 * 140.0 - 10.0 * (10.0 / 60.0) * 100.0) / 1000.0 * 0.95
    assert found["windrow_l_per_m"] == pytest.approx(above_edge_l, rel=0.08)
    flat = windrow(map_of(layer), GRID, 0.0, Rules())
    assert flat["windrow_l_per_m"] == 0.0
    assert "windrow_y_mm" not in flat


def test_nothing_there_is_said() -> None:
    bare = np.zeros((GRID.cells_x, GRID.cells_y))
    with pytest.raises(NothingThereError):
        spread(bare, GRID, 0.5, Rules(), ALL)
    with pytest.raises(NothingThereError):
        height_difference(bare, GRID, 50.0, 0.5, 0.5, Rules())
    with pytest.raises(NothingThereError):
        windrow(bare, GRID, 0.5, Rules())


def test_one_scan_has_an_interval_too_and_no_bare_ground_has_none() -> None:
    surface = heap(trapezoid(0.0, 250.0, 640.0, 70.0), -200.0, 200.0, 60.0)
    camera = TopCamera(height_mm=1300.0, seed=3, lens=HALF_VIEW)
    bed = bed_of(points_of(camera, surface, 1), 20.0)
    found = estimate([bed], lambda maps: spread(maps[0], bed.grid, bed.noise_mm, Rules(), ALL))
    assert all(1.0 < each.deviation < 40.0 for each in found.values())
    blind = replace(bed, residual_mm=np.full_like(bed.residual_mm, np.nan))
    unsure = estimate([blind], lambda maps: spread(maps[0], bed.grid, bed.noise_mm, Rules(), ALL))
    assert all(interval(each, 0.95) == (None, None) for each in unsure.values())


def test_states_share_their_cells() -> None:
    before = [Points(cloud(heap(trapezoid(0.0, 200.0, 700.0, 100.0), -300.0, 300.0, 100.0)), UP, AHEAD)]
    after = [Points(cloud(heap(trapezoid(0.0, 400.0, 900.0, 60.0), -300.0, 300.0, 100.0)), UP, AHEAD)]
    grid = common_grid([before, after], 20.0)
    assert bed_of(before, 20.0, grid).heights_mm.shape == bed_of(after, 20.0, grid).heights_mm.shape
    with pytest.raises(NoGroundError, match=r"cells of 0\.1 mm"):
        common_grid([before], 0.1)
