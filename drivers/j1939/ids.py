"""29-bit identifiers of SAE J1939-21: priority, parameter group number (PGN), destination and source address.

Layout, most significant first: priority 3 bits, extended data page 1, data page 1, PDU format (PF) 8, PDU specific
(PS) 8, source address 8. PF below 240 is *PDU1*: PS is the destination and no part of the PGN. PF from 240 on is
*PDU2*: PS belongs to the PGN and the message is for everybody.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

GLOBAL: Final = 0xFF
"""Destination address: everybody."""
NULL: Final = 0xFE
"""Source address of a node that has none (request for address claimed, cannot claim)."""
MAX_ADDRESS: Final = 0xFD
"""Highest address a node can own."""


class Pgn(IntEnum):
    """Parameter groups that graderd sends or understands (J1939-21, -71, -73, -81, ISO 11783-7, Thomson manual)."""

    ACKNOWLEDGEMENT = 0xE800
    REQUEST = 0xEA00
    TP_DATA = 0xEB00
    TP_CONNECTION = 0xEC00
    ADDRESS_CLAIMED = 0xEE00
    PROPRIETARY_A = 0xEF00  # Thomson: actuator control message, ACM
    PROPRIETARY_A2 = 0x1EF00  # Thomson: actuator feedback message, AFM (PDU1, sent to everybody)
    STOP_ALL_IMPLEMENTS = 0xFD02  # ISO 11783-7 "all implements stop operations switch state"
    DM1 = 0xFECA
    COMMANDED_ADDRESS = 0xFED8
    SOFTWARE_ID = 0xFEDA
    COMPONENT_ID = 0xFEEB
    CRUISE_CONTROL_VEHICLE_SPEED = 0xFEF1  # J1939-71 "cruise control/vehicle speed 1", CCVS1


class Frame(NamedTuple):
    """One classical CAN data frame; ``can_id`` has 29 bits where ``extended``, 11 otherwise."""

    can_id: int
    data: bytes
    extended: bool = True


def make_id(priority: int, pgn: int, source: int, destination: int = GLOBAL) -> int:
    """Build a 29-bit identifier; ``destination`` counts only for PDU1 groups.

    Raises:
        ValueError: a field is outside its range, or a PDU1 group number has a low byte.
    """
    if not (0 <= priority <= 7 and 0 <= pgn <= 0x3FFFF and 0 <= source <= 0xFF and 0 <= destination <= 0xFF):
        raise ValueError(f"no such identifier: priority {priority}, PGN {pgn}, SA {source}, DA {destination}")
    if is_pdu1(pgn):
        if pgn & 0xFF:
            raise ValueError(f"PGN {pgn:#x} is PDU1: its low byte is the destination and must be 0")
        pgn |= destination
    return priority << 26 | pgn << 8 | source


def is_pdu1(pgn: int) -> bool:
    """Whether the group is sent to a destination (PDU format below 240)."""
    return (pgn >> 8) & 0xFF < 0xF0


def pgn_of(can_id: int) -> int:
    """The parameter group number of an identifier, without the destination of PDU1 groups."""
    pgn = (can_id >> 8) & 0x3FFFF
    return pgn & 0x3FF00 if pgn & 0xFF00 < 0xF000 else pgn


def source_of(can_id: int) -> int:
    """The source address."""
    return can_id & 0xFF


def destination_of(can_id: int) -> int:
    """The destination address; :data:`GLOBAL` for PDU2 groups."""
    return (can_id >> 8) & 0xFF if can_id & 0xFF0000 < 0xF00000 else GLOBAL


def priority_of(can_id: int) -> int:
    """Priority, 0 (highest) to 7."""
    return (can_id >> 26) & 7


def pgn_name(pgn: int) -> str:
    """A readable name of a group that graderd knows, otherwise ``PGN 12345``."""
    try:
        return Pgn(pgn).name.lower()
    except ValueError:
        return f"PGN {pgn}"
