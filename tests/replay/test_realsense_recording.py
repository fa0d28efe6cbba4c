"""A recording made by librealsense's own recorder, played through the ordinary pipeline."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.drivers.realsense import RecordingCamera
from graderd.hal.camera import EndOfFrames, Frame
from graderd.hal.errors import DeviceMissingError, DeviceTimeoutError, LifecycleError
from graderd.hal.settings import CameraSettings
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.classifier import make_classifier
from harness.perception_scenes import Scene, render
from harness.realsense_devices import Color, Depth, SoftD455, record

COUNT = 6
COLOR_SIZE, DEPTH_SIZE = (320, 200), (212, 120)


def pictures(count: int = COUNT) -> list[tuple[Color, Depth | None]]:
    rng = np.random.default_rng(3)
    taken: list[tuple[Color, Depth | None]] = []
    frame = render(Scene(zone=Zone.LEFT, seed=2), color_size=COLOR_SIZE, depth_size=DEPTH_SIZE)
    assert frame.depth_mm is not None
    for _ in range(count):
        color = np.clip(frame.color_bgr + rng.normal(0, 1, frame.color_bgr.shape), 0, 255).astype(np.uint8)
        depth = frame.depth_mm + (frame.depth_mm > 0) * rng.integers(0, 2, frame.depth_mm.shape).astype(np.uint16)
        taken.append((color, depth.astype(np.uint16)))
    return taken


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "pass.db3"
    record(path, pictures(), SoftD455(COLOR_SIZE, DEPTH_SIZE))
    return path


def camera_of(path: Path, real_time: bool = False, repeat: bool = False) -> RecordingCamera:
    return RecordingCamera(CameraSettings(source="recording", path=str(path), repeat=repeat), real_time)


def everything(camera: RecordingCamera) -> list[Frame]:
    frames: list[Frame] = []
    camera.open()
    try:
        while True:
            frames.append(camera.read(3.0))
    except EndOfFrames:
        return frames
    finally:
        camera.close()


def test_every_frame_bit_by_bit_in_its_order(recording: Path) -> None:
    frames = everything(camera_of(recording))
    assert [frame.color_number for frame in frames] == list(range(1, COUNT + 1))
    assert [frame.depth_number for frame in frames] == list(range(1, COUNT + 1))
    for frame, (color, depth) in zip(frames, pictures(), strict=True):
        assert np.array_equal(frame.color_bgr, color)
        assert frame.depth_mm is not None
        assert depth is not None
        assert np.array_equal(frame.depth_mm, depth)


def test_lens_data_and_times_survive(recording: Path) -> None:
    frames = everything(camera_of(recording))
    lens = frames[0].color_intrinsics
    assert lens is not None
    assert (lens.width, lens.height) == COLOR_SIZE
    assert lens.fx == pytest.approx(157.27, abs=0.01)
    assert frames[1].metadata["color_device_s"] == pytest.approx(2 * 0.033333, abs=1e-4)
    assert frames[0].capture_s <= frames[-1].capture_s


def test_the_soil_is_told_from_it(recording: Path) -> None:
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry())
    zones = {classifier.classify(frame, 0.0, 0.0).zone for frame in everything(camera_of(recording))}
    assert zones == {Zone.LEFT}


def test_a_paced_repeated_recording_gives_only_whole_sets(recording: Path) -> None:
    camera = camera_of(recording, real_time=True, repeat=True)
    camera.open()
    try:
        frames = [camera.read(3.0) for _ in range(4 * COUNT)]
    finally:
        camera.close()
    assert all(frame.color_number == frame.depth_number for frame in frames)
    assert all(one.color_number != other.color_number for one, other in pairwise(frames))
    starts = sum(one.color_number > other.color_number for one, other in pairwise(frames))
    assert starts >= 2  # it did start over


def test_colour_without_depth(tmp_path: Path) -> None:
    path = tmp_path / "color.db3"
    record(path, [(color, None) for color, _ in pictures()], SoftD455(COLOR_SIZE, None))
    frames = everything(camera_of(path))
    assert len(frames) == COUNT
    assert all(frame.depth_mm is None for frame in frames)


@pytest.mark.parametrize("content", [None, b"", b"junk" * 1000, "cut"])
def test_unreadable_recordings_are_one_clear_line(recording: Path, tmp_path: Path, content: bytes | str | None) -> None:
    path = tmp_path / "bad.db3"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "cut":
        path.write_bytes(recording.read_bytes()[:3000])
    with pytest.raises(DeviceMissingError) as caught:
        camera_of(path).open()
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_closed_recording_cannot_be_read(recording: Path) -> None:
    camera = camera_of(recording)
    with pytest.raises(LifecycleError):
        camera.read(0.1)
    camera.open()
    camera.close()
    camera.close()
    with pytest.raises(LifecycleError):
        camera.read(0.1)


def test_a_stall_is_not_the_end(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """librealsense gives the same sign for both; the playback's status tells them apart."""
    camera = camera_of(recording)
    camera.open()

    playback = camera._playback
    assert playback is not None
    monkeypatch.setattr(playback, "next", lambda _timeout_s: None)
    with pytest.raises(DeviceTimeoutError):
        camera.read(0.02)
    camera.close()


def test_a_slow_reader_loses_nothing(tmp_path: Path) -> None:
    """More frames than are decoded ahead, and a reader that stops now and then: the playback waits for it."""
    count = 40
    path = tmp_path / "long.db3"
    record(path, pictures(count), SoftD455(COLOR_SIZE, DEPTH_SIZE))
    camera = camera_of(path)
    camera.open()
    numbers = []
    for read_n in range(count):
        if read_n % 10 == 3:
            time.sleep(0.3)  # the slow reader
        frame = camera.read(5.0)
        numbers.append((frame.color_number, frame.depth_number))
    with pytest.raises(EndOfFrames):
        camera.read(5.0)
    camera.close()
    assert numbers == [(number, number) for number in range(1, count + 1)]


def test_a_whole_recording_over_and_over(recording: Path) -> None:
    camera = camera_of(recording, repeat=True)
    camera.open()
    numbers = [camera.read(5.0).color_number for _ in range(3 * COUNT)]
    camera.close()
    assert numbers == 3 * list(range(1, COUNT + 1))


def test_closing_in_the_middle_does_not_wait_for_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "long.db3"
    record(path, pictures(40), SoftD455(COLOR_SIZE, DEPTH_SIZE))
    camera = camera_of(path)
    camera.open()
    camera.read(5.0)
    started_s = time.monotonic()
    camera.close()
    assert time.monotonic() - started_s < 3.0
