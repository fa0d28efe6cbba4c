"""``python -m graderd.drivers.electrak.dump``: the bus in words, live or from a log.

One line or one JSON object a frame, and each told as what it is: data, remote, error or CAN FD.

A serial adapter has one reader: while the daemon has it, the frames come from the daemon (``graderd can dump``).
"""

from __future__ import annotations

import argparse
import functools
import json
import select
import sys
from collections.abc import Iterable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Literal, TextIO, TypedDict

from cantools.database.can import Message as DbcMessage
from cantools.database.namedsignalvalue import NamedSignalValue

from graderd.drivers.electrak.codec import SELECTABLE_ADDRESSES, load_database
from graderd.drivers.j1939 import dm1
from graderd.drivers.j1939.bus_health import ERROR_CLASSES, event_of
from graderd.drivers.j1939.can_logs import read_candump, read_file
from graderd.drivers.j1939.can_port import READY_S, PortLostError, open_port
from graderd.drivers.j1939.ids import Pgn, destination_of, pgn_name, pgn_of, source_of
from graderd.drivers.j1939.name import Name
from graderd.drivers.j1939.node import Ack
from graderd.drivers.j1939.python_can import can
from graderd.drivers.j1939.transport import Control, Listener, Message
from graderd.hal.errors import DeviceError, DeviceLostError, ProtocolError
from graderd.hal.settings import CanSettings
from graderd.hal.text import printable

_MD_ADDRESSES: Final = range(27, 35)
Kind = Literal["data", "remote", "error", "fd"]


class DecodedFrame(TypedDict):
    """One frame. Signal names carry their units; ``can_id`` is a number, ``data`` hexadecimal."""

    t_s: float
    kind: Kind
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
        self._listener = Listener()

    def decode(self, frame: can.Message) -> DecodedFrame:
        """One frame in words; never raises for whatever the bus carries."""
        can_id, data, t_s = frame.arbitration_id, bytes(frame.data), frame.timestamp
        decoded = DecodedFrame(
            t_s=round(t_s, 6),
            kind=kind_of(frame),
            can_id=can_id,
            pgn=None,
            source=None,
            destination=None,
            name="",
            data=data.hex().upper(),
            signals={},
        )
        if decoded["kind"] == "error":
            event = event_of(can_id, data)
            decoded["name"] = "error frame"
            decoded["signals"] = {"errors": [name for n, name in enumerate(ERROR_CLASSES) if can_id >> n & 1]}
            decoded["signals"] |= {"state": event.value} if event else {}
            return decoded
        if decoded["kind"] == "fd":
            decoded["name"] = "CAN FD frame"
            return decoded
        if not frame.is_extended_id:
            decoded["name"] = "remote request" if decoded["kind"] == "remote" else ""
            return decoded
        pgn, source, destination = pgn_of(can_id), source_of(can_id), destination_of(can_id)
        decoded["pgn"], decoded["source"], decoded["destination"] = pgn, source, destination
        decoded["name"] = pgn_name(pgn)
        if decoded["kind"] == "remote":
            decoded["name"] = f"remote request for {pgn_name(pgn)}"
        elif pgn == Pgn.PROPRIETARY_A and destination in SELECTABLE_ADDRESSES:
            decoded["name"] = "ACM"
            decoded["signals"] = _electrak("ACM", destination, data)
        elif pgn == Pgn.PROPRIETARY_A2 and source in SELECTABLE_ADDRESSES:
            decoded["name"] = "AFM"
            decoded["signals"] = _electrak("AFM", source, data)
        elif pgn == Pgn.ADDRESS_CLAIMED and source == 0xFE:
            decoded["name"] = "cannot_claim"
            decoded["signals"] = _standard(Message(pgn, source, destination, data))
        elif pgn in (Pgn.TP_CONNECTION, Pgn.TP_DATA):
            decoded["signals"] = self._transport(pgn, source, destination, data, t_s)
        else:
            decoded["signals"] = _standard(Message(pgn, source, destination, data))
        return decoded

    def _transport(self, pgn: int, source: int, destination: int, data: bytes, t_s: float) -> dict[str, Any]:
        message = self._listener.on_frame(pgn, source, destination, data, t_s)
        if len(data) != 8:
            return {}
        if pgn == Pgn.TP_CONNECTION:
            about = int.from_bytes(data[5:8], "little")
            return {"control": _word(Control, data[0]), "about_pgn": about, "about": pgn_name(about)}
        signals: dict[str, Any] = {"packet": data[0]}
        if message is not None:
            signals |= {"message": pgn_name(message.pgn), "message_pgn": message.pgn, **_standard(message)}
        return signals


def kind_of(frame: can.Message) -> Kind:
    """What kind of frame it is."""
    if frame.is_error_frame:
        return "error"
    if frame.is_remote_frame:
        return "remote"
    return "fd" if frame.is_fd else "data"


def _word(words: type[IntEnum], number: int) -> str | int:
    """The number's name in a table, or the number."""
    return words(number).name.lower() if number in words._value2member_map_ else number


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
                return {"control": _word(Ack, data[0]), "about_pgn": about, "address": data[4]}
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


def read_live(channel: str) -> Iterator[can.Message]:
    """Frames of a live bus for ever: a serial port or link is opened as slcan, anything else as SocketCAN.

    Raises:
        DeviceMissingError: it cannot be opened.
        DeviceLostError: it was lost.
    """
    is_port = "/" in channel
    settings = CanSettings(interface="slcan" if is_port else "socketcan", channel=channel)
    port = open_port(settings, fd=True)
    try:
        port.wait_ready(READY_S)
        while True:
            if not port.pending:
                select.select([port.fileno()], [], [])
            yield from port.read_messages()
    except PortLostError as error:
        raise DeviceLostError(f"CAN {channel}", f"{error.condition}: {error.detail}") from error
    finally:
        port.close()


def text_of(decoded: DecodedFrame) -> str:
    """One line for people."""
    head = f"{decoded['t_s']:17.6f}  {decoded['can_id']:08X}"
    signals = " ".join(f"{key}={value}" for key, value in decoded["signals"].items())
    if decoded["pgn"] is None:
        return printable(
            f"{head}  {decoded['name']:<18} {signals or decoded['data']}"
            if decoded["name"]
            else f"{head}  {decoded['data']}"
        )
    route = f"{decoded['source']:3d} > {decoded['destination']:3d}"
    return printable(f"{head}  {route}  {decoded['name']:<18} {signals or decoded['data']}")  # a unit's own words


def dump(frames: Iterable[can.Message], out: TextIO, *, as_json: bool) -> None:
    """Write every frame, decoded."""
    decoder = FrameDecoder()
    for frame in frames:
        decoded = decoder.decode(frame)
        out.write((json.dumps(decoded) if as_json else text_of(decoded)) + "\n")
        out.flush()


def main(argv: list[str] | None = None) -> int:
    """Exit status 1 where the source cannot be read."""
    parser = argparse.ArgumentParser(
        prog="python -m graderd.drivers.electrak.dump",
        description="Print a CAN bus decoded, live or from a candump, ASC, BLF, MF4, TRC or CSV file (also .gz).",
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
            text = open(sys.stdin.fileno(), encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115  (not ours to close)
            frames = read_candump(text, "standard input")
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
