"""A recording as ordinary files: for spreadsheets, for the decoders of the wires, and its raw frames as a frame set."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from graderd.config import ConfigError
from graderd.hal.camera import ColorImage
from graderd.perception.frame_set import Entry, FrameSetWriter, with_lens_of
from graderd.record.files import RecordingFile
from graderd.record.frames import Judged, circumstances_of, color_of, depth_of, judged_of
from graderd.record.layout import (
    COLOR,
    DEPTH,
    FRAME,
    FRAME_CHANNELS,
    GAP,
    LOG,
    PREVIEW,
    WIRE,
    FrameRecord,
    Gap,
    Message,
)
from graderd.record.reader import Recording, new_folder, picture_data, said
from graderd.record.table import rows, write_csv

WHOLE = "recording.mcap"
_WIRE_NAME = re.compile(r"\w{1,32}", re.ASCII)


def export(recording: Recording, folder: Path) -> dict[str, int]:
    """Write everything that is in it to ``folder``; returns how much of each there was.

    ``recording.mcap`` is the same recording with an end and a summary, which every reader opens, also where the
    original was cut off; where something of it could not be read, a ``/gap`` says so. What is not as graderd writes it
    is in ``recording.unreadable`` then, and in no other file but, word for word, that one.

    Raises:
        FileExistsError: the folder is there already.
        OSError: it cannot be written; nothing of it is left.
    """
    with new_folder(folder):
        (folder / "config.json").write_bytes(recording.config_json)
        found = {"ticks_n": write_csv(folder / "ticks.csv", rows(recording)), "pictures_n": 0, "log_lines_n": 0}
        whole = RecordingFile(folder / WHOLE, recording.head, recording.config_json)
        for message in recording.messages():
            try:
                whole.add(message)
            except ValueError as error:  # no channel of graderd's
                recording.refuse(message, error)
                continue
            if message.topic == PREVIEW:
                if (picture := recording.value_of(message, picture_data)) is None:
                    continue
                path = folder / "pictures" / f"{message.log_ns}.jpg"
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(picture)
                found["pictures_n"] += 1
            elif message.topic == LOG or message.topic.startswith(WIRE):
                if (lines := _lines_of(recording, message)) is None:
                    continue
                with (folder / f"{message.topic.rpartition('/')[2]}.log").open("a", encoding="utf-8") as file:
                    file.writelines(f"{line}\n" for line in lines)
                found["log_lines_n"] += len(lines)
        whole.finish()
        if recording.frame_files:
            try:
                found["frames_n"] = export_frames(recording, folder / "frames")
            except ConfigError as error:
                recording.leave_out(recording.path.name, f"its raw frames need its configuration: {error.problems[0]}")
    return found


def _lines_of(recording: Recording, message: Message) -> list[str] | None:
    """Lines of a log or a wire."""

    def lines(data: bytes) -> list[str]:
        told = said(data)
        if message.topic == LOG:
            return [f"{message.log_ns / 1e9:.3f} {told['name']}: {told['message']}"]
        if not _WIRE_NAME.fullmatch(message.topic.removeprefix(WIRE)):
            raise ValueError("no name of a wire")
        if not (isinstance(told["lines"], list) and all(isinstance(line, str) for line in told["lines"])):
            raise ValueError("lines: no list of texts")
        return told["lines"]

    return recording.value_of(message, lines)


def raw_frames(recording: Recording) -> Iterator[tuple[Message, Judged]]:
    """The raw frames of a recording, whole ones only, oldest first: those that lie beside a run, or in it; each with
    its ``/camera/frame``. What is not as graderd writes it is left out."""
    for each in recording.beside or (recording,):
        yield from _frames_in(each)


def gaps_of(recording: Recording) -> list[Gap]:
    """What cannot be read of it and of its raw frames."""
    return [gap for each in (recording, *recording.beside) for gap in each.gaps]


def _frames_in(recording: Recording) -> Iterator[tuple[Message, Judged]]:
    message: Message
    at: Message | None = None
    record: FrameRecord | None = None
    color: ColorImage | None = None  # of a frame that may be followed by its depth
    has_depth = False

    def without_depth(*, ends: bool) -> Iterator[tuple[Message, Judged]]:
        """A frame that no depth came after. Where the file breaks off (``ends``), it is whole if there never is any."""
        if at is None or record is None or color is None:
            return
        if not ends or (not has_depth and record.depth_number < 0):
            yield at, judged_of(record, color, None)

    for message in recording.messages((*FRAME_CHANNELS, GAP)):
        if message.topic == GAP:
            yield from without_depth(ends=True)
            record = color = None
        elif message.topic == FRAME:
            yield from without_depth(ends=False)
            at, color = message, None
            record = recording.value_of(message, circumstances_of)
        elif message.topic == COLOR and record is not None:
            color = recording.value_of(message, color_of)
        elif message.topic == DEPTH and at is not None and record is not None and color is not None:
            if (depth := recording.value_of(message, depth_of)) is not None:
                has_depth = True
                yield at, judged_of(record, color, depth)
            record = color = None
    yield from without_depth(ends=True)


def export_frames(recording: Recording, folder: Path) -> int:
    """The raw frames as a frame set, for ``graderd classify`` and ``graderd label``; returns how many.

    Raises:
        ConfigError: the recording's configuration is not one any more.
    """
    writer, count_n = None, 0
    for _, judged in raw_frames(recording):
        frame = judged.frame
        if writer is None:
            calibration = with_lens_of(frame, recording.config.camera.calibration)
            writer = FrameSetWriter(folder, calibration, recording.config.blade)
        writer.add(Entry(f"{count_n:05d}", None, judged.angle_deg, attitude=judged.attitude), frame)
        count_n += 1
    return count_n
