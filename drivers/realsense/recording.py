"""A RealSense recording (.db3, or the older .bag) played through the ordinary pipeline."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from graderd.drivers.realsense import sdk
from graderd.hal.camera import ColorImage, DepthImage, EndOfFrames, Frame, Intrinsics
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


APART_S = 0.02
"""Colour and depth further apart in device time are not of one moment."""
TORN_SHOWN_N = 30
"""So many torn sets in a row are no accident of playing: they are handed out, and the health check names them."""
PAUSE_S = 0.05
"""After so long without a picture the end of the recording is thought of."""
BUFFERED_N = 8
"""Pictures decoded ahead of the reader."""
WAITING_N = 16
"""So many colour pictures may wait for the depth of their moment."""


@dataclass(frozen=True, slots=True)
class Color:
    """A decoded colour picture."""

    image: ColorImage
    lens: Intrinsics
    number: int
    device_s: float


@dataclass(frozen=True, slots=True)
class Depth:
    """A decoded depth picture, in millimetres."""

    image: DepthImage
    lens: Intrinsics
    number: int
    device_s: float


Set = tuple[Color, Depth | None]


class Decoder:
    """Turns the SDK's frames into pictures of our own memory; the lenses are worked out once."""

    def __init__(self) -> None:
        self._lenses: dict[str, Intrinsics] = {}

    def color(self, frame: sdk.Rs) -> Color:
        """A colour frame; raises `ProtocolError` for an unknown pixel format."""
        lens = self._lens("color", frame)
        return Color(sdk.color_bgr(frame), lens, int(frame.get_frame_number()), frame.get_timestamp() / 1000.0)

    def depth(self, frame: sdk.Rs) -> Depth:
        """A depth frame."""
        image, lens = sdk.depth_mm(frame, sdk.depth_units_m(frame)), self._lens("depth", frame)
        return Depth(image, lens, int(frame.get_frame_number()), frame.get_timestamp() / 1000.0)

    def _lens(self, stream: str, frame: sdk.Rs) -> Intrinsics:
        if stream not in self._lenses:
            self._lenses[stream] = sdk.intrinsics(frame.get_profile())
        return self._lenses[stream]


class Playback(Protocol):
    """A recording being played."""

    def next(self, timeout_s: float) -> Set | None:
        """The next set; None when none came within ``timeout_s`` (seconds)."""

    def has_ended(self) -> bool:
        """Whether the recording is over; a stall looks the same to `next`."""

    def close(self) -> None:
        """Stop playing; idempotent."""


class PacedPlayback:
    """Through the SDK's pipeline, at the pace of the recording; what the reader is too slow for is lost.

    Where a repeated recording starts over, or the reader is slow, the SDK may pair colour and depth of different
    moments: such sets are dropped.
    """

    def __init__(self, path: str, repeat: bool) -> None:
        rs = sdk.load()
        self._decoder = Decoder()
        config, self._pipeline = rs.config(), rs.pipeline()
        config.enable_device_from_file(path, repeat_playback=repeat)
        self._device = self._pipeline.start(config).get_device().as_playback()
        self._last = (-1, -1)
        self._torn_in_a_row_n = 0

    def next(self, timeout_s: float) -> Set | None:
        """See `Playback`."""
        got, frames = self._pipeline.try_wait_for_frames(max(1, int(timeout_s * 1000)))
        color_frame = frames.get_color_frame() if got else None
        if not color_frame:
            return None
        depth_frame = frames.get_depth_frame()
        color = self._decoder.color(color_frame)
        depth = self._decoder.depth(depth_frame) if depth_frame else None
        numbers = (color.number, depth.number if depth else -1)
        if self._is_torn(numbers, color, depth):
            self._torn_in_a_row_n += 1
            if self._torn_in_a_row_n < TORN_SHOWN_N:
                return None
        self._torn_in_a_row_n = 0
        self._last = numbers
        return color, depth

    def _is_torn(self, numbers: tuple[int, int], color: Color, depth: Depth | None) -> bool:
        if numbers[0] == self._last[0] or (depth is not None and numbers[1] == self._last[1]):
            return True  # one of the two was handed out before
        return depth is not None and abs(color.device_s - depth.device_s) > APART_S

    def has_ended(self) -> bool:
        """See `Playback`."""
        return bool(self._device.current_status() == sdk.load().playback_status.stopped)

    def close(self) -> None:
        """See `Playback`."""
        pipeline, self._pipeline = self._pipeline, None
        # The playback object must go before the interpreter does: see librealsense's threads at exit.
        self._device = None
        if pipeline is not None:
            pipeline.stop()


class WholePlayback:
    """From the recording's own sensors, unpaced; no frame is lost, however slow the reader or busy the machine.

    The SDK's pipeline will not do here: its syncer goes by the wall clock and loses the first sets when the process
    does not get the processor for some 0.2 s; its blocking frame queue can wait for ever once it was full
    (librealsense 2.59). So the pictures are decoded in the sensors' callbacks, which wait while the reader is behind,
    and are paired here by the device's own time. Colour without the depth of its moment is handed out alone.
    """

    def __init__(self, path: str, repeat: bool) -> None:
        self._path, self._repeat = path, repeat
        self._decoder = Decoder()
        self._closing = threading.Event()
        self._sensors: list[sdk.Rs] = []
        try:
            self._start()
        except RuntimeError:
            self._stop()
            raise

    def _start(self) -> None:
        rs = sdk.load()
        self._colors: deque[Color] = deque()
        self._depths: deque[Depth] = deque()
        self._decoded: queue.Queue[Color | Depth | Exception] = queue.Queue(BUFFERED_N)
        self._context = rs.context()
        self._device = self._context.load_device(self._path).as_playback()
        self._device.set_real_time(False)
        self._with_depth = False
        for sensor in self._device.query_sensors():
            profiles = sensor.get_stream_profiles()
            wanted = [one for one in profiles if one.stream_type() in (rs.stream.color, rs.stream.depth)]
            if wanted:
                sensor.open(wanted)
                self._sensors.append(sensor)
            self._with_depth |= any(one.stream_type() == rs.stream.depth for one in wanted)
        self._device.pause()  # or the first sensor plays before the second listens
        for sensor in self._sensors:
            sensor.start(self._decode)
        self._device.resume()

    def _decode(self, frame: sdk.Rs) -> None:
        """One frame, in the sensor's own thread; waiting here holds the playback back."""
        picture: Color | Depth | Exception
        try:
            is_depth = frame.get_profile().stream_type() == sdk.load().stream.depth
            picture = self._decoder.depth(frame) if is_depth else self._decoder.color(frame)
        except Exception as error:  # whatever it is, it belongs to the reader: here the SDK would swallow it
            picture = error
        while not self._closing.is_set():
            try:
                self._decoded.put(picture, timeout=0.1)
            except queue.Full:
                continue
            return

    def next(self, timeout_s: float) -> Set | None:
        """See `Playback`."""
        paired = self._pair(is_over=False)
        if paired is not None:
            return paired
        try:
            picture = self._decoded.get(timeout=min(max(0.001, timeout_s), PAUSE_S))
        except queue.Empty:
            return self._at_a_pause()
        if isinstance(picture, Exception):
            raise picture
        if isinstance(picture, Color):
            self._colors.append(picture)
        else:
            self._depths.append(picture)
        return self._pair(is_over=False)

    def _pair(self, is_over: bool) -> Set | None:
        if not self._colors:
            if len(self._depths) > WAITING_N:
                self._depths.popleft()
            return None
        color = self._colors[0]
        while self._depths and self._depths[0].device_s < color.device_s - APART_S:
            self._depths.popleft()
        if self._depths and self._depths[0].device_s <= color.device_s + APART_S:
            return self._colors.popleft(), self._depths.popleft()
        is_alone = self._depths or not self._with_depth or is_over or len(self._colors) > WAITING_N
        return (self._colors.popleft(), None) if is_alone else None

    def _at_a_pause(self) -> Set | None:
        if not self._is_played() or not self._decoded.empty():
            return None
        left = self._pair(is_over=True)
        if left is None and self._repeat:
            self._stop()
            self._start()
        return left

    def _is_played(self) -> bool:
        return bool(self._device.current_status() == sdk.load().playback_status.stopped)

    def has_ended(self) -> bool:
        """See `Playback`."""
        return not self._repeat and self._is_played() and self._decoded.empty() and not self._colors

    def _stop(self) -> None:
        self._closing.set()
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()
        self._sensors = []
        self._device = self._context = None
        self._closing = threading.Event()

    def close(self) -> None:
        """See `Playback`."""
        if self._sensors:
            self._stop()
