"""The camera's conformance class on every source of frames: live, from the simulator, and from files."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from graderd.core.blade import BladeGeometry
from graderd.drivers.realsense import FolderCamera, RealSenseCamera, RecordingCamera, VideoCamera
from graderd.drivers.simulated.camera import RigCamera
from graderd.hal.camera import Camera, Frame
from graderd.hal.settings import CameraSettings
from graderd.perception import CameraCalibration
from graderd.perception.frame_set import Entry, FrameSetCamera, FrameSetWriter
from harness.realsense_devices import Color, Depth, SoftD455, record
from tests.contract.conformance import CameraConformance, CameraStand
from tests.contract.test_realsense_live import both, settings, streaming
from tests.rig_process import running_rig

FRAMES_N = 4


class LiveStand(CameraStand):
    """Pictures come until the camera is pulled out."""

    def __init__(self, camera: Camera, lose: Callable[[], None]) -> None:
        self.camera = camera
        self._lose = lose

    def lose(self) -> None:
        self._lose()


class FileStand(CameraStand):
    """A file or folder that is taken away."""

    live = False

    def __init__(self, camera: Camera, path: Path) -> None:
        self.camera = camera
        self._path = path

    def lose(self) -> None:
        if self._path.is_dir():
            shutil.rmtree(self._path)
        else:
            self._path.unlink()


def pictures() -> list[tuple[Color, Depth]]:
    rng = np.random.default_rng(5)
    return [
        (rng.integers(0, 255, (200, 320, 3), dtype=np.uint8), rng.integers(300, 1700, (120, 212), dtype=np.uint16))
        for _ in range(FRAMES_N)
    ]


class TestRealSense(CameraConformance):
    """The live driver on the SDK's own software device."""

    @pytest.fixture
    def camera_stand(self) -> Iterator[LiveStand]:
        soft = SoftD455()
        plugged = [soft.device]
        camera = RealSenseCamera(settings(), lambda: plugged)
        push = both(soft)
        with streaming(soft, lambda number: push(number) if plugged else None):
            yield LiveStand(camera, plugged.clear)
        camera.close()


class TestRig(CameraConformance):
    """The simulator's camera over its socket."""

    @pytest.fixture
    def camera_stand(self, tmp_path: Path) -> Iterator[LiveStand]:
        with running_rig(tmp_path / "rig") as (process, where):
            sizes = {"color_width_px": 320, "color_height_px": 200, "depth_width_px": 212, "depth_height_px": 120}
            camera = RigCamera(CameraSettings.model_validate({"source": "rig", "path": where["camera"], **sizes}))
            yield LiveStand(camera, lambda: ended(process, Path(where["camera"])))
            camera.close()


def ended(rig: subprocess.Popen[bytes], socket: Path) -> None:
    """Kill the rig; its camera is a process of its own and ends by itself with it."""
    rig.kill()
    rig.wait()
    socket.unlink(missing_ok=True)


class TestRecording(CameraConformance):
    @pytest.fixture
    def camera_stand(self, tmp_path: Path) -> Iterator[FileStand]:
        path = tmp_path / "pass.db3"
        record(path, list(pictures()), SoftD455())
        camera = RecordingCamera(CameraSettings(source="recording", path=str(path)), real_time=False)
        yield FileStand(camera, path)
        camera.close()


class TestFolder(CameraConformance):
    @pytest.fixture
    def camera_stand(self, tmp_path: Path) -> FileStand:
        path = tmp_path / "pictures"
        path.mkdir()
        for number, (color, _) in enumerate(pictures()):
            cv2.imwrite(str(path / f"{number}.png"), color)
        return FileStand(FolderCamera(CameraSettings(source="folder", path=str(path)), real_time=False), path)


class TestVideo(CameraConformance):
    @pytest.fixture
    def camera_stand(self, tmp_path: Path) -> FileStand:
        path = tmp_path / "pass.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (320, 200))
        for color, _ in pictures():
            writer.write(color)
        writer.release()
        return FileStand(VideoCamera(CameraSettings(source="video", path=str(path)), real_time=False), path)


class TestFrameSet(CameraConformance):
    @pytest.fixture
    def camera_stand(self, tmp_path: Path) -> FileStand:
        path = tmp_path / "set"
        writer = FrameSetWriter(path, CameraCalibration(), BladeGeometry())
        for number, _ in enumerate(pictures()):
            color, depth = np.zeros((800, 1280, 3), np.uint8), np.zeros((480, 848), np.uint16)
            writer.add(Entry(f"{number:03d}", None, 0.0), Frame(color, depth, None, None, 0.0))
        return FileStand(FrameSetCamera(CameraSettings(source="frame_set", path=str(path)), real_time=False), path)
