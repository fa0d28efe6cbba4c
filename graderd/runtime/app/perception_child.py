"""The perception child: owns the camera, judges every frame, can be killed at any moment without harm.

Run by the daemon as ``python -m graderd.runtime.app.perception_child``; speaks
:mod:`graderd.runtime.perception_protocol` on stdin and stdout.
"""

from __future__ import annotations

import base64
import os
import queue
import sys
import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import cv2
import numpy as np
from pydantic import BaseModel, ValidationError

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.soil import SoilObservation
from graderd.hal.camera import Camera, EndOfFrames, Frame
from graderd.hal.errors import DeviceError, DeviceTimeoutError
from graderd.hal.settings import DEPTH_PRESETS, CameraSettings
from graderd.perception.classifier import Classifier, judge_frame, make_classifier
from graderd.perception.frame_set import Entry, FrameSetWriter, with_lens_of
from graderd.record import FramesWanted
from graderd.runtime.app.frame_sources import open_camera
from graderd.runtime.perception_protocol import (
    Angle,
    CameraProblem,
    Observed,
    Opened,
    Preview,
    PreviewFormat,
    RecordFrames,
    Saved,
    SaveFrame,
    Start,
    ToChild,
)

if TYPE_CHECKING:
    from graderd.record.frames import FrameRecorder

JPEG_QUALITY = 80
OpenSource = Callable[[CameraSettings], Camera]


class AngleHistory:
    """The last second or two of measured blade angles, to know the angle at the moment of exposure."""

    def __init__(self, length_n: int = 128) -> None:
        self._samples: deque[tuple[float, float]] = deque(maxlen=length_n)

    def add(self, time_s: float, angle_deg: float) -> None:
        """Append a sample; an older or equal time than the newest is ignored."""
        if not self._samples or time_s > self._samples[-1][0]:
            self._samples.append((time_s, angle_deg))

    def at(self, time_s: float) -> tuple[float, float]:
        """Angle at ``time_s`` (interpolated) and the age of what it rests on; no sample at all is infinitely old."""
        samples = list(self._samples)
        if not samples:
            return 0.0, float("inf")
        after = bisect_left(samples, (time_s, float("-inf")))
        if after == len(samples):
            newest_s, angle_deg = samples[-1]
            return angle_deg, time_s - newest_s
        if after == 0:
            oldest_s, angle_deg = samples[0]
            return angle_deg, oldest_s - time_s
        (t0, a0), (t1, a1) = samples[after - 1], samples[after]
        share = (time_s - t0) / (t1 - t0)
        return a0 + share * (a1 - a0), min(time_s - t0, t1 - time_s)


class Worker:
    """The child's two threads: one reads the daemon's lines, the main one reads the camera."""

    def __init__(self, start: Start, lines: BinaryIO, out: BinaryIO, open_source: OpenSource = open_camera) -> None:
        self._start = start
        self._open_source = open_source
        self._lines = lines
        self._out = out
        self._angles = AngleHistory()
        self._attitude = UNMEASURED
        """The newest: lifts and tilt move a millimetre between frames."""
        self._formats: queue.SimpleQueue[PreviewFormat] = queue.SimpleQueue()
        self._to_save: queue.SimpleQueue[SaveFrame] = queue.SimpleQueue()
        self._writers: dict[str, FrameSetWriter] = {}
        self._recorder: FrameRecorder | None = None

    def _send(self, message: BaseModel) -> None:
        self._out.write(message.model_dump_json().encode() + b"\n")
        self._out.flush()

    def _listen(self) -> None:
        """Until the daemon's end of the pipe closes; then the process goes at once, hung library call or not."""
        for line in self._lines:
            message = ToChild.validate_json(line)
            if isinstance(message, Angle):
                self._angles.add(message.time_s, message.angle_deg)
                self._attitude = message.attitude
            elif isinstance(message, SaveFrame):
                self._to_save.put(message)
            elif isinstance(message, RecordFrames):
                self._record(message.wanted)
            else:
                self._formats.put(message.format)
        os._exit(0)

    def run(self) -> int:
        """Open the camera, judge frames until something ends it. Returns the exit status."""
        threading.Thread(target=self._listen, name="daemon-lines", daemon=True).start()
        settings = self._start.camera
        try:
            camera = self._open_source(settings)
            if self._start.reset_first:
                camera.reset_hardware()
            camera.open()
        except DeviceError as error:
            self._send(CameraProblem(condition="missing", message=str(error), final=True))
            return 4
        read_back = camera.settings_read_back()
        self._send(
            Opened(
                description=camera.description,
                settings_read_back=read_back,
                not_kept=settings_not_kept(settings, read_back),
            )
        )
        classifier = make_classifier(
            self._start.perception, self._start.calibration, self._start.blade, camera=settings
        )
        try:
            return self._judge(camera, classifier)
        finally:
            camera.close()

    def _judge(self, camera: Camera, classifier: Classifier) -> int:
        while True:
            try:
                frame = camera.read(self._start.camera.stale_s)
            except DeviceTimeoutError as error:
                self._send(CameraProblem(condition="stale", message=str(error)))
                continue
            except EndOfFrames:
                self._send(CameraProblem(condition="missing", message="the recording came to its end", final=True))
                return 0
            except DeviceError as error:
                self._send(CameraProblem(condition="missing", message=str(error), final=True))
                return 3
            angle_deg, age_s = self._angles.at(frame.capture_s)
            attitude = self._attitude
            judged_s = time.monotonic()
            observation = judge_frame(
                classifier, frame, angle_deg, age_s, judged_s, self._start.perception.decision, attitude
            )
            self._send(Observed.of(observation))
            if (recorder := self._recorder) is not None:
                recorder.take(frame, angle_deg, age_s, attitude, judged_s, observation)
            if not self._to_save.empty():
                self._save(self._to_save.get(), frame, attitude)
            while not self._formats.empty():
                wanted = self._formats.get()
                jpeg = _jpeg(classifier, frame, observation, wanted)
                self._send(Preview(format=wanted, capture_s=frame.capture_s, jpeg_base64=jpeg))

    def _record(self, wanted: FramesWanted) -> None:
        """On the thread that listens: files are begun and ended beside the judging. It may be told twice."""
        if self._recorder is not None and self._recorder.wanted == wanted:
            return
        former, self._recorder = self._recorder, None
        if former is not None:
            former.end()
        if wanted.path:
            # Loaded late: it brings the whole of a recording with it, a quarter of what a child takes to start.
            from graderd.record.frames import FrameRecorder

            self._recorder = FrameRecorder(wanted)

    def _save(self, wanted: SaveFrame, frame: Frame, attitude: MeasuredAttitude) -> None:
        problem = ""
        try:
            if wanted.folder not in self._writers:
                calibration = with_lens_of(frame, self._start.calibration)
                self._writers[wanted.folder] = FrameSetWriter(Path(wanted.folder), calibration, self._start.blade)
            self._writers[wanted.folder].add(Entry(wanted.id, None, wanted.blade_angle_deg, attitude=attitude), frame)
        except OSError as error:
            problem = f"{wanted.folder}: {error.strerror}"
        self._send(Saved(id=wanted.id, problem=problem))


def _jpeg(classifier: Classifier, frame: Frame, observation: SoilObservation, wanted: PreviewFormat) -> str:
    # Made smaller before anything is drawn: lines stay sharp, and a small picture costs little.
    picture = classifier.annotate(no_wider(frame, wanted.width_px), observation, labels=wanted.labels)
    ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return base64.b64encode(data.tobytes()).decode() if ok else ""


def no_wider(frame: Frame, width_px: int | None) -> Frame:
    """The frame with a colour picture of at most that width, and the lens that this one would come from."""
    height, width = frame.color_bgr.shape[:2]
    if width_px is None or width_px >= width:
        return frame
    size = (width_px, round(height * width_px / width))
    small = np.asarray(cv2.resize(frame.color_bgr, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    lens = frame.color_intrinsics
    return replace(frame, color_bgr=small, color_intrinsics=lens and lens.scaled(*size))


def settings_not_kept(settings: CameraSettings, read_back: dict[str, float]) -> tuple[str, ...]:
    """Settings whose read-back value is more than 5 % off what was asked for."""
    wrong = []
    colour, depth = ("exposure_us", "gain", "white_balance_k"), ("depth_laser_mw", "depth_exposure_us", "depth_gain")
    asked: dict[str, float | None] = {name: getattr(settings, name) for name in (*colour, *depth)}
    asked["depth_emitter"] = float(settings.depth_emitter)
    if settings.depth_preset is not None:
        asked["depth_preset"] = float(DEPTH_PRESETS.index(settings.depth_preset))
    if not settings.depth_emitter:
        asked["depth_laser_mw"] = None
    for name, wanted in asked.items():
        got = read_back.get(name)
        if wanted is not None and got is not None and abs(got - wanted) > 0.05 * wanted:
            wrong.append(f"{name}: asked {wanted:g}, device says {got:g}")
    return tuple(wrong)


def main(open_source: OpenSource = open_camera) -> int:
    """Body of the child process; ``open_source`` makes the camera of the daemon's settings. Returns the exit status."""
    cv2.setNumThreads(1)  # one core is the control loop's
    # A camera library that prints must not be able to spoil the protocol: its stdout becomes stderr.
    out = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        start = Start.model_validate_json(sys.stdin.buffer.readline())
    except ValidationError as error:
        sys.stderr.write(f"graderd worker: not started by the daemon: {error.errors()[0]['msg']}\n")
        return 2
    return Worker(start, sys.stdin.buffer, out, open_source).run()


if __name__ == "__main__":
    sys.exit(main())
