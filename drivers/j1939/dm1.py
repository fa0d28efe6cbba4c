"""Active diagnostic trouble codes (DM1) of SAE J1939-73: their bytes, when they are sent, and which code stands for
which fault of graderd."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

PROPRIETARY_SPN: Final = 520_192
"""First suspect parameter number that a manufacturer may use freely (520192 to 524287)."""


class Lamp(IntEnum):
    """Lamps of the first byte: position of the two bits."""

    PROTECT = 0
    AMBER_WARNING = 2
    RED_STOP = 4
    MALFUNCTION = 6


class Fmi(IntEnum):
    """Failure mode identifiers that graderd uses."""

    ABOVE_RANGE = 0
    BELOW_RANGE = 1
    ERRATIC = 2
    VOLTAGE_HIGH = 3
    VOLTAGE_LOW = 4
    MECHANICAL = 7
    ABNORMAL_RATE = 9
    BAD_DEVICE = 12
    OUT_OF_CALIBRATION = 13
    SPECIAL = 14
    NETWORK_DATA = 19
    PRESENT = 31


@dataclass(frozen=True, slots=True)
class Dtc:
    """One trouble code: suspect parameter (0 to 524287), failure mode (0 to 31), occurrences (127: unknown)."""

    spn: int
    fmi: int
    occurrences_n: int = 1

    def to_bytes(self) -> bytes:
        """Four bytes, conversion method 0."""
        word = (self.spn & 0xFFFF) | (self.fmi | (self.spn >> 16) << 5) << 16 | (self.occurrences_n & 0x7F) << 24
        return word.to_bytes(4, "little")

    @classmethod
    def from_bytes(cls, data: bytes) -> Dtc:
        """Take four bytes apart."""
        word = int.from_bytes(data, "little")
        return cls(word & 0xFFFF | (word >> 21 & 7) << 16, word >> 16 & 0x1F, word >> 24 & 0x7F)


def encode(dtcs: list[Dtc], *, amber: bool = False, red: bool = False) -> bytes:
    """DM1 data: at least eight bytes; more than one code makes it a transport protocol message.

    Lamps that are off report "off", and no lamp flashes. Without a code, bytes 3 to 6 are 0 and 7 and 8 are FF
    (J1939-73, 2020).
    """
    lamps = amber << Lamp.AMBER_WARNING | red << Lamp.RED_STOP
    body = b"".join(dtc.to_bytes() for dtc in dtcs) or bytes(4)
    return (bytes((lamps, 0xFF)) + body).ljust(8, b"\xff")


def decode(data: bytes) -> tuple[frozenset[Lamp], list[Dtc]]:
    """Lamps that are on and the codes.

    Raises:
        ValueError: shorter than a lamp field and one code.
    """
    if len(data) < 6:
        raise ValueError(f"a DM1 has at least 6 bytes, got {len(data)}")
    lamps = frozenset(lamp for lamp in Lamp if data[0] >> lamp & 3 == 1)
    chunks = (data[i : i + 4] for i in range(2, len(data) - 3, 4))
    return lamps, [Dtc.from_bytes(chunk) for chunk in chunks if chunk not in (bytes(4), b"\xff\xff\xff\xff")]


PERIOD_S: Final = 1.0
"""A DM1 is sent so often; a change of a code at once, and no sooner than so long after the former of that code."""
_RED: Final = "red stop lamp"


class Dm1Sender:
    """What is said, and when: every second, and on a change at once, at most once a second for each code (and for the
    red lamp). What comes and goes between two messages is in the next one, once, whatever has become of it."""

    def __init__(self) -> None:
        self._active: frozenset[Dtc | str] = frozenset()
        self._owed: frozenset[Dtc | str] = frozenset()
        self._said: frozenset[Dtc | str] = frozenset()
        self._changed_s: dict[Dtc | str, float] = {}
        self._due_s: float | None = None

    def publish(self, dtcs: Iterable[Dtc], *, red: bool, now_s: float) -> None:
        """Set what is active now. Nothing is sent before the first call."""
        self._active = frozenset((*dtcs, _RED) if red else dtcs)
        self._owed |= self._active - self._said
        if self._due_s is None:
            self._due_s = now_s

    def present(self) -> bytes:
        """The data of what is active now, for who asks."""
        return _data(self._active)

    def due(self, now_s: float) -> bytes | None:
        """The data to send now; None: nothing. It stays due until :meth:`sent`."""
        if self._due_s is None:
            return None
        say = self._active | self._owed
        changed = any(now_s - self._changed_s.get(item, float("-inf")) >= PERIOD_S for item in say ^ self._said)
        return _data(say) if changed or now_s >= self._due_s else None

    def sent(self, now_s: float) -> None:
        """What was due is on its way."""
        say = self._active | self._owed
        lately = {item: at_s for item, at_s in self._changed_s.items() if now_s - at_s < PERIOD_S}
        self._changed_s = lately | dict.fromkeys(say ^ self._said, now_s)
        self._said, self._owed = say, frozenset()
        due_s = now_s if self._due_s is None else min(self._due_s, now_s)
        self._due_s = max(due_s, now_s - PERIOD_S / 2) + PERIOD_S


def _data(said: frozenset[Dtc | str]) -> bytes:
    dtcs = sorted((item for item in said if isinstance(item, Dtc)), key=lambda dtc: (dtc.spn, dtc.fmi))
    return encode(dtcs, amber=bool(dtcs), red=_RED in said)


_DEVICES: Final = ("daemon", "camera", "rotation", "lift_left", "lift_right", "tilt", "can", "servo_bus")
_CONDITIONS: Final[dict[str, tuple[int, Fmi]]] = {
    "no_feedback": (1, Fmi.ABNORMAL_RATE),
    "overload": (2, Fmi.MECHANICAL),
    "parameter": (3, Fmi.NETWORK_DATA),
    "saturation": (4, Fmi.ABOVE_RANGE),
    "backdrive": (5, Fmi.MECHANICAL),
    "fatal": (6, Fmi.BAD_DEVICE),
    "voltage": (7, Fmi.VOLTAGE_LOW),
    "temperature": (8, Fmi.ABOVE_RANGE),
    "uncommanded_motion": (9, Fmi.MECHANICAL),
    "not_moving": (10, Fmi.MECHANICAL),
    "restarted": (11, Fmi.SPECIAL),
    "wrong_address": (12, Fmi.NETWORK_DATA),
    "thermal_derating": (13, Fmi.ABOVE_RANGE),
    "thermal_limit": (14, Fmi.ABOVE_RANGE),
    "sides_apart": (15, Fmi.MECHANICAL),
    "implausible_feedback": (16, Fmi.ERRATIC),
    "feedback_flood": (17, Fmi.ABNORMAL_RATE),
    "no_reply": (18, Fmi.ABNORMAL_RATE),
    "corrupt_replies": (19, Fmi.ERRATIC),
    "stale": (20, Fmi.ABNORMAL_RATE),
    "missing": (21, Fmi.BAD_DEVICE),
}
_OTHER: Final = (63, Fmi.PRESENT)


def dtc_of(device: str, condition: str) -> Dtc:
    """The trouble code of a fault: SPN 520192 + 64 x device + condition; unlisted conditions share number 63."""
    number, fmi = _CONDITIONS.get(condition, _OTHER)
    base = _DEVICES.index(device) if device in _DEVICES else len(_DEVICES)
    return Dtc(PROPRIETARY_SPN + 64 * base + number, fmi)
