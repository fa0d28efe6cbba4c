"""A recording as ordinary files: for spreadsheets, for the decoders of the wires, and its raw frames as a frame set."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

from graderd.perception.frame_set import Entry, FrameSetWriter, with_lens_of
from graderd.record.files import RecordingFile
from graderd.record.frames import Judged, judged_of
from graderd.record.layout import COLOR, DEPTH, FRAME, GAP, LOG, PREVIEW, WIRE, Gap, Message
from graderd.record.reader import Recording, as_written, new_folder, said
from graderd.record.table import rows, write_csv

WHOLE = "recording.mcap"


def export(recording: Recording, folder: Path) -> dict[str, int]:
    """Write everything that is in it to ``folder``; returns how much of each there was.

    ``recording.mcap`` is the same recording with an end and a summary, which every reader opens, also where the
    original was cut off; where something of it could not be read, a ``/gap`` says so.

    Raises:
        FileExistsError: the folder is there already.
        OSError: it cannot be written; nothing of it is left.
        ProtocolError: the recording holds what graderd does not write.
    """
    with new_folder(folder):
        (folder / "config.json").write_bytes(recording.config_json)
        found = {"ticks_n": write_csv(folder / "ticks.csv", rows(recording)), "pictures_n": 0, "log_lines_n": 0}
        whole = RecordingFile(folder / WHOLE, recording.head, recording.config_json)
        with ExitStack() as stack:
            texts: dict[str, TextIO] = {}
            for message in recording.messages():
                whole.add(message)
                if message.topic == PREVIEW:
                    with as_written(recording, message):
                        picture = base64.b64decode(said(message)["data"])
                    path = folder / "pictures" / f"{message.log_ns}.jpg"
                    path.parent.mkdir(exist_ok=True)
                    path.write_bytes(picture)
                    found["pictures_n"] += 1
                elif message.topic == LOG or message.topic.startswith(WIRE):
                    with as_written(recording, message):
                        lines = [_log_line(message)] if message.topic == LOG else list(said(message)["lines"])
                    name = message.topic.rpartition("/")[2]
                    if name not in texts:
                        texts[name] = stack.enter_context((folder / f"{name}.log").open("w", encoding="utf-8"))
                    texts[name].writelines(f"{line}\n" for line in lines)
                    found["log_lines_n"] += len(lines)
        whole.finish()
        if recording.frame_files:
            found["frames_n"] = export_frames(recording, folder / "frames")
    return found


def _log_line(message: Message) -> str:
    told = said(message)
    return f"{message.log_ns / 1e9:.3f} {told['name']}: {told['message']}"


def raw_frames(recording: Recording) -> Iterator[Judged]:
    """The raw frames of a recording, whole ones only, oldest first: those that lie beside a run, or in it."""
    for each in frame_recordings(recording):
        yield from _frames_in(each)


def frame_recordings(recording: Recording) -> list[Recording]:
    """Where its raw frames are: in files beside it, else in it."""
    return [Recording(path) for path in recording.frame_files] or [recording]


def gaps_of(recording: Recording) -> list[Gap]:
    """What cannot be read of it and of its raw frames."""
    beside = [Recording(path) for path in recording.frame_files]
    return [gap for each in (recording, *beside) for gap in each.gaps]


def _frames_in(recording: Recording) -> Iterator[Judged]:
    frame, color = b"", ""
    waits_for_depth = has_depth = False

    def without_depth() -> Iterator[Judged]:
        """What there is of a frame after which the file breaks off: whole, where there is never any depth."""
        if waits_for_depth and not has_depth:
            judged = judged_of(frame, color, None)
            if judged.frame.depth_number < 0:
                yield judged

    for message in recording.messages((FRAME, COLOR, DEPTH, GAP)):
        if message.topic == GAP:
            yield from without_depth()
            frame, waits_for_depth = b"", False
        elif message.topic == FRAME:
            if waits_for_depth:
                yield judged_of(frame, color, None)
            frame, waits_for_depth = message.data, False
        elif message.topic == COLOR and frame:
            color, waits_for_depth = said(message)["data"], True
        elif waits_for_depth:
            has_depth = True
            yield judged_of(frame, color, said(message)["data"])
            waits_for_depth = False
    yield from without_depth()


def export_frames(recording: Recording, folder: Path) -> int:
    """The raw frames as a frame set, for ``graderd classify`` and ``graderd label``; returns how many."""
    writer, count_n = None, 0
    for judged in raw_frames(recording):
        frame = judged.frame
        if writer is None:
            calibration = with_lens_of(frame, recording.config.camera.calibration)
            writer = FrameSetWriter(folder, calibration, recording.config.blade)
        writer.add(Entry(f"{count_n:05d}", None, judged.angle_deg, attitude=judged.attitude), frame)
        count_n += 1
    return count_n
