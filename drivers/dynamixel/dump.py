"""``python -m graderd.drivers.dynamixel.dump``: the servo's wire in words, from the daemon's lines or a file of them.

One line or one JSON object a packet. The wire has one owner, the daemon; what crosses it comes from there
(``graderd rotation dump``).
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, Literal, TextIO, TypedDict

from graderd import firmware_profiles
from graderd.drivers.dynamixel.codec import Instruction, Packet, StatusError, StreamDecoder
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.errors import DeviceError, ProtocolError

Direction = Literal["tx", "rx"]
_LINE: Final = re.compile(r"^\((?P<t>\d{1,12}\.\d{1,9})\) servo (?P<direction>[rt]x) (?P<data>(?:[0-9A-Fa-f]{2})+)$")


class DecodedPacket(TypedDict):
    """One packet, or what was none.

    ``direction``: tx is sent by the daemon. ``kind``: the instruction's name, ``status``, or ``damaged`` for bytes that
    are no packet (a wrong CRC, the rest of a reply, noise): ``error`` says which, and there is no id. ``error`` of a
    status is what the servo refused with, ``alert`` that it has a hardware error. ``address`` and ``size``: the bytes
    of the control table that are read, written or answered. ``registers``: name to ``value`` and, where it has one,
    ``unit``. ``data``: the parameters, hexadecimal.
    """

    t_s: float
    direction: Direction
    id: int | None
    kind: str
    error: str
    alert: bool
    address: int | None
    size: int | None
    registers: dict[str, dict[str, Any]]
    data: str


def wire_line(t_s: float, direction: Direction, data: bytes) -> str:
    """Bytes on the wire as a line of text, in the manner of candump."""
    return f"({t_s:.6f}) servo {direction} {data.hex().upper()}"


def parse_wire_line(line: str) -> tuple[float, Direction, bytes] | None:
    """The reverse of :func:`wire_line`, or None where it is no such line."""
    match = _LINE.match(line.strip())
    if match is None:
        return None
    return float(match["t"]), "tx" if match["direction"] == "tx" else "rx", bytes.fromhex(match["data"])


class WireDecoder:
    """Puts packets together from both directions; a status is read as the answer to what was asked of its servo."""

    def __init__(self, table: ControlTable) -> None:
        self._table = table
        self._streams: dict[Direction, StreamDecoder] = {"tx": StreamDecoder(), "rx": StreamDecoder()}
        self._told: dict[Direction, tuple[int, int]] = {"tx": (0, 0), "rx": (0, 0)}
        self._asked: dict[int, tuple[int, int]] = {}

    def feed(self, t_s: float, direction: Direction, data: bytes) -> Iterator[DecodedPacket]:
        """What is complete with these bytes; never raises for whatever the wire carries."""
        if direction == "tx":
            self._streams["rx"].reset()  # the daemon does the same: a reply ends where the next request begins
            yield from self._damage(t_s, "rx")
        packets = self._streams[direction].feed(data)
        yield from self._damage(t_s, direction)
        for packet in packets:
            yield self._decoded(packet, t_s, direction)

    def _damage(self, t_s: float, direction: Direction) -> Iterator[DecodedPacket]:
        stream, (crc_n, stray_n) = self._streams[direction], self._told[direction]
        self._told[direction] = now = (stream.crc_errors_n, stream.stray_n)
        if now == (crc_n, stray_n):
            return
        error = f"{now[1] - stray_n} bytes belong to no packet"
        if now[0] > crc_n:
            error = f"wrong CRC; {error}"
        yield _packet(t_s, direction, None, "damaged", error=error)

    def _decoded(self, packet: Packet, t_s: float, direction: Direction) -> DecodedPacket:
        servo_id, params = packet.packet_id, packet.params
        asked = self._asked.pop(servo_id, None)
        if packet.is_status:
            found = _packet(t_s, direction, servo_id, "status", _error_name(packet.error), packet.alert, packet.data)
            if asked is not None and asked[1] == len(packet.data):
                self._name_registers(found, asked[0], packet.data)
            return found
        instruction = packet.instruction
        known = instruction in Instruction.__members__.values()
        kind = Instruction(instruction).name.lower() if known else f"instruction {instruction:#04x}"
        found = _packet(t_s, direction, servo_id, kind, data=params)
        if instruction == Instruction.READ and len(params) == 4:
            address, size = int.from_bytes(params[:2], "little"), int.from_bytes(params[2:], "little")
            self._asked[servo_id] = address, size
            found["address"], found["size"] = address, size
        elif instruction in (Instruction.WRITE, Instruction.REG_WRITE) and len(params) > 2:
            self._name_registers(found, int.from_bytes(params[:2], "little"), params[2:])
        return found

    def _name_registers(self, found: DecodedPacket, address: int, data: bytes) -> None:
        found["address"], found["size"], found["registers"] = address, len(data), self._registers(address, data)

    def _registers(self, address: int, data: bytes) -> dict[str, dict[str, Any]]:
        """The registers that lie wholly within ``data``."""
        found: dict[str, dict[str, Any]] = {}
        at = address
        while at < address + len(data):
            register = self._table.at(at)
            if register is None:
                at += 1
                continue
            if register.address >= address and register.end <= address + len(data):
                counts = register.decode(data[register.address - address : register.end - address])
                value = round(counts * register.scale, 4) if register.scale != 1 else counts
                found[register.name] = {"value": value, "unit": register.unit} if register.unit else {"value": value}
            at = register.end
        return found


def _error_name(number: int) -> str:
    if number == StatusError.NONE:
        return ""
    return StatusError(number).name.lower() if number in StatusError.__members__.values() else f"error {number}"


def _packet(
    t_s: float,
    direction: Direction,
    servo_id: int | None,
    kind: str,
    error: str = "",
    alert: bool = False,
    data: bytes = b"",
) -> DecodedPacket:
    return DecodedPacket(
        t_s=round(t_s, 6),
        direction=direction,
        id=servo_id,
        kind=kind,
        error=error,
        alert=alert,
        address=None,
        size=None,
        registers={},
        data=data.hex().upper(),
    )


def text_of(packet: DecodedPacket) -> str:
    """One line for people."""
    servo = "  -" if packet["id"] is None else f"{packet['id']:3d}"
    where = "" if packet["address"] is None else f"{packet['address']}+{packet['size']}"
    registers = (f"{name}={entry['value']}{entry.get('unit', '')}" for name, entry in packet["registers"].items())
    told = packet["data"] if packet["kind"] != "read" else ""
    body = " ".join(filter(None, ("ALERT" * packet["alert"], packet["error"], " ".join(registers) or told)))
    return f"{packet['t_s']:17.6f}  {packet['direction']}  {servo}  {packet['kind']:<8} {where:<8} {body}".rstrip()


def dump(lines: Iterable[str], table: ControlTable, out: TextIO, *, as_json: bool) -> int:
    """Write every packet of the lines, decoded; other lines are passed over. Returns how many lines were the wire's."""
    decoder, lines_n = WireDecoder(table), 0
    for line in lines:
        parsed = parse_wire_line(line)
        if parsed is None:
            continue
        lines_n += 1
        for packet in decoder.feed(*parsed):
            out.write((json.dumps(packet) if as_json else text_of(packet)) + "\n")
        out.flush()
    return lines_n


def main(argv: list[str] | None = None) -> int:
    """Exit status 1 where the source cannot be read."""
    parser = argparse.ArgumentParser(
        prog="python -m graderd.drivers.dynamixel.dump",
        description="Print the servo's wire decoded, from lines as the daemon's /v1/bus/servo gives them.",
        epilog="examples: dump servo.log | dump servo.log --json | dump - --profile ph54_200_s500",
    )
    parser.add_argument("source", help="file of such lines, or - for standard input")
    parser.add_argument("--profile", default="ph54_200_s500", help="firmware profile whose registers are named")
    parser.add_argument("--json", action="store_true", help="one JSON object a packet")
    arguments = parser.parse_args(argv)
    try:
        table = ControlTable.load(arguments.profile)
        if arguments.source == "-":
            dump(sys.stdin, table, sys.stdout, as_json=arguments.json)
            return 0
        with Path(arguments.source).open(encoding="ascii", errors="replace") as lines:
            if not dump(lines, table, sys.stdout, as_json=arguments.json):
                cause = "holds no line of the servo's wire"
                raise ProtocolError(arguments.source, cause, "Write one with 'graderd rotation dump --raw'")
    except (BrokenPipeError, KeyboardInterrupt):
        sys.stderr.close()  # the reader is gone, and Python would complain about it at exit
    except (DeviceError, firmware_profiles.UnknownProfileError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
