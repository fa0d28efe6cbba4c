"""Generated frame sets: format, truth of the labels, variety, repeatability."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from graderd.perception.frame_set import FrameSet
from graderd.simulator import dataset
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.materials import materials_of
from graderd.simulator.camera.optics import COLOR_POSE, DEPTH_INTRINSICS, knocked
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import volumes_in_front_m3
from graderd.simulator.scenes import label_of, random_scene

# One set of pictures for all.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rig dataset")]

SCENES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set, written by the command line."""
    out = tmp_path_factory.mktemp("rig") / "set"
    assert dataset.main(["--out", str(out), "--scenes", str(SCENES), "--seed", "11", "--quiet"]) == 0
    return out


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "manifest.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_rig_set_has_the_documented_form(folder: Path) -> None:
    rows = rows_of(folder)
    assert list(rows[0])[:6] == ["id", "label", "blade_angle_deg", "vol_left_l", "vol_center_l", "vol_right_l"]
    assert [row["id"] for row in rows] == [f"{number:03d}" for number in range(SCENES)]
    for row in rows:
        color = cv2.imread(str(folder / f"{row['id']}.color.jpg"))
        depth = cv2.imread(str(folder / f"{row['id']}.depth.png"), cv2.IMREAD_UNCHANGED)
        assert color is not None
        assert depth is not None
        assert color.shape == (800, 1280, 3)
        assert (depth.shape, depth.dtype) == ((480, 848), np.dtype(np.uint16))
        assert (depth[depth > 0] >= 340).all()
        assert (depth[depth > 0] <= 1700).all()
        assert row["label"] in {"left", "center", "right", "even", "none"}
        assert row["ambiguous"] in {"true", "false"}
        assert all(abs(float(row[f"shift_{axis}_mm"])) <= 20.0 for axis in "xyz")
        assert all(abs(float(row[f"turn_{axis}_deg"])) <= 2.0 for axis in "xyz")
    camera = json.loads((folder / "camera.json").read_text())
    assert camera["color"]["position_m"] == list(COLOR_POSE.position_m)  # nominal, not the scenes' own
    assert camera["depth"]["scale_m"] == 0.001


def test_rig_set_is_read_by_the_perception_room(folder: Path) -> None:
    frame_set = FrameSet(folder)
    assert len(frame_set.entries) == SCENES
    assert frame_set.blade.length_m == 1.0
    frames = list(frame_set.frames())
    assert all(frame.depth_mm is not None for _, frame in frames)


def test_rig_labels_come_from_the_true_volumes(folder: Path) -> None:
    for number, row in enumerate(rows_of(folder)):
        scene = random_scene(11, number)
        left, center, right = volumes_in_front_m3(scene.field, scene.vehicle_x_m, scene.blade.angle_deg)
        assert float(row["vol_left_l"]) == pytest.approx(left * 1e3, abs=1e-3)
        assert float(row["vol_center_l"]) == pytest.approx(center * 1e3, abs=1e-3)
        assert float(row["vol_right_l"]) == pytest.approx(right * 1e3, abs=1e-3)
        assert row["label"] == label_of(scene.volumes_l)[0]
        assert abs(float(row["blade_angle_deg"]) - scene.blade.angle_deg) < 1.0


@pytest.mark.parametrize(
    ("volumes_l", "label", "ambiguous"),
    [
        ((0.0, 0.0, 0.0), "none", False),
        ((0.3, 0.3, 0.3), "none", True),
        ((8.0, 1.0, 0.0), "left", False),
        ((0.0, 8.0, 1.0), "center", False),
        ((0.5, 1.0, 9.0), "right", False),
        ((5.0, 5.0, 5.0), "even", False),
        ((7.0, 4.5, 3.5), "even", True),
        ((5.0, 4.9, 0.2), "left", True),
        ((1.0, 0.3, 0.2), "left", True),
        ((8.4, 4.0, 3.6), "left", True),
    ],
)
def test_rig_label_rule(volumes_l: tuple[float, float, float], label: str, ambiguous: bool) -> None:
    assert label_of(volumes_l) == (label, ambiguous)


def test_rig_scenes_vary_and_repeat() -> None:
    scenes = [random_scene(3, number) for number in range(60)]
    again = random_scene(3, 17)
    assert np.array_equal(again.field.heights_m, scenes[17].field.heights_m)
    assert again.appearance == scenes[17].appearance
    assert again.props == scenes[17].props
    assert not np.array_equal(random_scene(4, 17).field.heights_m, scenes[17].field.heights_m)
    labels = Counter(scene.label for scene in scenes)
    assert set(labels) == {"left", "center", "right", "even", "none"}
    assert min(labels.values()) >= 6
    assert sum(scene.ambiguous for scene in scenes) < 0.25 * len(scenes)
    assert len({scene.appearance.soil for scene in scenes}) == 6
    assert len({scene.appearance.blade for scene in scenes}) == 3
    assert len({scene.appearance.ground for scene in scenes}) == 3
    assert sum(scene.appearance.red_cast > 0.08 for scene in scenes) > 10
    assert sum(scene.appearance.machine_shadow > 0 for scene in scenes) > 8
    angles = [scene.blade.angle_deg for scene in scenes]
    assert min(angles) < -45
    assert max(angles) > 45
    occluders = "+".join(scene.occluders for scene in scenes)
    assert all(name in occluders for name in ("stones", "hose", "rod", "boot"))


def test_rig_set_depth_shows_the_volumes_it_is_labelled_with() -> None:
    """Re-measured from noise-free depth and the scene's true pose, by nothing that the renderer shares."""
    materials = materials_of(0)
    checked = 0
    for number in (0, 1, 2, 3):
        scene = random_scene(21, number)
        color_pose, depth_pose = knocked(scene.shift_m, scene.turn_deg)
        renderer = Renderer((320, 200), (848, 480), color_pose=color_pose, depth_pose=depth_pose, materials=materials)
        state = SceneState(scene.field.heights_m.astype(np.float32), scene.field.cell_m, scene.vehicle_x_m, scene.blade)
        depth = renderer.render_depth_m(state, scene.appearance)
        v, u = np.mgrid[0:480, 0:848].astype(np.float64)
        lens = DEPTH_INTRINSICS
        rays = np.stack(((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)), axis=-1)
        points = (rays * depth[..., None]) @ np.array(depth_pose.rotation).T + np.array(depth_pose.position_m)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        angle = np.deg2rad(scene.blade.angle_deg)
        s, d = -x * np.sin(angle) + y * np.cos(angle), x * np.cos(angle) + y * np.sin(angle)
        soil = (d > 0.02) & (d < 0.35) & (np.abs(s) < 0.5) & (z > 0.01) & (z < 0.35)
        cells = {(int(a), int(b)): c for a, b, c in zip(s[soil] // 0.01, d[soil] // 0.01, z[soil], strict=True)}
        seen = np.zeros(3)
        for (a, _), height in cells.items():
            along = (a + 0.5) * 0.01
            seen[0 if along > 1 / 6 else 2 if along < -1 / 6 else 1] += height * 0.1
        # the camera sees a heap's front and top, so somewhat less than all of it, and the fullest third first
        assert seen.sum() < 1.15 * sum(scene.volumes_l) + 0.3
        if scene.label in {"left", "center", "right"}:
            assert int(np.argmax(seen)) == int(np.argmax(scene.volumes_l))
            assert seen.sum() > 0.35 * sum(scene.volumes_l)
            checked += 1
    assert checked >= 2


@pytest.mark.live
def test_rig_set_is_not_overwritten_and_bad_arguments_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert dataset.main(["--out", str(folder), "--scenes", "1", "--quiet"]) == 1
    assert "holds a frame set already" in capsys.readouterr().err
    blocker = tmp_path / "file"
    blocker.write_text("")
    assert dataset.main(["--out", str(blocker / "set"), "--scenes", "1", "--quiet"]) == 1
    result = subprocess.run(
        [sys.executable, "-m", "graderd.simulator.dataset", "--out", str(tmp_path / "x"), "--scenes", "0"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 2
    assert "at least 1" in result.stderr


def test_rig_set_does_not_depend_on_how_many_processes_made_it(tmp_path: Path) -> None:
    for jobs in (1, 2):
        dataset.export(
            tmp_path / f"{jobs}", 3, 8, color_size=(320, 200), depth_size=(424, 240), jobs=jobs, progress=False
        )
    files = sorted(path.name for path in (tmp_path / "1").iterdir())
    assert len(files) == 8
    assert files == sorted(path.name for path in (tmp_path / "2").iterdir())
    for name in files:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes(), name


def test_rig_set_shows_its_progress(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset.export(tmp_path / "set", 1, 1, color_size=(320, 200), depth_size=(424, 240), color_format="png")
    assert "1/1 scenes" in capsys.readouterr().err
    assert (tmp_path / "set" / "000.color.png").is_file()
