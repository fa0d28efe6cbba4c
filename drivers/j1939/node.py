"""One J1939 node: address claim, requests, transport protocol, DM1 and identification, without socket or clock."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from graderd.drivers.j1939 import dm1
from graderd.drivers.j1939.claim import AddressClaimer, ClaimState
from graderd.drivers.j1939.ids import GLOBAL, NULL, Frame, Pgn, destination_of, make_id, pgn_of, source_of
from graderd.drivers.j1939.name import Name
from graderd.drivers.j1939.transport import Message, Transport
from graderd.hal.clock import Pace

_ANSWER_RATE_HZ: Final = 20.0
_ANSWER_BURST_N: Final = 10


class Ack(IntEnum):
    """Control byte of an acknowledgement (PGN 59392)."""

    POSITIVE = 0
    NEGATIVE = 1
    ACCESS_DENIED = 2
    CANNOT_RESPOND = 3


@dataclass(frozen=True, slots=True)
class Identity:
    """What the node says about itself on request; fields must not contain ``*``."""

    make: str = "graderd"
    model: str = "blade controller"
    serial_number: str = ""
    unit: str = ""
    software: str = "graderd"

    def component_id(self) -> bytes:
        """PGN 65259: make, model, serial number and unit, each ended by ``*``."""
        return "".join(f"{text}*" for text in (self.make, self.model, self.serial_number, self.unit)).encode("ascii")

    def software_id(self) -> bytes:
        """PGN 65242: number of fields, then each ended by ``*``."""
        return b"\x01" + f"{self.software}*".encode("ascii")


class J1939Node:
    """Feeds frames to the protocol machines and collects what has to be sent.

    :meth:`on_frame` returns messages for the application (single frames and completed transport sessions, apart from
    what the node handles by itself). Frames to send pile up in :attr:`outbox`; the caller takes them away.
    """

    def __init__(
        self,
        name: Name,
        address: int,
        *,
        identity: Identity | None = None,
        obey_commanded: bool = False,
        seed: int | None = None,
    ) -> None:
        self.claimer = AddressClaimer(name, address, obey_commanded=obey_commanded, seed=seed)
        self.transport = Transport()
        self.identity = identity or Identity()
        self.outbox: list[Frame] = []
        self.claim_requested_at_s = -1e9
        """When anybody last asked for claims; a claim soon after is an answer and no restart."""
        self.nacks_sent_n = 0
        self._answers = Pace(_ANSWER_RATE_HZ, _ANSWER_BURST_N)
        self._dm1 = dm1.Dm1Sender()

    @property
    def address(self) -> int | None:
        """Our address, once it may be used."""
        return self.claimer.address

    def start(self, now_s: float) -> None:
        """Claim the preferred address (again)."""
        self.transport = Transport()
        self.claim_requested_at_s = now_s
        self.outbox += self.claimer.start(now_s)
        self._follow_address()

    def publish(self, dtcs: Iterable[dm1.Dtc], *, red: bool, now_s: float) -> None:
        """Set the active trouble codes and the stop lamp; see :class:`graderd.drivers.j1939.dm1.Dm1Sender`."""
        self._dm1.publish(dtcs, red=red, now_s=now_s)

    def poll(self, now_s: float) -> None:
        """Let time pass; call at least every 50 ms."""
        self.outbox += self.claimer.poll(now_s)
        self._follow_address()
        if self.address is None:
            return
        self.outbox += self.transport.poll(now_s)
        data = self._dm1.due(now_s)
        if data is not None and self._broadcast(Pgn.DM1, data, now_s):
            self._dm1.sent(now_s)

    def on_frame(self, frame: Frame, now_s: float) -> Message | None:
        """Take one 29-bit frame from the bus; a message for the application, if it makes one."""
        can_id, data = frame.can_id, frame.data
        pgn, source, destination = pgn_of(can_id), source_of(can_id), destination_of(can_id)
        if source == self.address and pgn != Pgn.ADDRESS_CLAIMED:
            self.outbox += self.claimer.on_violation(now_s)
        if pgn == Pgn.ADDRESS_CLAIMED and len(data) == 8:
            self.outbox += self.claimer.on_claim(source, int.from_bytes(data, "little"), now_s)
            self._follow_address()
        elif pgn == Pgn.REQUEST:
            self._on_request(source, destination, data, now_s)
        elif pgn == Pgn.TP_CONNECTION:
            self.outbox += self.transport.on_connection(source, destination, data, now_s)
        elif pgn == Pgn.TP_DATA:
            frames, message = self.transport.on_data(source, destination, data, now_s)
            self.outbox += frames
            if message is not None and message.pgn == Pgn.COMMANDED_ADDRESS and len(message.data) == 9:
                name = int.from_bytes(message.data[:8], "little")
                self.outbox += self.claimer.on_commanded(name, message.data[8], now_s)
                self._follow_address()
            return message
        return Message(pgn, source, destination, data)

    def request(self, pgn: int, destination: int = GLOBAL, *, now_s: float) -> None:
        """Ask a node, or everybody, for a parameter group."""
        if pgn == Pgn.ADDRESS_CLAIMED:
            self.claim_requested_at_s = now_s
        source = NULL if self.address is None else self.address
        self.outbox.append(Frame(make_id(6, Pgn.REQUEST, source, destination), pgn.to_bytes(3, "little")))

    def take(self) -> list[Frame]:
        """Frames to send now, in order; empties the outbox."""
        frames, self.outbox = self.outbox, []
        return frames

    # -- inside -----------------------------------------------------------------------------------------------------

    def _follow_address(self) -> None:
        self.transport.address = self.address

    def _on_request(self, source: int, destination: int, data: bytes, now_s: float) -> None:
        if len(data) < 3:
            return
        pgn = int.from_bytes(data[:3], "little")
        to_us = destination == self.claimer.wanted and self.claimer.state is not ClaimState.CANNOT_CLAIM
        if pgn == Pgn.ADDRESS_CLAIMED:
            self.claim_requested_at_s = now_s
            if to_us or destination == GLOBAL:
                self.outbox += self.claimer.on_request(now_s)
            return
        if self.address is None or not (to_us or destination == GLOBAL) or not self._answers.take(now_s):
            return
        content = self._content_of(pgn)
        if content is None:
            if to_us:  # a request to everybody is never refused
                self._acknowledge(Ack.NEGATIVE, pgn, source)
        elif len(content) <= 8 or destination == GLOBAL:
            self._broadcast(pgn, content, now_s)
        else:
            self.outbox += self.transport.send(pgn, content, source, now_s, priority=6)

    def _content_of(self, pgn: int) -> bytes | None:
        match pgn:
            case Pgn.DM1:
                return self._dm1.present()
            case Pgn.COMPONENT_ID:
                return self.identity.component_id()
            case Pgn.SOFTWARE_ID:
                return self.identity.software_id()
        return None

    def _broadcast(self, pgn: int, data: bytes, now_s: float) -> bool:
        """False where another long message to everybody is under way."""
        frames = (
            [Frame(make_id(6, pgn, self.address or 0), data)]
            if len(data) <= 8
            else self.transport.send(pgn, data, GLOBAL, now_s)
        )
        self.outbox += frames
        return bool(frames)

    def _acknowledge(self, control: Ack, pgn: int, requester: int) -> None:
        body = bytes((control, 0xFF, 0xFF, 0xFF, requester)) + pgn.to_bytes(3, "little")
        self.nacks_sent_n += 1
        self.outbox.append(Frame(make_id(6, Pgn.ACKNOWLEDGEMENT, self.address or 0, GLOBAL), body))
