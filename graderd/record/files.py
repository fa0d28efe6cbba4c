"""A recording being written: one MCAP file that is whole up to its last chunk whatever becomes of process and disk."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from graderd.record.layout import CHANNEL_NAMES, CONFIG, METADATA, Message, schema_of

CHUNK_MOST_BYTES = 4 << 20


class _Output:
    """What the MCAP writer writes into. It reaches the file with :meth:`flush`, in one piece; where that fails, the
    file is cut back to what was whole before, so that nothing is ever glued to a broken chunk."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        self._whole_n = 0
        self._waiting = bytearray()

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._whole_n + len(self._waiting)

    def flush(self) -> None:
        data = memoryview(bytes(self._waiting))
        try:
            while data:
                data = data[os.write(self._file, data) :]
        except OSError:
            os.ftruncate(self._file, self._whole_n)
            raise
        self._whole_n += len(self._waiting)
        self._waiting.clear()

    def is_at(self, path: Path) -> bool:
        """Whether the file is still the one of that name."""
        try:
            return os.path.samestat(os.fstat(self._file), path.stat())
        except OSError:
            return False

    def close(self) -> None:
        os.close(self._file)


class RecordingFile:
    """One file. ``head`` says where it comes from; it and the configuration stand before everything else. ``topics``:
    channels that are named there too; others are named in the chunk that first uses them, and where the file has no
    summary, nobody knows what they are once that chunk is damaged.

    Every method that writes raises ``OSError``; then, and after :meth:`finish`, the file is closed and takes nothing
    more.
    """

    def __init__(self, path: Path, head: Mapping[str, str], config_json: bytes, topics: Iterable[str] = ()) -> None:
        self.path = path
        self._output = _Output(path)
        output: Any = self._output
        self._writer: Any = Writer(output, chunk_size=CHUNK_MOST_BYTES, compression=CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._closed = False
        self.waiting_n = 0
        """Bytes since the last chunk; they become fewer by being written."""
        self._summary_n = 0
        self._writer.start(profile="", library=f"graderd {head.get('version', '')}")
        for topic in topics:
            self._register(topic)
        self._writer.add_metadata(METADATA, dict(head))
        # The library names them in the first chunk alone, and in the summary that a killed process does not write.
        self._writer.add_metadata(CHANNEL_NAMES, {str(number): topic for topic, number in self._channels.items()})
        self._writer.add_attachment(0, 0, CONFIG, "application/json", config_json)
        self.flush()

    @property
    def size_n(self) -> int:
        """Bytes so far, without the chunk in progress."""
        return self._output.tell()

    @property
    def needed_n(self) -> int:
        """The most that it will grow by if it is finished now: what waits, and a summary with each schema once more."""
        return self.waiting_n + self._summary_n

    def is_there(self) -> bool:
        """Whether it still lies under its name: a file that somebody took away is begun anew."""
        return self._output.is_at(self.path)

    def add(self, message: Message) -> None:
        """Into the chunk in progress; one that grew past :data:`CHUNK_MOST_BYTES` is finished."""
        channel = self._channels.get(message.topic)
        if channel is None:
            channel = self._register(message.topic)
        self.waiting_n += len(message.data)
        self._writer.add_message(channel, message.log_ns, message.data, message.log_ns)

    def flush(self) -> None:
        """Finish the chunk in progress: what is in it survives the process."""
        try:
            self._writer.flush()
            self.waiting_n = 0
        except OSError:
            self._close()
            raise

    def finish(self) -> None:
        """Write the summary by which readers seek, and close; idempotent."""
        if self._closed:
            return
        try:
            self._writer.finish()
            self._output.flush()
        finally:
            self._close()

    def _close(self) -> None:
        if not self._closed:
            self._closed = True
            self._output.close()

    def _register(self, topic: str) -> int:
        name, schema = schema_of(topic)
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema)
            self.waiting_n += len(schema)
            self._summary_n += len(schema)
        self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[name])
        return self._channels[topic]
