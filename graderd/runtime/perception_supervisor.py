"""The daemon's side of perception: keeps the child alive, takes its newest observation, says what is wrong.

Ladder when frames stop: stale -> unknown at once; child killed and started again with back-off; the camera's hardware
reset before the third open. Each step is reported.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import sys
from collections import deque
from dataclasses import asdict
from pathlib import Path

from pydantic import BaseModel

from graderd.core.attitude import MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import SoilObservation
from graderd.core.status import CameraStatus
from graderd.hal.clock import Clock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceRefusedError, DeviceTimeoutError
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.reading import Reading
from graderd.hal.settings import CameraSettings
from graderd.perception.settings import CameraCalibration, PerceptionSettings
from graderd.record import FramesWanted
from graderd.runtime.perception_protocol import (
    Angle,
    CameraProblem,
    FromChild,
    Observed,
    Opened,
    Preview,
    PreviewFormat,
    PreviewRequest,
    RecordFrames,
    Saved,
    SaveFrame,
    Start,
)

WORKER_MODULE = "graderd.runtime.app.perception_child"
START_GRACE_S = 15.0
"""A child may take so long from its start to its first word (imports, camera start)."""
RESET_BEFORE_OPEN_N = 3
BACK_OFF_S = (0.5, 1.0, 2.0, 5.0, 10.0)
RESTART_SHOWN_S = 5.0
FUTURE_S = 0.1
"""Both processes read one clock; a frame further ahead of it than this is none."""
COMPLAINTS_S = 0.5
COMPLAINTS_EVERY_S = 0.01
COMPLAINTS_BYTES = 65_536
COMPLAINTS_N = 20
MAX_LINE_BYTES = 8 * 1024 * 1024
MAX_WORDS_BYTES = 64 * 1024
"""Of a message that is no picture: its texts are told to every client, at every tick."""
MAX_KIND_AT = 64
"""A message names its kind first."""
MAX_UNSENT_BYTES = 64 * 1024

log = logging.getLogger(__name__)
_FIELDS = {"device": "camera"}

AS_IT_IS = PreviewFormat()


class PerceptionSupervisor:
    """Supervises the perception child. All methods belong to the daemon's event loop; the sync ones never wait."""

    def __init__(
        self,
        camera: CameraSettings,
        calibration: CameraCalibration,
        perception: PerceptionSettings,
        blade: BladeGeometry,
        clock: Clock,
        command: tuple[str, ...] = (sys.executable, "-P", "-m", WORKER_MODULE),
        start_grace_s: float = START_GRACE_S,
        back_off_s: tuple[float, ...] = BACK_OFF_S,
    ) -> None:
        self._start = Start(camera=camera, calibration=calibration, perception=perception, blade=blade)
        self._camera = camera
        self._clock = clock
        self._command = command
        self._start_grace_s = start_grace_s
        self._back_off_s = back_off_s
        self._process: asyncio.subprocess.Process | None = None
        self._newest: SoilObservation | None = None
        self._taken = True
        self._opened: Opened | None = None
        self._problem: CameraProblem | None = None
        self._last_word_s = clock.now_s()
        self._no_frame_since_s = clock.now_s()
        self._opened_s = clock.now_s()
        self._killed_hung = False
        self._picture_faults = PresentFaults("camera")
        self._worker_faults = PresentFaults("camera")
        self._nonsense = PresentFaults("daemon")
        self._opens_without_frame_n = 0
        self._restarts_n = 0
        self._frames_n = 0
        self._frame_times: deque[float] = deque(maxlen=30)
        self._previews: dict[PreviewFormat, asyncio.Future[Reading[bytes]]] = {}
        self._saved: asyncio.Future[Saved] | None = None
        self._frames = FramesWanted()

    @property
    def newest(self) -> SoilObservation | None:
        """The newest observation, whether taken or not."""
        return self._newest

    def take_observation(self) -> SoilObservation | None:
        """The newest observation if it was not taken before; of an old frame it says unknown, a stale one is None."""
        if self._taken or self._newest is None:
            return None
        self._taken = True
        now_s = self._clock.now_s()
        if now_s - self._newest.capture_s > self._camera.stale_s:
            return None
        return self._newest.as_of(now_s, self._start.perception.decision.max_frame_age_s)

    @property
    def frames_per_s(self) -> float:
        """Rate of the last frames; 0 when they stopped."""
        times = self._frame_times
        if len(times) < 2 or self._clock.now_s() - times[-1] > self._camera.stale_s:
            return 0.0
        return (len(times) - 1) / max(times[-1] - times[0], 1e-3)

    def status(self) -> CameraStatus:
        """For people."""
        if self._process is None:
            lifecycle = Lifecycle.CLOSED
        elif self._opened is None or self._is_stale():
            lifecycle = Lifecycle.FAILED if self._is_stale() else Lifecycle.STANDBY
        else:
            lifecycle = Lifecycle.ACTIVE
        recovery = ""
        if self._is_stale():
            recovery = "waiting for frames" if not self._restarts_n else f"worker restarted {self._restarts_n} times"
            if self._opens_without_frame_n >= RESET_BEFORE_OPEN_N:
                recovery += ", camera reset"
        return CameraStatus(
            lifecycle=lifecycle,
            description=self._opened.description if self._opened else "",
            frames_n=self._frames_n,
            restarts_n=self._restarts_n,
            recovery=recovery,
            settings_read_back=self._opened.settings_read_back if self._opened else {},
            settings_age_s=self._clock.now_s() - self._opened_s if self._opened else None,
        )

    def faults(self) -> tuple[DeviceFault, ...]:
        """What is wrong with camera, worker and picture now."""
        now_s = self._clock.now_s()
        seen: dict[str, str] = {}
        if self._is_stale():
            condition, detail = "stale", f"no frame for {now_s - self._no_frame_since_s:.1f} s"
            if self._problem is not None and self._problem.final:
                condition, detail = self._problem.condition, self._problem.message
            seen[condition] = detail
        elif self._newest is not None:
            seen |= {fault.condition: fault.detail for fault in self._newest.faults}
        if self._opened is not None and self._opened.not_kept:
            seen["settings_not_kept"] = "; ".join(self._opened.not_kept)
        self._picture_faults.keep_only(seen, now_s)
        books = (self._picture_faults, self._worker_faults, self._nonsense)
        return tuple(fault for book in books for fault in book.present(now_s))

    def _is_stale(self) -> bool:
        return self._clock.now_s() - self._no_frame_since_s > self._camera.stale_s

    def send_angle(self, angle_deg: float, time_s: float, attitude: MeasuredAttitude) -> None:
        """Tell the child the measured blade angle and attitude; dropped while the child does not read."""
        self._write(Angle(angle_deg=angle_deg, time_s=time_s, **asdict(attitude)))

    async def preview_jpeg(self, wanted: PreviewFormat = AS_IT_IS, timeout_s: float = 3.0) -> Reading[bytes]:
        """The next frame's annotated picture, and when it was taken; who asks for the same gets the same.

        Raises:
            TimeoutError: none came.
        """
        preview = self._previews.get(wanted)
        if preview is None or preview.done():
            preview = self._previews[wanted] = asyncio.get_running_loop().create_future()
            self._write(PreviewRequest(format=wanted))
        try:
            async with asyncio.timeout(timeout_s):
                return await asyncio.shield(preview)
        except TimeoutError:
            if self._previews.get(wanted) is preview:
                del self._previews[wanted]  # who asks again is not answered by what never came
            raise

    async def save_frame(self, folder: Path, id_: str, blade_angle_deg: float, timeout_s: float = 5.0) -> None:
        """Have the next frame added to the frame set in ``folder``.

        Raises:
            DeviceTimeoutError: no frame came.
            DeviceRefusedError: it could not be written.
        """
        self._saved = asyncio.get_running_loop().create_future()
        self._write(SaveFrame(folder=str(folder), id=id_, blade_angle_deg=blade_angle_deg))
        try:
            async with asyncio.timeout(timeout_s):
                saved = await self._saved
        except TimeoutError:
            raise DeviceTimeoutError("camera", f"no frame within {timeout_s:g} s", "See graderd status") from None
        if saved.problem:
            raise DeviceRefusedError("camera", f"the frame could not be saved: {saved.problem}")

    def record_frames(self, wanted: FramesWanted) -> None:
        """Have raw frames recorded from now on, or no more; a child that is started anew is told again."""
        self._frames = wanted
        self._write(RecordFrames(wanted=wanted))

    def _write(self, message: BaseModel) -> None:
        process = self._process
        if process is None or process.stdin is None or process.stdin.is_closing():
            return
        if process.stdin.transport.get_write_buffer_size() < MAX_UNSENT_BYTES:
            process.stdin.write(message.model_dump_json().encode() + b"\n")

    async def run(self) -> None:
        """Keep a child running until cancelled; its end, hang or silence leads to the next step."""
        try:
            while True:
                await self._one_child()
                self._restarts_n += 1
                self._opens_without_frame_n += 1
                restart = "worker_hung" if self._killed_hung else "worker_restarted"
                self._worker_faults.tell(restart, f"restart {self._restarts_n}", self._clock.now_s(), RESTART_SHOWN_S)
                pause_s = self._back_off_s[min(self._opens_without_frame_n, len(self._back_off_s)) - 1]
                log.warning("perception worker ended (restart %d in %.1f s)", self._restarts_n, pause_s, extra=_FIELDS)
                await asyncio.sleep(pause_s)
        finally:
            await self._kill()

    async def _one_child(self) -> None:
        reset_first = self._opens_without_frame_n == RESET_BEFORE_OPEN_N - 1
        self._opened = None
        self._last_word_s = self._clock.now_s() + self._start_grace_s - self._camera.restart_s
        starting = asyncio.ensure_future(
            asyncio.create_subprocess_exec(
                *self._command,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                limit=MAX_LINE_BYTES,
                process_group=0,  # Ctrl-C in a terminal is the daemon's, which ends it in its own order
            )
        )
        try:
            self._process = await asyncio.shield(starting)
        except asyncio.CancelledError:
            # Cancelled half-way, the child would be left running: wait for it, run() kills it on the way out.
            with contextlib.suppress(OSError):
                self._process = await starting
            raise
        assert self._process.stdin is not None  # asked for above
        assert self._process.stdout is not None
        start = self._start.model_copy(update={"reset_first": reset_first})
        self._process.stdin.write(start.model_dump_json().encode() + b"\n")
        self._killed_hung = False
        assert self._process.stderr is not None
        complaints = asyncio.create_task(_log_complaints(self._process.stderr), name="perception-complaints")
        try:
            while await self._one_line(self._process.stdout):
                pass
        finally:
            try:
                await self._kill()
                # Dead, its pipe ends by itself, unless a process that it left behind holds it.
                await asyncio.wait((complaints,), timeout=COMPLAINTS_S)
            finally:
                complaints.cancel()

    async def _one_line(self, lines: asyncio.StreamReader) -> bool:
        """Handle the child's next line. False: it ended, spoke nonsense or has been silent for too long."""
        await asyncio.sleep(0)  # lines that wait already are read without a turn for anybody else
        silent_s = self._clock.now_s() - self._last_word_s
        try:
            async with asyncio.timeout(max(0.05, self._camera.restart_s - silent_s)):
                line = await lines.readline()
        except TimeoutError:
            self._killed_hung = True
            log.warning("perception worker said nothing for %.1f s: killing it", self._camera.restart_s, extra=_FIELDS)
            return False
        except ValueError:
            log.warning("perception worker sent an overlong line: killing it", extra=_FIELDS)
            return False
        if not line:
            return False
        try:
            if len(line) > MAX_WORDS_BYTES and b'"preview"' not in line[:MAX_KIND_AT]:
                raise ValueError(f"{len(line)} bytes that are no picture")
            message = FromChild.validate_json(line)
            self._last_word_s = self._clock.now_s()
            return self._take(message)
        except ValueError as error:  # pydantic's ValidationError is one
            detail = str(error).splitlines()[0]
            self._nonsense.tell("perception_nonsense", detail, self._clock.now_s(), RESTART_SHOWN_S)
            log.warning("perception worker sent what cannot be true (%s): killing it", detail, extra=_FIELDS)
            return False

    def _take(self, message: Opened | Observed | CameraProblem | Preview | Saved) -> bool:
        if isinstance(message, Observed):
            observation = message.unpack()
            if observation.capture_s > self._last_word_s + FUTURE_S:
                raise ValueError(f"a frame of {observation.capture_s - self._last_word_s:.2f} s in the future")
            if not self._is_news(observation):
                return self._may_wait()
            self._newest, self._taken = observation, False
            self._no_frame_since_s = self._last_word_s
            self._frames_n += 1
            self._frame_times.append(self._newest.capture_s)
            self._problem = None
            self._opens_without_frame_n = 0
        elif isinstance(message, Opened):
            self._opened, self._problem = message, None
            self._opened_s = self._last_word_s
            log.info("camera open: %s", message.description, extra=_FIELDS)
            if self._frames.path:
                self._write(RecordFrames(wanted=self._frames))
            for wanted in self._previews:  # the one that was asked may be gone
                self._write(PreviewRequest(format=wanted))
        elif isinstance(message, CameraProblem):
            log.warning("camera: %s", message.message, extra={**_FIELDS, "fault": f"camera.{message.condition}"})
            self._problem = message
            return not message.final and self._may_wait()
        elif isinstance(message, Saved):
            if self._saved is not None and not self._saved.done():
                self._saved.set_result(message)
        else:
            preview = self._previews.pop(message.format, None)
            if preview is not None and not preview.done():
                preview.set_result(Reading(base64.b64decode(message.jpeg_base64), message.capture_s))
        return True

    def _is_news(self, observation: SoilObservation) -> bool:
        """Each picture counts once and none after a newer one, whatever order a child sends them in; one that is too
        old to decide by when it comes is none."""
        if self._last_word_s - observation.capture_s > self._camera.stale_s:
            return False
        return self._newest is None or observation.capture_s > self._newest.capture_s

    def _may_wait(self) -> bool:
        """Whether a child that is alive but without frames has time left: the ladder goes on all the same. The time it
        took to start does not count against it, or none that starts slowly would ever get to its first frame."""
        return self._clock.now_s() - max(self._no_frame_since_s, self._opened_s) < self._camera.restart_s

    async def _kill(self) -> None:
        """End the child, hung or not, and wait for it (a killed process is gone in milliseconds)."""
        process = self._process
        if process is None:
            return
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
        if process.stdin is not None:
            process.stdin.close()
        # Forgotten only when it is reaped: cancelled while waiting here, run() comes here again.
        await process.wait()
        self._process = None


async def _log_complaints(stream: asyncio.StreamReader) -> None:
    """What the child and the libraries in it print on standard error, through our log: a child that fails at every
    start would else fill the journal past all its limits. Of a torrent, each piece's first and last lines are told."""
    while data := await stream.read(COMPLAINTS_BYTES):
        lines = [line for line in data.decode("utf-8", "replace").splitlines() if line.strip()]
        for line in lines if len(lines) <= 2 * COMPLAINTS_N else lines[:COMPLAINTS_N] + lines[-COMPLAINTS_N:]:
            log.warning("perception worker: %s", line, extra=_FIELDS)
        await asyncio.sleep(COMPLAINTS_EVERY_S)
