"""A RealSense recording (.db3, or the older .bag) played through the ordinary pipeline."""

from __future__ import annotations

import time
from pathlib import Path

from graderd.drivers.realsense.playback import Color, Depth, PacedPlayback, Playback, WholePlayback
from graderd.hal.camera import EndOfFrames, Frame
from graderd.hal.errors import DeviceMissingError, DeviceTimeoutError, LifecycleError
from graderd.hal.settings import CameraSettings

POLL_S = 0.25


class RecordingCamera:
    """Plays a recording.

    ``real_time`` True paces frames as they were recorded and drops what the reader is too slow for; False hands out
    every frame as fast as it is read, which makes results repeatable.

    The end of a file looks like a camera that stalls; only the playback's status tells them apart.
    """

    def __init__(self, settings: CameraSettings, real_time: bool = True) -> None:
        self._path = Path(settings.path)
        self._repeat = settings.repeat
        self._real_time = real_time
        self._playback: Playback | None = None

    @property
    def description(self) -> str:
        """The path."""
        return f"recording {self._path}"

    def open(self) -> None:
        """Start the playback.

        Raises:
            DeviceMissingError: no such file, or not a readable recording.
        """
        where = str(self._path)
        if not self._path.is_file():
            raise DeviceMissingError(where, "no such recording", "Give the path of a .db3 or .bag file")
        if self._path.stat().st_size == 0:
            raise DeviceMissingError(where, "the file is empty", "Record again")
        play = PacedPlayback if self._real_time else WholePlayback
        try:
            self._playback = play(where, self._repeat)
        except RuntimeError as error:
            cause = " ".join(str(error).split())
            raise DeviceMissingError(
                where, f"not a readable RealSense recording ({cause})", "Give a .db3 or .bag made by librealsense"
            ) from error

    def read(self, timeout_s: float) -> Frame:
        """The next frame set.

        Raises:
            EndOfFrames: the recording ended.
            DeviceTimeoutError: no frame set within ``timeout_s``, and the recording has not ended.
            LifecycleError: not open.
        """
        if self._playback is None:
            raise LifecycleError(str(self._path), "the recording is not open")
        deadline_s = time.monotonic() + timeout_s
        while True:
            pictures = self._playback.next(min(POLL_S, max(0.0, deadline_s - time.monotonic())))
            if pictures is not None:
                return self._frame(*pictures)
            if self._playback.has_ended():
                raise EndOfFrames(str(self._path))
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(
                    str(self._path),
                    f"no frame set for {timeout_s:.2f} s",
                    "A stream in the recording stops: see rs-convert",
                )

    def _frame(self, color: Color, depth: Depth | None) -> Frame:
        metadata = {"color_device_s": color.device_s}
        if depth is not None:
            metadata["depth_device_s"] = depth.device_s
        return Frame(
            color.image,
            depth.image if depth is not None else None,
            color.lens,
            depth.lens if depth is not None else None,
            time.monotonic(),
            color.number,
            depth.number if depth is not None else -1,
            f"{self._path.stem}#{color.number}",
            metadata,
        )

    def settings_read_back(self) -> dict[str, float]:
        """Nothing can be set on a recording."""
        return {}

    def reset_hardware(self) -> None:
        """No effect."""

    def close(self) -> None:
        """Stop the playback; idempotent."""
        playback, self._playback = self._playback, None
        if playback is not None:
            playback.close()
