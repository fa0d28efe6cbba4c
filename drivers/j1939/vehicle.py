"""The vehicle's speed as its own control units tell it: wheel-based vehicle speed (SPN 84) in CCVS1 (PGN 65265).

J1939-71: broadcast every 100 ms; bytes 2 and 3, little endian, 1/256 km/h a bit, 0 to 250.996 km/h; 0xFExx is an error
indicator and 0xFFxx means not available. It has no sign: a machine in reverse reads as one that drives on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from graderd.drivers.j1939.ids import Pgn
from graderd.drivers.j1939.link import CanLink
from graderd.drivers.j1939.transport import Message
from graderd.hal.reading import Reading
from graderd.hal.settings import VehicleSettings
from graderd.hal.vehicle import VehicleTelemetry

_M_PER_S_PER_BIT: Final = 1.0 / 256.0 / 3.6
_HIGHEST_RAW: Final = 0xFAFF
"""Above it J1939-71 has indicators, no values."""


def wheel_speed_m_per_s(data: bytes) -> float | None:
    """Speed in the content of a CCVS1 message; None where it holds none."""
    if len(data) < 3:
        return None
    raw = int.from_bytes(data[1:3], "little")
    return raw * _M_PER_S_PER_BIT if raw <= _HIGHEST_RAW else None


class J1939Vehicle:
    """Listens on the shared link; see :class:`graderd.hal.vehicle.Vehicle`.

    The distance is the speed added up from message to message; a gap longer than ``max_age_s`` is no travel that could
    be known, and the count starts anew. Where several nodes send and none is named, the one heard is kept for as long
    as it speaks.
    """

    def __init__(self, settings: VehicleSettings, link: CanLink) -> None:
        self._settings = settings
        self._link = link
        self._source: int | None = None
        self._speed: Reading[float] | None = None
        self._travelled_m = 0.0
        self._untap: Callable[[], None] | None = None

    @property
    def where(self) -> str:
        """See the contract."""
        node = "any node" if self._settings.address_n is None else f"address {self._settings.address_n}"
        return f"wheel-based speed of {node} on {self._link.where}"

    async def open(self) -> None:
        """See the contract."""
        if self._untap is None:
            self._untap = self._link.tap_messages(self._on_message)

    def telemetry(self) -> VehicleTelemetry:
        """See the contract."""
        if self._speed is None:
            return VehicleTelemetry()
        return VehicleTelemetry(self._speed, Reading(self._travelled_m, self._speed.time_s, self._speed.valid))

    async def close(self) -> None:
        """See the contract."""
        untap, self._untap = self._untap, None
        if untap is not None:
            untap()

    def _on_message(self, message: Message, now_s: float) -> None:
        if message.pgn != Pgn.CRUISE_CONTROL_VEHICLE_SPEED or not self._believed(message.source, now_s):
            return
        speed, last = wheel_speed_m_per_s(message.data), self._speed
        if speed is None:
            self._speed = Reading(0.0, now_s, valid=False)
            return
        if last is not None and last.is_fresh(now_s, self._settings.max_age_s):
            self._travelled_m += last.value * (now_s - last.time_s)
        else:
            self._travelled_m = 0.0
        self._source, self._speed = message.source, Reading(speed, now_s)

    def _believed(self, source: int, now_s: float) -> bool:
        if self._settings.address_n is not None:
            return source == self._settings.address_n
        speaks = self._speed is not None and self._speed.is_fresh(now_s, self._settings.max_age_s)
        return source == self._source or not speaks
