"""Folders of pictures and videos as cameras."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from graderd.drivers.realsense import FolderCamera, VideoCamera
from graderd.hal.camera import EndOfFrames
from graderd.hal.errors import DeviceMissingError, LifecycleError, ProtocolError
from graderd.hal.settings import CameraSettings


def folder_of(path: Path, **more: object) -> FolderCamera:
    return FolderCamera(CameraSettings.model_validate({"source": "folder", "path": str(path), **more}), real_time=False)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    for name, level in (("b.png", 20), ("a.jpg", 10), ("c.bmp", 30)):
        cv2.imwrite(str(tmp_path / name), np.full((20, 30, 3), level, dtype=np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    return tmp_path


def test_pictures_come_in_the_order_of_their_names(pictures: Path) -> None:
    camera = folder_of(pictures)
    camera.open()
    frames = [camera.read(1.0) for _ in range(3)]
    assert [frame.name for frame in frames] == ["a.jpg", "b.png", "c.bmp"]
    assert [frame.color_number for frame in frames] == [1, 2, 3]
    assert frames[0].depth_mm is None
    assert frames[0].color_intrinsics is None
    with pytest.raises(EndOfFrames):
        camera.read(1.0)
    camera.close()
    with pytest.raises(LifecycleError):
        camera.read(1.0)


def test_a_folder_can_repeat(pictures: Path) -> None:
    camera = folder_of(pictures, repeat=True)
    camera.open()
    assert [camera.read(1.0).name for _ in range(4)][-1] == "a.jpg"


def test_one_picture(pictures: Path) -> None:
    camera = folder_of(pictures / "b.png")
    camera.open()
    assert camera.read(1.0).color_bgr[0, 0, 0] == 20
    with pytest.raises(EndOfFrames):
        camera.read(1.0)


@pytest.mark.parametrize("depth", [np.uint16, np.uint8])
def test_grey_and_deep_pictures_become_colour(tmp_path: Path, depth: type) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((9, 9), 100, dtype=depth))
    camera = folder_of(tmp_path)
    camera.open()
    frame = camera.read(1.0)
    assert frame.color_bgr.shape == (9, 9, 3)
    assert frame.color_bgr.dtype == np.uint8


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0 no picture"])
def test_a_damaged_picture_is_named_and_the_next_one_read(pictures: Path, content: bytes) -> None:
    (pictures / "aa.png").write_bytes(content)
    camera = folder_of(pictures)
    camera.open()
    assert camera.read(1.0).name == "a.jpg"
    with pytest.raises(ProtocolError, match=r"aa.png: not a readable picture"):
        camera.read(1.0)
    assert camera.read(1.0).name == "b.png"


def test_missing_and_empty_folders(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissingError, match="no such picture or folder"):
        folder_of(tmp_path / "nowhere").open()
    with pytest.raises(DeviceMissingError, match="holds no pictures"):
        folder_of(tmp_path).open()


def test_pace(pictures: Path) -> None:
    camera = FolderCamera(CameraSettings(source="folder", path=str(pictures), rate_hz=50.0, repeat=True))
    camera.open()
    start_s = time.monotonic()
    times = [camera.read(1.0).capture_s for _ in range(6)]
    assert times == sorted(times)
    assert time.monotonic() - start_s >= 0.09


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "pass.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for level in (10, 120, 240):
        writer.write(np.full((48, 64, 3), level, dtype=np.uint8))
    writer.release()
    return path


def test_video(video: Path) -> None:
    camera = VideoCamera(CameraSettings(source="video", path=str(video)), real_time=False)
    camera.open()
    frames = [camera.read(1.0) for _ in range(3)]
    assert [frame.name for frame in frames] == ["pass#1", "pass#2", "pass#3"]
    assert frames[1].color_bgr.mean() == pytest.approx(120, abs=4)
    with pytest.raises(EndOfFrames):
        camera.read(1.0)
    camera.close()


def test_what_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "x.mp4"
    for content in (None, b"junk" * 100):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(DeviceMissingError, match="video"):
            VideoCamera(CameraSettings(source="video", path=str(path))).open()
