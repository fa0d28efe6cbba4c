"""What the virtual servos answer to one instruction packet: addressing, broadcast, sync and bulk. No time, no I/O."""

from __future__ import annotations

from collections.abc import Sequence

from graderd.drivers.dynamixel.codec import (
    BROADCAST_ID,
    FastReply,
    Instruction,
    Packet,
    encode_fast_status,
    encode_status,
)
from graderd.simulator.servo.servo import VirtualServo

_READS = (Instruction.SYNC_READ, Instruction.BULK_READ, Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
_FAST = (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)


def answers(servos: Sequence[VirtualServo], packet: Packet, now_s: float) -> list[tuple[VirtualServo, bytes]]:
    """The status packets to ``packet`` in the order they go out, each with the servo that (first) sends it.

    Servos that are off or rebooting take no part. All others see every packet: it feeds their watchdog.
    """
    present = [s for s in servos if s.listens(now_s)]
    for servo in present:
        servo.note_traffic(now_s)
    if packet.is_status:
        return []
    if packet.instruction in _READS:
        return _group_read(present, packet) if packet.packet_id == BROADCAST_ID else []
    if packet.instruction in (Instruction.SYNC_WRITE, Instruction.BULK_WRITE):
        if packet.packet_id == BROADCAST_ID:
            _group_write(present, packet)
        return []
    out: list[tuple[VirtualServo, bytes]] = []
    for servo in sorted(present, key=lambda s: s.servo_id):
        own_id = servo.servo_id
        if packet.packet_id == own_id:
            reply = servo.execute(packet, now_s)
            if reply is not None:
                out.append((servo, encode_status(own_id, *reply)))
        elif packet.packet_id == BROADCAST_ID:
            reply = servo.execute(packet, now_s)
            if reply is not None and packet.instruction == Instruction.PING:
                out.append((servo, encode_status(own_id, *reply)))
        elif packet.packet_id == servo.memory["secondary_id"]:
            servo.execute(packet, now_s, ram_only=True)
    return out


def _requests(packet: Packet) -> list[tuple[int, int, int]]:
    """(id, address, size) for each servo asked by a sync or bulk read; empty where the packet is malformed."""
    p = packet.params
    if packet.instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        if len(p) < 5:
            return []
        address, size = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
        return [(servo_id, address, size) for servo_id in p[4:]]
    if not p or len(p) % 5:
        return []
    return [
        (p[i], int.from_bytes(p[i + 1 : i + 3], "little"), int.from_bytes(p[i + 3 : i + 5], "little"))
        for i in range(0, len(p), 5)
    ]


def _group_read(present: Sequence[VirtualServo], packet: Packet) -> list[tuple[VirtualServo, bytes]]:
    by_id = {s.servo_id: s for s in present if s.memory["status_return_level"] >= 1}
    asked = _requests(packet)
    if packet.instruction not in _FAST:
        return [
            (by_id[servo_id], encode_status(servo_id, *by_id[servo_id].read(address, size)))
            for servo_id, address, size in asked
            if servo_id in by_id
        ]
    if not asked or any(servo_id not in by_id for servo_id, _, _ in asked):
        return []  # the shares are chained: one missing servo leaves no complete packet
    shares = []
    for servo_id, address, size in asked:
        error, data = by_id[servo_id].read(address, size)
        shares.append(FastReply(servo_id, error, data if len(data) == size else bytes(size)))
    return [(by_id[asked[0][0]], encode_fast_status(shares))]


def _group_write(present: Sequence[VirtualServo], packet: Packet) -> None:
    by_id = {s.servo_id: s for s in present}
    p = packet.params
    if packet.instruction == Instruction.SYNC_WRITE:
        if len(p) < 4:
            return
        address, size = int.from_bytes(p[:2], "little"), int.from_bytes(p[2:4], "little")
        if size == 0 or (len(p) - 4) % (size + 1):
            return
        for i in range(4, len(p), size + 1):
            if p[i] in by_id:
                by_id[p[i]].write(address, p[i + 1 : i + 1 + size])
        return
    at = 0
    while at + 5 <= len(p):
        address, size = int.from_bytes(p[at + 1 : at + 3], "little"), int.from_bytes(p[at + 3 : at + 5], "little")
        data = p[at + 5 : at + 5 + size]
        if len(data) == size and p[at] in by_id:
            by_id[p[at]].write(address, data)
        at += 5 + size
