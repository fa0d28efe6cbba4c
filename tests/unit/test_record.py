"""The recorder: its files read back bit for bit, survive kill and full disk, and hold what led to an incident."""

from __future__ import annotations

import asyncio
import errno
import itertools
import json
import math
import os
import pickle
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader

from graderd.config import Config, parse
from graderd.core import rule as rule_module
from graderd.core.attitude import MeasuredAttitude
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import ActiveFault
from graderd.core.machine import Mode, State
from graderd.core.soil import SoilObservation, Zone
from graderd.core.tick import Controller, Sensed, Tick
from graderd.hal.camera import Frame, Intrinsics
from graderd.hal.reading import Reading
from graderd.record import FramesWanted, layout
from graderd.record import recorder as recorder_module
from graderd.record.export import export, raw_frames
from graderd.record.files import RecordingFile
from graderd.record.frames import FrameRecorder, Judged
from graderd.record.layout import (
    COLOR,
    FRAME,
    LOG,
    MARK,
    MEMORY,
    PREVIEW,
    SENSED,
    TICK,
    TRANSFORM,
    WIRE,
    Mark,
    Memory,
    controller_of,
    memory_of,
    schema_of,
    sensed_bytes,
    sensed_of,
    tick_bytes,
    tick_of,
)
from graderd.record.reader import Recording, said
from graderd.record.recorder import AFTER_S, BEFORE_S, Recorder, head_of
from graderd.record.store import Store
from harness.recording import Feed, NoEyes, record_until_killed
from harness.stretch import SETTINGS, stretch_of_work

WORK = stretch_of_work()
TOPICS = (SENSED, TICK, MEMORY, MARK, LOG, TRANSFORM, PREVIEW, FRAME, COLOR, f"{WIRE}can")


def ticks() -> list[Tick]:
    controller = Controller(SETTINGS)
    return [controller.step(sensed) for sensed in WORK]


TICKS = ticks()


# ---- values as messages ----------------------------------------------------------------------------------------------


def test_what_a_tick_knew_and_decided_reads_back_bit_for_bit() -> None:
    assert [sensed_of(sensed_bytes(sensed)) for sensed in WORK] == WORK
    assert [tick_of(tick_bytes(tick)) for tick in TICKS] == TICKS


@pytest.mark.parametrize("value", [math.inf, -math.inf, 5e-324, 0.1 + 0.2, -0.0, 1.7976931348623157e308])
def test_no_number_is_rounded(value: float) -> None:
    back = sensed_of(sensed_bytes(replace(WORK[0], late_s=value))).late_s
    assert (back, math.copysign(1.0, back)) == (value, math.copysign(1.0, value))


@pytest.mark.parametrize("topic", TOPICS)
def test_a_schema_is_plain_enough_for_foxglove(topic: str) -> None:
    """Its reader of schemas follows no reference and no alternative but a choice of constants."""

    def walk(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
        yield schema
        for inner in schema.get("properties", {}).values():
            yield from walk(inner)
        if "items" in schema:
            yield from walk(schema["items"])

    name, text = schema_of(topic)
    schema = json.loads(text)
    assert schema["type"] == "object", name
    for part in walk(schema):
        assert not {"$ref", "anyOf", "allOf", "prefixItems"} & part.keys()
        assert isinstance(part.get("type", "constants" if "oneOf" in part else None), str), part


def test_the_messages_are_as_their_schemas_say(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS, WORK)
    work.recorder.listen("can")("(1.0) can0 18EF1300#00")
    work.ticks(TICKS[-1:], WORK[-1:], after_s=1.0)
    work.put(Reading(b"jpeg", work.now_s))
    seen: dict[str, int] = {}
    for message in work.end().messages():
        seen[message.topic] = seen.get(message.topic, 0) + 1
        if seen[message.topic] % 25 != 1:
            continue
        schema = json.loads(schema_of(message.topic)[1])
        told = said(message.data)
        if message.topic == TICK and told["state"]["decision"].get("decided_s") == "-Infinity":
            del told["state"]["decision"]["decided_s"]  # JSON has no number for it
        jsonschema.Draft202012Validator(schema).validate(told)
    assert seen.keys() == {SENSED, TICK, MEMORY, MARK, LOG, TRANSFORM, PREVIEW, f"{WIRE}can"}


@pytest.mark.parametrize("at_n", [1, 7, 95, 120, 200, 261])
def test_the_tick_goes_on_from_its_memory_bit_for_bit(at_n: int) -> None:
    controller = Controller(SETTINGS)
    for sensed in WORK[:at_n]:
        controller.step(sensed)
    resumed = controller_of(memory_of(controller, SETTINGS), SETTINGS)
    assert [tick_bytes(resumed.step(sensed)) for sensed in WORK[at_n:]] == [tick_bytes(t) for t in TICKS[at_n:]]


def test_the_memory_is_alike_in_every_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """3.11.0 to 3.11.3 write an enum as a call that the reader refuses; Debian 12 has 3.11.2."""
    controller = Controller(SETTINGS)
    for sensed in WORK[:95]:
        controller.step(sensed)
    written = memory_of(controller, SETTINGS)
    for kind in (Mode, Zone):
        monkeypatch.setattr(kind, "__reduce_ex__", lambda value, _: (getattr, (type(value), value.name)))
    assert memory_of(controller, SETTINGS) == written
    controller_of(written, SETTINGS)


class Evil:
    def __reduce__(self) -> Any:
        return os.system, ("true",)


class Renamed:
    def __reduce__(self) -> Any:
        return eval, ("1",)


@pytest.mark.parametrize(
    "memory", [b"", b"no pickle", pickle.dumps(Evil()), pickle.dumps(Renamed()), pickle.dumps(Mode.AUTO)]
)
def test_a_memory_that_is_none_is_refused_and_runs_nothing(memory: bytes) -> None:
    with pytest.raises(ValueError, match="the tick's memory"):
        controller_of(layout._fingerprint() + memory, SETTINGS)


def test_a_memory_of_a_class_with_other_fields_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = memory_of(Controller(SETTINGS), SETTINGS)
    layout._fingerprint.cache_clear()
    monkeypatch.setattr(rule_module, "Later", SoilObservation, raising=False)
    with pytest.raises(ValueError, match="another version"):
        controller_of(memory, SETTINGS)
    monkeypatch.undo()
    layout._fingerprint.cache_clear()
    controller_of(memory, SETTINGS)


def test_a_memory_of_another_version_is_refused() -> None:
    controller = Controller(SETTINGS)
    controller._later_idea = 1  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="another version"):
        controller_of(memory_of(controller, SETTINGS), SETTINGS)


# ---- a recorder without its thread -----------------------------------------------------------------------------------


class Work:
    """A recorder that is given ticks, and written out after each."""

    def __init__(self, directory: Path, **settings: object) -> None:
        self.config: Config = parse({"recording": {"directory": str(directory), "min_free_mb": 0, **settings}})
        self.eyes = NoEyes()
        self.recorder = Recorder(self.config, SETTINGS, Controller(SETTINGS), self.eyes)
        assert self.recorder._writer is not None
        self.files = self.recorder._writer
        self.files._tell_frames = self.eyes.record_frames
        self.directory = directory
        self.now_s = 1000.0
        self.most_n = 0

    def put(self, item: recorder_module.Item) -> None:
        self.files.put(item)
        self.files.tend()

    def drain(self) -> None:
        queue = self.recorder._queue
        while queue:
            self.files.put(queue.popleft())
        self.files.tend()
        self.most_n = max(self.most_n, sum(path.stat().st_size for path in self.paths()))

    def ticks(self, ticks: list[Tick], sensed: list[Sensed], after_s: float = 0.1) -> None:
        """Each ``after_s`` after the one before, whatever its own time was."""
        for tick, knew in zip(ticks, sensed, strict=True):
            self.now_s += after_s
            self.recorder.take(replace(knew, now_s=self.now_s), tick._replace(now_s=self.now_s))
            self.drain()

    def stand(self, seconds: float, mode: Mode = Mode.MANUAL, fault: str = "", after_s: float = 0.5) -> None:
        """Nothing happens but that mode and that fault."""
        row = CATALOGUE[fault] if fault else None
        faults = (ActiveFault(fault, row, "", self.now_s, True),) if row else ()
        tick = TICKS[0]._replace(state=State(mode=mode, reason="t"), faults=faults)
        for _ in range(round(seconds / after_s)):
            self.ticks([tick], [replace(WORK[0], commands=())], after_s)

    def paths(self, kind: str = "") -> list[Path]:
        found = Store(self.directory, 1.0, 0.0).entries()
        return [entry.path for entry in found if kind in ("", entry.kind)]

    def end(self) -> Recording:
        """End in order; the one run there is."""
        self.files._guarded(self.files._end)
        (path,) = self.paths("run")
        return Recording(path)


def spans_s(path: Path) -> tuple[float, float]:
    times_s = [said(message.data)["now_s"] for message in Recording(path).messages((SENSED,))]
    return times_s[0], times_s[-1]


def test_a_recording_says_where_it_comes_from(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS, WORK)
    recording = work.end()
    assert recording.config == work.config
    assert recording.head["config_sha256"] == head_of(work.config)["config_sha256"]
    assert {"version", "python", "calibration_id", "started"} <= recording.head.keys()
    assert recording.extent.is_ended
    back = [sensed_of(m.data) for m in recording.messages((SENSED,))]
    assert [replace(sensed, now_s=0.0) for sensed in back] == [replace(sensed, now_s=0.0) for sensed in WORK]
    lines = [said(m.data)["message"] for m in recording.messages((LOG,))]
    assert "arm by a: arming" in lines
    assert "stop by b: stopped" in lines
    assert any(line.startswith("lift_left.no_feedback: ") for line in lines)
    assert "lift_left.no_feedback: over" in lines
    assert not any(line.startswith("renew") for line in lines)


def test_a_whole_recording_validates_with_the_public_library(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS, WORK)
    path = work.end().path
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = list(reader.iter_messages())
        assert len(found) == summary.statistics.message_count == len(list(Recording(path).messages()))
        assert [m.name for m in reader.iter_metadata()] == ["graderd", "graderd.channels"]
        assert [a.name for a in reader.iter_attachments()] == ["config.json"]
    times = [message.log_time for _, _, message in found]
    assert times == sorted(times)


def test_a_recording_cut_off_anywhere_reads_to_its_last_whole_chunk(tmp_path: Path) -> None:
    work = Work(tmp_path / "whole")
    work.ticks(TICKS[:60], WORK[:60])
    recording = work.end()
    whole = list(recording.messages())
    data, cut = recording.path.read_bytes(), tmp_path / "graderd-cut.mcap"
    head_n = data.index(b"zstd")
    most_n = -1
    for length_n in range(head_n, len(data), max(1, (len(data) - head_n) // 60)):
        cut.write_bytes(data[:length_n])
        found = list(Recording(cut).messages())
        assert found == whole[: len(found)]
        assert len(found) >= most_n
        assert Recording(cut).extent.is_ended is False
        most_n = len(found)
    assert most_n == len(whole)


def test_damage_in_a_chunk_is_no_data(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS[:60], WORK[:60])
    recording = work.end()
    whole = list(recording.messages())
    data = bytearray(recording.path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    recording.path.write_bytes(data)
    found = list(Recording(recording.path).messages())
    assert len(found) < len(whole)
    assert [message.topic for message in found if message not in whole] == ["/gap"]


@pytest.mark.live
def test_a_killed_recorder_loses_a_second_at_most(tmp_path: Path) -> None:
    """Shorter than ``python -m benchmarks.record``, which kills a hundred."""
    for number, after_s in enumerate((0.8, 1.3, 1.9)):
        assert record_until_killed(tmp_path / str(number), after_s) <= 1.0


@pytest.mark.live
async def test_a_starved_thread_keeps_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each rest takes as long as others leave it waiting: 0.3 ms become 50."""
    rest = time.sleep
    monkeypatch.setattr(time, "sleep", lambda seconds: rest(seconds + 0.05))
    feed = Feed(tmp_path)
    task = asyncio.create_task(feed.recorder.run())
    await feed.ticks(3.0)
    (path,) = tmp_path.glob("*.mcap")
    *_, last = Recording(path).messages((TICK,))
    lost_s = feed.now_s - said(last.data)["now_s"]
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert lost_s <= 1.0


# ---- the disk --------------------------------------------------------------------------------------------------------


def test_a_disk_that_fills_up_cuts_nothing_and_glues_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS[:60], WORK[:60])
    (first,) = work.paths()
    size_n, write = first.stat().st_size, os.write

    def full(file: int, data: bytes) -> int:
        if len(data) > 100:
            return write(file, data[:100])  # the last that fits
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    work.ticks(TICKS[60:61], WORK[60:61])
    assert first.stat().st_size == size_n
    (fault,) = work.recorder.faults(work.now_s)
    assert fault.condition == "disk_full"
    work.ticks(TICKS[61:70], WORK[61:70])
    monkeypatch.setattr(os, "write", write)
    work.ticks(TICKS[70:100], WORK[70:100])
    work.files._guarded(work.files._end)
    assert work.recorder.faults(work.now_s) == ()
    assert first.stat().st_size == size_n
    assert len(list(Recording(first).messages((TICK,)))) == 60
    last = Recording(work.paths("run")[-1])
    assert "No space left on device" in last.head["gap_before"]
    assert last.extent.is_ended


def test_recording_ends_before_the_disk_is_full_and_says_so_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS[:60], WORK[:60])
    usage = shutil.disk_usage
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(path)._replace(free=-1))
    work.ticks(TICKS[60:70], WORK[60:70])
    (fault,) = work.recorder.faults(work.now_s)
    assert fault.condition == "disk_full"
    (first,) = work.paths()
    marks = [Mark.model_validate_json(m.data) for m in Recording(first).messages((MARK,))]
    assert marks[-1].kind == "ended"
    assert "MB free" in marks[-1].text
    assert Recording(first).extent.is_ended
    monkeypatch.setattr(shutil, "disk_usage", usage)
    work.ticks(TICKS[70:100], WORK[70:100])
    assert len(work.paths()) == 2
    assert "MB free" in Recording(work.paths()[-1]).head["gap_before"]


def test_a_directory_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    work = Work(tmp_path / "file" / "sub")
    work.files.put(Memory(now_s=1.0, controller=b""))
    work.files.tend()
    assert [fault.condition for fault in work.recorder.faults(0.1)] == ["recorder_failed"]


def test_a_file_that_somebody_took_away_is_begun_anew(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS[:20], WORK[:20])
    (first,) = work.paths()
    first.unlink()
    work.ticks(TICKS[20:40], WORK[20:40])
    (second,) = work.paths()
    assert "took it away" in Recording(second).head["gap_before"]


def test_a_mistake_of_the_recorder_is_told_and_the_next_file_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work(tmp_path)
    work.ticks(TICKS[:20], WORK[:20])
    with monkeypatch.context() as broken:
        broken.setattr(RecordingFile, "flush", lambda _: 1 / 0)
        work.ticks(TICKS[20:21], WORK[20:21])
    assert [fault.condition for fault in work.recorder.faults(work.now_s)] == ["recorder_failed"]
    work.ticks(TICKS[21:40], WORK[21:40])
    assert Recording(work.paths("run")[-1]).head["gap_before"] == "division by zero"


def test_the_limit_is_kept_while_recording_and_the_newest_stays(tmp_path: Path) -> None:
    work = Work(tmp_path, max_mb=0.4)
    work.stand(900.0, after_s=1.0)
    assert work.most_n <= 400_000
    assert work.most_n > 300_000, "the room that is given is used"
    times_s = [at_s for path in work.paths() for at_s in spans_s(path)]
    assert times_s[-1] == work.now_s
    parts = [spans_s(path) for path in work.paths()]
    assert all(b[0] - a[1] == pytest.approx(1.0) for a, b in itertools.pairwise(parts)), "nothing is missing between"
    for path in work.paths()[1:]:
        assert next(Recording(path).messages()).topic == MEMORY, "a replay can begin with every part"


def test_a_limit_that_holds_nothing_is_told(tmp_path: Path) -> None:
    work = Work(tmp_path, max_mb=0.005)
    work.stand(2.0)
    (fault,) = work.recorder.faults(work.now_s)
    assert fault.condition == "disk_full"
    assert "recording.max_mb (0.005) is full" in fault.detail


def test_recordings_of_the_former_kind_go_first(tmp_path: Path) -> None:
    for index in range(5):
        path = tmp_path / f"graderd-2020010{index}T000000Z.jsonl"
        path.write_bytes(b"x" * 1_000_000)
        os.utime(path, (index, index))
    Work(tmp_path, max_mb=2.5).stand(1.0)
    assert [path.name[-12:] for path in sorted(tmp_path.glob("*.jsonl"))] == ["00000Z.jsonl"] * 2


# ---- the black box ---------------------------------------------------------------------------------------------------

FAULT = "rotation.no_reply"


@pytest.mark.parametrize("incident", ["stop", "disarm", "fault", "mark"])
@pytest.mark.parametrize("runs", [True, False])
def test_the_black_box_keeps_what_was_around_it(tmp_path: Path, incident: str, runs: bool) -> None:
    work = Work(tmp_path, runs=runs)
    work.stand(100.0)
    work.put(Reading(b"jpeg", work.now_s))
    at_s = work.now_s + 0.5
    if incident == "mark":
        work.recorder.mark("look here", "ann")
    work.stand(60.0, {"stop": Mode.STOPPED, "disarm": Mode.DISARMED}.get(incident, Mode.MANUAL),
               FAULT if incident == "fault" else "")  # fmt: skip
    (kept,) = work.paths("incident")
    assert bool(work.paths("run")) is runs
    first_s, last_s = spans_s(kept)
    assert at_s - BEFORE_S - recorder_module.MEMORY_EVERY_S - 1.0 <= first_s <= at_s - BEFORE_S
    assert at_s + AFTER_S <= last_s <= at_s + AFTER_S + 1.0
    recording = Recording(kept)
    assert recording.extent.is_ended
    assert recording.head["reason"].startswith({"mark": "mark: look here"}.get(incident, incident))
    assert len(list(recording.messages((PREVIEW,)))) == 1
    assert any(said(m.data)["kind"] == "incident" for m in recording.messages((MARK,)))


def test_an_ordinary_day_is_no_incident(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.stand(5.0, Mode.DISARMED, FAULT)  # nothing plugged in yet
    work.stand(5.0, Mode.MANUAL, "camera.settings_not_kept")
    work.stand(5.0, Mode.AUTO)
    work.recorder.expect_stop()
    work.stand(5.0, Mode.STOPPED)
    assert work.paths("incident") == []


def test_a_daemon_that_starts_stopped_is_no_incident(tmp_path: Path) -> None:
    work = Work(tmp_path)
    work.stand(5.0, Mode.STOPPED)
    assert work.paths("incident") == []


@pytest.mark.parametrize("by_s", [3600, -3600])
def test_a_clock_that_is_set_neither_fills_the_ring_nor_empties_it_nor_jumps_in_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_s: int
) -> None:
    work = Work(tmp_path)
    work.stand(60.0)
    clock = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: clock() + by_s * 10**9)
    work.stand(45.0)
    for path in work.paths("run"):
        assert Recording(path).extent.duration_s < 80.0
    assert len(work.paths("run")) == 2
    work.recorder.mark("now")
    work.stand(AFTER_S + 1.0)
    (incident,) = work.paths("incident")
    from_s, to_s = spans_s(incident)
    assert BEFORE_S + AFTER_S <= to_s - from_s <= BEFORE_S + AFTER_S + 12.0


def test_two_daemons_may_record_into_one_folder(tmp_path: Path) -> None:
    both = [Work(tmp_path), Work(tmp_path)]
    for tick, sensed in zip(TICKS[:60], WORK[:60], strict=True):
        for work in both:
            work.ticks([tick], [sensed])
    for work in both:
        work.files._guarded(work.files._end)
    paths = both[0].paths("run")
    assert len(paths) == 2
    assert [len(list(Recording(path).messages((TICK,)))) for path in paths] == [60, 60]


def test_incidents_go_last(tmp_path: Path) -> None:
    work = Work(tmp_path, max_mb=0.4)
    work.stand(30.0)
    work.stand(20.0, Mode.STOPPED)
    (kept,) = work.paths("incident")
    work.stand(900.0, Mode.STOPPED, after_s=1.0)
    assert work.paths("incident") == [kept]
    assert work.most_n <= 400_000


# ---- what comes in ---------------------------------------------------------------------------------------------------


def test_what_is_not_taken_off_in_time_is_counted_and_a_replay_goes_on_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "QUEUE_N", 20)
    work = Work(tmp_path)
    for tick, sensed in zip(TICKS[:50], WORK[:50], strict=True):
        work.recorder.take(sensed, tick)
    assert len(work.recorder._queue) <= 21
    work.drain()
    work.recorder.take(WORK[50], TICKS[50])
    work.drain()
    found = list(work.end().messages((MARK, MEMORY, TICK)))
    (lost,) = (index for index, message in enumerate(found) if message.topic == MARK)
    assert said(found[lost].data)["lost_n"] + sum(m.topic == TICK for m in found) == 51
    assert [message.topic for message in found[lost + 1 :]] == [TICK, MEMORY]


def test_what_crosses_a_wire_is_kept_line_by_line(tmp_path: Path) -> None:
    work = Work(tmp_path)
    hear = work.recorder.listen("servo")
    lines = [f"({n}.000000) servo tx FFFFFD00{n:02X}" for n in range(40)]
    for line, tick, sensed in zip(lines, TICKS, WORK, strict=False):
        hear(line)
        work.ticks([tick], [sensed], 0.02)
    work.ticks(TICKS[40:50], WORK[40:50])
    found = [line for m in work.end().messages((f"{WIRE}servo",)) for line in said(m.data)["lines"]]
    assert found == lines


def test_runs_start_and_stop_on_demand_and_raw_frames_with_them(tmp_path: Path) -> None:
    work = Work(tmp_path, runs=False)
    work.stand(2.0)
    assert work.paths() == []
    work.recorder.start(1)
    work.stand(2.0)
    (path,) = work.paths("run")
    assert work.eyes.told[-1].path == str(path.with_name(path.name.replace(".mcap", ".frames.mcap")))
    work.recorder.stop()
    work.stand(2.0)
    assert work.eyes.told[-1].path == ""
    assert Recording(path).extent.is_ended


async def test_the_recorder_writes_by_itself_and_ends_in_order(tmp_path: Path) -> None:
    work = Work(tmp_path)
    task = asyncio.create_task(work.recorder.run())
    for tick, sensed in zip(TICKS, WORK, strict=True):
        work.recorder.take(sensed, tick)
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    (path,) = work.paths("run")
    assert len(list(Recording(path).messages((TICK,)))) == len(TICKS)
    assert Recording(path).extent.is_ended


class StalledDisk:
    """A disk that answers no write until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self.released = threading.Event(), threading.Event()
        self._write = os.write
        monkeypatch.setattr(os, "write", self._hang)

    def _hang(self, file: int, data: bytes) -> int:
        if threading.current_thread().name == "recorder":
            self.reached.set()
            self.released.wait()
        return self._write(file, data)


async def test_a_disk_that_hangs_holds_up_neither_the_ticks_nor_the_end_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "ENDING_S", 1.0)
    work = Work(tmp_path)
    work.recorder.take(WORK[0], TICKS[0])
    disk = StalledDisk(monkeypatch)
    task = asyncio.create_task(work.recorder.run())
    assert await asyncio.to_thread(disk.reached.wait, 10.0)
    at_s = TICKS[0].now_s
    assert work.recorder.faults(at_s + 4.0) == ()
    (fault,) = work.recorder.faults(at_s + 6.0)
    assert fault.name == "daemon.recorder_failed"
    assert "has not answered for 6 s" in fault.detail
    task.cancel()
    turns_n = 0
    while not task.done():
        await asyncio.sleep(0.005)
        turns_n += 1
    assert turns_n > 5, "the event loop went on while the disk was waited for"
    disk.released.set()
    async with asyncio.timeout(10.0):
        await work.recorder._thread_ended.wait()
    assert work.recorder.faults(at_s + 6.0) == ()


async def test_a_recorder_that_is_started_again_writes_with_one_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "ENDING_S", 0.05)
    work = Work(tmp_path, pictures_hz=10)
    work.recorder.take(WORK[0], TICKS[0])
    disk = StalledDisk(monkeypatch)
    pictures = AsyncMock(side_effect=ValueError("no such picture"))
    monkeypatch.setattr(work.eyes, "preview_jpeg", pictures)
    with pytest.raises(ValueError, match="no such picture"):
        await work.recorder.run()
    again = asyncio.create_task(work.recorder.run())
    await asyncio.to_thread(disk.reached.wait, 10.0)
    assert pictures.await_count == 1, "the first thread still has the files"
    disk.released.set()
    with pytest.raises(ValueError, match="no such picture"):
        await again
    async with asyncio.timeout(10.0):  # a busy machine's thread may take longer than the run waits for it
        await work.recorder._thread_ended.wait()
    assert all(Recording(path).extent.is_ended for path in work.paths("run"))


async def test_without_a_directory_nothing_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    recorder = Recorder(Config(), SETTINGS, Controller(SETTINGS), NoEyes())
    recorder.take(WORK[0], TICKS[0])
    assert recorder.faults(1.0) == ()
    await recorder.run()
    assert recorder.directory is None


def test_a_service_records_in_its_state_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    recorder = Recorder(Config(), SETTINGS, Controller(SETTINGS), NoEyes())
    assert recorder.directory == tmp_path / "recordings"


# ---- raw frames ------------------------------------------------------------------------------------------------------


def judged(number: int) -> Judged:
    generator = np.random.default_rng(number)
    lens = Intrinsics(32, 24, 30.1, 30.2, 15.5, 11.5)
    frame = Frame(
        generator.integers(0, 256, (24, 32, 3), np.uint8),
        generator.integers(0, 65536, (24, 32), np.uint16),
        lens,
        lens,
        100.0 + number / 3.0,
        number,
        number + 7,
        metadata={"exposure_us": 1.0 / 3.0},
    )
    seen = SoilObservation(frame.capture_s, Zone.LEFT, 1.0 / 3.0, "r", frame_number=number)
    return Judged(frame, 1.0 / 7.0, 0.01, MeasuredAttitude(1.0 / 9.0, None, 0.3), frame.capture_s + 0.03, seen)


def test_raw_frames_read_back_as_they_were_judged(tmp_path: Path) -> None:
    path = tmp_path / "graderd-a-000.frames.mcap"
    config = Config().model_dump_json()
    recorder = FrameRecorder(FramesWanted(path=str(path), every_n=2, head={"version": "t"}, config_json=config))
    given = [judged(number) for number in range(7)]
    for one in given:
        recorder.take(*one)
    recorder.end()
    recorder.join(10.0)
    found = [one for _, one in raw_frames(Recording(path))]
    assert len(found) == 3
    for one, back in zip(given[1::2], found, strict=True):
        assert np.array_equal(one.frame.color_bgr, back.frame.color_bgr)
        assert one.frame.depth_mm is not None
        assert back.frame.depth_mm is not None
        assert np.array_equal(one.frame.depth_mm, back.frame.depth_mm)
        assert one[1:] == back[1:]
        assert one.frame.color_intrinsics == back.frame.color_intrinsics
        assert one.frame.metadata == back.frame.metadata
    again = FrameRecorder(FramesWanted(path=str(path), head={"version": "t"}, config_json=config))
    again.end()
    again.join(10.0)
    assert (tmp_path / "graderd-a-000-2.frames.mcap").exists()


# ---- other forms -----------------------------------------------------------------------------------------------------


def test_an_export_has_everything_and_is_whole(tmp_path: Path) -> None:
    work = Work(tmp_path / "rec")
    work.recorder.listen("can")("(1.0) can0 18EF1300#00")
    work.ticks(TICKS, WORK)
    work.put(Reading(b"jpeg", work.now_s))
    (path,) = work.paths("run")  # not ended
    found = export(Recording(path), tmp_path / "out")
    assert found["ticks_n"] == len(TICKS)
    assert found["pictures_n"] == 1
    assert (tmp_path / "out" / "can.log").read_text() == "(1.0) can0 18EF1300#00\n"
    with (tmp_path / "out" / "recording.mcap").open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == len(
            list(Recording(path).messages())
        )
    assert len((tmp_path / "out" / "ticks.csv").read_text().splitlines()) == len(TICKS) + 1


def test_a_step_is_small(tmp_path: Path) -> None:
    """A day must fit: what a tick takes on disk, pictures aside."""
    work = Work(tmp_path)
    for tick, sensed in zip(TICKS, WORK, strict=True):
        work.recorder.take(sensed, tick)
    work.drain()
    assert work.end().path.stat().st_size / len(TICKS) < 700
