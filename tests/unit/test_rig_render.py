"""The rig's pictures: geometry against pencil and paper, left and right, noise, repeatability."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from graderd.hal.camera import Intrinsics, StreamPose
from graderd.simulator.camera import renderer as rendering
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import GroundMap, SceneState, ground_map
from graderd.simulator.camera.materials import Materials, materials_of
from graderd.simulator.camera.optics import (
    COLOR_INTRINSICS,
    COLOR_POSE,
    DEPTH_INTRINSICS,
    DEPTH_POSE,
    MAX_DEPTH_M,
    MIN_DEPTH_M,
    camera_json,
    knocked,
)
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.camera.shapes import Solid
from graderd.simulator.camera.surface import Rays, SurfaceSweep
from graderd.simulator.grader.blade import BladePose, Plough
from graderd.simulator.grader.piles import SceneZone, lay_scene
from graderd.simulator.grader.soil import SoilField

COLOR_SIZE, DEPTH_SIZE = (320, 200), (424, 240)


@pytest.fixture(scope="module")
def materials() -> Materials:
    return materials_of(0)


def state_of(field: SoilField, x_m: float = 3.0, blade: BladePose | None = None, *props: Solid) -> SceneState:
    return SceneState(field.heights_m.astype(np.float32), field.cell_m, x_m, blade or BladePose(), props)


def points_m(depth_m: npt.NDArray[np.float32], lens: Intrinsics, pose: StreamPose) -> npt.NDArray[np.float64]:
    """Vehicle-frame points of a depth picture, ``(height, width, 3)``: written out here, apart from the renderer."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    optical = np.stack(((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)), axis=-1)
    return np.asarray((optical * depth_m[..., None]) @ np.array(pose.rotation).T + np.array(pose.position_m))


def test_rig_ranges_of_planes_are_exact() -> None:
    lens = DEPTH_INTRINSICS.scaled(*DEPTH_SIZE)
    rays = Rays.of(lens, DEPTH_POSE)
    sweep = SurfaceSweep(rays)
    for level_m in (0.0, 0.1, 0.25):
        heights = np.full((340, 240), level_m, np.float32)
        ranges = sweep.ranges_m(heights, -2.3, -1.2, 0.01)
        exact = (DEPTH_POSE.position_m[2] - level_m) / -rays.slope
        x = DEPTH_POSE.position_m[0] - ranges * np.cos(rays.azimuth_rad)
        y = DEPTH_POSE.position_m[1] + ranges * np.sin(rays.azimuth_rad)
        inside = (x > -1.4) & (x < 0.9) & (np.abs(y) < 1.1)
        assert inside.mean() > 0.5
        assert np.abs(ranges - exact)[inside].max() < 4e-4


def test_rig_ranges_of_an_inclined_plane_are_right_within_a_millimetre() -> None:
    lens = DEPTH_INTRINSICS.scaled(*DEPTH_SIZE)
    rays = Rays.of(lens, DEPTH_POSE)
    x = (-2.3 + np.arange(340) * 0.01)[:, None]
    y = (-1.2 + np.arange(240) * 0.01)[None, :]
    heights = np.maximum(0.0, 0.12 - 0.3 * x + 0.1 * y).astype(np.float32)
    ranges = SurfaceSweep(rays).ranges_m(heights, -2.3, -1.2, 0.01)
    hit_x = DEPTH_POSE.position_m[0] - ranges * np.cos(rays.azimuth_rad)
    hit_y = DEPTH_POSE.position_m[1] + ranges * np.sin(rays.azimuth_rad)
    hit_z = DEPTH_POSE.position_m[2] + ranges * rays.slope
    wanted = 0.12 - 0.3 * hit_x + 0.1 * hit_y
    inside = (hit_x > -0.4) & (hit_x < 0.25) & (np.abs(hit_y) < 0.6) & (wanted > 0.02)
    assert inside.mean() > 0.2
    assert np.abs(hit_z - wanted)[inside].max() < 1e-3


def test_rig_depth_of_bare_floor_and_blade(materials: Materials) -> None:
    """Every point seen lies on the floor, on the bed's sides, or on the hollow face of the blade."""
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
    angle_deg = 20.0
    lens = renderer.depth_intrinsics
    assert lens is not None
    points = points_m(
        renderer.render_depth_m(state_of(SoilField(), 3.0, BladePose(angle_deg)), Appearance()), lens, DEPTH_POSE
    )
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    angle = math.radians(angle_deg)
    s, d = -x * math.sin(angle) + y * math.cos(angle), x * math.cos(angle) + y * math.sin(angle)
    floor = (np.abs(z) < 0.001) & (np.abs(y) < 1.0)
    hollow = 0.2165 - np.sqrt(np.maximum(0.0625 - (z - 0.127) ** 2, 0.0))
    blade = (np.abs(d - hollow) < 0.001) & (np.abs(s) < 0.502) & (z > 0.0) & (z < 0.254)
    lower = np.zeros(x.shape, bool)
    lower[110:] = True  # machine parts stand above that row
    assert (floor | blade | (np.abs(np.abs(y) - 1.0) < 0.001))[lower].mean() > 0.99
    assert blade.mean() > 0.1
    assert floor.mean() > 0.3
    # both ends of the blade are in the picture
    assert s[blade].min() < -0.49
    assert s[blade].max() > 0.49


@pytest.mark.parametrize(("zone", "side"), [(SceneZone.LEFT, 1), (SceneZone.RIGHT, -1)])
def test_rig_the_operators_left_is_on_image_right(materials: Materials, zone: SceneZone, side: int) -> None:
    field = SoilField()
    lay_scene(field, zone, 3.0, BladePose())
    bare, heaped = SoilField(), field
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
    depth = {name: renderer.render_depth_m(state_of(f), Appearance()) for name, f in (("bare", bare), ("heap", heaped))}
    nearer = (depth["bare"] - depth["heap"]) > 0.02
    columns = np.nonzero(nearer)[1] - DEPTH_SIZE[0] / 2
    assert nearer.mean() > 0.03
    assert columns.mean() * side > 60
    color, _ = Renderer(COLOR_SIZE, None, materials=materials).render(state_of(heaped), Appearance(color_noise=0.0))
    empty, _ = Renderer(COLOR_SIZE, None, materials=materials).render(state_of(bare), Appearance(color_noise=0.0))
    changed = np.abs(color.astype(int) - empty).max(axis=2) > 40
    assert (np.nonzero(changed)[1].mean() - COLOR_SIZE[0] / 2) * side > 40


def test_rig_counter_clockwise_takes_the_left_end_back(materials: Materials) -> None:
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
    lens = renderer.depth_intrinsics
    assert lens is not None
    points = points_m(
        renderer.render_depth_m(state_of(SoilField(), 3.0, BladePose(30.0)), Appearance()), lens, DEPTH_POSE
    )
    on_blade = (points[..., 2] > 0.05) & (points[..., 2] < 0.2) & (np.abs(points[..., 1]) < 0.5)
    left = on_blade & (points[..., 1] > 0.3) & (points[..., 0] > -0.6)
    right = on_blade & (points[..., 1] < -0.3)
    assert points[left][:, 0].mean() < -0.1
    assert points[right][:, 0].mean() > 0.1


def test_rig_measured_depth_has_the_noise_holes_and_limits_of_the_camera(materials: Materials) -> None:
    renderer = Renderer(COLOR_SIZE, (848, 480), materials=materials)
    field = SoilField()
    lay_scene(field, SceneZone.CENTER, 3.0, BladePose())
    Plough(field).settle(3.0, BladePose())
    state = state_of(field)
    true_mm = renderer.render_depth_m(state, Appearance()) * 1000.0
    frames = [renderer.render(state, Appearance())[1] for _ in range(6)]
    stack = np.stack([frame for frame in frames if frame is not None]).astype(np.float64)
    assert frames[0] is not None
    assert frames[0].dtype == np.uint16
    band = (true_mm > 900) & (true_mm < 1100)
    errors = (stack - true_mm)[:, band][stack[:, band] > 0]
    # 0.12 px of disparity: z^2 * 0.12 / (f * baseline) = 3.0 mm at 1 m
    assert 2.4 < errors.std() < 3.6
    assert abs(errors.mean()) < 0.3
    reachable = (true_mm > 380) & (true_mm < 1650)
    holes = (stack[:, reachable] == 0).mean()
    assert 0.03 < holes < 0.10
    assert (stack[:, true_mm < (MIN_DEPTH_M - 0.01) * 1000] == 0).all()
    assert (stack[:, true_mm > (MAX_DEPTH_M + 0.05) * 1000] == 0).all()
    assert (stack[0] != stack[1]).mean() > 0.3


def test_rig_depth_is_lost_at_edges(materials: Materials) -> None:
    renderer = Renderer(COLOR_SIZE, (848, 480), materials=materials)
    wall = Solid("box", (0.30, 0.0, 0.15), (0.01, 0.05, 0.15), (80, 80, 80))
    state = state_of(SoilField(), 3.0, BladePose(), wall)
    true_m = renderer.render_depth_m(state, Appearance())
    _, depth = renderer.render(state, Appearance(hole_share=0.0))
    assert depth is not None
    jump = np.abs(np.diff(true_m, axis=1)) > 0.15
    jump &= (true_m[:, 1:] < MAX_DEPTH_M) & (true_m[:, :-1] < MAX_DEPTH_M)
    assert jump.sum() > 50
    assert (depth[:, 1:][jump] == 0).mean() > 0.9


def test_rig_pictures_repeat_by_seed(materials: Materials) -> None:
    field = SoilField()
    lay_scene(field, SceneZone.LEFT, 3.0, BladePose(), seed=4)

    def film(seed: int) -> list[npt.NDArray[np.uint8]]:
        renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, seed=seed, materials=Materials(seed))
        pictures: list[npt.NDArray[np.uint8]] = []
        for _ in range(2):
            color, depth = renderer.render(state_of(field), Appearance())
            assert depth is not None
            pictures += [color, depth.view(np.uint8)]
        return pictures

    first, again, other = film(5), film(5), film(6)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_rig_color_is_a_whole_picture_under_any_look(materials: Materials) -> None:
    field = SoilField()
    lay_scene(field, SceneZone.EVEN, 3.0, BladePose())
    renderer = Renderer(COLOR_SIZE, None, materials=materials)
    plain, depth = renderer.render(state_of(field), Appearance())
    assert depth is None
    assert plain.shape == (200, 320, 3)
    assert plain.dtype == np.uint8
    looks = {
        "dark": Appearance(exposure=0.3),
        "red": Appearance(red_cast=0.3),
        "wet": Appearance(wetness=1.0),
        "sand": Appearance(soil="sand"),
        "rusty": Appearance(blade="rusty"),
        "painted": Appearance(blade="painted"),
        "concrete": Appearance(ground="concrete"),
        "low sun": Appearance(sun_azimuth_deg=-90.0, sun_elevation_deg=10.0),
        "shadow": Appearance(machine_shadow=0.7),
        "night": Appearance(sun_strength=0.0, ambient=0.1),
    }
    pictures = {name: renderer.render(state_of(field), appearance)[0] for name, appearance in looks.items()}
    for name, picture in pictures.items():
        assert np.abs(picture.astype(int) - plain).mean() > 1.0, name
    assert pictures["dark"].mean() < 0.5 * plain.mean()
    assert pictures["wet"].mean() < plain.mean()
    blue, _, red = (pictures["red"][..., channel].mean() / plain[..., channel].mean() for channel in range(3))
    assert red > 1.1 * blue
    left_half, right_half = pictures["shadow"][:, 160:].mean(), pictures["shadow"][:, :160].mean()
    assert left_half < right_half  # the machine's shadow falls from its left, which is image right


def test_rig_soil_texture_stays_on_the_ground(materials: Materials) -> None:
    """Driving moves the picture of the ground, not the pattern on it."""
    field = SoilField()
    field.heights_m += 0.05
    renderer = Renderer((640, 400), None, materials=materials)
    still = Appearance(color_noise=0.0, shadows=False, ambient=0.8, sun_strength=0.4)
    near, far = (renderer.render(state_of(field, x_m), still)[0].astype(np.float32).mean(axis=2) for x_m in (3.0, 3.1))
    rays = Rays.of(COLOR_INTRINSICS.scaled(640, 400), COLOR_POSE)
    depth = (COLOR_POSE.position_m[2] - 0.05) / -rays.dz
    seen, moved = [], []
    for row, column in [(r, c) for r in range(250, 380, 13) for c in range(120, 520, 17)]:
        x = COLOR_POSE.position_m[0] + depth[row, column] * rays.dx[row, column] - 0.1
        y = COLOR_POSE.position_m[1] + depth[row, column] * rays.dy[row, column]
        local = np.array(COLOR_POSE.rotation).T @ (np.array([x, y, 0.05]) - np.array(COLOR_POSE.position_m))
        lens = COLOR_INTRINSICS.scaled(640, 400)
        u, v = lens.fx * local[0] / local[2] + lens.cx, lens.fy * local[1] / local[2] + lens.cy
        if 2 <= u < 637 and 2 <= v < 397:
            seen.append(near[row, column])
            moved.append(far[round(v), round(u)])
    assert len(seen) > 50
    assert np.corrcoef(seen, moved)[0, 1] > 0.6


def test_rig_an_unchanged_scene_is_looked_at_once_and_has_new_noise(
    materials: Materials, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[SceneState] = []

    def look(state: SceneState, appearance: Appearance, textures: Materials) -> GroundMap:
        looked.append(state)
        return ground_map(state, appearance, textures)

    monkeypatch.setattr(rendering, "ground_map", look)
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
    field, light = SoilField(), Appearance(ground="earth")
    heights = field.heights_m.astype(np.float32)
    first, again = (renderer.render(SceneState(heights, field.cell_m, 3.0, BladePose()), light) for _ in range(2))
    assert len(looked) == 1
    assert first[1] is not None
    assert again[1] is not None
    assert (first[0] != again[0]).mean() > 0.3
    assert (first[1] != again[1]).mean() > 0.3
    heights[300:310] += 0.05  # by whoever made the state, in place
    box = Solid("box", (0.3, 0.0, 0.1), (0.05, 0.05, 0.05), (0, 0, 255))
    for number, (x_m, blade, props, shone) in enumerate(
        (
            (3.0, BladePose(), (), light),
            (3.01, BladePose(), (), light),
            (3.01, BladePose(0.1), (), light),
            (3.01, BladePose(0.1), (box,), light),
            (3.01, BladePose(0.1), (box,), Appearance(exposure=2.0)),
        ),
        start=2,
    ):
        color, depth = renderer.render(SceneState(heights, field.cell_m, x_m, blade, props), shone)
        assert len(looked) == number
        afresh = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
        for _ in range(number):
            afresh.render(SceneState(heights, field.cell_m, 1.0, blade), light)  # as many draws of noise
        true_color, true_depth = afresh.render(SceneState(heights, field.cell_m, x_m, blade, props), shone)
        assert np.array_equal(color, true_color)
        assert depth is not None
        assert true_depth is not None
        assert np.array_equal(depth, true_depth)
        del looked[number:]


@pytest.mark.parametrize("height_m", [0.0, 0.3, 0.54, 0.56, 1.5])
def test_rig_pictures_of_any_bed_are_whole(materials: Materials, height_m: float) -> None:
    """Even one so full that the camera is buried; at either end of the bed, at any angle."""
    field = SoilField()
    field.heights_m += height_m
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
    for x_m, angle_deg, lift_m in ((0.0, 90.0, 0.0), (0.8, -60.0, 0.195), (7.0, 45.0, -0.1), (8.0, 180.0, 0.0)):
        state = state_of(field, x_m, BladePose(angle_deg, lift_m, 5.0, 15.0))
        color, depth = renderer.render(state, Appearance())
        assert color.shape == (200, 320, 3)
        assert depth is not None
        assert depth.shape == (240, 424)
        assert np.isfinite(renderer.render_depth_m(state, Appearance())).all()


def test_rig_a_knock_moves_the_picture(materials: Materials) -> None:
    color_pose, depth_pose = knocked((0.02, 0.03, 0.0), (4.0, -3.0, 2.0))
    straight = Renderer(COLOR_SIZE, DEPTH_SIZE, materials=materials)
    bent = Renderer(COLOR_SIZE, DEPTH_SIZE, color_pose=color_pose, depth_pose=depth_pose, materials=materials)
    state = state_of(SoilField())
    assert np.abs(straight.render_depth_m(state, Appearance()) - bent.render_depth_m(state, Appearance())).mean() > 0.02
    rotation = np.array(color_pose.rotation)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    offset = np.array(depth_pose.position_m) - np.array(color_pose.position_m)
    assert np.linalg.norm(offset) == pytest.approx(0.059, abs=1e-9)  # one housing
    unmoved_color, unmoved_depth = knocked((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert np.allclose(unmoved_color.position_m, COLOR_POSE.position_m)
    assert np.allclose(unmoved_depth.position_m, DEPTH_POSE.position_m)


def test_rig_camera_data_are_those_of_a_d455() -> None:
    data = camera_json(COLOR_INTRINSICS, DEPTH_INTRINSICS)
    color, depth = data["color"], data["depth"]
    horizontal = 2 * math.degrees(math.atan(color["width"] / 2 / color["fx"]))
    vertical = 2 * math.degrees(math.atan(color["height"] / 2 / color["fy"]))
    assert horizontal == pytest.approx(90.0, abs=1.5)
    assert vertical == pytest.approx(65.0, abs=1.0)
    assert 2 * math.degrees(math.atan(depth["width"] / 2 / depth["fx"])) == pytest.approx(89.5, abs=2.5)
    assert data["depth_to_color"]["translation_m"] == pytest.approx([-0.059, 0.0, 0.0])
    rotation = np.array(color["rotation_vehicle_from_optical"])
    assert rotation[1, 0] == 1.0  # image right is vehicle +y
    assert math.degrees(math.asin(-rotation[2, 2])) == pytest.approx(35.0)
