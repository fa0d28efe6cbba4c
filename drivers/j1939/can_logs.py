"""CAN traffic as text and in files: candump's text in all its forms, and every log format that python-can reads.

What is read are python-can's messages, so that error, remote and FD frames stay what they are.
"""

from __future__ import annotations

import datetime
import gzip
import io
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from graderd.drivers.j1939.bus_health import ERROR_FRAMES, BusEvent
from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.python_can import MESSAGE_READERS, BinaryIOMessageReader, can, load_mf4
from graderd.hal.errors import ProtocolError

_ERROR_FLAG: Final = 0x2000_0000
_ID_MASK: Final = 0x1FFF_FFFF
_CANDUMP_SUFFIXES: Final = (".log", ".db")
"""python-can has readers for these: one for ``candump -L`` that stops at the first other line, and one for a database
that does not take an open file."""

# candump's columns, with -t, -x, or none:  (0.105000)  can0  TX - -  18EF1300   [8]  DC 05 19 15 00 00 00 00
_COLUMNS: Final = re.compile(
    r"^\s*(?:\((?P<t>[^)]*)\)\s+)?(?P<channel>\S+)\s+(?:[RT]X\s+\S+\s+\S+\s+)?(?P<id>[0-9A-Fa-f]{3,8})\s+"
    r"\[(?P<n>\d{1,2})\]\s*(?P<data>remote request|(?:[0-9A-Fa-f]{2}(?:\s|$))*)"
)
# candump -l / -L:  (1622749162.123456) can0 18EF1300#DC05191500000000 R
_COMPACT: Final = re.compile(
    r"^\s*(?:\((?P<t>[^)]*)\)\s+)?(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{3,8})#(?P<data>#?[0-9A-FRa-fr]*)"
    r"(?:_[0-9A-F]+)?(?:\s|$)"
)


def candump_line(item: Frame | BusEvent, t_s: float, channel: str = "can0") -> str:
    """One frame, or what the controller tells of the bus as an error frame, as ``candump -L`` writes it."""
    if isinstance(item, BusEvent):
        class_bits, data = ERROR_FRAMES[item]
        return f"({t_s:.6f}) {channel} {class_bits | _ERROR_FLAG:08X}#{data.hex().upper()}"
    return f"({t_s:.6f}) {channel} {item.can_id:0{8 if item.extended else 3}X}#{item.data.hex().upper()}"


def parse_candump_line(line: str) -> can.Message | None:
    """One line of candump text in any of its forms, or None where it is no frame. A line without a time is at 0."""
    match = _COMPACT.match(line)
    if match is not None:
        data = match["data"]
    elif (match := _COLUMNS.match(line)) is not None:
        data = re.sub(r"\s", "", match["data"])
        if match["data"] == "remote request":
            data = "R" + match["n"]
        elif len(match["n"]) == 2:  # candump writes [08] for CAN FD
            data = "#0" + data
    else:
        return None
    digits = data[2:] if data.startswith("#") else data
    if len(digits) % 2 and digits[:1].upper() != "R":  # half a byte: the line was cut
        return None
    text = f"({_seconds(match['t'])}) {match['channel']} {match['id']}#{data}\n"
    try:
        message = next(iter(can.CanutilsLogReader(io.StringIO(text))))
    except (ValueError, IndexError):  # no frame after all
        return None
    if len(match["id"]) == 8 and int(match["id"], 16) & _ERROR_FLAG:  # python-can takes most of them for data
        content = bytes.fromhex(data)
        return can.Message(message.timestamp, int(match["id"], 16) & _ID_MASK, is_error_frame=True, data=content)
    is_sound = len(message.data) <= (64 if message.is_fd else 8)
    return message if is_sound else None


def _seconds(text: str | None) -> float:
    try:
        return float(text or 0.0)
    except ValueError:
        pass
    try:  # candump -tA
        return datetime.datetime.fromisoformat(text or "").timestamp()
    except ValueError:
        return 0.0


def read_candump(lines: Iterable[str], where: str) -> Iterator[can.Message]:
    """The frames of candump text; other lines are left out.

    Raises:
        ProtocolError: there is none.
    """
    found, is_empty = False, True
    for line in lines:
        is_empty = False
        message = parse_candump_line(line)
        if message is not None:
            found = True
            yield message
    if not found:
        raise _no_frame(where, is_empty=is_empty)


def read_file(path: Path) -> Iterator[can.Message]:
    """The frames of a log file: candump text, or by its name one of python-can's formats; both also as ``.gz``.

    Raises:
        ProtocolError: it holds no frame, or cannot be read as such a log.
        OSError: it cannot be opened.
    """
    packed = path.suffix.lower() == ".gz"
    suffix = path.with_suffix("").suffix.lower() if packed else path.suffix.lower()
    if suffix == ".mf4":
        load_mf4()
    reader = MESSAGE_READERS.get(suffix)
    is_candump = reader is None or suffix in _CANDUMP_SUFFIXES
    is_binary = reader is not None and issubclass(reader, BinaryIOMessageReader)
    how: dict[str, Any] = {"mode": "rb"} if is_binary else {"mode": "rt", "encoding": "utf-8", "errors": "replace"}
    found = False
    try:
        with gzip.open(path, **how) if packed else path.open(**how) as file:
            if is_candump:
                yield from read_candump(file, str(path))
                return
            assert reader is not None
            for message in reader(file):
                found = True
                yield message
    except ProtocolError:
        raise
    except (gzip.BadGzipFile, EOFError) as error:
        raise ProtocolError(str(path), f"cannot be read: {error}", "Is it complete, and packed by gzip?") from error
    except OSError:
        raise
    except Exception as error:  # each format's reader has its own ways to fail on a damaged file
        if path.stat().st_size:
            remedy = "Is it a log of this format, and complete?"
            raise ProtocolError(str(path), f"cannot be read: {error or type(error).__name__}", remedy) from error
    if not found:
        raise _no_frame(str(path), is_empty=not path.stat().st_size)


def _no_frame(where: str, *, is_empty: bool) -> ProtocolError:
    formats = ", ".join(sorted(set(MESSAGE_READERS) - set(_CANDUMP_SUFFIXES)))
    what = "is empty" if is_empty else "holds no CAN frame"
    return ProtocolError(where, what, f"Known formats: candump text, {formats}, each also as .gz")
