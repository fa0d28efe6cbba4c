"""The daemon's recorder: ticks, wires, pictures and commands to MCAP files, and the black box around incidents.

The tick only appends to a bounded queue. A thread makes messages of what is there and writes them, a little at a time,
so that it never keeps the interpreter from the tick for long. Whatever disk or thread do costs records, never control,
and is told: as a fault, and in the next file's head.

Everything goes through a ring of the last half minute. A run is written from it as it comes (``recording.runs``). The
**black box** is always on: with a stop, a disarm, a fault that matters or a mark, the ring and the ten seconds that
follow are kept in a file of their own, which goes last when room is made.
"""

from __future__ import annotations

import asyncio
import base64
import errno
import hashlib
import logging
import math
import platform
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple, Protocol

from graderd.config import Config
from graderd.core.faults.monitor import Reaction
from graderd.core.machine import ARMED, Mode
from graderd.core.status import RecordingStatus
from graderd.core.tick import Controller, Sensed, Tick, TickSettings
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.reading import Reading
from graderd.record import FramesWanted
from graderd.record.files import RecordingFile
from graderd.record.layout import (
    CHANNELS,
    FRAMES_SUFFIX,
    INCIDENT_SUFFIX,
    LEVELS,
    MARK,
    MEMORY,
    PREVIEW,
    SENSED,
    SUFFIX,
    TICK,
    WIRE,
    Mark,
    Memory,
    Message,
    Wire,
    blade_message,
    image_message,
    log_message,
    memory_of,
    schema_of,
    sensed_bytes,
    tick_bytes,
)
from graderd.record.store import Store, directory_of

BEFORE_S = 30.0
AFTER_S = 10.0
"""The black box keeps so much before and after what set it off."""
MEMORY_EVERY_S = 10.0
"""A replay can begin at each of these; the ring holds up to so much more than :data:`BEFORE_S`."""
QUEUE_N = 2000
WIRE_LINES_N = 20_000
WIRE_EVERY_S = 0.1
TRANSFORM_EVERY_S = 0.1
DRAIN_S = 0.1
FLUSH_S = 0.5
"""A process that is killed loses what came in so long, and :data:`DRAIN_S`."""
GIVE_WAY_S = 0.0003
"""The thread rests so long after each value: who waits for the interpreter has it meanwhile."""
BEHIND_N = 15
"""With more than this waiting it rests no more until it has caught up: where others want the processors, a rest of
0.3 ms takes 20 ms and more, and at one a tick the queue grew, so that a kill took seconds of it."""
ENDING_S = 2.0
"""What is there is written within this, or is lost: a disk that hangs does not keep the daemon alive."""
STALLED_S = 5.0
"""A thread that has not come round for so long waits for the disk."""
FAULT_SHOWN_S = 5.0

log = logging.getLogger(__name__)


class Pictures(Protocol):
    """What the recorder wants of perception."""

    def preview_jpeg(self) -> Awaitable[Reading[bytes]]:
        """The next frame's annotated picture; raises TimeoutError where none comes."""
        ...

    def record_frames(self, wanted: FramesWanted) -> None:
        """Record raw frames from now on, or no more."""
        ...


class Step(NamedTuple):
    """One tick on its way into a file."""

    sensed: Sensed
    tick: Tick
    wires: dict[str, tuple[str, ...]]


Item = Step | Memory | Mark | Reading[bytes]


class Recorder:
    """Belongs to the daemon's event loop; :meth:`take` is called after every step of the tick."""

    def __init__(self, config: Config, settings: TickSettings, controller: Controller, eyes: Pictures) -> None:
        """``controller``: whose memory is kept; it is only read, between two ticks."""
        directory = directory_of(config.recording.directory)
        own = config.recording
        self._config = config
        self._settings = settings
        self._controller = controller
        self._eyes = eyes
        self._writer = None if directory is None else _Files(config, Store(directory, own.max_mb, own.min_free_mb))
        self._queue: deque[Item] = deque()
        self._lines: dict[str, deque[str]] = {}
        self._lost_n = self._lost_ever_n = 0
        self._memory_due_s = self._wires_due_s = -math.inf
        self._thread_ended = asyncio.Event()
        self._thread_ended.set()

    @property
    def directory(self) -> Path | None:
        """Where it writes; None: nothing is recorded."""
        return None if self._writer is None else self._writer.store.directory

    # ---- what comes in, on the event loop -------------------------------------------------------------------------

    def take(self, sensed: Sensed, tick: Tick) -> None:
        """A step of the tick, with what crossed the wires since the last one. Never waits."""
        if self._writer is None:
            return
        self._writer.now_s = tick.now_s
        if len(self._queue) >= QUEUE_N:
            self._lost_n += 1
            self._lost_ever_n += 1
            return
        if self._lost_n:
            self._queue.append(Mark(kind="lost", lost_n=self._lost_n, text="the disk or the processor did not keep up"))
            self._lost_n, self._memory_due_s = 0, -math.inf
        wires: dict[str, tuple[str, ...]] = {}
        if tick.now_s >= self._wires_due_s:
            self._wires_due_s = tick.now_s + WIRE_EVERY_S
            for name, lines in self._lines.items():
                if lines:
                    wires[name] = tuple(lines)
                    lines.clear()
        self._queue.append(Step(sensed, tick, wires))
        if tick.now_s >= self._memory_due_s:
            self._memory_due_s = tick.now_s + MEMORY_EVERY_S
            self._queue.append(Memory(now_s=tick.now_s, controller=memory_of(self._controller, self._settings)))

    def listen(self, wire: str) -> Callable[[str], None]:
        """What a wire's tap is to call with each line."""
        return self._lines.setdefault(wire, deque(maxlen=WIRE_LINES_N)).append

    def mark(self, text: str, client: str = "") -> None:
        """Somebody's word at this moment; the black box keeps what is around it."""
        self._queue.append(Mark(kind="note", text=text, client=client))

    def start(self, every_n: int) -> None:
        """Record the run from now on, with one raw frame of ``every_n`` (0: none)."""
        if self._writer is not None:
            self._writer.wanted = Wanted(True, every_n)

    def stop(self) -> None:
        """Record runs no more; the black box stays on."""
        if self._writer is not None:
            self._writer.wanted = Wanted(False, 0)

    def expect_stop(self) -> None:
        """The machine stops now because the daemon ends with nothing to interrupt: that is no incident."""
        if self._writer is not None:
            self._writer.incidents.expect_stop()

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """Why nothing is written now."""
        if self._writer is None:
            return ()
        return (*self._writer.faults.present(now_s), *self._stalled(now_s))

    def _stalled(self, now_s: float) -> tuple[DeviceFault, ...]:
        """What the thread cannot tell: that it hangs, in a call that the disk does not answer."""
        assert self._writer is not None
        since_s = self._writer.came_round_s
        if since_s is None or now_s - since_s <= STALLED_S or self._thread_ended.is_set():
            return ()
        detail = f"{self._writer.store.directory}: the disk has not answered for {now_s - since_s:.0f} s"
        return (DeviceFault("daemon", "recorder_failed", detail, since_s + STALLED_S),)

    def status(self) -> RecordingStatus:
        """For people; what the thread has open may be a moment old."""
        if self._writer is None:
            return RecordingStatus()
        run, incident = self._writer.open
        return RecordingStatus(run=run, incident=incident, waiting_n=len(self._queue), lost_n=self._lost_ever_n)

    # ---- what goes out --------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Write until cancelled; what is there is written on the way out. The event loop never waits for the disk."""
        if self._writer is None:
            log.info("nothing is recorded: recording.directory is empty, and there is no state directory")
            return
        await self._thread_ended.wait()  # of a run before that failed: the files are one thread's
        self._thread_ended.clear()
        ending = threading.Event()
        own = (asyncio.get_running_loop(), ending)
        threading.Thread(target=self._write, args=own, name="recorder", daemon=True).start()
        try:
            await self._ask_for_pictures()
        finally:
            ending.set()
            try:
                async with asyncio.timeout(ENDING_S):
                    await self._thread_ended.wait()
            except TimeoutError:
                log.error("recording: the disk does not answer; what was not written yet is lost")

    def _write(self, loop: asyncio.AbstractEventLoop, ending: threading.Event) -> None:
        """Body of the thread."""
        assert self._writer is not None
        try:
            self._writer.work(self._queue, ending, _from_thread(loop, self._eyes.record_frames))
        finally:
            _from_thread(loop, self._thread_ended.set)()

    async def _ask_for_pictures(self) -> None:
        pictures_hz = self._config.recording.pictures_hz
        if pictures_hz == 0.0:
            await asyncio.Event().wait()
        while True:
            await asyncio.sleep(1.0 / pictures_hz)
            try:
                picture = await self._eyes.preview_jpeg()
            except TimeoutError:
                continue
            if len(self._queue) < QUEUE_N:
                self._queue.append(picture)


def _from_thread(loop: asyncio.AbstractEventLoop, call: Callable[..., None]) -> Callable[..., None]:
    """The same on the event loop, for a thread to call."""

    def soon(*values: object) -> None:
        try:
            loop.call_soon_threadsafe(call, *values)
        except RuntimeError:  # the loop is closed, and with it went whom it would tell
            return

    return soon


class Wanted(NamedTuple):
    """Whether runs are recorded, and with one raw frame of how many (0: none)."""

    runs: bool
    every_n: int


class _Files:
    """The thread's side: what is taken becomes messages, goes through the ring and into the files that are open.

    ``wanted``, ``now_s`` and ``incidents.expect_stop`` are told by the event loop; everything else is the thread's.
    ``came_round_s``: the tick at which the thread was last seen to wait for nothing; None: it has not begun.
    """

    def __init__(self, config: Config, store: Store) -> None:
        own = config.recording
        self.store = store
        self.wanted = Wanted(own.runs, {"off": 0, "reduced": own.raw_every_n, "full": 1}[own.raw])
        self.faults = PresentFaults("daemon")
        self.incidents = IncidentWatch()
        self.now_s = 0.0
        self.came_round_s: float | None = None
        self._config_json = config.model_dump_json().encode()
        for topic in (SENSED, TICK, MEMORY):  # made once, now: it would hold up ticks later
            schema_of(topic)
        self._head = head_of(config)
        self._ring = Ring()
        self._translator = Translator()
        self._run: RecordingFile | None = None
        self._box: RecordingFile | None = None
        self._box_until_s = -math.inf
        self._part_n = 0
        self._every_n = 0
        self._gap = ""
        self._tell_frames: Callable[[FramesWanted], None] = lambda _: None

    @property
    def open(self) -> tuple[bool, bool]:
        """Whether a run, and the black box, are being written."""
        return self._run is not None, self._box is not None

    def work(
        self,
        queue: deque[Item],
        ending: threading.Event,
        tell_frames: Callable[[FramesWanted], None],
    ) -> None:
        """Body of the thread."""
        self._tell_frames = tell_frames
        due_s = 0.0
        while not ending.wait(DRAIN_S):
            self.came_round_s = self.now_s or None  # 0: no tick has come yet
            # Whatever still comes in, what is there is written out in time.
            while queue and time.monotonic() < due_s:
                self.put(queue.popleft())
                if len(queue) <= BEHIND_N:
                    time.sleep(GIVE_WAY_S)
            if (now_s := time.monotonic()) >= due_s:
                due_s = now_s + FLUSH_S
                self.tend()
        while queue:
            self.put(queue.popleft())
        self.tend()
        self._guarded(self._end)

    def put(self, item: Item) -> None:
        """Take one value: into the ring, and into the files that are open."""
        messages = self._translator.messages(item)
        if isinstance(item, Memory):
            self._guarded(self._next_part)
        if isinstance(item, Step):
            reason = self.incidents.seen_in(item.tick)
        else:
            reason = f"mark: {item.text}" if isinstance(item, Mark) and item.kind == "note" else ""
        if reason:
            messages = [*messages, self._translator.mark(Mark(kind="incident", text=reason))]
        self._ring.put(messages, begins_s=item.now_s if isinstance(item, Memory) else None)
        for file in (self._run, self._box):
            if file is not None:
                for message in messages:
                    file.add(message)
        if reason:
            self._guarded(lambda: self._keep(reason))
        if self._box is not None and self._translator.now_s > self._box_until_s:
            self._guarded(self._end_box)

    def tend(self) -> None:
        """Write out what was put; begin, end and make room."""
        self._guarded(self._tend)

    # ---- files ------------------------------------------------------------------------------------------------------

    def _tend(self) -> None:
        self.store.directory.mkdir(parents=True, exist_ok=True)
        if why := self.store.no_room():
            self._end(Mark(kind="ended", text=why))
            self._gap = why
            self._tell("disk_full", why)
            return
        for file in (self._run, self._box):
            if file is not None and not file.is_there():
                raise OSError(errno.ENOENT, "somebody took it away", str(file.path))
        self._obey()
        self._write_out()
        self.faults.clear("disk_full", "recorder_failed")

    def _write_out(self) -> None:
        open_files = [file for file in (self._run, self._box) if file is not None]
        kept = {path for file in open_files for path in (file.path, _frames_of(file.path))}
        self.store.make_room(sum(file.needed_n for file in open_files), kept)
        for file in open_files:
            file.flush()

    def _obey(self) -> None:
        """Begin or end the run as it is wanted now."""
        wanted = self.wanted
        if self._run is not None and (not wanted.runs or wanted.every_n != self._every_n):
            self._end_run()
        if self._run is None and wanted.runs and self._ring.has_begun:
            self._begin_run(self._ring.newest())

    def _next_part(self) -> None:
        """At a memory, where a replay can begin, a run that has grown large goes on in another file; and where the wall
        clock was set, so that within one file time does not jump."""
        if self._run is not None and (
            self._translator.clock_was_set or self._run_size_n(self._run) >= self.store.part_most_bytes
        ):
            self._end_run()
            self._begin_run(iter(()))

    def _run_size_n(self, run: RecordingFile) -> int:
        """With its raw frames, which are the child's."""
        frames = _frames_of(run.path)
        return run.size_n + (frames.stat().st_size if self._every_n and frames.exists() else 0)

    def _begin_run(self, messages: Iterator[Message]) -> None:
        self._every_n = self.wanted.every_n
        self._run = self._begin("run", SUFFIX, messages)
        self._part_n += 1
        if self._every_n:
            frames, head = _frames_of(self._run.path), {**self._head, "kind": "frames", "every_n": str(self._every_n)}
            wanted = FramesWanted(
                path=str(frames), every_n=self._every_n, head=head, config_json=self._config_json.decode()
            )
            self._tell_frames(wanted)

    def _begin(self, kind: str, suffix: str, messages: Iterator[Message], **more: str) -> RecordingFile:
        now = datetime.now(UTC)
        head = {
            **self._head,
            **more,
            "kind": kind,
            "started": now.isoformat(timespec="seconds"),
            "part": str(self._part_n),
        }
        if self._gap:
            head["gap_before"] = self._gap
        file = RecordingFile(self.store.new_path(now, suffix), head, self._config_json, CHANNELS)
        for number, message in enumerate(messages):
            file.add(message)
            if number % 20 == 19:
                time.sleep(GIVE_WAY_S)
        self._gap = ""
        return file

    def _keep(self, reason: str) -> None:
        """The ring into a file of its own, and what follows after it."""
        self._box_until_s = self._translator.now_s + AFTER_S
        if self._box is None:
            self._box = self._begin("incident", INCIDENT_SUFFIX, self._ring.everything(), reason=reason)
            self._write_out()
            log.info("black box: %s is kept in %s", reason, self._box.path.name)

    def _end_run(self) -> None:
        if self._run is not None:
            if self._every_n:
                self._tell_frames(FramesWanted())
            run, self._run = self._run, None
            run.finish()

    def _end_box(self) -> None:
        if self._box is not None:
            box, self._box = self._box, None
            box.finish()

    def _end(self, mark: Mark | None = None) -> None:
        for file in (self._run, self._box):
            if file is not None and mark is not None:
                file.add(self._translator.mark(mark))
        self._end_run()
        self._end_box()

    def _guarded(self, work: Callable[[], None]) -> None:
        """What fails ends the files as they are, whole to their last chunk; the next begin anew."""
        try:
            work()
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            detail = f"{error.filename or self.store.directory}: {error.strerror}"
            self._abandon(detail)
            self._tell("disk_full" if full else "recorder_failed", detail)
        except Exception as error:  # a mistake of ours must not end the thread, nor go unseen
            log.exception("the recorder failed")
            self._abandon(str(error))
            self._tell("recorder_failed", str(error))

    def _abandon(self, why: str) -> None:
        self._gap = why
        for end in (self._end_run, self._end_box):
            try:
                end()
            except Exception:  # it is whole to its last chunk, and readers know
                log.debug("a recording has no end", exc_info=True)

    def _tell(self, condition: str, detail: str) -> None:
        if self.faults.tell(condition, detail, self.now_s, FAULT_SHOWN_S):
            log.warning("recording: %s", detail)
        self.faults.clear(*({"disk_full", "recorder_failed"} - {condition}))


def _frames_of(run: Path) -> Path:
    """The file of a run's raw frames."""
    return run.with_name(run.name.partition(".")[0] + FRAMES_SUFFIX)


def head_of(config: Config) -> dict[str, str]:
    """What every file says of where it comes from."""
    calibrated = (config.camera.calibration, config.rotation, config.attitude, config.blade)
    calibration = b"".join(part.model_dump_json().encode() for part in calibrated)
    return {
        "version": version("graderd"),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "simulated": str(config.simulated).lower(),
        "tick_hz": f"{config.control.tick_hz:g}",
        "config_sha256": config.sha256(),
        "calibration_id": hashlib.sha256(calibration).hexdigest()[:12],
    }


class Ring:
    """The messages of the last :data:`BEFORE_S` and a little more, in stretches that begin with a memory.

    Its time is the monotonic one: where the wall clock is set, it neither grows nor forgets.
    """

    def __init__(self) -> None:
        self._stretches: deque[tuple[float, list[Message]]] = deque()
        self._has_memory = False

    @property
    def has_begun(self) -> bool:
        """Whether there is anything."""
        return bool(self._stretches)

    def put(self, messages: list[Message], begins_s: float | None = None) -> None:
        """Append; ``begins_s``: when a memory, with which a stretch begins, was. What came before the first memory
        stands before it in the first stretch."""
        if not self._stretches:
            self._stretches.append((-math.inf if begins_s is None else begins_s, []))
        elif begins_s is not None and self._has_memory:
            self._stretches.append((begins_s, []))
            while len(self._stretches) > 2 and self._stretches[1][0] <= begins_s - BEFORE_S:
                self._stretches.popleft()
        self._has_memory = self._has_memory or begins_s is not None
        self._stretches[-1][1].extend(messages)

    def newest(self) -> Iterator[Message]:
        """From the last memory on."""
        return iter(self._stretches[-1][1])

    def everything(self) -> Iterator[Message]:
        """All that is held."""
        return (message for _, stretch in self._stretches for message in stretch)


class Translator:
    """Makes messages of what is taken, and log lines of what changed from tick to tick."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.clock_was_set = False
        """With the last memory: what comes from it on has another wall clock than what was before."""
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._mode: Mode | None = None
        self._faults: frozenset[str] = frozenset()
        self._transform_due_s = -math.inf

    def messages(self, item: Item) -> list[Message]:
        """What goes into the file for it."""
        if isinstance(item, Step):
            return list(self._step(item))
        if isinstance(item, Memory):
            offset_ns = time.time_ns() - time.monotonic_ns()
            self.clock_was_set = abs(offset_ns - self._offset_ns) > 1e9
            if self.clock_was_set:
                self._offset_ns = offset_ns
            return [Message(MEMORY, self._at_ns(item.now_s), item.model_dump_json().encode())]
        if isinstance(item, Mark):
            return [self.mark(item)]
        picture = base64.b64encode(item.value).decode()
        return [image_message(PREVIEW, self._at_ns(item.time_s), picture, "jpeg")]

    def mark(self, mark: Mark) -> Message:
        """A mark at the time of the last tick."""
        return Message(MARK, self._at_ns(self.now_s), mark.model_dump_json().encode())

    def _at_ns(self, time_s: float) -> int:
        return int(time_s * 1e9) + self._offset_ns

    def _step(self, step: Step) -> Iterator[Message]:
        tick = step.tick
        self.now_s = tick.now_s
        at_ns = self._at_ns(tick.now_s)
        yield Message(SENSED, at_ns, sensed_bytes(step.sensed))
        yield Message(TICK, at_ns, tick_bytes(tick))
        for name, lines in step.wires.items():
            yield Message(WIRE + name, at_ns, Wire(lines=lines).model_dump_json().encode())
        for level, name, text in self._changes(step):
            yield log_message(at_ns, LEVELS[level], name, text)
        if tick.now_s >= self._transform_due_s:
            self._transform_due_s = tick.now_s + TRANSFORM_EVERY_S
            if tick.pose.rotation_deg is not None:
                yield blade_message(at_ns, tick.pose.rotation_deg, tick.attitude.height_mm)

    def _changes(self, step: Step) -> Iterator[tuple[str, str, str]]:
        """Level, name and words of what happened in this tick."""
        tick = step.tick
        for command, reply in zip(step.sensed.commands, tick.replies, strict=True):
            if command.command != "renew":
                answer = reply.message if reply.accepted else f"refused: {reply.message}"
                yield "INFO", "command", f"{command.command} by {command.client or '?'}: {answer}"
        if tick.state.mode is not self._mode:
            level = "ERROR" if tick.state.mode is Mode.STOPPED else "INFO"
            yield level, "mode", f"{self._mode or 'start'} -> {tick.state.mode}: {tick.state.reason}"
            self._mode = tick.state.mode
        if tick.faults or self._faults:
            names = frozenset(fault.name for fault in tick.faults)
            for fault in tick.faults:
                if fault.name not in self._faults:
                    level = "WARNING" if fault.row.reaction is Reaction.WARN else "ERROR"
                    yield level, "fault", f"{fault.name}: {fault.row.reads} ({fault.detail})"
            for name in sorted(self._faults - names):
                yield "INFO", "fault", f"{name}: over"
            self._faults = names


class IncidentWatch:
    """Finds in the ticks what a recording is looked at for: a stop, a disarm, and a fault that holds an armed machine
    or takes it out of operation."""

    def __init__(self) -> None:
        self._mode: Mode | None = None
        self._faults: frozenset[str] = frozenset()
        self._stop_expected = False

    def expect_stop(self) -> None:
        """The next stop is none."""
        self._stop_expected = True

    def seen_in(self, tick: Tick) -> str:
        """What has come with this tick; empty: nothing."""
        before, now = self._mode, tick.state.mode
        present = tuple(f for f in tick.faults if f.row.reaction is not Reaction.WARN) if tick.faults else ()
        faults = frozenset(f.name for f in present)
        fresh = faults - self._faults
        self._mode, self._faults = now, faults
        if before is None:
            return ""
        if now is Mode.STOPPED and before is not Mode.STOPPED:
            return "" if self._stop_expected else f"stop: {tick.state.reason}"
        if now is Mode.DISARMED and before in ARMED:
            return f"disarm: {tick.state.reason}"
        if fresh and before in ARMED:
            return "fault: " + ", ".join(sorted(fresh))
        return ""
