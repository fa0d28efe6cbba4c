"""Where the daemon's log goes: the systemd journal with its fields, JSON lines, or lines on a terminal.

``extra={"device": …, "fault": …, "mode": …, "client": …}`` of a log call becomes fields of the journal entry
(``GRADERD_DEVICE`` and so on, for ``journalctl GRADERD_DEVICE=rotation``) and of the JSON line. Whatever the way, text
is made printable: a name that a client chose cannot end a line and begin another, nor command the reader's terminal.
"""

from __future__ import annotations

import contextlib
import copy
import json
import logging
import os
import queue
import re
import socket
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from graderd.hal.text import printable

JOURNAL_SOCKET = Path("/run/systemd/journal/socket")
FIELDS = ("device", "mode", "client", "fault")
LATER_MOST_N = 2000
LATER_END_S = 1.0
MESSAGE_MOST_BYTES = 32_768
"""Longer than any text of ours; a datagram has to hold it."""


def priority(level: int) -> int:
    """A level of ``logging`` as syslog(3) counts: 2 critical, 3 error, 4 warning, 6 informational, 7 debug."""
    for at_least, number in ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6)):
        if level >= at_least:
            return number
    return 7


def fields_of(record: logging.LogRecord) -> dict[str, str]:
    """What the record says beside its message."""
    found = {name: getattr(record, name, None) for name in FIELDS}
    return {name: printable(str(value)) for name, value in found.items() if value}


class _Line(logging.Formatter):
    """One line an entry; only a traceback, which is ours, goes on over several."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (as in logging)
        record.message = printable(record.message)
        return super().formatMessage(record)


class _PriorityLine(_Line):
    """A line as sd-daemon(3) reads it from standard error: its priority first, on every line of it."""

    def format(self, record: logging.LogRecord) -> str:
        head = f"<{priority(record.levelno)}>"
        return "\n".join(head + line for line in super().format(record).splitlines())


class _JsonLine(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line = {
            "time": record.created,
            "level": record.levelname.lower(),
            "event": "log",
            "message": record.getMessage(),
        }
        line |= fields_of(record)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line)


class JournalHandler(logging.Handler):
    """Sends each record as one datagram of journald's own protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL).

    What the journal does not take (it is full, gone, or the entry too long) goes to ``otherwise``: never lost, never
    waited for.

    Raises:
        OSError: there is no journal at ``address``.
    """

    def __init__(self, otherwise: logging.Handler, address: Path = JOURNAL_SOCKET) -> None:
        super().__init__()
        self._otherwise = otherwise
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        try:
            self._socket.connect(str(address))
        except OSError:
            self._socket.close()
            raise

    def emit(self, record: logging.LogRecord) -> None:
        """Send the record, or hand it on."""
        try:
            self._socket.send(journal_entry(record))
        except OSError:
            self._otherwise.handle(record)

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()
        super().close()


def journal_entry(record: logging.LogRecord) -> bytes:
    """The record as journald reads it."""
    message = printable(record.getMessage())
    if record.exc_info:
        message += "\n" + logging.Formatter().formatException(record.exc_info)
    values = {
        "MESSAGE": message,
        "PRIORITY": str(priority(record.levelno)),
        "SYSLOG_IDENTIFIER": "graderd",
        "LOGGER": record.name,
        "CODE_FILE": record.pathname,
        "CODE_LINE": str(record.lineno),
        "CODE_FUNC": record.funcName or "",
        **{f"GRADERD_{name.upper()}": value for name, value in fields_of(record).items()},
    }
    return b"".join(_field(name, value) for name, value in values.items())


def _field(name: str, value: str) -> bytes:
    """``NAME=value``; a value of several lines goes by its length, so that none of them can be taken for a field."""
    data = value.encode("utf-8", "replace")[:MESSAGE_MOST_BYTES]
    if b"\n" not in data:
        return name.encode() + b"=" + data + b"\n"
    return name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"


class LaterHandler(logging.Handler):
    """Hands every record to a thread, which has the other handler write it: who logs never waits for a reader.

    Where that handler does not keep up (a full pipe that nobody reads), :data:`LATER_MOST_N` records wait and what
    comes beyond is lost; the next line that gets through says how many were.
    """

    def __init__(self, handler: logging.Handler) -> None:
        super().__init__()
        self._handler = handler
        self._records: queue.Queue[logging.LogRecord | None] = queue.Queue(LATER_MOST_N)
        self._lost_n = 0
        self._thread = threading.Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the record, its text made now: what it names may change."""
        record = copy.copy(record)
        record.msg, record.args = record.getMessage(), None
        try:
            self._records.put_nowait(record)
        except queue.Full:
            self._lost_n += 1

    def close(self) -> None:
        """Wait for what was said to be written, not longer than :data:`LATER_END_S`."""
        with contextlib.suppress(queue.Full):
            self._records.put_nowait(None)
            self._thread.join(LATER_END_S)
        super().close()

    def _write(self) -> None:
        while (record := self._records.get()) is not None:
            if self._lost_n:
                lost_n, self._lost_n = self._lost_n, 0
                told = f"{lost_n} lines of this log were lost: it was not read for too long"
                self._handler.handle(logging.LogRecord(__name__, logging.WARNING, __file__, 0, told, None, None))
            self._handler.handle(record)


class _StandardError(logging.Handler):
    """Writes to the file itself. ``sys.stderr`` has a lock, and whoever ends the process waits for it."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self.lock = None  # only one thread writes, and one that hangs in a full pipe must not be waited for

    def handle(self, record: logging.LogRecord) -> bool:
        """Write it."""
        self.emit(record)
        return True

    def emit(self, record: logging.LogRecord) -> None:
        """Write the whole line; a reader that is gone has nothing to be told."""
        data = f"{self.format(record)}\n".encode("utf-8", "replace")
        with contextlib.suppress(OSError):
            while data:
                data = data[os.write(self._descriptor, data) :]

    def acquire(self) -> None:
        """As :attr:`lock`."""

    def release(self) -> None:
        """As :attr:`lock`."""


def set_up_logging(as_json: bool, level: int = logging.INFO) -> None:
    """One line an event, repeated ones ever more rarely: to the journal where standard error is the journal's, else to
    standard error (a terminal gets the time from us). ``level``: the least that graderd's own entries must have; what
    libraries say counts from warning on, or from ``level`` where that is higher."""
    handler = LaterHandler(_handler(as_json))
    handler.addFilter(RepeatFilter())
    logging.basicConfig(level=max(logging.WARNING, level), handlers=[handler], force=True)
    logging.getLogger("graderd").setLevel(level)
    logging.getLogger("can").setLevel(max(logging.ERROR, level))


def _handler(as_json: bool) -> logging.Handler:
    lines = _lines()
    if as_json:
        lines.setFormatter(_JsonLine())
    elif not _stderr_is_the_journals():
        lines.setFormatter(_Line("%(asctime)s %(levelname)-7s %(message)s"))
    else:
        lines.setFormatter(_PriorityLine("%(message)s"))
        try:
            return JournalHandler(lines)
        except OSError:
            return lines  # a journal that only reads what we print
    return lines


def _lines() -> logging.Handler:
    try:
        return _StandardError(sys.stderr.fileno())
    except (OSError, ValueError):
        return logging.StreamHandler(sys.stderr)  # a test that captures it


def _stderr_is_the_journals() -> bool:
    """Whether what we print goes to the journal: systemd says which file that is, as DEVICE:INODE. A daemon that was
    started by hand from a unit's shell inherits the variable and prints elsewhere."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


SECOND_S = 60.0
THEN_EVERY_S = 3600.0
QUIET_S = 600.0
"""What has not come for so long and comes again is news, and told at once."""
KEYS_MOST_N = 500
BURST_N = 60
PER_S = 1 / 60
_NUMBERS = re.compile(r"0x[0-9a-f]+|\d+(\.\d+)?")


@dataclass(slots=True)
class _Told:
    """What is known of one message. ``times_n``: how often it came since it was told last."""

    told_s: float
    came_s: float
    told_n: int = 1
    times_n: int = 0


class _Budget:
    """So many lines at once and so many in the long run, whatever comes; counts those that were too many."""

    def __init__(self, now_s: float) -> None:
        self._left_n = float(BURST_N)
        self._at_s = now_s
        self._too_many_n = 0

    def spend(self, now_s: float) -> int | None:
        """None: there is nothing left. Else how many were left out since the last one that was not."""
        self._left_n = min(float(BURST_N), self._left_n + (now_s - self._at_s) * PER_S)
        self._at_s = now_s
        if self._left_n < 1.0:
            self._too_many_n += 1
            return None
        self._left_n -= 1.0
        too_many_n, self._too_many_n = self._too_many_n, 0
        return too_many_n


class RepeatFilter(logging.Filter):
    """Lets a message through at once, again after a minute, then hourly with a count of what came between.

    Two messages are the same where they differ in numbers alone: retry loops count, and name ports and times. One that
    carries the attribute ``event`` (a change of mode) tells what somebody did and is never taken for a repetition.
    Neither what is new nor what is an event can fill a disk: of each, :data:`BURST_N` go through at once and one a
    minute in the long run, and the next one that does says how many did not.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now_s = now_s
        self._told: OrderedDict[tuple[str, int, str], _Told] = OrderedDict()
        self._news = _Budget(now_s())
        self._events = _Budget(now_s())

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is told now; its message then carries the count."""
        now_s = self._now_s()
        event = getattr(record, "event", False)
        left_out_n = self._events.spend(now_s) if event else self._repetition(record, now_s)
        if left_out_n is None:
            return False
        if left_out_n:
            record.msg, record.args = f"{record.getMessage()} ({left_out_n} more not told)", None
        return True

    def _repetition(self, record: logging.LogRecord, now_s: float) -> int | None:
        key = (record.name, record.levelno, _NUMBERS.sub("#", record.getMessage()))
        told = self._told.pop(key, None)
        if told is None or now_s - told.came_s >= QUIET_S:
            left_out_n = self._news.spend(now_s)
            if left_out_n is not None:
                self._told[key] = _Told(now_s, now_s)
                if len(self._told) > KEYS_MOST_N:
                    self._told.popitem(last=False)
            return left_out_n
        self._told[key] = told
        told.came_s = now_s
        if now_s < told.told_s + (SECOND_S if told.told_n == 1 else THEN_EVERY_S):
            told.times_n += 1
            return None
        left_out_n, told.times_n = told.times_n, 0
        told.told_s, told.told_n = now_s, told.told_n + 1
        return left_out_n
