"""The rig's vehicle, its world as a whole, and the memory it shares with its camera."""

from __future__ import annotations

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.renderer import CAMERA_HEIGHT_M, top_depth, top_view
from graderd.simulator.camera.shared_scene import SharedScene
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.load import blade_load
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.world import MAX_X_M, MIN_X_M, START_X_M, Vehicle, World, scene_heights


def driven(vehicle: Vehicle, step_s: float = 0.01, limit_s: float = 60.0) -> tuple[float, float]:
    """Let it drive until it stands; returns the time that took and its highest speed."""
    time_s, fastest = 0.0, 0.0
    while vehicle.driving and time_s < limit_s:
        vehicle.step(step_s)
        time_s += step_s
        fastest = max(fastest, abs(vehicle.speed_m_per_s))
    return time_s, fastest


@given(
    speed=st.floats(0.05, 1.5).flatmap(lambda v: st.sampled_from((v, -v))),
    distance_m=st.floats(0.01, 8.0),
    start_m=st.floats(MIN_X_M, MAX_X_M),
    step_s=st.sampled_from((0.005, 0.01, 0.05)),
)
def test_rig_vehicle_drives_as_far_as_it_said(speed: float, distance_m: float, start_m: float, step_s: float) -> None:
    vehicle = Vehicle(x_m=start_m)
    promised_m = vehicle.drive(speed, distance_m)
    assert 0.0 <= promised_m <= distance_m + 1e-9
    time_s, fastest = driven(vehicle, step_s, limit_s=400.0)
    assert time_s < 400.0
    assert vehicle.speed_m_per_s == 0.0
    assert vehicle.x_m - start_m == pytest.approx(np.sign(speed) * promised_m, abs=2e-3)
    assert MIN_X_M <= vehicle.x_m <= MAX_X_M
    assert fastest <= abs(speed) + 1e-9


def test_rig_vehicle_reaches_the_papers_speed_and_halts() -> None:
    vehicle = Vehicle()
    vehicle.drive(1.0, 5.0)
    for _ in range(150):
        vehicle.step(0.01)
    assert vehicle.speed_m_per_s == pytest.approx(1.0)
    at_m = vehicle.x_m
    vehicle.halt()
    driven(vehicle)
    assert vehicle.x_m - at_m < 0.2
    vehicle.reset()
    assert (vehicle.x_m, vehicle.speed_m_per_s) == (START_X_M, 0.0)


def test_rig_world_keeps_its_soil_through_a_working_pass() -> None:
    world = World()
    world.lay(scene_heights(SceneZone.LEFT, world.vehicle.x_m, world.blade, seed=9))
    mass_kg = world.soil_kg
    world.vehicle.drive(1.0, 2.0)
    angle_deg, worst_n = 0.0, 0.0
    for _ in range(260):
        angle_deg = min(30.0, angle_deg + 0.3)
        world.step(0.01, BladePose(angle_deg))
        worst_n = max(worst_n, world.load.force_n)
    assert world.soil_kg == pytest.approx(mass_kg, rel=1e-12)
    assert world.vehicle.x_m == pytest.approx(START_X_M + 2.0, abs=2e-3)
    assert 50.0 < worst_n < 1500.0


def test_rig_world_at_rest_changes_nothing() -> None:
    world = World()
    world.lay(scene_heights(SceneZone.CENTER, world.vehicle.x_m, world.blade, seed=9))
    for _ in range(400):
        world.step(0.01, BladePose())
    assert not world.plough.restless
    before = world.field.heights_m.copy()
    for _ in range(50):
        world.step(0.01, BladePose())
    assert np.array_equal(before, world.field.heights_m)


def test_rig_scenes_repeat_by_seed() -> None:
    first, again, other = (scene_heights(SceneZone.LEFT, 1.2, BladePose(), seed) for seed in (4, 4, 5))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_rig_top_view_is_seen_from_above_with_forward_up_and_left_left() -> None:
    heights_m = np.zeros((400, 100))
    heights_m[300:320, 80:90] = 0.2  # far ahead, to the left
    depth = top_depth(heights_m)
    rows, columns = np.nonzero(depth < CAMERA_HEIGHT_M * 1000 - 100)
    assert rows.max() < 100
    assert columns.max() < 20
    assert depth.min() == round((CAMERA_HEIGHT_M - 0.2) * 1000)
    assert depth.max() == round(CAMERA_HEIGHT_M * 1000)
    view = top_view(heights_m, 0.02, 4.0, BladePose(30.0), Appearance())
    assert view.shape == (1600, 400, 3)
    yellow = (view[..., 2] > 240) & (view[..., 1] > 180) & (view[..., 0] < 90)
    rows, columns = np.nonzero(yellow)
    assert rows.mean() == pytest.approx(800, abs=8)
    # counter-clockwise: the left end lies further back, so lower in the picture
    assert rows[columns < 150].mean() > rows[columns > 250].mean() + 40


def test_rig_shared_memory_never_shows_half_a_state() -> None:
    writer = SharedScene.create((50, 40))
    reader = SharedScene.open(writer.descriptor)
    stop = threading.Event()

    def write() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            writer.write(float(number), float(number), BladePose(number), np.full((50, 40), float(number)), 0.02)

    writer.write(0.0, 0.0, BladePose(), np.zeros((50, 40)), 0.02)
    thread = threading.Thread(target=write, name="writer")
    thread.start()
    try:
        for _ in range(300):
            state = reader.read()
            assert state.heights_m.min() == state.heights_m.max() == state.time_s == state.vehicle_x_m
            assert state.blade.angle_deg == state.time_s
            assert state.cell_m == pytest.approx(0.02)
    finally:
        stop.set()
        thread.join()
    writer.close()
    writer.close()


def test_rig_load_at_rest_is_what_it_would_be_worked_out_anew() -> None:
    world, pose, kept_n = World(), BladePose(), 0
    world.lay(scene_heights(SceneZone.LEFT, world.vehicle.x_m, pose, seed=3))
    for number in range(1500):
        if 200 <= number < 400:
            pose = replace(pose, angle_deg=pose.angle_deg + 0.12)
        elif 600 <= number < 700:
            pose = replace(pose, height_m=pose.height_m + 1e-4)
        elif number == 900:
            world.vehicle.drive(0.5, 0.5)
        load, angle_deg = world.load, world.blade.angle_deg
        world.step(0.01, pose)
        kept_n += world.load is load
        turn = math.radians(pose.angle_deg - angle_deg) / 0.01
        assert world.load == blade_load(world.field, world.vehicle.x_m, pose, world.vehicle.speed_m_per_s, turn)
    assert kept_n > 500, "worked out only while something moves"
