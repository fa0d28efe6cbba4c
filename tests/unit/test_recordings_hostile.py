"""Recordings that graderd did not write so, and disks that take no more: told in a line, and the rest is read."""

from __future__ import annotations

import asyncio
import base64
import csv
import errno
import json
import os
import random
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import harness.recording
from graderd.cli.app import run_app
from graderd.cli.label import make_frame_set
from graderd.record import files, layout
from graderd.record.files import RecordingFile
from graderd.record.frames import messages_of
from graderd.record.layout import (
    CHANNELS,
    COLOR,
    DEPTH,
    FRAME,
    FRAME_CHANNELS,
    FRAMES_SUFFIX,
    GAP,
    LOG,
    MARK,
    MEMORY,
    PREVIEW,
    SENSED,
    TICK,
    TRANSFORM,
    WIRE,
    Gap,
    Mark,
    Message,
    Wire,
    blade_message,
    image_message,
    log_message,
)
from graderd.record.reader import Recording
from graderd.runtime.app.replay_server import Player
from harness.recording import record_in_virtual_time
from tests.unit.test_record import judged

TICKS_N = 40
CAN = f"{WIRE}can"
Captured = pytest.CaptureFixture[str]


@dataclass(frozen=True)
class Work:
    """A little work with every channel in it, and its raw frames."""

    recording: Recording
    run: tuple[Message, ...]
    frames: tuple[Message, ...]

    def write(self, folder: Path, change: Callable[[Message], Message], *, gaps: bool = False) -> Path:
        """The same with a change to each message; ``gaps``: and with gaps, as an export of a damaged one has them."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "graderd-a b\nc.mcap"
        files = ((path, self.run, CHANNELS), (_beside(path), self.frames, FRAME_CHANNELS))
        for each, messages, topics in files:
            file = RecordingFile(each, self.recording.head, self.recording.config_json, topics)
            for message in messages:
                if gaps or message.topic != GAP:
                    file.add(change(message))
            file.finish()
        return path


def _beside(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(".mcap") + FRAMES_SUFFIX)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Work:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harness.recording, "MEMORY_EVERY_S", 0.0)  # after what it leaves out, a check goes on at once
        whole = Recording(record_in_virtual_time(tmp_path_factory.mktemp("whole"), TICKS_N / 50.0))
    run: list[Message] = []
    ok, jpeg = cv2.imencode(".jpg", np.zeros((4, 4, 3), np.uint8))
    assert ok
    picture = base64.b64encode(jpeg.tobytes()).decode()
    for message in whole.messages():
        run.append(message)
        if message.topic == TICK:
            at_ns = message.log_ns
            gap = Gap(file="b", chunk_n=1, first_byte_n=2, bytes_n=3, from_ns=at_ns, to_ns=at_ns)
            run += [
                image_message(PREVIEW, at_ns, picture, "jpeg"),
                log_message(at_ns, 2, "mode", "m"),
                blade_message(at_ns, 3.0, None),
                Message(CAN, at_ns, Wire(lines=("one", "two")).model_dump_json().encode()),
                Message(MARK, at_ns, Mark(kind="note", text="here").model_dump_json().encode()),
                Message(GAP, at_ns, gap.model_dump_json().encode()),
            ]
    offset_ns = run[0].log_ns - 100 * 10**9
    frames = [message for number in range(16) for message in messages_of(judged(number), 1, offset_ns)]
    return Work(whole, tuple(run), tuple(frames))


# ---- messages that are not as graderd writes them --------------------------------------------------------------------

WORDS: tuple[Any, ...] = (None, "x", "", [], {}, [1], {"a": 1}, -1, True, 1e308, -1e308, 10**30, float("nan"), "NaN")
GONE = object()


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a JSON value."""
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, each in inner:
        yield from places(each, (*path, key))


def put(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """The same with something else at a place, or nothing."""
    if not path:
        return {} if new is GONE else new
    copy = value.copy()
    if len(path) > 1:
        copy[path[0]] = put(value[path[0]], path[1:], new)
    elif new is GONE:
        del copy[path[0]]
    else:
        copy[path[0]] = new
    return copy


def broken(data: bytes, chance: random.Random) -> bytes:
    """One of the many ways in which a message can be another: cut, not JSON, something of another kind or gone."""
    way = chance.randrange(8)
    if way == 0:
        return data[: chance.randrange(len(data))]
    if way == 1:
        return chance.choice((b"", b"\xff\xfe", b"null", b"7", b"[]", b'"x"', b"[" * 5000, b"{}", b'{"data": "%%"}'))
    value = json.loads(data)
    if way == 2 and "data" in value:
        picture = np.full((7, 9, chance.choice((1, 3, 4))), 5, np.uint8)
        _, coded = cv2.imencode(chance.choice((".png", ".jpg")), picture)
        png = bytearray(coded.tobytes())
        if chance.random() < 0.3:
            png[16:24] = b"\x00\x0f\xff\xff\x00\x0f\xff\xff"  # a million pixels each way
        return json.dumps(value | {"data": base64.b64encode(png).decode()}).encode()
    path = chance.choice(list(places(value)))
    new = GONE if chance.random() < 0.2 else chance.choice(WORDS)
    return json.dumps(put(value, path, new)).encode()


def half_broken(topic: str, chance: random.Random) -> tuple[Callable[[Message], Message], list[Message]]:
    """A change that breaks every other message of a channel; and those that it broke, as they were."""
    seen: list[Message] = []
    number = 0

    def change(message: Message) -> Message:
        nonlocal number
        if message.topic != topic:
            return message
        number += 1
        if number % 2:
            return message
        seen.append(message)
        return message._replace(data=broken(message.data, chance))

    return change, seen


def told_in_lines(said: str) -> None:
    for line in said.splitlines():
        assert re.match(r"graderd: \S.*: ", line), line
        if "not as graderd writes it" in line:
            assert re.search(r": /\S+ at \d\d:\d\d:\d\d\.\d\d\d( and \d+ more)?: not as graderd writes it \(.+\)", line)
            assert "left out. Another version or another program wrote it; graderd " in line


@pytest.mark.parametrize("topic", [SENSED, TICK, MEMORY, MARK, GAP, PREVIEW, LOG, TRANSFORM, CAN, FRAME, COLOR, DEPTH])
def test_whoever_reads_a_recording_tells_what_is_not_as_graderd_writes_it_and_goes_on_with_the_rest(
    work: Work, tmp_path: Path, capsys: Captured, topic: str
) -> None:
    """Every channel, by everything that reads recordings."""
    change, were = half_broken(topic, random.Random(topic))
    path, to = work.write(tmp_path, change, gaps=topic == GAP), tmp_path / "out"
    kept = Counter(message.topic for message in (*work.run, *work.frames))
    kept[topic] -= len(were)

    assert run_app(["record", "export", str(path), "--to", str(to / "export"), "--json"]) in (0, 1)
    said = capsys.readouterr()
    exported = json.loads(said.out)
    told_in_lines(said.err)
    assert exported["ticks_n"] >= min(kept[SENSED], kept[TICK])
    assert exported["pictures_n"] >= kept[PREVIEW]
    assert exported["log_lines_n"] >= kept[LOG] + 2 * kept[CAN]
    assert exported["frames_n"] >= min(kept[each] for each in FRAME_CHANNELS)
    assert list(Recording(to / "export" / "recording.mcap").messages()) == list(Recording(path).messages())
    status = run_app(["report", str(path), "--to", str(to / "report"), "--json"])
    assert status == (topic in (SENSED, TICK, MARK, GAP, *FRAME_CHANNELS))
    said = capsys.readouterr()
    told_in_lines(said.err)
    reported = json.loads(said.out)
    with (to / "report" / "ticks.csv").open(encoding="utf-8", newline="") as table:
        assert len(list(csv.DictReader(table))) == exported["ticks_n"] == reported["ticks_n"]

    other = to / "other.toml"
    other.write_text("[rule]\nleft_deg = 20.0\n", encoding="utf-8")
    for words in (["--check", "--json"], ["--check"], ["--check", "--json", "--config", str(other)]):
        assert run_app(["replay", str(path), *words]) in (0, 1)
        said = capsys.readouterr()
        told_in_lines(said.err)
        if "--json" in words:
            last = json.loads(said.out.splitlines()[-1])
            assert last["event"] == "replay_finished"
            assert last["ticks_n"] + last["skipped_n"] == kept[TICK] + (len(were) if topic == TICK else 0)
            # What does not read so is not compared; where the memory goes on, all else is.
            assert "--config" in words or last["ticks_n"] >= min(kept[SENSED], kept[TICK], kept[MEMORY]) - 2
            # A what-if goes its own way from the first memory on.
            read = {SENSED, TICK, MARK, GAP, *FRAME_CHANNELS} | (set() if "--config" in words else {MEMORY})
            assert last["damaged"] == (topic in read)

    frames_n = min(kept[each] for each in FRAME_CHANNELS)
    is_whole = make_frame_set(path, to / "set", None, 0.0)
    told_in_lines(capsys.readouterr().err)
    assert is_whole or topic in (*FRAME_CHANNELS, GAP)
    assert len(list((to / "set").glob("*.depth.png"))) >= frames_n
    experiment = to / "experiment.toml"
    experiment.write_text(EXPERIMENT.format(path=json.dumps(str(_beside(path)))), encoding="utf-8")
    assert run_app(["evaluate", str(experiment)]) == 2  # there is no bed in such pictures, if they can be read
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    if topic in FRAME_CHANNELS:
        assert "not as graderd writes it" in said.err

    asyncio.run(played(path, kept))
    assert run_app(["record", "list", "--dir", str(tmp_path), "--verify", "--json"]) in (0, 1)


EXPERIMENT = """name = "e"
[[case]]
name = "c"
work = "scattering"
[[case.trial]]
angle_deg = 0
after = [{path}]
"""


async def played(path: Path, kept: Counter[str]) -> None:
    """To its end, and every status that it shows is one."""
    player = Player(Recording(path), speed=1e9)
    shown_n, show = 0, player._show

    def counted(knew: Message, told: Message) -> bool:
        nonlocal shown_n
        is_shown = show(knew, told)
        player.status().model_dump_json()
        shown_n += is_shown
        return is_shown

    player._show = counted  # type: ignore[method-assign]
    player._jump_s = None
    await player._play(player._first_ns)
    assert shown_n >= min(kept[SENSED], kept[TICK])


@pytest.mark.parametrize("topic", ["/stranger", f"{WIRE}../../evil", f"{WIRE}a\x00b", f"{WIRE}{'long' * 100}", ""])
def test_a_channel_of_another_name_is_told_and_the_rest_is_written(
    work: Work, tmp_path: Path, capsys: Captured, topic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def schema_of(name: str) -> tuple[str, bytes]:
        return ("of its own", b"{}") if name == topic else layout.schema_of(name)

    with monkeypatch.context() as patch:
        patch.setattr(files, "schema_of", schema_of)
        path = work.write(tmp_path, lambda m: m._replace(topic=topic) if m.topic == CAN else m)
    assert run_app(["record", "export", str(path), "--to", str(tmp_path / "deep" / "export"), "--json"]) == 1
    exported = json.loads(capsys.readouterr().out)
    assert [each["topic"] for each in exported["unreadable"]] == [topic]
    assert exported["ticks_n"] == TICKS_N
    assert not list(tmp_path.glob("**/*evil*"))
    assert run_app(["report", str(path), "--to", str(tmp_path / "report")]) == 0


def test_raw_frames_that_ended_before_they_began_cost_nothing_else(
    work: Work, tmp_path: Path, capsys: Captured
) -> None:
    """The perception child was killed as it made the file."""
    path = work.write(tmp_path, lambda m: m)
    _beside(path).write_bytes(b"")
    for words in (["record", "export", str(path), "--to", str(tmp_path / "e")], ["replay", str(path), "--check"]):
        assert run_app(words) == 1
        assert "graderd-a b c.frames.mcap: is no recording of graderd's" in capsys.readouterr().err
    assert run_app(["report", str(path), "--to", str(tmp_path / "r")]) == 1
    assert (tmp_path / "r" / "index.html").exists()


def test_raw_frames_of_a_configuration_that_is_none_any_more_are_left_out(
    work: Work, tmp_path: Path, capsys: Captured
) -> None:
    path = tmp_path / "graderd-x.mcap"
    for each, messages in ((path, work.run), (_beside(path), work.frames)):
        head = {key: value for key, value in work.recording.head.items() if key != "config_sha256"}
        file = RecordingFile(each, head, b'{"former": 1}')
        for message in messages:
            file.add(message)
        file.finish()
    assert run_app(["record", "export", str(path), "--to", str(tmp_path / "e"), "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["ticks_n"] == TICKS_N
    assert "its raw frames need its configuration: " in said.err
    assert "former" in said.err
    assert run_app(["label", str(path), "--to", str(tmp_path / "set")]) == 1
    assert "former" in capsys.readouterr().err


# ---- disks and heads -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["export", "report"])
def test_a_disk_that_is_full_is_told_by_its_folder_and_a_second_try_finds_it_free(
    work: Work,
    tmp_path: Path,
    capsys: Captured,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    path, to = work.write(tmp_path, lambda m: m), tmp_path / "out"

    words = [*(["record", "export"] if command == "export" else ["report"]), str(path), "--to", str(to)]

    def full(*_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as broken:
        broken.setattr(Path, "write_text", full)
        broken.setattr(Path, "write_bytes", full)
        assert run_app(words) == 1
    said = capsys.readouterr().err
    assert f"{to}: No space left on device" in said
    assert not to.exists()
    assert run_app(words) == 0


def test_a_strangers_head_does_not_end_the_list(work: Work, tmp_path: Path, capsys: Captured) -> None:
    path = tmp_path / "graderd-stranger.frames.mcap"
    file = RecordingFile(
        path, {**work.recording.head, "every_n": "many", "started": "never"}, work.recording.config_json
    )
    first, *_, last = work.run
    for message in (first, last._replace(log_ns=first.log_ns + 20 * 10**9)):
        file.add(message)
    file.finish()
    assert run_app(["record", "list", "--dir", str(tmp_path)]) == 0
    assert "graderd-stranger.frames.mcap" in capsys.readouterr().out
