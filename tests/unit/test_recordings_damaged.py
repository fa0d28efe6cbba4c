"""Damage in the middle of a recording: what is whole is read, and every command says where the rest was."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path

import pytest

from graderd.cli.app import run_app
from graderd.record import recorder as recorder_module
from graderd.record.export import raw_frames
from graderd.record.files import RecordingFile
from graderd.record.frames import messages_of
from graderd.record.layout import FRAMES_SUFFIX, GAP, TICK, Message
from graderd.record.reader import Recording
from graderd.record.replay import check
from graderd.record.table import rows
from graderd.runtime.app.replay_server import Player
from tests.unit.test_record import judged
from tests.unit.test_replay import STRICTER, WORK, recorded
from tests.unit.test_replay_server import playing

TICK_HZ = 50.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The work, with a memory every second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder_module, "MEMORY_EVERY_S", 1.0)
        return recorded(tmp_path_factory.mktemp("whole"))


def chunks_of(recording: Recording) -> list[tuple[int, int]]:
    """Where each chunk's record begins and ends."""
    data, found, at = recording.path.read_bytes(), [], 8
    while (kind := data[at]) != 0x0F:
        ends = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if kind == 0x06:
            found.append((at, ends))
        at = ends
    return found


def damaged(whole: Recording, folder: Path, *stretches: tuple[int, int], keeps_end: bool = True) -> Recording:
    """A copy with zeros in those bytes; without its end: as a process leaves it that was killed."""
    data = bytearray(whole.path.read_bytes())
    for first, last in stretches:
        data[first:last] = bytes(last - first)
    if not keeps_end:
        data = data[: chunks_of(whole)[-1][1]]
    copy = folder / whole.path.name
    copy.write_bytes(data)
    return Recording(copy)


@pytest.mark.parametrize("keeps_end", [True, False], ids=["ended", "killed"])
@pytest.mark.parametrize("part", ["messages", "kind", "length", "whole", "index_before", "three"])
def test_damage_costs_its_chunks_and_is_told_where(
    whole: Recording, tmp_path: Path, part: str, keeps_end: bool
) -> None:
    chunks = chunks_of(whole)
    at = len(chunks) // 2
    (first, last), (after, _) = chunks[at], chunks[at + 3]
    stretch = {
        "messages": (first + 100, first + 101),
        "kind": (first, first + 1),
        "length": (first + 1, first + 3),
        "whole": (first, last),
        "index_before": (chunks[at - 1][1] + 1, first + 60),
        "three": (first + 60, after - 1),
    }[part]
    lost_n = {"three": 3}.get(part, 1)
    recording = damaged(whole, tmp_path, stretch, keeps_end=keeps_end)
    (gap,) = recording.gaps
    assert gap.first_byte_n <= stretch[0]
    assert gap.first_byte_n + gap.bytes_n >= stretch[1]
    assert gap.first_byte_n + gap.bytes_n == chunks[at + lost_n][0]
    assert gap.file == whole.path.name
    whole_messages, found = list(whole.messages()), list(recording.messages())
    where = next(number for number, message in enumerate(found) if message.topic == GAP)
    before, rest = found[:where], found[where + 1 :]
    assert before == whole_messages[: len(before)]
    assert rest == whole_messages[-len(rest) :]
    missing = whole_messages[len(before) : -len(rest)]
    assert (gap.from_ns, gap.to_ns) == (before[-1].log_ns, rest[0].log_ns)
    (told,) = check(recording).breaks
    assert told.missing_n == pytest.approx(sum(message.topic == TICK for message in missing), abs=1)


def test_each_flipped_byte_of_a_chunk_is_seen(whole: Recording, tmp_path: Path) -> None:
    """But those of its times, which no checksum holds: they decide nothing of what is read."""
    chunks = chunks_of(whole)
    first, last = chunks[len(chunks) // 2]
    data, copy = bytearray(whole.path.read_bytes()), tmp_path / whole.path.name
    places = [n for n in (*range(first, first + 54), *range(first + 54, last, 97)) if not first + 9 <= n < first + 25]
    for place in places:
        data[place] ^= 0x01
        copy.write_bytes(data)
        data[place] ^= 0x01
        kept_n = sum(1 for message in Recording(copy).messages((TICK,)))
        assert len(Recording(copy).gaps) == (kept_n < len(WORK)), place - first
        assert kept_n >= len(WORK) - 30


def test_a_first_chunk_costs_no_more_where_the_summary_names_the_channels(whole: Recording, tmp_path: Path) -> None:
    first, last = chunks_of(whole)[0]
    recording = damaged(whole, tmp_path, (first + 60, last))
    (gap,) = recording.gaps
    assert gap.from_ns is None
    assert gap.chunk_n == 1
    assert len(list(recording.messages((TICK,)))) > len(WORK) - 30


def test_a_first_chunk_costs_no_more_in_a_file_without_an_end_either(whole: Recording, tmp_path: Path) -> None:
    chunks = chunks_of(whole)
    (first, last), (after, _) = chunks[:2]
    recording = damaged(whole, tmp_path, (first + 60, last), keeps_end=False)
    (gap,) = recording.gaps
    assert (gap.chunk_n, gap.first_byte_n, gap.bytes_n) == (1, first, after - first)
    found = [message for message in recording.messages() if message.topic != GAP]
    assert found == list(whole.messages())[-len(found) :]
    assert len(list(recording.messages((TICK,)))) > len(WORK) - 30


def test_without_a_summary_what_nobody_names_is_a_gap_and_not_silence(whole: Recording, tmp_path: Path) -> None:
    """As of a version that did not name channels in the head."""
    first, last = chunks_of(whole)[0]
    at = whole.path.read_bytes().index(b"graderd.channels")
    recording = damaged(whole, tmp_path, (at, at + 7), (first + 60, last), keeps_end=False)
    (gap,) = recording.gaps
    assert gap.bytes_n == recording.path.stat().st_size - first
    assert list(recording.messages((TICK,))) == []


def test_zeros_at_the_end_are_told_and_a_file_that_was_cut_off_has_no_gap(whole: Recording, tmp_path: Path) -> None:
    first, last = chunks_of(whole)[-1]
    zeros = damaged(whole, tmp_path, (first, last), keeps_end=False)
    (gap,) = zeros.gaps
    assert (gap.first_byte_n, gap.to_ns) == (first, None)
    (told,) = check(zeros).breaks
    assert (told.missing_n, told.again_s) == (None, None)
    data = whole.path.read_bytes()
    for length_n in (first, first + 5, first + 40, last - 1):
        zeros.path.write_bytes(data[:length_n])
        assert Recording(zeros.path).gaps == ()


def test_after_a_gap_nothing_is_judged_before_the_next_memory_and_all_of_it_then(
    whole: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunks = chunks_of(whole)
    at = len(chunks) // 2
    recording = damaged(whole, tmp_path, (chunks[at][0] + 60, chunks[at][1]))
    found = check(recording)
    (broken,) = found.breaks
    assert found.differences == ()
    assert found.is_damaged
    assert broken.again_s is not None
    assert broken.missing_n is not None
    assert broken.missing_n > 0
    assert broken.skipped_n <= TICK_HZ
    assert found.ticks_n + found.skipped_n == len(list(recording.messages((TICK,))))
    again = [row["now_s"] for row in rows(recording) if row["now_s"] >= broken.again_s]
    monkeypatch.setattr("graderd.core.tick.CATALOGUE", STRICTER)
    later = [each for each in check(recording).differences if each.at_s >= again[0]]
    assert later, "what comes after the gap is judged"


def test_damage_is_said_by_the_check_and_is_its_exit_status(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chunks = chunks_of(whole)
    path = damaged(whole, tmp_path, (chunks[4][0] + 60, chunks[4][1])).path
    assert run_app(["replay", str(path), "--check", "--json"]) == 1
    *_, broken, last = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert broken["event"] == "not_compared"
    assert broken["gap"]["chunk_n"] == 5
    assert broken["gap"]["first_byte_n"] == chunks[4][0]
    assert broken["again_s"] > 0.0
    assert (last["event"], last["damaged"], last["breaks_n"]) == ("replay_finished", True, 1)
    assert last["missing_n"] == broken["missing_n"] > 0
    assert run_app(["replay", str(path), "--check"]) == 1
    said = capsys.readouterr().out
    assert f"damaged in chunk 5, bytes {chunks[4][0]} to " in said
    assert "ticks missing: " in said
    assert "compared again from " in said


def test_a_check_that_could_compare_nothing_is_no_success(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "graderd-short.mcap"
    file = RecordingFile(path, whole.head, whole.config_json)
    for message in whole.messages((TICK,)):
        file.add(message)
    file.finish()
    assert run_app(["replay", str(path), "--check"]) == 1
    assert "Nothing could be compared" in capsys.readouterr().out


def test_the_list_reads_all_when_asked_and_says_what_is_damaged(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chunks = chunks_of(whole)
    damaged(whole, tmp_path, (chunks[4][0] + 60, chunks[4][1]))
    words = ["record", "list", "--dir", str(tmp_path)]
    assert run_app(words) == 0
    assert "--verify does" in capsys.readouterr().out
    assert run_app([*words, "--verify"]) == 1
    said = capsys.readouterr().out
    assert "damaged in 1 places" in said
    assert "damaged in chunk 5, bytes" in said
    assert run_app([*words, "--verify", "--json"]) == 1
    (told,) = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert told["verified"] is True
    assert told["gaps"][0]["chunk_n"] == 5
    shutil.copy(whole.path, tmp_path / whole.path.name)
    assert run_app([*words, "--verify"]) == 0


def test_a_report_counts_no_time_that_nobody_knows_and_says_so(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chunks = chunks_of(whole)
    path = damaged(whole, tmp_path, (chunks[4][0] + 60, chunks[7][1])).path
    assert run_app(["report", str(whole.path), "--to", str(tmp_path / "all"), "--json"]) == 0
    of_all = json.loads(capsys.readouterr().out)
    assert run_app(["report", str(path), "--to", str(tmp_path / "rest"), "--json"]) == 0
    said = capsys.readouterr()
    of_rest = json.loads(said.out)
    assert of_rest["missing_s"] == pytest.approx(2.0, abs=0.6)
    assert of_all["missing_s"] == 0.0
    assert of_rest["gaps"][0]["chunk_n"] == 5
    assert said.err.startswith("graderd: ")
    page = (tmp_path / "rest" / "index.html").read_text(encoding="utf-8")
    assert "damaged in chunk 5" in page
    assert "in no sum below" in page
    table = (tmp_path / "rest" / "ticks.csv").read_text(encoding="utf-8").splitlines()
    assert table[0].endswith("missing_before_s")
    assert sum(not line.endswith(",") for line in table[1:]) == 1


def test_an_export_keeps_the_gap(whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chunks = chunks_of(whole)
    recording = damaged(whole, tmp_path, (chunks[4][0] + 60, chunks[4][1]))
    assert run_app(["record", "export", str(recording.path), "--to", str(tmp_path / "out"), "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["gaps"][0]["chunk_n"] == 5
    assert "damaged in chunk 5" in said.err
    exported = Recording(tmp_path / "out" / "recording.mcap")
    assert exported.gaps == recording.gaps
    assert check(exported).breaks == check(recording).breaks


def test_raw_frames_are_never_put_together_across_a_gap(
    whole: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / whole.path.name
    shutil.copy(whole.path, run)
    path = run.with_name(run.name.partition(".")[0] + FRAMES_SUFFIX)
    file = RecordingFile(path, whole.head, whole.config_json)
    given = [judged(number) for number in range(3)]
    messages = [messages_of(one, 1, 0) for one in given]
    # The second frame's colour picture is in a chunk of its own, which is lost.
    for some in (messages[0] + messages[1][:1], messages[1][1:2], messages[1][2:] + messages[2]):
        for message in some:
            file.add(message)
        file.flush()
    file.finish()
    frames = Recording(path)
    assert len(list(raw_frames(frames))) == 3
    _, (first, last), _ = chunks_of(frames)
    lost = damaged(frames, tmp_path, (first + 60, last))
    assert [one.frame.color_number for _, one in raw_frames(lost)] == [0, 2]
    assert check(Recording(run)).picture_gaps == lost.gaps
    assert run_app(["record", "export", str(run), "--to", str(tmp_path / "out")]) == 0
    assert f"{path.name}: damaged in chunk 2" in capsys.readouterr().err


def test_a_configuration_that_was_changed_in_the_file_is_none(whole: Recording, tmp_path: Path) -> None:
    data = whole.path.read_bytes().replace(b'"left_deg":30.0', b'"left_deg":20.0', 1)
    path = tmp_path / "graderd-changed.mcap"
    path.write_bytes(data)
    with pytest.raises(Exception, match="its head is damaged"):
        Recording(path)


async def test_played_it_says_so_while_the_gap_lasts(whole: Recording, tmp_path: Path) -> None:
    chunks = chunks_of(whole)
    recording = damaged(whole, tmp_path, (chunks[4][0] + 60, chunks[7][1]))
    (gap,) = recording.gaps
    first_ns = recording.extent.first_ns
    assert gap.from_ns is not None
    assert gap.duration_s is not None
    assert first_ns is not None
    before_s = (gap.from_ns - first_ns) / 1e9
    async with playing(Player(recording, speed=100.0)) as player:
        await player.next_status(0.0)
        await player.service("replay.pause", {})
        await player.service("replay.seek", {"to_s": before_s})
        assert "recording.damaged" not in [fault.name for fault in player.status().faults]
        await player.service("replay.play", {"speed": 0.5})  # the gap lasts for seconds now
        while not (where := await player.service("replay.where", {}))["in_gap"]:
            await asyncio.sleep(0)
        fault, *_ = player.status().faults
        assert (fault.name, fault.detail) == ("recording.damaged", str(gap))
        assert where["gaps"][0]["chunk_n"] == 5
        await player.service("replay.seek", {"to_s": before_s + gap.duration_s + 0.1})
        assert "recording.damaged" not in [fault.name for fault in player.status().faults]
        assert (await player.service("replay.where", {}))["in_gap"] is False


def test_a_lost_mark_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "QUEUE_N", 100)
    recording = recorded(tmp_path)
    mark = b'{"kind":"lost","text":"the disk or the processor did not keep up","client":"","lost_n":7}'
    path = tmp_path / "graderd-marked.mcap"
    file = RecordingFile(path, recording.head, recording.config_json)
    for number, message in enumerate(recording.messages()):
        file.add(message)
        if number == 60:
            file.add(Message("/mark", message.log_ns, mark))
    file.finish()
    found = check(Recording(path))
    (broken,) = found.breaks
    assert (broken.kind, broken.missing_n, broken.again_s, broken.gap) == ("lost", 7, None, None)
    assert broken.skipped_n > 0
    assert not found.is_damaged
