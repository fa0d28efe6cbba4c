"""Control and feedback messages to bytes and back, compiled from the DBC file: a shift and a mask a signal.

The layout is data (``firmware_profiles/electrak_*.dbc``); cantools reads it once, afterwards each message is one
64-bit little-endian word. Thomson numbers bits ``byte.bit`` from 1 with the least significant bit first, which is
plain Intel packing (decoded from a capture of a real unit).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import cantools.database
from cantools.database.can import Database, Message

from graderd.drivers.electrak.profile import load_profile, read_layout
from graderd.drivers.j1939.ids import Pgn, make_id
from graderd.hal.errors import ProtocolError
from graderd.hal.settings import ElectrakSettings

_PRIORITY: Final = 6
_EXTENDED: Final = 1
"""Value of the attribute VFrameFormat: to be told by the whole identifier, not by the parameter group (3)."""
FACTORY_FILL: Final = 0
"""The manual allows all 0 or all 1 in the unused bits of the control message; real units accepted 0."""

MAX_RAW_POSITION: Final = 10_000
"""1000.0 mm: beyond it no Electrak exists, so the field is no position."""

SELECTABLE_ADDRESSES: Final = range(19, 43)
"""An Electrak's first address is 19 (HD) or 27 (MD), to which its select wires add; a third family with the same
messages was seen from 35 on."""

FLAGS: Final = ("overload", "backdrive", "parameter", "saturation", "fatal")
"""One-bit flags of the feedback message; names as in the telemetry contract."""


class Control(NamedTuple):
    """Content of one actuator control message (ACM)."""

    target_mm: float
    current_limit_a: float
    speed_percent: float
    motion_enable: bool


class Feedback(NamedTuple):
    """Content of one actuator feedback message (AFM).

    ``flags``: those that are set, of :data:`FLAGS` and ``voltage_low``, ``voltage_high``, ``temperature_low``,
    ``temperature_high``. ``duty_percent`` is the motor's actual duty, without a sign.
    """

    position_mm: float
    current_a: float
    duty_percent: float
    moving: bool
    flags: frozenset[str]


@functools.cache
def load_database(layout: str) -> Database:
    """The DBC file of a layout as a cantools database."""
    database = cantools.database.load_string(read_layout(layout), database_format="dbc")
    if not isinstance(database, Database):
        raise TypeError(f"{layout}.dbc is no CAN database")
    return database


@dataclass(frozen=True, slots=True)
class _Field:
    shift: int
    mask: int
    scale: float

    @classmethod
    def of(cls, message: Message, name: str) -> _Field:
        signal = message.get_signal_by_name(name)
        if signal.byte_order != "little_endian" or signal.is_signed or signal.offset != 0:
            raise ProtocolError(f"DBC message {message.name}", f"signal {name} is not a plain little-endian field")
        return cls(signal.start, (1 << signal.length) - 1, float(signal.scale))


_NO_FLAGS: Final[frozenset[str]] = frozenset()


class ElectrakCodec:
    """Encoder and decoder for one layout (``electrak_hd`` or ``electrak_md``)."""

    def __init__(self, layout: str) -> None:
        database = load_database(layout)
        acm, afm = database.get_message_by_name("ACM"), database.get_message_by_name("AFM")
        self._target, self._limit = _Field.of(acm, "target_position_mm"), _Field.of(acm, "current_limit_a")
        self._speed, self._enable = _Field.of(acm, "speed_percent"), _Field.of(acm, "motion_enable")
        self._factory = _Field.of(acm, "factory_use")
        self._position, self._current = _Field.of(afm, "position_mm"), _Field.of(afm, "current_a")
        self._duty, self._moving = _Field.of(afm, "speed_percent"), _Field.of(afm, "moving")
        self._voltage = _Field.of(afm, "voltage_error")
        self._temperature = _Field.of(afm, "temperature_error")
        self._flags = tuple((name, 1 << _Field.of(afm, name).shift) for name in FLAGS)
        self._flag_mask = sum(bit for _, bit in self._flags)
        for field in (self._voltage, self._temperature):
            self._flag_mask |= field.mask << field.shift
        # scales such as 0.1 are not exact in binary; dividing by the whole number gives the nearest decimal
        self._position_steps = round(1 / self._position.scale)
        self._current_steps = round(1 / self._current.scale)
        self._duty_step = round(self._duty.scale)
        self._afm_factory = _Field.of(afm, "factory_use")

    def encode_control(self, control: Control) -> bytes:
        """The eight bytes of a control message; values are rounded to the message's steps.

        Raises:
            ValueError: a value does not fit its field (ranges of the model are the caller's to check).
        """
        word = FACTORY_FILL << self._factory.shift
        for field, value in (
            (self._target, control.target_mm),
            (self._limit, control.current_limit_a),
            (self._speed, control.speed_percent),
            (self._enable, float(control.motion_enable)),
        ):
            raw = round(value / field.scale)
            if not 0 <= raw <= field.mask:
                raise ValueError(f"{value} does not fit its field of the control message")
            word |= raw << field.shift
        return word.to_bytes(8, "little")

    def decode_control(self, data: bytes) -> Control:
        """Take a control message apart.

        Raises:
            ValueError: not eight bytes.
        """
        word = _word(data)
        return Control(
            target_mm=((word >> self._target.shift) & self._target.mask) / self._position_steps,
            current_limit_a=((word >> self._limit.shift) & self._limit.mask) / self._current_steps,
            speed_percent=float(((word >> self._speed.shift) & self._speed.mask) * self._duty_step),
            motion_enable=bool((word >> self._enable.shift) & 1),
        )

    def decode_feedback(self, data: bytes) -> Feedback:
        """Take a feedback message apart; the factory bits (manual: 0, real units: 1) are ignored.

        Raises:
            ValueError: not eight bytes, or a position beyond 1000 mm.
        """
        word = _word(data)
        raw_position = (word >> self._position.shift) & self._position.mask
        if raw_position > MAX_RAW_POSITION:
            raise ValueError(f"position field {raw_position:#x} is beyond 1000 mm")
        return Feedback(
            position_mm=raw_position / self._position_steps,
            current_a=((word >> self._current.shift) & self._current.mask) / self._current_steps,
            duty_percent=float(((word >> self._duty.shift) & self._duty.mask) * self._duty_step),
            moving=bool((word >> self._moving.shift) & 1),
            flags=self._flags_of(word) if word & self._flag_mask else _NO_FLAGS,
        )

    def encode_feedback(self, feedback: Feedback, *, factory_ones: bool = True) -> bytes:
        """The eight bytes a real unit would send; for the virtual actuator."""
        word = (self._afm_factory.mask if factory_ones else 0) << self._afm_factory.shift
        word |= min(round(feedback.position_mm * self._position_steps), self._position.mask) << self._position.shift
        word |= min(round(feedback.current_a * self._current_steps), self._current.mask) << self._current.shift
        word |= round(feedback.duty_percent / self._duty_step) << self._duty.shift
        word |= feedback.moving << self._moving.shift
        for name, field in (("voltage", self._voltage), ("temperature", self._temperature)):
            code = 1 if f"{name}_low" in feedback.flags else 2 if f"{name}_high" in feedback.flags else 0
            word |= code << field.shift
        for name, bit in self._flags:
            if name in feedback.flags:
                word |= bit
        return word.to_bytes(8, "little")

    def _flags_of(self, word: int) -> frozenset[str]:
        flags = [name for name, bit in self._flags if word & bit]
        for name, field in (("voltage", self._voltage), ("temperature", self._temperature)):
            code = (word >> field.shift) & field.mask
            if code in (1, 2):
                flags.append(f"{name}_{'low' if code == 1 else 'high'}")
        return frozenset(flags)


def _word(data: bytes) -> int:
    if len(data) != 8:
        raise ValueError(f"an Electrak message has 8 bytes, got {len(data)}")
    return int.from_bytes(data, "little")


def machine_database(actuators: Mapping[str, ElectrakSettings], source: int) -> Database:
    """One message description of the whole machine, for other CAN tools: ``ACM_<name>`` and ``AFM_<name>`` of each
    actuator. ``source``: our own address, from which the ACM come.

    The layouts in ``firmware_profiles`` describe one actuator each, at its first address, and all actuators share two
    parameter groups: a tool that goes by the identifier knows only one of them, one that goes by the group takes all
    for the same. Here every actuator has messages of its own, under the identifiers that it really uses.
    """
    messages = []
    parts = None
    for name, settings in actuators.items():
        layout = load_profile(settings.profile).layout
        parts = cantools.database.load_string(read_layout(layout), database_format="dbc")
        assert isinstance(parts, Database)  # for the type checker: it is a DBC file
        for message in parts.messages:
            if message.name == "ACM":
                message.frame_id = make_id(_PRIORITY, Pgn.PROPRIETARY_A, source, settings.address_n)
                message.comment = f"Actuator control message to {name}, address {settings.address_n}."
            else:
                message.frame_id = make_id(_PRIORITY, Pgn.PROPRIETARY_A2, settings.address_n)
                message.comment = f"Actuator feedback message of {name}, address {settings.address_n}."
            message.name = f"{message.name}_{name}"
            if message.dbc is not None:
                message.dbc.attributes["VFrameFormat"].value = _EXTENDED
            messages.append(message)
    if parts is None:
        return Database()
    return Database(messages=messages, nodes=parts.nodes, dbc_specifics=parts.dbc)
