"""Raw frames to a recording of their own, beside the run's: written by the perception child, which has them.

Colour and depth are PNG, bit for bit what the classifier saw; with each frame goes everything it was judged by.
"""

from __future__ import annotations

import base64
import itertools
import queue
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from graderd.core.attitude import MeasuredAttitude
from graderd.core.soil import SoilObservation
from graderd.hal.camera import ColorImage, DepthImage, Frame
from graderd.record import FramesWanted
from graderd.record.files import RecordingFile
from graderd.record.layout import (
    COLOR,
    DEPTH,
    FRAME,
    FRAME_CHANNELS,
    FRAMES_SUFFIX,
    MARK,
    FrameRecord,
    Mark,
    Message,
    frame_bytes,
    frame_of,
    image_message,
)
from graderd.record.reader import picture_data
from graderd.record.table import MOST

WAITING_N = 4
"""Frames that wait to be written; what comes beyond is left out, and counted."""
FLUSH_S = 0.5
PIXELS_MOST_N = 1 << 26
"""What says it is larger is no camera's."""
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)
_PNG_HEAD = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
_SIZE = struct.Struct(">II")


class Judged(NamedTuple):
    """One frame, what it was judged by, and what came of it."""

    frame: Frame
    angle_deg: float
    angle_age_s: float
    attitude: MeasuredAttitude
    judged_s: float
    observation: SoilObservation


class FrameRecorder:
    """Writes one of ``every_n`` frames, on a thread of its own. :meth:`take` never waits."""

    def __init__(self, wanted: FramesWanted) -> None:
        self.wanted = wanted
        """What it was made for."""
        self._frames: queue.Queue[Judged | None] = queue.Queue(WAITING_N)
        self._seen_n = 0
        self._lost_n = 0
        self._thread = threading.Thread(target=self._work, name="frame-recorder", daemon=True)
        self._thread.start()

    def take(
        self,
        frame: Frame,
        angle_deg: float,
        angle_age_s: float,
        attitude: MeasuredAttitude,
        judged_s: float,
        observation: SoilObservation,
    ) -> None:
        """One more frame was judged; all as in :class:`Judged`."""
        self._seen_n += 1
        if self._seen_n % self.wanted.every_n:
            return
        try:
            self._frames.put_nowait(Judged(frame, angle_deg, angle_age_s, attitude, judged_s, observation))
        except queue.Full:
            self._lost_n += 1

    def end(self) -> None:
        """Take no more; what waits is written, and the file is ended."""
        threading.Thread(target=self._frames.put, args=(None,), daemon=True).start()

    def join(self, most_s: float) -> None:
        """Wait for the end of the file after :meth:`end`."""
        self._thread.join(most_s)

    def _work(self) -> None:
        try:
            self._write_all()
        except OSError as error:
            sys.stderr.write(f"raw frames are no longer recorded: {error.filename or ''} {error.strerror}\n")
            while self._frames.get() is not None:
                pass

    def _write_all(self) -> None:
        head, config_json = self.wanted.head, self.wanted.config_json.encode()
        file = RecordingFile(_free(Path(self.wanted.path)), head, config_json, FRAME_CHANNELS)
        offset_ns = time.time_ns() - time.monotonic_ns()
        due_s, lost_n = 0.0, 0
        while (judged := self._frames.get()) is not None:
            if self._lost_n > lost_n:
                mark = Mark(kind="lost", lost_n=self._lost_n - lost_n, text="frames came faster than they were written")
                lost_n = self._lost_n
                file.add(Message(MARK, int(judged.judged_s * 1e9) + offset_ns, mark.model_dump_json().encode()))
            for message in messages_of(judged, self.wanted.every_n, offset_ns):
                file.add(message)
            if (now_s := time.monotonic()) >= due_s:
                due_s = now_s + FLUSH_S
                file.flush()
        file.finish()


def _free(path: Path) -> Path:
    """``path``, or a name beside it: a child that was started anew goes on in a file of its own."""
    stem = path.name.removesuffix(FRAMES_SUFFIX)
    names = itertools.chain([path], (path.with_name(f"{stem}-{n}{FRAMES_SUFFIX}") for n in itertools.count(2)))
    return next(name for name in names if not name.exists())


def messages_of(judged: Judged, every_n: int, offset_ns: int) -> list[Message]:
    """Circumstances, colour and depth; ``offset_ns``: of the wall clock on the monotonic one."""
    frame, attitude = judged.frame, judged.attitude
    at_ns = int(frame.capture_s * 1e9) + offset_ns
    record = FrameRecord(
        capture_s=frame.capture_s,
        judged_s=judged.judged_s,
        angle_deg=judged.angle_deg,
        angle_age_s=judged.angle_age_s,
        observation=judged.observation,
        every_n=every_n,
        color_number=frame.color_number,
        depth_number=frame.depth_number,
        height_mm=attitude.height_mm,
        slope_deg=attitude.slope_deg,
        pitch_deg=attitude.pitch_deg,
        color_intrinsics=frame.color_intrinsics,
        depth_intrinsics=frame.depth_intrinsics,
        metadata=frame.metadata,
    )
    found = [Message(FRAME, at_ns, frame_bytes(record)), image_message(COLOR, at_ns, _png(frame.color_bgr), "png")]
    if frame.depth_mm is not None:
        found.append(image_message(DEPTH, at_ns, _png(frame.depth_mm), "png"))
    return found


def _png(picture: Any) -> str:
    ok, data = cv2.imencode(".png", picture, _PNG)
    if not ok:
        raise ValueError("a picture that is none")
    return base64.b64encode(data.tobytes()).decode()


def color_of(message: bytes) -> ColorImage:
    """The picture of a ``/camera/color``, as it was.

    Raises:
        ValueError, LookupError: it is none.
    """
    picture = _picture_of(message)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError("a picture, but none of 8-bit colour")
    return np.asarray(picture, dtype=np.uint8)


def depth_of(message: bytes) -> DepthImage:
    """The picture of a ``/camera/depth``, as it was: millimetres.

    Raises:
        ValueError, LookupError: it is none.
    """
    picture = _picture_of(message)
    if picture.dtype != np.uint16 or picture.ndim != 2:
        raise ValueError("a picture, but none of 16-bit depth")
    return np.asarray(picture, dtype=np.uint16)


def _picture_of(message: bytes) -> Any:
    data = picture_data(message)
    if not data.startswith(_PNG_HEAD) or len(data) < len(_PNG_HEAD) + _SIZE.size:
        raise ValueError("not a PNG")
    width_px, height_px = _SIZE.unpack_from(data, len(_PNG_HEAD))
    if not 0 < width_px * height_px <= PIXELS_MOST_N:
        raise ValueError(f"a picture of {width_px}x{height_px}")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"not a readable picture: {error.err}") from None
    if picture is None:
        raise ValueError("not a readable picture")
    return picture


def circumstances_of(message: bytes) -> FrameRecord:
    """What a frame was judged by, of a ``/camera/frame``.

    Raises:
        ValueError: it is none, or says what no camera and no blade can.
    """
    record = frame_of(message)
    known = [record.capture_s, record.judged_s, record.angle_deg, record.observation.capture_s]
    known += [value for value in (record.height_mm, record.slope_deg, record.pitch_deg) if value is not None]
    for lens in (record.color_intrinsics, record.depth_intrinsics):
        if lens is not None:
            known += [lens.fx, lens.fy, lens.cx, lens.cy, *lens.coeffs]
            if not (0 < lens.width * lens.height <= PIXELS_MOST_N and min(lens.width, lens.fx, lens.fy) > 0):
                raise ValueError(f"a lens for {lens.width}x{lens.height}, {lens.fx:g} and {lens.fy:g} px long")
    if not all(abs(value) < MOST for value in known):
        raise ValueError("a number in it is no measurement")
    return record


def judged_of(record: FrameRecord, color: ColorImage, depth: DepthImage | None) -> Judged:
    """A recorded frame as it was judged."""
    return Judged(
        Frame(
            color_bgr=color,
            depth_mm=depth,
            color_intrinsics=record.color_intrinsics,
            depth_intrinsics=record.depth_intrinsics,
            capture_s=record.capture_s,
            color_number=record.color_number,
            depth_number=record.depth_number,
            metadata=record.metadata,
        ),
        record.angle_deg,
        record.angle_age_s,
        MeasuredAttitude(record.height_mm, record.slope_deg, record.pitch_deg),
        record.judged_s,
        record.observation,
    )
