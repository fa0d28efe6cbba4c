"""Frame sets: what is written is read again, and what is wrong is named with file and line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import EndOfFrames, Frame
from graderd.hal.errors import DeviceError, LifecycleError
from graderd.hal.settings import CameraSettings
from graderd.perception import CameraCalibration
from graderd.perception.frame_set import Entry, FrameSet, FrameSetCamera, FrameSetWriter, is_frame_set
from graderd.perception.settings import StreamCalibration

HEAD = "id,label,blade_angle_deg,vol_left_l,vol_center_l,vol_right_l"


def small() -> CameraCalibration:
    full = CameraCalibration()

    def shrunk(stream: StreamCalibration, width: int, height: int) -> StreamCalibration:
        pose = stream.pose(full.mounting)
        return StreamCalibration.from_pose(stream.intrinsics().scaled(width, height), pose, full.mounting)

    return full.model_copy(update={"color": shrunk(full.color, 64, 40), "depth": shrunk(full.depth, 53, 30)})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    writer = FrameSetWriter(tmp_path / "set", small(), BladeGeometry(length_m=1.02), ("ambiguous", "soil"))
    for number, label in enumerate((Zone.LEFT, None), start=1):
        color = rng.integers(0, 255, (40, 64, 3), dtype=np.uint8)
        depth = rng.integers(0, 1700, (30, 53), dtype=np.uint16)
        entry = Entry(
            f"{number:03d}", label, 12.5, 4.5 if label else None, 1.0, 0.0, extra={"ambiguous": "true", "soil": "a,b"}
        )
        writer.add(entry, Frame(color, depth, None, None, 0.0))
    return tmp_path / "set"


def test_round_trip(folder: Path) -> None:
    frames = FrameSet(folder)
    assert is_frame_set(folder)
    assert [entry.id for entry in frames.entries] == ["001", "002"]
    first, second = frames.entries
    assert first.label is Zone.LEFT
    assert second.label is None
    assert first.vol_left_l == 4.5
    assert second.vol_left_l is None
    assert first.extra == {"ambiguous": "true", "soil": "a,b"}
    assert frames.blade.length_m == 1.02
    assert frames.calibration.mounting == "facing_blade_from_front"
    assert frames.calibration.color.pitch_down_deg == pytest.approx(35.0)
    color = np.random.default_rng(1).integers(0, 255, (40, 64, 3), dtype=np.uint8)
    frame = frames.frame(first, 3)
    assert np.array_equal(frame.color_bgr, color)
    assert frame.depth_mm is not None
    assert frame.depth_mm.dtype == np.uint16
    assert frame.metadata["blade_angle_deg"] == 12.5


def test_colour_only(folder: Path) -> None:
    camera = json.loads((folder / "camera.json").read_text())
    del camera["depth"]
    (folder / "camera.json").write_text(json.dumps(camera))
    for path in folder.glob("*.depth.png"):
        path.unlink()
    frames = FrameSet(folder)
    assert not frames.has_depth
    assert frames.frame(frames.entries[0]).depth_mm is None


def manifest(folder: Path, *lines: str) -> None:
    (folder / "manifest.csv").write_text("\n".join((HEAD, *lines)) + "\n")


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("001,leftish,0,,,", "manifest.csv:3: label 'leftish'"),
        ("001,left,fast,,,", "manifest.csv:3: blade_angle_deg is 'fast', not a number"),
        ("001,left,,,,", "manifest.csv:3: blade_angle_deg is empty"),
        ("001,left,nan,,,", "manifest.csv:3: blade_angle_deg is nan, not a finite number"),
        ("001,left,0,,", "manifest.csv:3: has another number of columns"),
        ("001,left,0,,,,,", "manifest.csv:3: has another number of columns"),
        ("002,left,0,,,", "manifest.csv:3: id 002 is there twice"),
        ("../x,left,0,,,", "manifest.csv:3: id '../x'"),
    ],
)
def test_a_wrong_line_is_named(folder: Path, line: str, complaint: str) -> None:
    manifest(folder, "002,left,0,,,", line)
    with pytest.raises(DeviceError) as caught:
        FrameSet(folder)
    assert complaint in str(caught.value)


def test_other_wrongs_of_the_manifest(folder: Path) -> None:
    manifest(folder)
    with pytest.raises(DeviceError, match="lists no frames"):
        FrameSet(folder)
    (folder / "manifest.csv").write_text("name,label\n1,left\n")
    with pytest.raises(DeviceError, match=r"manifest.csv:1: column id, blade_angle_deg is missing"):
        FrameSet(folder)
    (folder / "manifest.csv").unlink()
    with pytest.raises(DeviceError, match=r"manifest.csv: cannot be read"):
        FrameSet(folder)
    with pytest.raises(DeviceError, match="no such folder"):
        FrameSet(folder / "elsewhere")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"fx": "wide"}, "camera.json color: not as documented"),
        ({"position_m": [0.1, 0.2]}, "camera.json color: not as documented"),
        ({"rotation_vehicle_from_optical": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "not a rotation matrix"),
        ({"rotation_vehicle_from_optical": [[0, 1, 0], [1, 0, 0], [0, 0, 1]]}, "not a rotation matrix"),
        ({"rotation_vehicle_from_optical": [[1, 0], [0, 1]]}, "rotation"),
        ({"scale_m": 0.0001}, "scale_m is not 0.001"),
        ({"width": 65}, r"001.color.*: is 64x40, camera.json says 65x40"),
    ],
)
def test_wrong_camera_data(folder: Path, change: dict[str, object], complaint: str) -> None:
    camera = json.loads((folder / "camera.json").read_text())
    camera["color"].update(change)
    (folder / "camera.json").write_text(json.dumps(camera))
    with pytest.raises(DeviceError) as caught:
        next(FrameSet(folder).frames())
    assert complaint in str(caught.value)


def test_camera_data_that_are_no_json(folder: Path) -> None:
    (folder / "camera.json").write_text('{"color": \n oops}')
    with pytest.raises(DeviceError, match=r"camera.json:2: not JSON"):
        FrameSet(folder)
    (folder / "camera.json").write_text("[]")
    with pytest.raises(DeviceError, match="the block 'color' is missing"):
        FrameSet(folder)


def test_wrong_pictures(folder: Path) -> None:
    frames = FrameSet(folder)
    cv2.imwrite(str(folder / "001.depth.png"), np.zeros((30, 53), dtype=np.uint8))
    with pytest.raises(DeviceError, match=r"001.depth.png: not a 16-bit grey PNG"):
        frames.frame(frames.entries[0])
    (folder / "001.depth.png").unlink()
    with pytest.raises(DeviceError, match=r"001.depth.png: .*is not there"):
        frames.frame(frames.entries[0])
    (folder / "002.color.png").write_bytes(b"no picture")
    with pytest.raises(DeviceError, match=r"002.color.png: not a readable picture"):
        frames.frame(frames.entries[1])
    (folder / "002.color.png").unlink()
    with pytest.raises(DeviceError, match=r"002.color.png: named in manifest.csv, but not there"):
        frames.frame(frames.entries[1])


def test_as_a_camera(folder: Path) -> None:
    camera = FrameSetCamera(CameraSettings(source="frame_set", path=str(folder)), real_time=False)
    with pytest.raises(LifecycleError):
        camera.read(0.1)
    camera.open()
    assert [camera.read(0.1).name for _ in range(2)] == ["001", "002"]
    assert camera.entry is not None
    assert camera.entry.id == "002"
    with pytest.raises(EndOfFrames):
        camera.read(0.1)
    camera.close()
    again = FrameSetCamera(CameraSettings(source="frame_set", path=str(folder), repeat=True), real_time=False)
    again.open()
    assert [again.read(0.1).name for _ in range(5)] == ["001", "002", "001", "002", "001"]
