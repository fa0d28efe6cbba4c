"""``python -m graderd.drivers.electrak.dump``: the bus in words, live or from a log.

One line or one JSON object a frame.

A serial adapter has one reader: while the daemon has it, the frames come from the daemon (``graderd can dump``).
"""

from __future__ import annotations

import argparse
import functools
import json
import re
import select
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, TextIO, TypedDict

import can
from cantools.database.can import Message as DbcMessage
from cantools.database.namedsignalvalue import NamedSignalValue

from graderd.drivers.electrak.codec import load_database
from graderd.drivers.j1939 import dm1
from graderd.drivers.j1939.bus_health import BusEvent
from graderd.drivers.j1939.can_port import PortLostError, open_port
from graderd.drivers.j1939.ids import Frame, Pgn, destination_of, pgn_name, pgn_of, source_of
from graderd.drivers.j1939.name import Name
from graderd.drivers.j1939.transport import Message, Transport
from graderd.hal.clock import SystemClock
from graderd.hal.errors import DeviceError, DeviceLostError, ProtocolError
from graderd.hal.settings import CanSettings
from graderd.hal.text import printable

_THOMSON_ADDRESSES: Final = range(19, 43)
"""HD from 19, MD from 27, and a third family seen from 35 on with the same messages."""
_MD_ADDRESSES: Final = range(27, 35)
_TP_CONTROLS: Final = {16: "rts", 17: "cts", 19: "end_of_message", 32: "bam", 255: "abort"}
_ACKS: Final = {0: "positive", 1: "negative", 2: "access_denied", 3: "cannot_respond"}


class DecodedFrame(TypedDict):
    """One frame. Signal names carry their units; ``can_id`` is a number, ``data`` hexadecimal."""

    t_s: float
    can_id: int
    pgn: int | None
    source: int | None
    destination: int | None
    name: str
    data: str
    signals: dict[str, Any]


@functools.cache
def _dbc_message(layout: str, name: str) -> DbcMessage:
    return load_database(layout).get_message_by_name(name)


class FrameDecoder:
    """Decodes frame after frame; it remembers transport protocol sessions and puts long messages together."""

    def __init__(self) -> None:
        self._sessions: dict[tuple[int, int], Transport] = {}

    def decode(self, frame: Frame, t_s: float) -> DecodedFrame:
        """One frame in words; never raises for whatever the bus carries."""
        decoded = DecodedFrame(
            t_s=round(t_s, 6),
            can_id=frame.can_id,
            pgn=None,
            source=None,
            destination=None,
            name="",
            data=frame.data.hex().upper(),
            signals={},
        )
        if not frame.extended:
            return decoded
        pgn, source, destination = pgn_of(frame.can_id), source_of(frame.can_id), destination_of(frame.can_id)
        decoded["pgn"], decoded["source"], decoded["destination"] = pgn, source, destination
        decoded["name"] = pgn_name(pgn)
        if pgn == Pgn.PROPRIETARY_A and destination in _THOMSON_ADDRESSES:
            decoded["name"] = "ACM"
            decoded["signals"] = _electrak("ACM", destination, frame.data)
        elif pgn == Pgn.PROPRIETARY_A2 and source in _THOMSON_ADDRESSES:
            decoded["name"] = "AFM"
            decoded["signals"] = _electrak("AFM", source, frame.data)
        elif pgn == Pgn.ADDRESS_CLAIMED and source == 0xFE:
            decoded["name"] = "cannot_claim"
            decoded["signals"] = _standard(Message(pgn, source, destination, frame.data))
        elif pgn in (Pgn.TP_CONNECTION, Pgn.TP_DATA):
            decoded["signals"] = self._transport(pgn, source, destination, frame.data, t_s)
        else:
            decoded["signals"] = _standard(Message(pgn, source, destination, frame.data))
        return decoded

    def _transport(self, pgn: int, source: int, destination: int, data: bytes, t_s: float) -> dict[str, Any]:
        if len(data) != 8:
            return {}
        key = (source, destination)
        if pgn == Pgn.TP_CONNECTION:
            about = int.from_bytes(data[5:8], "little")
            if data[0] in (16, 32):
                session = Transport()
                session.address = destination  # a listener: what it would answer is thrown away
                session.on_connection(source, destination, data, t_s)
                if len(self._sessions) < 64 or key in self._sessions:
                    self._sessions[key] = session
            return {"control": _TP_CONTROLS.get(data[0], data[0]), "about_pgn": about, "about": pgn_name(about)}
        signals: dict[str, Any] = {"packet": data[0]}
        if key in self._sessions:
            _, message = self._sessions[key].on_data(source, destination, data, t_s)
            if message is not None:
                del self._sessions[key]
                signals |= {"message": pgn_name(message.pgn), "message_pgn": message.pgn, **_standard(message)}
        return signals


def _electrak(name: str, address: int, data: bytes) -> dict[str, Any]:
    message = _dbc_message("electrak_md" if address in _MD_ADDRESSES else "electrak_hd", name)
    if len(data) != 8:
        return {}
    values = message.decode(data, decode_choices=True, allow_truncated=True)
    assert isinstance(values, dict)  # for the type checker: these messages hold no containers
    return {key: _plain(value) for key, value in values.items() if key != "factory_use"}


def _plain(value: Any) -> Any:
    if isinstance(value, NamedSignalValue):
        return str(value)
    return round(value, 4) if isinstance(value, float) else value


def _standard(message: Message) -> dict[str, Any]:
    data = message.data
    try:
        match message.pgn:
            case Pgn.ADDRESS_CLAIMED:
                return {"name": f"{int.from_bytes(data, 'little'):016X}", **Name.from_bytes(data).as_dict()}
            case Pgn.REQUEST if len(data) >= 3:
                about = int.from_bytes(data[:3], "little")
                return {"requested_pgn": about, "requested": pgn_name(about)}
            case Pgn.ACKNOWLEDGEMENT if len(data) == 8:
                about = int.from_bytes(data[5:8], "little")
                return {"control": _ACKS.get(data[0], data[0]), "about_pgn": about, "address": data[4]}
            case Pgn.DM1:
                lamps, dtcs = dm1.decode(data)
                codes = [{"spn": d.spn, "fmi": d.fmi, "occurrences": d.occurrences_n} for d in dtcs]
                return {"lamps": sorted(lamp.name.lower() for lamp in lamps), "dtcs": codes}
            case Pgn.COMPONENT_ID:
                return {"text": data.decode("ascii", "replace")}
            case Pgn.SOFTWARE_ID:
                return {"text": data[1:].decode("ascii", "replace")}
            case Pgn.COMMANDED_ADDRESS if len(data) == 9:
                return {"name": f"{int.from_bytes(data[:8], 'little'):016X}", "new_address": data[8]}
            case Pgn.STOP_ALL_IMPLEMENTS if len(data) == 8:
                return {"transitions": data[6], "state": ("stop", "permit", "error", "not_available")[data[7] & 3]}
    except ValueError:
        return {}
    return {}


# candump -l / -L:  (1622749162.123456) can0 18EF1300#DC05191500000000
_COMPACT: Final = re.compile(
    r"^\s*(?:\((?P<t>\d+(?:\.\d+)?)\)\s+)?\S+\s+(?P<id>[0-9A-Fa-f]{3,8})#(?P<data>[0-9A-Fa-f]*)"
)
# candump, also with -t and -x:  (0.105000)  can0  TX - -  18EF1300   [8]  DC 05 19 15 00 00 00 00
_COLUMNS: Final = re.compile(
    r"^\s*(?:\((?P<t>[^)]*)\)\s+)?\S+\s+(?:[RT]X\s+\S+\s+\S+\s+)?(?P<id>[0-9A-Fa-f]{3,8})\s+\[(?P<n>\d)\]\s*"
    r"(?P<data>(?:[0-9A-Fa-f]{2}\s?)*)"
)

Timed = tuple[float, Frame]


def parse_candump_line(line: str) -> Timed | None:
    """One line of candump text (any of its formats), or None where it is no data frame."""
    match = _COMPACT.match(line) or _COLUMNS.match(line)
    if match is None:
        return None
    digits = match["id"]
    data = re.sub(r"\s", "", match["data"])
    if len(data) % 2 or len(data) > 16:
        return None
    try:
        t_s = float(match["t"] or 0.0)
    except ValueError:  # candump -tA writes a date
        t_s = 0.0
    return t_s, Frame(int(digits, 16) & 0x1FFFFFFF, bytes.fromhex(data), len(digits) > 3)


def parse_candump(lines: Iterable[str]) -> Iterator[Timed]:
    """The frames of many lines; what is none is left out."""
    for line in lines:
        timed = parse_candump_line(line)
        if timed is not None:
            yield timed


def candump_line(frame: Frame, t_s: float, channel: str = "can0") -> str:
    """One frame as ``candump -L`` writes it."""
    return f"({t_s:.6f}) {channel} {frame.can_id:0{8 if frame.extended else 3}X}#{frame.data.hex().upper()}"


_READERS: Final[dict[str, tuple[Callable[[Any], Iterable[can.Message]], str]]] = {
    ".asc": (can.ASCReader, "r"),
    ".blf": (can.BLFReader, "rb"),
    ".mf4": (can.MF4Reader, "rb"),
    ".trc": (can.TRCReader, "r"),
    ".csv": (can.CSVReader, "r"),
}
"""Log formats read by python-can, by file name; every other file is taken for candump text."""


def read_file(path: Path) -> Iterator[Timed]:
    """Frames of a candump, ASC, BLF or MF4 log with their times in seconds.

    Raises:
        ProtocolError: the file cannot be read as such a log.
    """
    if path.suffix.lower() not in _READERS:
        yield from _read_candump(path)
        return
    make_reader, mode = _READERS[path.suffix.lower()]
    try:
        with path.open(mode) as file:  # opened here, because some readers leave a damaged file open
            for message in make_reader(file):
                if not (message.is_error_frame or message.is_remote_frame):
                    yield message.timestamp, Frame(message.arbitration_id, bytes(message.data), message.is_extended_id)
    except OSError:
        raise
    except Exception as error:  # each format's reader has its own ways to fail on a damaged file
        raise ProtocolError(
            str(path), f"cannot be read: {error}", "Is it a log of this format, and complete?"
        ) from error


def _read_candump(path: Path) -> Iterator[Timed]:
    found = False
    with path.open(encoding="ascii", errors="replace") as lines:
        for timed in parse_candump(lines):
            found = True
            yield timed
    if not found:
        formats = "candump text, or .asc, .blf, .mf4"
        raise ProtocolError(str(path), "holds no CAN frame in candump's form", f"Known formats: {formats}")


def read_live(channel: str) -> Iterator[Timed]:
    """Frames of a live bus for ever: a serial port or link is opened as slcan, anything else as SocketCAN.

    Raises:
        DeviceMissingError: it cannot be opened.
        DeviceLostError: it was lost.
    """
    is_port = "/" in channel
    settings = CanSettings(interface="slcan" if is_port else "socketcan", channel=channel)
    clock = SystemClock()
    port = open_port(settings)
    try:
        while True:
            if not port.pending:
                select.select([port.fileno()], [], [])
            for item in port.read():
                if not isinstance(item, BusEvent):
                    yield clock.now_s(), item
    except PortLostError as error:
        raise DeviceLostError(f"CAN {channel}", f"{error.condition}: {error.detail}") from error
    finally:
        port.close()


def text_of(decoded: DecodedFrame) -> str:
    """One line for people."""
    head = f"{decoded['t_s']:17.6f}  {decoded['can_id']:08X}"
    if decoded["pgn"] is None:
        return f"{head}  {decoded['data']}"
    route = f"{decoded['source']:3d} > {decoded['destination']:3d}"
    signals = " ".join(f"{key}={value}" for key, value in decoded["signals"].items())
    return printable(f"{head}  {route}  {decoded['name']:<18} {signals or decoded['data']}")  # a unit's own words


def dump(frames: Iterator[Timed], out: TextIO, *, as_json: bool) -> None:
    """Write every frame, decoded."""
    decoder = FrameDecoder()
    for t_s, frame in frames:
        decoded = decoder.decode(frame, t_s)
        out.write((json.dumps(decoded) if as_json else text_of(decoded)) + "\n")
        out.flush()


def main(argv: list[str] | None = None) -> int:
    """Exit status 1 where the source cannot be read."""
    parser = argparse.ArgumentParser(
        prog="python -m graderd.drivers.electrak.dump",
        description="Print a CAN bus decoded, live or from a candump, ASC, BLF or MF4 file.",
        epilog="examples: dump can0 | dump /dev/graderd/can | dump trip.log --json | candump -L can0 | dump -",
    )
    parser.add_argument(
        "source", nargs="?", default="can0", help="CAN interface, slcan port, log file, or - for candump text"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a frame")
    arguments = parser.parse_args(argv)
    path = Path(arguments.source)
    try:
        is_file = path.is_file()
        if not is_file and path.suffix and not path.exists():
            raise ProtocolError(str(path), "no such file")
        if arguments.source == "-":
            frames = parse_candump(sys.stdin)
        else:
            frames = read_file(path) if is_file else read_live(arguments.source)
        dump(frames, sys.stdout, as_json=arguments.json)
    except (BrokenPipeError, KeyboardInterrupt):
        sys.stderr.close()  # the reader is gone, and Python would complain about it at exit
    except (DeviceError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
