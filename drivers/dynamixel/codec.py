"""Dynamixel Protocol 2.0 on the byte level: packets to bytes, and a byte stream back to packets.

``FF FF FD 00 | id | length (2) | instruction | parameters … | CRC (2)``, little-endian; ``length`` counts from the
instruction to the CRC. A status packet is instruction 0x55 with an error byte before its data. Inside instruction and
parameters every ``FF FF FD`` is sent as ``FF FF FD FD`` (byte stuffing), so a header never occurs in a packet; only
the status packets of Fast Sync Read and Fast Bulk Read are not stuffed. CRC-16: polynomial 0x8005, start 0, not
reflected, over all bytes from the header to the last parameter as sent.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0", https://emanual.robotis.com/docs/en/dxl/protocol2/
"""

from __future__ import annotations

import functools
import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

HEADER = b"\xff\xff\xfd\x00"
BROADCAST_ID = 0xFE
MAX_ID = 0xFC
ALERT = 0x80
"""Bit 7 of a status packet's error byte: the servo has a hardware error. The rest of the packet is valid."""

_STUFFED = b"\xff\xff\xfd\xfd"
_PATTERN = b"\xff\xff\xfd"
_OVERHEAD = 7  # header, id and length: what the length field does not count
MAX_LENGTH = 2048
"""Largest length field accepted: above anything a P-series table can ask for, small enough to recover at once."""


class Instruction(IntEnum):
    """Instruction byte of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class StatusError(IntEnum):
    """Bits 0-6 of a status packet's error byte."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC: Final = _crc_table()


@functools.cache
def _word_table() -> array[int]:
    """The CRC of every pair of bytes; made at the first use, as not every importer needs one."""
    firsts = [((crc << 8) & 0xFF00) ^ _CRC[crc >> 8] for crc in _CRC]
    return array("H", [first ^ second for first in firsts for second in _CRC])


def crc16(data: bytes | bytearray, start: int = 0) -> int:
    """CRC-16 (0x8005, not reflected, no final xor) of ``data``, going on from ``start``; two bytes a step."""
    crc, odd = start, len(data) & 1
    if odd:
        crc = ((crc << 8) & 0xFF00) ^ _CRC[(crc >> 8) ^ data[0]]
    table = _word_table()
    for word in struct.unpack_from(f">{len(data) >> 1}H", data, odd):
        crc = table[crc ^ word]
    return crc


class Packet(NamedTuple):
    """One packet whose CRC was right.

    ``params``: without stuffing; of a status packet the first byte is the error byte. ``raw``: as it was on the wire.
    """

    packet_id: int
    instruction: int
    params: bytes
    raw: bytes

    @property
    def is_status(self) -> bool:
        """Whether it comes from a servo."""
        return self.instruction == Instruction.STATUS

    @property
    def error(self) -> int:
        """Error number of a status packet (:class:`StatusError`), without the alert bit."""
        return self.params[0] & 0x7F

    @property
    def alert(self) -> bool:
        """Whether the servo reports a hardware error beside its (valid) answer."""
        return bool(self.params[0] & ALERT)

    @property
    def data(self) -> bytes:
        """Data of a status packet: everything after the error byte."""
        return self.params[1:]


def encode(packet_id: int, instruction: int, params: bytes = b"") -> bytes:
    """A packet with stuffing, length and CRC, ready for the wire.

    Raises:
        ValueError: the id is not 0-252 or 254, or the packet is too long for the length field.
    """
    if not (0 <= packet_id <= MAX_ID or packet_id == BROADCAST_ID):
        raise ValueError(f"packet id {packet_id} is not 0-252 or 254")
    body = bytes((instruction,)) + params
    if _PATTERN in body:
        body = body.replace(_PATTERN, _STUFFED)
    length = len(body) + 2
    if length > 0xFFFF:
        raise ValueError(f"{len(params)} bytes of parameters do not fit into a packet")
    head = HEADER + bytes((packet_id, length & 0xFF, length >> 8)) + body
    return head + crc16(head).to_bytes(2, "little")


def encode_status(packet_id: int, error: int = 0, data: bytes = b"") -> bytes:
    """A status packet: ``error`` with the alert bit, then ``data``."""
    return encode(packet_id, Instruction.STATUS, bytes((error,)) + data)


@dataclass(frozen=True, slots=True)
class FastReply:
    """One servo's share of a fast status packet."""

    packet_id: int
    error: int
    data: bytes


def encode_fast_status(replies: Sequence[FastReply]) -> bytes:
    """The one status packet that several servos build together for Fast Sync Read and Fast Bulk Read.

    Not stuffed; each share ends with the CRC of everything sent so far.
    """
    length = 1 + sum(len(reply.data) + 4 for reply in replies)
    out = bytearray(HEADER + bytes((BROADCAST_ID, length & 0xFF, length >> 8, Instruction.STATUS)))
    crc, counted_n = 0, 0
    for reply in replies:
        out += bytes((reply.error, reply.packet_id)) + reply.data
        crc = crc16(out[counted_n:], crc)
        counted_n = len(out)
        out += crc.to_bytes(2, "little")
    return bytes(out)


def split_fast_status(packet: Packet, expected: Sequence[tuple[int, int]]) -> list[FastReply]:
    """The shares of a fast status packet; ``expected`` are (id, data bytes) in the order of the request.

    Raises:
        ValueError: lengths, ids or one of the cumulative CRCs do not fit.
    """
    raw, at = packet.raw, _OVERHEAD + 1
    if len(raw) != at + sum(size + 4 for _, size in expected):
        raise ValueError(f"fast status packet of {len(raw)} bytes does not fit the request")
    replies, crc, counted_n = [], 0, 0
    for packet_id, size in expected:
        end = at + 2 + size
        crc = crc16(raw[counted_n:end], crc)
        counted_n = end
        if raw[at + 1] != packet_id or raw[end : end + 2] != crc.to_bytes(2, "little"):
            raise ValueError(f"share of servo {packet_id} in a fast status packet is damaged")
        replies.append(FastReply(packet_id, raw[at], raw[at + 2 : end]))
        at = end + 2
    return replies


class StreamDecoder:
    """Finds packets in a stream of bytes that may hold anything else, and finds its way back after damage.

    A candidate starts at a header and is judged by its CRC. One that fails costs only its first byte: the search goes
    on right behind it, so a good packet inside the debris of a bad one is not lost. Nothing here raises on input.

    ``crc_errors_n``: candidates with a wrong CRC. ``stray_n``: bytes that belonged to no packet.
    """

    def __init__(self, max_length: int = MAX_LENGTH) -> None:
        self._buffer = bytearray()
        self._max_length = max_length
        self.crc_errors_n = 0
        self.stray_n = 0

    @property
    def pending_n(self) -> int:
        """Bytes waiting for the rest of a packet."""
        return len(self._buffer)

    def reset(self) -> int:
        """Forget an unfinished packet; returns how many bytes were thrown away."""
        dropped_n = len(self._buffer)
        self.stray_n += dropped_n
        self._buffer.clear()
        return dropped_n

    def feed(self, data: bytes) -> list[Packet]:
        """Take in bytes; returns the packets that are complete now, in order."""
        buffer = self._buffer
        if not buffer and (packet := _whole(data, self._max_length)) is not None:
            return [packet]  # as it mostly comes: one packet in one piece
        buffer += data
        packets: list[Packet] = []
        while buffer:
            start = buffer.find(HEADER)
            if start:  # -1 (none) or bytes before it
                self._drop(start if start > 0 else len(buffer) - _header_prefix(buffer))
                if start < 0:
                    return packets
            if len(buffer) < _OVERHEAD:
                return packets
            packet_id, length = buffer[4], buffer[5] | buffer[6] << 8
            if not 3 <= length <= self._max_length or not (packet_id <= MAX_ID or packet_id == BROADCAST_ID):
                self._drop(1)
                continue
            end = _OVERHEAD + length
            if len(buffer) < end:
                return packets
            raw = bytes(buffer[:end])
            if not _crc_fits(raw):
                self.crc_errors_n += 1
                self._drop(1)
                continue
            packet = _packet(raw)
            if packet is None:
                self._drop(1)
                continue
            del buffer[:end]
            packets.append(packet)
        return packets

    def _drop(self, count: int) -> None:
        self.stray_n += count
        del self._buffer[:count]


def _whole(data: bytes, max_length: int) -> Packet | None:
    """The packet that ``data`` is from its first to its last byte; None where it is anything else."""
    length = len(data) - _OVERHEAD
    if not 3 <= length <= max_length or data[5] | data[6] << 8 != length or not data.startswith(HEADER):
        return None
    if not (data[4] <= MAX_ID or data[4] == BROADCAST_ID) or not _crc_fits(data):
        return None
    return _packet(data)


def _crc_fits(raw: bytes) -> bool:
    return crc16(raw[:-2]) == raw[-2] | raw[-1] << 8


def _header_prefix(buffer: bytearray) -> int:
    """How many bytes at the end of ``buffer`` may be the start of a header."""
    for size in (3, 2, 1):
        if buffer.endswith(HEADER[:size]):
            return size
    return 0


def _packet(raw: bytes) -> Packet | None:
    """Take apart a packet whose CRC is right; None for a status without its error byte."""
    packet_id, instruction, params = raw[4], raw[7], raw[8:-2]
    if instruction == Instruction.STATUS and not params:
        return None
    fast = instruction == Instruction.STATUS and packet_id == BROADCAST_ID
    if not fast and _STUFFED in raw:
        params = raw[7:-2].replace(_STUFFED, _PATTERN)[1:]
    return Packet(packet_id, instruction, params, raw)
