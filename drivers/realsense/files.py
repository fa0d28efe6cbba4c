"""Pictures from a folder, or from a video: colour only, no lens data."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from graderd.hal.camera import ColorImage, EndOfFrames, Frame
from graderd.hal.errors import DeviceMissingError, LifecycleError, ProtocolError
from graderd.hal.settings import CameraSettings

PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".mjpg", ".mjpeg"})

Load = Callable[[], ColorImage]


def read_picture(path: Path) -> ColorImage:
    """One picture as BGR.

    Raises:
        DeviceMissingError: no such file, or it may not be read.
        ProtocolError: it is not a picture, or a damaged one.
    """
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise DeviceMissingError(str(path), f"cannot be read ({error.strerror or error})") from error
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    except cv2.error as error:
        raise ProtocolError(str(path), f"not a readable picture ({error.err})") from error
    if picture is None:
        raise ProtocolError(str(path), "not a readable picture", "JPEG, PNG, BMP, TIFF and WebP are read")
    return np.asarray(picture, dtype=np.uint8)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder in the order of their names."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES and p.is_file())


class _Paced(ABC):
    """What folder and video have in common: frames handed out one after the other, at a rate or as fast as read."""

    def __init__(self, settings: CameraSettings, real_time: bool = True) -> None:
        self._path = Path(settings.path)
        self._repeat = settings.repeat
        self._period_s = 1.0 / settings.rate_hz if real_time else 0.0
        self._frames: Iterator[tuple[str, Load]] | None = None
        self._due_s = 0.0
        self._number = 0

    @property
    def description(self) -> str:
        """The path."""
        return str(self._path)

    def open(self) -> None:
        """Open the source.

        Raises:
            DeviceMissingError: there is nothing to read.
        """
        self._check()
        self._frames = self._every()
        self._due_s = time.monotonic()

    @abstractmethod
    def _check(self) -> None:
        """Raise where there is nothing to read."""

    @abstractmethod
    def _every(self) -> Iterator[tuple[str, Load]]:
        """Every picture's name and how to load it, in their order."""

    def read(self, timeout_s: float) -> Frame:  # noqa: ARG002  (the contract's; a file is always there)
        """The next picture.

        Raises:
            EndOfFrames: there is no further one.
            ProtocolError: a picture is damaged; the next call goes on with the one after it.
            LifecycleError: not open.
        """
        if self._frames is None:
            raise LifecycleError(str(self._path), "the source is not open")
        try:
            name, load = next(self._frames)
        except StopIteration:
            raise EndOfFrames(str(self._path)) from None
        picture = load()
        wait_s = self._due_s - time.monotonic()
        if wait_s > 0:
            time.sleep(wait_s)
        self._due_s = max(self._due_s + self._period_s, time.monotonic())
        self._number += 1
        return Frame(picture, None, None, None, time.monotonic(), self._number, -1, name)

    def settings_read_back(self) -> dict[str, float]:
        """Nothing can be set on a file."""
        return {}

    def reset_hardware(self) -> None:
        """No effect."""
        return

    def close(self) -> None:
        """Let go of the source; idempotent."""
        self._frames = None


class FolderCamera(_Paced):
    """The pictures of a folder, or one picture."""

    def _check(self) -> None:
        if self._path.is_file():
            return
        if not self._path.is_dir():
            raise DeviceMissingError(str(self._path), "no such picture or folder")
        if not pictures_in(self._path):
            kinds = ", ".join(sorted(PICTURE_SUFFIXES))
            raise DeviceMissingError(str(self._path), "the folder holds no pictures", f"Looked for {kinds}")

    def _every(self) -> Iterator[tuple[str, Load]]:
        while True:
            paths = [self._path] if self._path.is_file() else pictures_in(self._path)
            for path in paths:
                yield path.name, partial(read_picture, path)
            if not self._repeat or not paths:
                return


class VideoCamera(_Paced):
    """The frames of a video file."""

    def _check(self) -> None:
        if not self._path.is_file():
            raise DeviceMissingError(str(self._path), "no such video")
        video = cv2.VideoCapture(str(self._path))
        readable = video.isOpened() and video.read()[0]
        video.release()
        if not readable:
            raise DeviceMissingError(str(self._path), "not a readable video", "MP4, AVI, MKV and WebM are read")

    def _every(self) -> Iterator[tuple[str, Load]]:
        while True:
            video = cv2.VideoCapture(str(self._path))
            try:
                number = 0
                while True:
                    got, picture = video.read()
                    if not got:
                        break
                    number += 1
                    yield f"{self._path.stem}#{number}", partial(np.asarray, picture, np.uint8)
            finally:
                video.release()
            if not self._repeat:
                return
