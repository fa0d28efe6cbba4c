"""A RealSense recording (.db3, or the older .bag) played through the ordinary pipeline."""

from __future__ import annotations

import time
from pathlib import Path

from drivers.realsense import sdk
from graderd.hal.camera import DepthImage, EndOfFrames, Frame, Intrinsics
from graderd.hal.errors import DeviceMissingError, DeviceTimeoutError, LifecycleError
from graderd.hal.settings import CameraSettings

POLL_MS = 250
APART_S = 0.02
"""A set whose colour and depth lie further apart in device time is torn."""
TORN_SHOWN_N = 30
"""So many torn sets in a row are no accident of playing: they are handed out, and the health check names them."""


class RecordingCamera:
    """Plays a recording.

    ``real_time`` True paces frames as they were recorded and drops what the reader is too slow for; False hands out
    every frame as fast as it is read, which makes results repeatable.

    The end of a file looks like a camera that stalls; only the playback's status tells them apart. Where a repeated
    recording starts over, or the reader is slow, the SDK may pair colour and depth of different moments: such sets are
    dropped, and counted.
    """

    def __init__(self, settings: CameraSettings, real_time: bool = True) -> None:
        self._path = Path(settings.path)
        self._repeat = settings.repeat
        self._real_time = real_time
        self._pipeline: sdk.Rs = None
        self._playback: sdk.Rs = None
        self._lenses: dict[str, Intrinsics] = {}
        self._last = (-1, -1)
        self._torn_in_a_row_n = 0
        self.torn_dropped_n = 0

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
        rs = sdk.load()
        config, pipeline = rs.config(), rs.pipeline()
        try:
            config.enable_device_from_file(where, repeat_playback=self._repeat)
            if not self._real_time:
                # Said before the start, or the first frames are paced, and lost. (Said before a paced start, the
                # pace counts from here, and frames are lost too.)
                config.resolve(rs.pipeline_wrapper(pipeline)).get_device().as_playback().set_real_time(False)
            playback = pipeline.start(config).get_device().as_playback()
        except RuntimeError as error:
            cause = " ".join(str(error).split())
            raise DeviceMissingError(
                where, f"not a readable RealSense recording ({cause})", "Give a .db3 or .bag made by librealsense"
            ) from error
        self._pipeline, self._playback = pipeline, playback
        self._last = (-1, -1)

    def read(self, timeout_s: float) -> Frame:
        """The next frame set.

        Raises:
            EndOfFrames: the recording ended.
            DeviceTimeoutError: no frame set within ``timeout_s``, and the recording has not ended.
            LifecycleError: not open.
        """
        rs = sdk.load()
        if self._pipeline is None:
            raise LifecycleError(str(self._path), "the recording is not open")
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_ms = int((deadline_s - time.monotonic()) * 1000)
            got, frames = self._pipeline.try_wait_for_frames(max(1, min(POLL_MS, left_ms)))
            if got:
                frame = self._frame(frames)
                if frame is not None:
                    return frame
            elif self._playback.current_status() == rs.playback_status.stopped:
                raise EndOfFrames(str(self._path))
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(
                    str(self._path),
                    f"no frame set for {timeout_s:.2f} s",
                    "A stream in the recording stops: see rs-convert",
                )

    def _frame(self, frames: sdk.Rs) -> Frame | None:
        arrived_s = time.monotonic()
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        if not color:
            return None
        numbers = (int(color.get_frame_number()), int(depth.get_frame_number()) if depth else -1)
        if self._is_torn(numbers, color, depth):
            self.torn_dropped_n += 1
            self._torn_in_a_row_n += 1
            if self._torn_in_a_row_n < TORN_SHOWN_N:
                return None
        self._torn_in_a_row_n = 0
        self._last = numbers
        metadata = {"color_device_s": color.get_timestamp() / 1000.0}
        picture: DepthImage | None = None
        if depth:
            metadata["depth_device_s"] = depth.get_timestamp() / 1000.0
            picture = sdk.depth_mm(depth, sdk.depth_units_m(depth))
        return Frame(
            sdk.color_bgr(color),
            picture,
            self._lens("color", color),
            self._lens("depth", depth) if depth else None,
            arrived_s,
            numbers[0],
            numbers[1],
            f"{self._path.stem}#{numbers[0]}",
            metadata,
        )

    def _is_torn(self, numbers: tuple[int, int], color: sdk.Rs, depth: sdk.Rs) -> bool:
        if numbers[0] == self._last[0] or (depth and numbers[1] == self._last[1]):
            return True  # one of the two was handed out before
        return bool(depth) and abs(color.get_timestamp() - depth.get_timestamp()) / 1000.0 > APART_S

    def _lens(self, stream: str, frame: sdk.Rs) -> Intrinsics:
        if stream not in self._lenses:
            self._lenses[stream] = sdk.intrinsics(frame.get_profile())
        return self._lenses[stream]

    def settings_read_back(self) -> dict[str, float]:
        """Nothing can be set on a recording."""
        return {}

    def reset_hardware(self) -> None:
        """No effect."""

    def close(self) -> None:
        """Stop the playback; idempotent."""
        pipeline, self._pipeline = self._pipeline, None
        # The playback object must go before the interpreter does: see librealsense's threads at exit.
        self._playback = None
        if pipeline is not None:
            pipeline.stop()
