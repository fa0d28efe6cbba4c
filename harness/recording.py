"""A recorder that is fed as the daemon feeds it, without a machine: for tests and benchmarks of recordings.

``python -m harness.recording FOLDER`` records at 50 Hz until it is killed.
"""

from __future__ import annotations

import asyncio
import itertools
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from graderd.config import parse
from graderd.core.tick import Controller, Sensed
from graderd.hal.reading import Reading
from graderd.record import FramesWanted
from graderd.record.files import RecordingFile
from graderd.record.layout import TICK, Memory, memory_of
from graderd.record.reader import Recording, said
from graderd.record.recorder import FLUSH_S, MEMORY_EVERY_S, Item, Recorder, Step, Translator, head_of
from harness.stretch import SETTINGS, TICK_S, stretch_of_work

CAN_LINES_N, SERVO_LINES_N = 4, 6
"""A tick, as on the simulated grader."""


class NoEyes:
    """Perception that has no pictures."""

    def __init__(self) -> None:
        self.told: list[FramesWanted] = []

    async def preview_jpeg(self) -> Reading[bytes]:
        raise TimeoutError

    def record_frames(self, wanted: FramesWanted) -> None:
        self.told.append(wanted)


class Feed:
    """A controller that goes over a stretch of work again and again, and its recorder."""

    def __init__(self, directory: Path) -> None:
        config = parse({"recording": {"directory": str(directory), "min_free_mb": 0}})
        self._controller = Controller(SETTINGS)
        self.recorder = Recorder(config, SETTINGS, self._controller, NoEyes())
        self._work = itertools.cycle([replace(sensed, commands=()) for sensed in stretch_of_work()])
        self._hear = {name: self.recorder.listen(name) for name in ("can", "servo")}
        self.now_s = time.monotonic()

    def tick(self, recording: bool = True) -> None:
        """One tick, now."""
        self.now_s = time.monotonic()
        sensed: Sensed = replace(next(self._work), now_s=self.now_s)
        tick = self._controller.step(sensed)
        if recording:
            for name, count_n in (("can", CAN_LINES_N), ("servo", SERVO_LINES_N)):
                for _ in range(count_n):
                    self._hear[name](f"({self.now_s:.6f}) {name} tx FFFFFD00010D0002220174000C00F5B3")
            self.recorder.take(sensed, tick)

    async def ticks(self, seconds: float, recording: bool = True) -> list[float]:
        """Tick at 50 Hz for so long; how late each was, in milliseconds."""
        due_s, late_ms = time.monotonic(), []
        for _ in range(round(seconds / TICK_S)):
            late_ms.append(max(0.0, time.monotonic() - due_s) * 1e3)
            self.tick(recording)
            due_s = max(due_s + TICK_S, time.monotonic())
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
        return late_ms


def record_until_killed(folder: Path, after_s: float) -> float:
    """Have another process record into ``folder``, kill it so long after its first tick, and return how much of what it
    ticked its file lacks, seconds.

    Raises:
        AssertionError: it left no file that reads.
    """
    command = [sys.executable, "-m", "harness.recording", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            first_s = last_s = float(process.stdout.readline())
            while last_s - first_s < after_s:
                last_s = float(process.stdout.readline())
        finally:
            process.kill()
        ticked = process.stdout.read().split(b"\n")[:-1]  # what came after its last line end is no whole line
    last_s = float(ticked[-1]) if ticked else last_s
    (path,) = folder.glob("*.mcap")
    kept_s = [float(said(message.data)["now_s"]) for message in Recording(path).messages((TICK,))]
    return last_s - (kept_s[-1] if kept_s else first_s)


def record_in_virtual_time(folder: Path, seconds: float) -> Path:
    """A run of so long, in one file, without waiting."""
    config = parse({"recording": {"directory": str(folder), "min_free_mb": 0, "max_mb": 100_000}})
    controller = Controller(SETTINGS)
    path = folder / "graderd-virtual.mcap"
    file = RecordingFile(path, head_of(config), config.model_dump_json().encode())
    translator, due_s, flush_s = Translator(), 0.0, 0.0
    work = itertools.cycle(stretch_of_work())
    for number in range(round(seconds / TICK_S)):
        sensed = _later(next(work), number * TICK_S)
        now_s = sensed.now_s
        items: list[Item] = [Step(sensed, controller.step(sensed), {})]
        if now_s >= due_s:
            due_s = now_s + MEMORY_EVERY_S
            items.append(Memory(now_s=now_s, controller=memory_of(controller, SETTINGS)))
        for item in items:
            for message in translator.messages(item):
                file.add(message)
        if now_s >= flush_s:
            flush_s = now_s + FLUSH_S
            file.flush()
    file.finish()
    return path


def _later(sensed: Sensed, now_s: float) -> Sensed:
    """The same at another time, with readings as old as they were."""
    by_s = now_s - sensed.now_s

    def moved(told: Any) -> Any:
        changes = {
            field.name: replace(reading, time_s=reading.time_s + by_s)
            for field in fields(told)
            if isinstance(reading := getattr(told, field.name), Reading)
        }
        return replace(told, **changes)

    axes = {name: replace(axis, telemetry=moved(axis.telemetry)) for name, axis in sensed.axes.items()}
    seen = sensed.observation
    if seen is not None:
        seen = replace(seen, capture_s=seen.capture_s + by_s)
    faults = tuple(replace(fault, since_s=fault.since_s + by_s) for fault in sensed.faults)
    return replace(sensed, now_s=now_s, axes=axes, observation=seen, faults=faults)


async def _record(folder: Path) -> None:
    feed = Feed(folder)
    task = asyncio.create_task(feed.recorder.run())
    while not task.done():
        await feed.ticks(TICK_S)
        sys.stdout.write(f"{feed.now_s}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    asyncio.run(_record(Path(sys.argv[1])))
