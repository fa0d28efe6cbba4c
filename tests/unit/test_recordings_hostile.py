"""Recordings that graderd did not write so, and disks that take no more: one line, and nothing half done."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from graderd.cli.app import run_app
from graderd.record.files import RecordingFile
from graderd.record.layout import LOG, MARK, MEMORY, PREVIEW, SENSED, TICK, WIRE, Mark, Message
from graderd.record.reader import Recording
from harness.recording import record_in_virtual_time

COMMANDS = ("export", "report", "check")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Three seconds of work, with one of each message."""
    return Recording(record_in_virtual_time(tmp_path_factory.mktemp("whole"), 3.0))


def changed(folder: Path, whole: Recording, change: Callable[[Message], Message]) -> Path:
    """The same, with a mark, a picture, a log line and a wire, and a change to each message."""
    path = folder / "graderd-a b\nc.mcap"
    file = RecordingFile(path, whole.head, whole.config_json)
    messages = list(whole.messages())
    at_ns = messages[-1].log_ns
    messages += [
        Message(MARK, at_ns, Mark(kind="note", text="here").model_dump_json().encode()),
        Message(PREVIEW, at_ns, b'{"data": "aGVsbG8="}'),
        Message(LOG, at_ns, b'{"name": "mode", "message": "m"}'),
        Message(f"{WIRE}can", at_ns, b'{"lines": ["one"]}'),
    ]
    for message in messages:
        file.add(change(message))
    file.finish()
    return path


def run(command: str, path: Path, to: Path) -> int:
    words = {
        "export": ["record", "export", str(path), "--to", str(to)],
        "report": ["report", str(path), "--to", str(to)],
        "check": ["replay", str(path), "--check"],
    }
    return run_app(words[command])


@pytest.mark.parametrize("data", [b"{", b"[]", b"{}", b"\xff", b"null", b"7"])
@pytest.mark.parametrize("topic", [SENSED, TICK, MEMORY, MARK, PREVIEW, LOG, f"{WIRE}can"])
def test_a_message_that_is_written_otherwise_is_one_line_and_leaves_nothing(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], topic: str, data: bytes
) -> None:
    path = changed(tmp_path, whole, lambda m: m._replace(data=data) if m.topic == topic else m)
    for command in COMMANDS:
        to = tmp_path / command
        status = run(command, path, to)
        said = capsys.readouterr().err
        if status:
            assert said.count("\n") == 1
            assert said.startswith("graderd: ")
            assert ".mcap: " in said
            assert not to.exists()
        else:
            assert said == ""


def test_a_wire_of_another_name_stays_in_the_folder(whole: Recording, tmp_path: Path) -> None:
    path = changed(tmp_path, whole, lambda m: m._replace(topic=f"{WIRE}../../evil") if m.topic.startswith(WIRE) else m)
    assert run("export", path, tmp_path / "deep" / "export") == 0
    assert not list(tmp_path.glob("evil*")) + list((tmp_path / "deep").glob("evil*"))
    assert (tmp_path / "deep" / "export" / "evil.log").read_text(encoding="utf-8") == "one\n"


@pytest.mark.parametrize("command", ["export", "report"])
def test_a_disk_that_is_full_is_told_by_its_folder_and_a_second_try_finds_it_free(
    whole: Recording,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    path, to = changed(tmp_path, whole, lambda m: m), tmp_path / "out"

    def full(*_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as broken:
        broken.setattr(Path, "write_text", full)
        broken.setattr(Path, "write_bytes", full)
        assert run(command, path, to) == 1
    said = capsys.readouterr().err
    assert f"{to}: No space left on device" in said
    assert not to.exists()
    assert run(command, path, to) == 0


def test_a_strangers_head_does_not_end_the_list(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "graderd-stranger.frames.mcap"
    file = RecordingFile(path, {**whole.head, "every_n": "many", "started": "never"}, whole.config_json)
    first, *_, last = whole.messages()
    for message in (first, last._replace(log_ns=first.log_ns + 20 * 10**9)):
        file.add(message)
    file.finish()
    assert run_app(["record", "list", "--dir", str(tmp_path)]) == 0
    assert "graderd-stranger.frames.mcap" in capsys.readouterr().out
