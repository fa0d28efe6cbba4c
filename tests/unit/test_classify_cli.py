"""``graderd classify`` on pictures, folders, frame sets and recordings."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from graderd.cli.app import run_app
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.perception import METHODS, CameraCalibration
from graderd.perception.frame_set import Entry, FrameSetWriter
from graderd.perception.settings import StreamCalibration
from harness.perception_scenes import Scene, height_field, render, volumes_l
from harness.realsense_devices import SoftD455, record

pytestmark = pytest.mark.xdist_group("classify cli")  # one set of pictures for all

FIELDS = [
    "id",
    "zone",
    "confidence",
    "share_left",
    "share_center",
    "share_right",
    "volume_left_l",
    "volume_center_l",
    "volume_right_l",
    "cpu_ms",
    "reason",
]
COLOR, DEPTH = (480, 300), (424, 240)
Captured = pytest.CaptureFixture[str]


def objects(text: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture(scope="module")
def frame_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    full = CameraCalibration()
    streams = {
        name: StreamCalibration.from_pose(
            getattr(full, name).intrinsics().scaled(*size), getattr(full, name).pose(full.mounting), full.mounting
        )
        for name, size in (("color", COLOR), ("depth", DEPTH))
    }
    folder = tmp_path_factory.mktemp("frames") / "set"
    writer = FrameSetWriter(folder, full.model_copy(update=streams), BladeGeometry(), ("ambiguous",))
    for number, zone in enumerate([Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE]):
        scene = Scene(zone=zone, angle_deg=10.0 * number - 20, seed=number)
        left, center, right = volumes_l(scene, height_field(scene))
        entry = Entry(f"{number:03d}", zone, scene.angle_deg, left, center, right, extra={"ambiguous": "false"})
        writer.add(entry, render(scene, color_size=COLOR, depth_size=DEPTH))
    return folder


@pytest.mark.parametrize("method", METHODS)
def test_frame_set_as_json(frame_set: Path, method: str, capsys: Captured) -> None:
    assert run_app(["classify", str(frame_set), "--method", method, "--json"]) == 0
    *frames, last = objects(capsys.readouterr().out)
    assert [frame["zone"] for frame in frames] == ["left", "center", "right", "even", "none"]
    assert all(list(frame) == FIELDS for frame in frames)
    summary = last["summary"]
    assert isinstance(summary, dict)
    assert summary["accuracy"] == 1.0
    assert summary["answered_share"] == 1.0
    assert summary["confusion"]["left"]["left"] == 1
    assert summary["cpu_ms_median"] <= summary["cpu_ms_p99"]


def test_fused_is_the_default_where_there_is_depth(frame_set: Path, capsys: Captured) -> None:
    assert run_app(["classify", str(frame_set), "--json"]) == 0
    assert objects(capsys.readouterr().out)[0]["volume_left_l"] is not None


def test_text_for_people(frame_set: Path, capsys: Captured) -> None:
    assert run_app(["classify", str(frame_set)]) == 0
    text = capsys.readouterr().out
    assert "000  left" in text
    assert "right 100.0 % of the answers" in text


def test_labels_may_be_missing(frame_set: Path, tmp_path: Path, capsys: Captured) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    for path in frame_set.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "manifest.csv").write_text("id,label,blade_angle_deg,vol_left_l,vol_center_l,vol_right_l\n000,,-20,,,\n")
    assert run_app(["classify", str(folder), "--json"]) == 0
    (frame,) = objects(capsys.readouterr().out)
    assert frame["zone"] == "left"


def soil_photo(path: Path) -> Path:
    """Something like a photograph: grey gravel with a brown heap at the picture's right."""
    rng = np.random.default_rng(1)
    picture = np.clip(rng.normal(120, 25, (240, 360, 1)) + rng.normal(0, 3, (240, 360, 3)) + (12, 4, 0), 0, 255)
    heap = np.zeros((240, 360), dtype=np.uint8)
    cv2.circle(heap, (290, 170), 60, 1, -1)
    brown = np.clip(rng.normal(1.0, 0.2, (240, 360, 1)) * (45, 75, 110), 0, 255)
    cv2.imwrite(str(path), np.where(heap[..., None] > 0, brown, picture).astype(np.uint8))
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("method", ["paper", "fast_color"])
def test_any_photograph(tmp_path: Path, suffix: str, method: str, capsys: Captured) -> None:
    photo = soil_photo(tmp_path / f"soil.{suffix}")
    assert run_app(["classify", str(photo), "--method", method, "--json"]) == 0
    (answer,) = objects(capsys.readouterr().out)
    assert answer["id"] == photo.name
    assert answer["zone"] == "left"
    assert "thirds of the whole picture" in str(answer["reason"])
    mounting = ["--mounting", "facing_blade_from_behind"]
    assert run_app(["classify", str(photo), "--method", method, *mounting, "--json"]) == 0
    assert objects(capsys.readouterr().out)[0]["zone"] == "right"


def test_a_configuration_brings_its_calibration(tmp_path: Path, capsys: Captured) -> None:
    frame = render(Scene(zone=Zone.RIGHT, angle_deg=20.0, seed=3), color_size=COLOR, depth_size=(53, 30))
    cv2.imwrite(str(tmp_path / "a.png"), frame.color_bgr)
    (tmp_path / "g.toml").write_text('[perception]\nmethod = "paper"\n')
    arguments = ["classify", str(tmp_path / "a.png"), "--config", str(tmp_path / "g.toml"), "--blade-angle-deg", "20"]
    assert run_app([*arguments, "--json"]) == 0
    (answer,) = objects(capsys.readouterr().out)
    assert answer["zone"] == "right"
    assert "whole picture" not in str(answer["reason"])


def test_annotated_pictures_are_saved(frame_set: Path, tmp_path: Path, capsys: Captured) -> None:
    target = tmp_path / "new" / "annotated"
    assert run_app(["classify", str(frame_set), "--save", str(target)]) == 0
    capsys.readouterr()
    names = sorted(path.name for path in target.iterdir())
    assert names == [f"{number:03d}.annotated.jpg" for number in range(5)]
    picture = cv2.imread(str(target / names[0]))
    assert picture is not None
    assert picture.shape == (*COLOR[::-1], 3)


def test_a_recording(tmp_path: Path, capsys: Captured) -> None:
    frame = render(Scene(zone=Zone.LEFT, seed=2), color_size=(320, 200), depth_size=(212, 120))
    rng = np.random.default_rng(1)
    taken = [
        (np.clip(frame.color_bgr + rng.normal(0, 1, frame.color_bgr.shape), 0, 255).astype(np.uint8), frame.depth_mm)
        for _ in range(3)
    ]
    record(tmp_path / "pass.db3", taken, SoftD455())
    assert run_app(["classify", str(tmp_path / "pass.db3"), "--json"]) == 0
    answers = objects(capsys.readouterr().out)
    assert [answer["zone"] for answer in answers] == ["left"] * 3
    assert answers[0]["id"] == "pass#1"


def test_a_damaged_picture_among_good_ones(tmp_path: Path, capsys: Captured) -> None:
    soil_photo(tmp_path / "a.jpg")
    (tmp_path / "b.jpg").write_bytes(b"\xff\xd8\xff no picture")
    soil_photo(tmp_path / "c.jpg")
    assert run_app(["classify", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert "a.jpg  left" in said.out
    assert "c.jpg  left" in said.out
    assert "b.jpg: not a readable picture" in said.err
    assert said.err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("none.jpg", None, "no such file or folder"),
        ("soil.doc", b"x", ".doc is no picture, video or recording"),
        ("soil.png", b"x", "not a readable picture"),
        ("soil.db3", b"x" * 50, "not a readable RealSense recording"),
        ("soil.bag", b"", "the file is empty"),
        ("soil.mp4", b"x", "not a readable video"),
    ],
)
def test_bad_sources_are_one_line_and_status_2(
    tmp_path: Path, name: str, content: bytes | None, complaint: str, capsys: Captured
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert run_app(["classify", str(tmp_path / name)]) == 2
    said = capsys.readouterr()
    assert complaint in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_depth_method_without_depth(tmp_path: Path, capsys: Captured) -> None:
    photo = soil_photo(tmp_path / "a.jpg")
    assert run_app(["classify", str(photo), "--method", "depth"]) == 2
    assert "--method depth needs depth" in capsys.readouterr().err


def test_unknown_method_and_bad_configuration(tmp_path: Path, capsys: Captured) -> None:
    photo = soil_photo(tmp_path / "a.jpg")
    assert run_app(["classify", str(photo), "--method", "guess"]) == 2
    (tmp_path / "g.toml").write_text("[percepton]\n")
    assert run_app(["classify", str(photo), "--config", str(tmp_path / "g.toml")]) == 2
    assert "perception" in capsys.readouterr().err  # the nearest right key
    assert run_app(["classify", str(photo), "--save", str(photo)]) == 2


def test_help_has_an_example(capsys: Captured) -> None:
    assert run_app(["classify", "--help"]) == 0
    assert "graderd classify soil.jpg" in capsys.readouterr().out
