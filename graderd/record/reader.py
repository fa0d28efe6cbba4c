"""Recordings read back: whole ones, those that a killed process left, and those still being written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from pydantic import ValidationError

from graderd.config import Config, ConfigError
from graderd.config.loader import explain
from graderd.hal.errors import DeviceMissingError, ProtocolError
from graderd.record.layout import CONFIG, FRAMES_SUFFIX, METADATA, SUFFIX, Message

RECORD_MOST_BYTES = 256 << 20
"""A longer record is damage."""


@dataclass(frozen=True, slots=True)
class Extent:
    """What a file holds: nanoseconds of its first and last message, messages by channel (None where it was not counted:
    the file has no summary), and whether it was ended in order."""

    first_ns: int | None
    last_ns: int | None
    messages_n: int | None
    is_ended: bool

    @property
    def duration_s(self) -> float:
        """From the first to the last message."""
        return 0.0 if self.first_ns is None or self.last_ns is None else (self.last_ns - self.first_ns) / 1e9


class Recording:
    """One file, opened for reading: its head is read at once, messages when asked for.

    Raises:
        DeviceMissingError: no such file.
        ProtocolError: it is no recording of graderd's.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise DeviceMissingError(str(path), "no such recording", "graderd record list shows which there are")
        self.head: Mapping[str, str] = {}
        self.config_json = b""
        for record in self._records():
            if isinstance(record, Metadata) and record.name == METADATA:
                self.head = record.metadata
            elif isinstance(record, Attachment) and record.name == CONFIG:
                self.config_json = record.data
            elif isinstance(record, Chunk):
                break
            if self.head and self.config_json:
                break
        if not self.head or not self.config_json:
            raise ProtocolError(str(path), "is no recording of graderd's, or broke off before it began")

    @cached_property
    def config(self) -> Config:
        """The configuration it was made with.

        Raises:
            ConfigError: today's graderd does not take it any more.
        """
        try:
            return Config.model_validate_json(self.config_json)
        except ValidationError as error:
            raise ConfigError(self.path, explain(error, Config, where=f"{self.path} {CONFIG}")) from None

    @property
    def _summary(self) -> Summary | None:
        try:
            with self.path.open("rb") as file:
                return make_reader(file).get_summary()
        except Exception:  # whatever the library makes of a file without an end
            return None

    @property
    def _channels(self) -> dict[int, str]:
        """Topics by number; empty where the file has no summary."""
        summary = self._summary
        return {} if summary is None else {number: channel.topic for number, channel in summary.channels.items()}

    @cached_property
    def extent(self) -> Extent:
        """How much it holds, by its summary where there is one."""
        summary = self._summary
        if summary is not None and summary.statistics is not None and summary.statistics.message_count:
            told = summary.statistics
            return Extent(told.message_start_time, told.message_end_time, told.message_count, True)
        chunks = [record for record in self._records() if isinstance(record, Chunk)]
        if chunks and not _inside(chunks[-1]):
            chunks.pop()
        if not chunks:
            return Extent(None, None, 0, summary is not None)
        first_ns = min(chunk.message_start_time for chunk in chunks)
        return Extent(first_ns, max(chunk.message_end_time for chunk in chunks), None, summary is not None)

    @property
    def frame_files(self) -> list[Path]:
        """Where its raw frames lie: none, one, or more where perception was started anew meanwhile."""
        stem = self.path.name.removesuffix(SUFFIX)
        return sorted(self.path.parent.glob(f"{stem}*{FRAMES_SUFFIX}"), key=lambda path: (len(path.name), path.name))

    def messages(self, topics: Collection[str] | None = None, from_ns: int = 0) -> Iterator[Message]:
        """In the file's order, up to its last whole chunk; ``topics`` None: of all channels. ``from_ns``: not those
        that were logged before."""
        # Channels are named where they are first used: only who knows them beforehand may pass over a chunk.
        names = self._channels if from_ns else {}
        passes_over = bool(names)
        for record in self._records():
            if not isinstance(record, Chunk) or (passes_over and record.message_end_time < from_ns):
                continue
            for inner in _inside(record):
                if isinstance(inner, Channel):
                    names[inner.id] = inner.topic
                elif isinstance(inner, McapMessage):
                    topic = names.get(inner.channel_id)
                    if topic is None:  # a channel that nobody named: whoever wrote this, it is no message of ours
                        continue
                    if (topics is None or topic in topics) and inner.log_time >= from_ns:
                        yield Message(topic, inner.log_time, inner.data)

    def _records(self) -> Iterator[Any]:
        """Records up to the end or the first damage: a file that is being written ends anywhere, also in its last
        chunk."""
        with self.path.open("rb") as file:
            try:
                for record in StreamReader(file, emit_chunks=True, record_size_limit=RECORD_MOST_BYTES).records:
                    if isinstance(record, DataEnd | Footer):
                        return
                    yield record
            except Exception:  # the library has no one error for a record that is cut off or damaged
                return


def _inside(chunk: Chunk) -> list[Any]:
    """What is in a chunk; nothing where it is not whole."""
    try:
        return list(breakup_chunk(chunk, validate_crc=True))
    except Exception:  # as above
        return []


def said(message: Message) -> dict[str, Any]:
    """A message's JSON."""
    found: dict[str, Any] = json.loads(message.data)
    return found


@contextmanager
def as_written(recording: Recording, message: Message) -> Iterator[None]:
    """What is read from a message within: graderd writes it so, whoever else wrote the file may not.

    Raises:
        ProtocolError: something was not there, or of another kind; says of which message.
    """
    try:
        yield
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        what = " ".join(str(error).split())[:120]
        cause = f"{message.topic} at {message.log_ns / 1e9:.3f} s is not as graderd writes it ({what})"
        remedy = "It is another version's, or another program's; the version in its head reads its own"
        raise ProtocolError(str(recording.path), cause, remedy) from None


@contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """A folder that is made and filled within; what fails takes it away again, so that a second try finds it free.

    Raises:
        FileExistsError: it is there already.
        OSError: it cannot be made or filled; names it.
    """
    folder.mkdir(parents=True)
    try:
        yield
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise OSError(error.errno, error.strerror or str(error), str(folder)) from None
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
