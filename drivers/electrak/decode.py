"""Any J1939 frame in words: Electrak messages by the DBC files, network management and diagnostics by the standard."""

from __future__ import annotations

import functools
from typing import Any, Final, TypedDict

from cantools.database.can import Message as DbcMessage
from cantools.database.namedsignalvalue import NamedSignalValue

from drivers.electrak.codec import load_database
from drivers.electrak.j1939 import dm1
from drivers.electrak.j1939.ids import Frame, Pgn, destination_of, pgn_name, pgn_of, source_of
from drivers.electrak.j1939.name import Name
from drivers.electrak.j1939.transport import Message, Transport

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
