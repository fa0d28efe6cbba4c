"""Replay: the same code decides the same; what differs is listed, worst first, once a stretch."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from graderd.cli import app as cli
from graderd.config import Config, parse
from graderd.core import tick as tick_module
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Reaction
from graderd.core.soil import Zone
from graderd.core.tick import Controller, Sensed
from graderd.record import recorder as recorder_module
from graderd.record.files import RecordingFile
from graderd.record.layout import FRAME, MEMORY, TICK, Memory, Message, frame_bytes, frame_of, tick_of
from graderd.record.reader import Recording
from graderd.record.recorder import Recorder
from graderd.record.replay import check, decided_again
from graderd.record.store import Store
from harness.recording import NoEyes
from harness.stretch import SETTINGS, stretch_of_work
from tests.replay.test_recordings import RECORDINGS

WORK = stretch_of_work()


def recorded(folder: Path, work: list[Sensed] = WORK) -> Recording:
    """The work as the daemon would record it."""
    config = parse({"recording": {"directory": str(folder), "min_free_mb": 0}})
    controller = Controller(SETTINGS)
    recorder = Recorder(config, SETTINGS, controller, NoEyes())
    files = recorder._writer
    assert files is not None
    for sensed in work:
        recorder.take(sensed, controller.step(sensed))
    for number, item in enumerate(recorder._queue):
        files.put(item)
        if number % 25 == 0:
            files.tend()
    files._guarded(files._end)
    (path,) = (entry.path for entry in Store(folder, 1.0, 0.0).entries() if entry.kind == "run")
    return Recording(path)


def changed(recording: Recording, topic: str, change: Any) -> Recording:
    """A copy in which the messages of one channel are others; None: absent."""
    path = recording.path.with_name(f"changed-{recording.path.name}")
    file = RecordingFile(path, recording.head, recording.config_json)
    for message in recording.messages():
        data = change(message.data) if message.topic == topic else message.data
        if data is not None:
            file.add(Message(message.topic, message.log_ns, data))
    file.finish()
    return Recording(path)


def test_the_same_code_decides_the_same_twice(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    for _ in range(2):
        found = check(recording)
        assert found.differences == ()
        assert (found.ticks_n, found.skipped_n) == (len(WORK) - 1, 1)


def test_another_configuration_would_have_turned_elsewhere(tmp_path: Path) -> None:
    other = Config().model_copy(update={"rule": Config().rule.model_copy(update={"left_deg": 20.0})})
    found = check(recorded(tmp_path), other)
    first = found.differences[0]
    assert (first.kind, first.where) == ("command", "rotation")
    assert first.size == pytest.approx(10.0, abs=0.5)
    assert [d.kind for d in found.differences] == sorted(
        (d.kind for d in found.differences), key=("command", "decision", "picture", "mode", "fault", "other").index
    )
    assert any("decided left (30.0 deg), today left (20.0 deg)" in d.text for d in found.differences)


def test_what_would_not_have_turned_is_said(tmp_path: Path) -> None:
    strict = Config().model_copy(update={"rule": Config().rule.model_copy(update={"min_confidence": 0.95})})
    texts = [difference.text for difference in check(recorded(tmp_path), strict).differences]
    assert any(text.startswith("rotation: would not have turned; it was sent to ") for text in texts)


STRICTER = dict(CATALOGUE) | {
    "actuator.no_feedback": replace(CATALOGUE["actuator.no_feedback"], reaction=Reaction.STOP)
}


def test_a_change_of_the_code_is_found_where_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded(tmp_path)
    monkeypatch.setattr(tick_module, "CATALOGUE", STRICTER)
    modes = [d for d in check(recording).differences if d.kind == "mode"]
    assert modes[0].text.startswith("mode disarmed: ")
    assert "today stopped: lift_left.no_feedback" in modes[0].text
    assert modes[0].ticks_n > 10, "ticks on end are told once"


def test_one_difference_is_not_told_for_the_rest_of_the_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "MEMORY_EVERY_S", 1.0)
    recording = recorded(tmp_path)
    monkeypatch.setattr(tick_module, "CATALOGUE", STRICTER)
    (mode,) = (d for d in check(recording).differences if d.kind == "mode")
    assert mode.ticks_n <= 51, "with the next memory the replay goes on from what was"


def _once(old: bytes, new: bytes) -> Any:
    done: list[bool] = []

    def change(data: bytes) -> bytes:
        if not done and old in data:
            done.append(True)
            return data.replace(old, new)
        return data

    return change


def test_where_ticks_were_lost_nothing_is_judged_before_the_next_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "QUEUE_N", 100)
    found = check(recorded(tmp_path))
    assert found.differences == ()
    assert found.ticks_n < 100


def test_a_memory_of_another_version_costs_its_warm_up(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    foreign = changed(
        recording,
        MEMORY,
        lambda data: Memory(now_s=json.loads(data)["now_s"], controller=b"?").model_dump_json().encode(),
    )
    found = check(foreign)
    assert (found.warm_ups_n, found.ticks_n) == (1, 0)


@pytest.mark.parametrize("path", RECORDINGS[:1], ids=["frames"])
def test_a_frame_that_is_seen_otherwise_is_listed_and_reaches_the_tick(path: Path, tmp_path: Path) -> None:
    recording = Recording(path)
    (frames,) = recording.frame_files
    lied = changed(
        Recording(_copied(frames, tmp_path)),
        FRAME,
        lambda data: frame_bytes(
            replace(
                frame_of(data),
                observation=replace(frame_of(data).observation, zone=Zone.CENTER, ahead=None),
            )
        ),
    )
    copy = _copied(path, tmp_path)
    lied.path.replace(tmp_path / frames.name)
    found = check(Recording(copy))
    (picture,) = (d for d in found.differences if d.kind == "picture")
    assert "center" in picture.recorded
    assert picture.size >= 1.0


def _copied(path: Path, folder: Path) -> Path:
    copy = folder / path.name
    copy.write_bytes(path.read_bytes())
    return copy


def test_a_new_reference_is_what_today_decides(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    assert list(decided_again(recording)) == list(recording.messages())


def test_a_new_reference_of_another_version_is_the_same_work(tmp_path: Path) -> None:
    recording = recorded(tmp_path)
    foreign = changed(recording, MEMORY, lambda _: Memory(now_s=100.0, controller=b"?").model_dump_json().encode())
    again = [tick_of(message.data).state.mode for message in decided_again(foreign) if message.topic == TICK]
    assert again == [tick_of(message.data).state.mode for message in recording.messages((TICK,))]


def test_the_command_ends_with_what_it_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(tmp_path).path
    assert cli.run_app(["replay", str(path), "--check", "--json"]) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (last["event"], last["ticks_n"], last["differences_n"]) == ("replay_finished", len(WORK) - 1, 0)
    other = tmp_path / "other.toml"
    other.write_text("[rule]\nleft_deg = 20.0\n")
    assert cli.run_app(["replay", str(path), "--check", "--config", str(other), "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[-1]["differences_n"] == len(lines) - 1 > 0
    assert lines[0]["kind"] == "command"


def test_a_regression_is_the_exit_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = changed(recorded(tmp_path), TICK, _once(b'"mode":"auto"', b'"mode":"manual"')).path
    assert cli.run_app(["replay", str(path), "--check"]) == 1
    assert "1 differences" in capsys.readouterr().out


def test_what_is_no_recording_is_told_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no recording")
    assert cli.run_app(["replay", str(tmp_path / "x.mcap"), "--check"]) == 1
    assert "is no recording of graderd's" in capsys.readouterr().err
    assert cli.run_app(["replay", str(tmp_path / "none.mcap"), "--check"]) == 1
    assert "no such recording" in capsys.readouterr().err
