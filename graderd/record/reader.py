"""Recordings read back: whole ones, those that a killed process left, and those still being written."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shutil
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary
from pydantic import ValidationError

from graderd.config import Config, ConfigError
from graderd.config.loader import explain
from graderd.hal.errors import DeviceError, DeviceMissingError, ProtocolError
from graderd.record.layout import CHANNEL_NAMES, CONFIG, FRAMES_SUFFIX, GAP, METADATA, SUFFIX, Gap, Message, Unreadable

_T = TypeVar("_T")
_MAGIC: Final = b"\x89MCAP0\r\n"
_HEAD: Final = struct.Struct("<BQ")
"""Before each record: what it is, and how many bytes follow."""
_ZSTD: Final = struct.pack("<I", 4) + b"zstd"
"""How graderd's chunks are compressed, as it stands in their head: they are found again by it."""
_ZSTD_AT_N: Final = 37
_CHUNK_HEAD_N: Final = 44
"""Bytes of a chunk's record that are not its messages."""
_SEARCHED_N: Final = 1 << 20


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
        self._names: dict[int, str] = {}  # topics by number, by the head
        self._refused: dict[str, tuple[str, list[int]]] = {}  # by topic: why the first was, and when each was logged
        self._left_out: list[Unreadable] = []
        for _, record in self._records():
            if isinstance(record, Metadata) and record.name == CHANNEL_NAMES:
                self._names = {int(number): topic for number, topic in record.metadata.items() if number.isdecimal()}
            elif isinstance(record, Metadata) and record.name == METADATA:
                self.head = record.metadata
            elif isinstance(record, Attachment) and record.name == CONFIG:
                self.config_json = record.data
            elif isinstance(record, Chunk):
                break
            if self.head and self.config_json:
                break
        if not self.head or not self.config_json:
            cause = "is no recording of graderd's, or its head is damaged, or it broke off before it began"
            raise ProtocolError(str(path), cause)
        digest = hashlib.sha256(self.config_json).hexdigest()
        if self.head.get("config_sha256", digest) != digest:
            cause = "its head is damaged: the configuration in it is not the one that its hash is of"
            raise ProtocolError(str(path), cause)

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
        """Topics by number, by the summary; empty where the file has none."""
        summary = self._summary
        return {} if summary is None else {number: channel.topic for number, channel in summary.channels.items()}

    @cached_property
    def extent(self) -> Extent:
        """How much it holds, by its summary where there is one."""
        summary = self._summary
        if summary is not None and summary.statistics is not None and summary.statistics.message_count:
            told = summary.statistics
            return Extent(told.message_start_time, told.message_end_time, told.message_count, True)
        first_ns: int | None = None
        last_ns: int | None = None
        newest: Chunk | None = None
        for _, record in self._records():
            if not isinstance(record, Chunk):
                continue
            if newest is not None:
                first_ns, last_ns = _wider(first_ns, last_ns, newest)
            newest = record
        if newest is not None and _messages_in(newest, {}) is not None:
            first_ns, last_ns = _wider(first_ns, last_ns, newest)
        return Extent(first_ns, last_ns, None if newest is not None else 0, summary is not None)

    @property
    def frame_files(self) -> list[Path]:
        """Where its raw frames lie: none, one, or more where perception was started anew meanwhile."""
        stem = self.path.name.removesuffix(SUFFIX)
        return sorted(self.path.parent.glob(f"{stem}*{FRAMES_SUFFIX}"), key=lambda path: (len(path.name), path.name))

    @cached_property
    def beside(self) -> tuple[Recording, ...]:
        """Those files that are recordings; what is none (a process that was killed as it began one) is told as
        unreadable."""
        found = []
        for path in self.frame_files:
            try:
                found.append(Recording(path))
            except DeviceError as error:
                self.leave_out(path.name, error.cause)
        return tuple(found)

    def value_of(self, message: Message, how: Callable[[bytes], _T]) -> _T | None:
        """What ``how`` makes of a message; None where it is not as graderd writes it: told in :attr:`unreadable`."""
        try:
            return how(message.data)
        except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
            self.refuse(message, error)
            return None

    def refuse(self, message: Message, why: Exception) -> None:
        """A message is not as graderd writes it, by what came of it."""
        _, times_ns = self._refused.setdefault(message.topic, (_words(why), []))
        if message.log_ns not in times_ns[-1:]:
            times_ns.append(message.log_ns)

    def leave_out(self, file: str, cause: str) -> None:
        """A part of it that is no message cannot be read."""
        version = self.head.get("version", "")
        self._left_out.append(
            Unreadable(file=file, topic="", first_ns=None, messages_n=0, cause=cause, version=version)
        )

    @property
    def unreadable(self) -> tuple[Unreadable, ...]:
        """What of it and of its raw frames was found not to be as graderd writes it, by whatever was read so far."""
        own = (
            Unreadable(
                file=self.path.name,
                topic=" ".join(topic.split()),
                first_ns=min(times_ns),
                messages_n=len(set(times_ns)),
                cause=cause,
                version=self.head.get("version", ""),
            )
            for topic, (cause, times_ns) in self._refused.items()
        )
        return (*own, *self._left_out, *(each for other in self.beside for each in other.unreadable))

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """What of it cannot be read, in its order; reads all of it. That it has no end is no gap."""
        told = (self.value_of(message, Gap.model_validate_json) for message in self.messages((GAP,)))
        return tuple(gap for gap in told if gap is not None)

    def messages(self, topics: Collection[str] | None = None, from_ns: int = 0) -> Iterator[Message]:
        """In the file's order, up to its last whole chunk; ``topics`` None: of all channels. ``from_ns``: not those
        that were logged before.

        Where something between two chunks, or before the end, cannot be read, a :class:`Gap` stands in its place, on
        the channel of that name.
        """
        wants_gaps = topics is None or GAP in topics
        # Channels are named where they are first used: only who knows them beforehand may pass over a chunk.
        names = self._channels
        passes_over = bool(names) and from_ns > 0
        only_looks = bool(names) and topics is not None and set(topics) == {GAP} and GAP not in names.values()
        names = self._names | names
        chunk_n, last_ns = 0, None
        lost: tuple[int, int] | None = None  # chunk and first byte of what could not be read
        is_damaged, to_n = False, self.path.stat().st_size
        for first_n, record in self._records():
            if isinstance(record, Chunk):
                chunk_n += 1
                if passes_over and record.message_end_time < from_ns:
                    last_ns, lost = record.message_end_time, None
                    continue
                found = _looked_at(record) if only_looks else _messages_in(record, names, all_named=is_damaged)
                if found is not None:
                    if lost is not None and wants_gaps:
                        yield self._gap(lost, first_n, last_ns, record.message_start_time)
                    lost, last_ns = None, record.message_end_time
                    for topic, inner in found:
                        if (topics is None or topic in topics) and inner.log_time >= from_ns:
                            yield Message(topic, inner.log_time, inner.data)
                    continue
            elif record is None:
                chunk_n += 1
            else:
                to_n = first_n if isinstance(record, DataEnd) else to_n
                continue
            lost, is_damaged = lost or (chunk_n, first_n), True
        if lost is not None and wants_gaps:
            yield self._gap(lost, to_n, last_ns, None)

    def _gap(self, lost: tuple[int, int], to_n: int, from_ns: int | None, to_ns: int | None) -> Message:
        chunk_n, first_n = lost
        summary = self._summary if to_ns is None else None
        if summary is not None and summary.statistics is not None:
            to_ns = max(summary.statistics.message_end_time, from_ns or 0)
        gap = Gap(
            file=self.path.name,
            chunk_n=chunk_n,
            first_byte_n=first_n,
            bytes_n=to_n - first_n,
            from_ns=from_ns,
            to_ns=to_ns,
        )
        return Message(GAP, from_ns or to_ns or 0, gap.model_dump_json().encode())

    def _records(self) -> Iterator[tuple[int, Any]]:
        """Records of ours, each with the byte it begins at, up to the end of the data. None: there no record begins
        that graderd writes; what comes next is the next chunk that does."""
        with self.path.open("rb") as file:
            size_n = os.fstat(file.fileno()).st_size  # what is written meanwhile is another reading's
            at_n = len(file.read(len(_MAGIC)))
            while at_n + _HEAD.size <= size_n:
                file.seek(at_n)
                kind, length_n = _HEAD.unpack(file.read(_HEAD.size))
                next_n = at_n + _HEAD.size + length_n
                record = _record_of(kind, file.read(length_n)) if next_n <= size_n else None
                if record is None:
                    found_n = _next_chunk(file, at_n + 1, size_n)
                    if found_n is None and next_n > size_n and kind in _READ and not self._has_end(file, size_n):
                        return  # a file that was cut off, or is being written, ends within a record
                    next_n = size_n if found_n is None else found_n
                yield at_n, record
                if isinstance(record, DataEnd):
                    return
                at_n = next_n

    @staticmethod
    def _has_end(file: BinaryIO, size_n: int) -> bool:
        file.seek(max(0, size_n - len(_MAGIC)))
        return file.read(len(_MAGIC)) == _MAGIC


def _skipped(stream: ReadDataStream) -> int:
    """A record of which only its length counts: by channel, an index of the chunk before."""
    stream.read2()
    length_n = stream.read4()
    if length_n and len(stream.read(length_n)) < length_n:
        raise ValueError("longer than it is")
    return length_n


_READ: Final[Mapping[int, Callable[[ReadDataStream], Any]]] = {
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.MESSAGE_INDEX: _skipped,
    Opcode.DATA_END: DataEnd.read,
}
"""What graderd writes before a file's summary."""


def _record_of(kind: int, body: bytes) -> Any:
    """The record; None: it is none that graderd writes."""
    stream = ReadDataStream(BytesIO(body))
    try:
        record = _READ[kind](stream)
    except Exception:  # the library has no one error for a record that is damaged
        return None
    return record if stream.count == len(body) else None


def _next_chunk(file: BinaryIO, from_n: int, size_n: int) -> int | None:
    """Where the next chunk begins that agrees with itself and is all there; None: there is none."""
    file.seek(from_n)
    base_n, window = from_n, b""
    while piece := file.read(_SEARCHED_N):
        window += piece
        at = window.find(_ZSTD)
        while at >= 0:
            begins = at - _ZSTD_AT_N
            if begins >= 0 and at + len(_ZSTD) + 8 <= len(window):
                kind, length_n = _HEAD.unpack_from(window, begins)
                (data_n,) = struct.unpack_from("<Q", window, at + len(_ZSTD))
                ends_n = base_n + begins + _HEAD.size + length_n
                if kind == Opcode.CHUNK and length_n == _CHUNK_HEAD_N + data_n and ends_n <= size_n:
                    return base_n + begins
            at = window.find(_ZSTD, at + 1)
        kept_n = _ZSTD_AT_N + len(_ZSTD) + 8
        base_n, window = base_n + max(0, len(window) - kept_n), window[-kept_n:]
    return None


def _wider(first_ns: int | None, last_ns: int | None, chunk: Chunk) -> tuple[int, int]:
    start_ns, end_ns = chunk.message_start_time, chunk.message_end_time
    return (
        start_ns if first_ns is None else min(first_ns, start_ns),
        end_ns if last_ns is None else max(last_ns, end_ns),
    )


def _looked_at(chunk: Chunk) -> list[tuple[str, McapMessage]] | None:
    """Nothing of what is in a chunk; None: it is damaged."""
    try:
        get_chunk_data_stream(chunk, validate_crc=True)
    except Exception:  # as above
        return None
    return []


def _messages_in(
    chunk: Chunk, names: dict[int, str], *, all_named: bool = False
) -> list[tuple[str, McapMessage]] | None:
    """Topics and messages in a chunk; None: it is damaged. ``names``: of the channels, by number; those that the chunk
    names are put there. What nobody named is no message of ours, or (``all_named``) was named in what is lost."""
    try:
        records = breakup_chunk(chunk, validate_crc=True)
    except Exception:  # as above
        return None
    found = []
    for record in records:
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, McapMessage):
            topic = names.get(record.channel_id)
            if topic is not None:
                found.append((topic, record))
            elif all_named:
                return None
    return found


def said(data: bytes) -> dict[str, Any]:
    """A message's JSON.

    Raises:
        ValueError: it is none, or no object.
    """
    found = json.loads(data)
    if not isinstance(found, dict):
        raise ValueError("no JSON object")
    return found


def picture_data(data: bytes) -> bytes:
    """The file in an image message.

    Raises:
        ValueError, LookupError: there is none.
    """
    return base64.b64decode(said(data)["data"], validate=True)


def _words(error: Exception) -> str:
    """What is wrong with a message, in a line."""
    if isinstance(error, ValidationError):
        first, *_ = error.errors(include_url=False, include_context=False, include_input=False)
        text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    elif isinstance(error, KeyError):
        text = f"{error.args[0]!r} is missing"
    else:
        text = str(error) or type(error).__name__
    return " ".join(text.split())[:120]


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
