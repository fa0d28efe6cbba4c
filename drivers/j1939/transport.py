"""Transport protocol of SAE J1939-21: messages of 9 to 1785 bytes in packets of seven.

To everybody: BAM, packets 50 to 200 ms apart. To one node: RTS, CTS, packets, end-of-message acknowledgement, with
abort. Receiving and sending of both kinds; sessions, sizes, times and what others can make us send are bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, NamedTuple

from graderd.drivers.j1939.ids import GLOBAL, Frame, Pgn, make_id
from graderd.hal.clock import Pace

MAX_SIZE: Final = 1785
BAM_GAP_S: Final = 0.05
T1_S: Final = 0.75
"""Receiver: longest wait for the next packet."""
T2_S: Final = 1.25
"""Receiver: longest wait for the first packet after our CTS."""
T3_S: Final = 1.25
"""Sender: longest wait for a CTS or the acknowledgement."""
T4_S: Final = 1.05
"""Sender: longest wait after a CTS that says wait."""
MAX_SESSIONS_N: Final = 16
DATA_RATE_HZ: Final = 100.0
"""Packets a second of all connections together, after a burst: about 6 % of a bus of 250 kbit/s."""
DATA_BURST_N: Final = 16
_ASKED_FOR_MAX_N: Final = 3
"""A packet may be asked for again twice (J1939-21); the whole of a message may leave so often."""
_OPEN_RATE_HZ: Final = 50.0
_OPEN_BURST_N: Final = 20
_CTS_WINDOW_N: Final = 16


class Control(IntEnum):
    """First byte of a connection management message."""

    RTS = 16
    CTS = 17
    END_OF_MESSAGE = 19
    BAM = 32
    ABORT = 255


class Abort(IntEnum):
    """Why a connection is aborted."""

    BUSY = 1
    RESOURCES = 2
    TIMEOUT = 3
    RETRANSMITS = 5
    BAD_SEQUENCE = 7
    TOO_BIG = 9


class Message(NamedTuple):
    """A complete message, of whatever length."""

    pgn: int
    source: int
    destination: int
    data: bytes


@dataclass(slots=True)
class _Incoming:
    pgn: int
    size: int
    packets_n: int
    broadcast: bool
    deadline_s: float
    window_n: int = 255
    next_n: int = 1
    window_end_n: int = 0
    data: bytearray = field(default_factory=bytearray)


@dataclass(slots=True)
class _Outgoing:
    pgn: int
    data: bytes
    destination: int
    priority: int
    due_s: float
    next_n: int = 1
    window_end_n: int = 0
    sent_n: int = 0
    waiting: bool = False

    @property
    def packets_n(self) -> int:
        return math.ceil(len(self.data) / 7)


class Transport:
    """All sessions of one node. ``address`` is the node's own; every method returns the frames to send."""

    def __init__(self) -> None:
        self.address: int | None = None
        self.aborted_n = 0
        self._incoming: dict[tuple[int, int], _Incoming] = {}
        self._outgoing: dict[int, _Outgoing] = {}
        self._data = Pace(DATA_RATE_HZ, DATA_BURST_N)
        self._opens = Pace(_OPEN_RATE_HZ, _OPEN_BURST_N)

    # -- receiving --------------------------------------------------------------------------------------------------

    def on_connection(self, source: int, destination: int, data: bytes, now_s: float) -> list[Frame]:
        """A connection management frame (PGN 60416)."""
        if len(data) != 8:
            return []
        pgn = int.from_bytes(data[5:8], "little")
        control = data[0]
        if control in (Control.BAM, Control.RTS):
            return self._open(source, destination, data, pgn, now_s)
        if destination != self.address:
            return []
        outgoing = self._outgoing.get(source)
        if control == Control.ABORT:
            self._incoming.pop((source, destination), None)
            if outgoing and outgoing.pgn == pgn:
                del self._outgoing[source]
                self.aborted_n += 1
        elif outgoing is None or outgoing.pgn != pgn:
            pass
        elif control == Control.END_OF_MESSAGE:
            del self._outgoing[source]
        elif control == Control.CTS:
            return self._on_cts(outgoing, count=data[1], first=data[2], now_s=now_s)
        return []

    def on_data(self, source: int, destination: int, data: bytes, now_s: float) -> tuple[list[Frame], Message | None]:
        """A data frame (PGN 60160); the message, if it is complete now."""
        session = self._incoming.get((source, destination))
        if session is None or len(data) != 8:
            return [], None
        if data[0] != session.next_n:
            del self._incoming[source, destination]
            self.aborted_n += 1
            if session.broadcast:
                return [], None
            return [self._control(source, Control.ABORT, bytes((Abort.BAD_SEQUENCE, 255, 255, 255)), session.pgn)], None
        session.data += data[1:]
        session.next_n += 1
        session.deadline_s = now_s + T1_S
        if session.next_n <= session.packets_n:
            if not session.broadcast and session.next_n > session.window_end_n:
                return [self._clear_to_send(source, session, now_s)], None
            return [], None
        del self._incoming[source, destination]
        message = Message(session.pgn, source, destination, bytes(session.data[: session.size]))
        if session.broadcast:
            return [], message
        body = session.size.to_bytes(2, "little") + bytes((session.packets_n, 255))
        return [self._control(source, Control.END_OF_MESSAGE, body, session.pgn)], message

    def _open(self, source: int, destination: int, data: bytes, pgn: int, now_s: float) -> list[Frame]:
        size, packets_n = int.from_bytes(data[1:3], "little"), data[3]
        broadcast = data[0] == Control.BAM
        if broadcast != (destination == GLOBAL) or (not broadcast and destination != self.address):
            return []
        if not broadcast and not self._opens.take(now_s):
            return []
        key = (source, destination)
        if not 9 <= size <= MAX_SIZE or packets_n != math.ceil(size / 7):
            self._incoming.pop(key, None)
            if broadcast:
                return []
            return [self._control(source, Control.ABORT, bytes((Abort.TOO_BIG, 255, 255, 255)), pgn)]
        if key not in self._incoming and len(self._incoming) >= MAX_SESSIONS_N:
            if broadcast:
                return []
            return [self._control(source, Control.ABORT, bytes((Abort.RESOURCES, 255, 255, 255)), pgn)]
        session = _Incoming(pgn, size, packets_n, broadcast, now_s + T1_S, window_n=data[4])
        self._incoming[key] = session
        return [] if broadcast else [self._clear_to_send(source, session, now_s)]

    def _clear_to_send(self, source: int, session: _Incoming, now_s: float) -> Frame:
        left_n = session.packets_n - session.next_n + 1
        count = min(left_n, max(1, session.window_n), _CTS_WINDOW_N)
        session.window_end_n = session.next_n + count - 1
        session.deadline_s = now_s + T2_S
        return self._control(source, Control.CTS, bytes((count, session.next_n, 255, 255)), session.pgn)

    # -- sending ----------------------------------------------------------------------------------------------------

    def send(self, pgn: int, data: bytes, destination: int, now_s: float, priority: int = 7) -> list[Frame]:
        """Begin to send 9 to 1785 bytes: by BAM to everybody, by RTS/CTS to one node.

        A session that is already running to the same destination is not disturbed; the call then sends nothing.

        Raises:
            ValueError: the size is not one for this protocol.
        """
        if not 9 <= len(data) <= MAX_SIZE:
            raise ValueError(f"transport protocol carries 9 to {MAX_SIZE} bytes, not {len(data)}")
        if destination in self._outgoing or self.address is None or len(self._outgoing) >= MAX_SESSIONS_N:
            return []
        session = _Outgoing(pgn, data, destination, priority, now_s)
        self._outgoing[destination] = session
        size = len(data).to_bytes(2, "little")
        if destination == GLOBAL:
            session.due_s = now_s + BAM_GAP_S
            return [self._control(GLOBAL, Control.BAM, size + bytes((session.packets_n, 255)), pgn, priority)]
        session.waiting = True
        session.due_s = now_s + T3_S
        return [self._control(destination, Control.RTS, size + bytes((session.packets_n, 255)), pgn, priority)]

    def poll(self, now_s: float) -> list[Frame]:
        """Packets that became due, and sessions that ran out of time."""
        if not self._incoming and not self._outgoing:
            return []
        frames: list[Frame] = []
        for (source, destination), incoming in tuple(self._incoming.items()):
            if now_s > incoming.deadline_s:
                del self._incoming[source, destination]
                self.aborted_n += 1
                if not incoming.broadcast:
                    body = bytes((Abort.TIMEOUT, 255, 255, 255))
                    frames.append(self._control(source, Control.ABORT, body, incoming.pgn))
        for destination, outgoing in tuple(self._outgoing.items()):
            frames += self._packets(outgoing, now_s)
            if now_s < outgoing.due_s or destination not in self._outgoing:
                continue
            if outgoing.waiting:
                del self._outgoing[destination]
                self.aborted_n += 1
                body = bytes((Abort.TIMEOUT, 255, 255, 255))
                frames.append(self._control(destination, Control.ABORT, body, outgoing.pgn))
            elif destination == GLOBAL:
                frames.append(self._packet(outgoing))
                outgoing.due_s = now_s + BAM_GAP_S
                if outgoing.next_n > outgoing.packets_n:
                    del self._outgoing[destination]
        return frames

    def _on_cts(self, session: _Outgoing, count: int, first: int, now_s: float) -> list[Frame]:
        if count == 0:
            session.due_s = now_s + T4_S
            return []
        if not 1 <= first <= session.packets_n:
            del self._outgoing[session.destination]
            self.aborted_n += 1
            body = bytes((Abort.BAD_SEQUENCE, 255, 255, 255))
            return [self._control(session.destination, Control.ABORT, body, session.pgn)]
        session.next_n = first
        session.window_end_n = min(session.packets_n, first + count - 1)
        session.due_s = now_s + T3_S
        return self._packets(session, now_s)

    def _packets(self, session: _Outgoing, now_s: float) -> list[Frame]:
        """What a connection may send now of the packets it was asked for."""
        frames: list[Frame] = []
        while session.next_n <= session.window_end_n and self._data.take(now_s):
            if session.sent_n >= _ASKED_FOR_MAX_N * session.packets_n:
                del self._outgoing[session.destination]
                self.aborted_n += 1
                body = bytes((Abort.RETRANSMITS, 255, 255, 255))
                return [*frames, self._control(session.destination, Control.ABORT, body, session.pgn)]
            session.sent_n += 1
            session.due_s = now_s + T3_S
            frames.append(self._packet(session))
        return frames

    def _packet(self, session: _Outgoing) -> Frame:
        start = 7 * (session.next_n - 1)
        body = session.data[start : start + 7].ljust(7, b"\xff")
        frame = Frame(
            make_id(session.priority, Pgn.TP_DATA, self.address or 0, session.destination),
            bytes((session.next_n,)) + body,
        )
        session.next_n += 1
        return frame

    def _control(self, destination: int, control: Control, body: bytes, pgn: int, priority: int = 7) -> Frame:
        can_id = make_id(priority, Pgn.TP_CONNECTION, self.address or 0, destination)
        return Frame(can_id, bytes((control,)) + body + pgn.to_bytes(3, "little"))


class Listener:
    """Puts together what others send each other, and says nothing itself. Time may be that of a log.

    A session ends with its last packet, with an abort from either side, with a packet out of turn that nobody asked
    for, or when nothing came for as long as the standard lets either side wait. The oldest of too many is forgotten.
    """

    def __init__(self) -> None:
        self._sessions: dict[tuple[int, int], _Incoming] = {}

    def on_frame(self, pgn: int, source: int, destination: int, data: bytes, now_s: float) -> Message | None:
        """A frame of either of the protocol's two groups; the message where it is complete now."""
        for key, session in tuple(self._sessions.items()):
            if now_s > session.deadline_s:
                del self._sessions[key]
        if len(data) != 8:
            return None
        if pgn == Pgn.TP_DATA:
            return self._on_data((source, destination), data, now_s)
        about = int.from_bytes(data[5:8], "little")
        match data[0]:
            case Control.RTS | Control.BAM:
                self._open((source, destination), about, data, now_s)
            case Control.CTS:
                asked = self._sessions.get((destination, source))
                if asked is not None and asked.pgn == about:
                    asked.deadline_s = now_s + (T2_S if data[1] else T4_S)
                    if data[1] and 0 < data[2] < asked.next_n:  # asked for again
                        asked.next_n = data[2]
                        del asked.data[7 * (data[2] - 1) :]
            case Control.ABORT:
                for key in ((source, destination), (destination, source)):
                    if key in self._sessions and self._sessions[key].pgn == about:
                        del self._sessions[key]
        return None

    def _open(self, key: tuple[int, int], about: int, data: bytes, now_s: float) -> None:
        size, packets_n, broadcast = int.from_bytes(data[1:3], "little"), data[3], data[0] == Control.BAM
        self._sessions.pop(key, None)
        if not 9 <= size <= MAX_SIZE or packets_n != math.ceil(size / 7) or broadcast != (key[1] == GLOBAL):
            return
        if len(self._sessions) >= MAX_SESSIONS_N:
            del self._sessions[next(iter(self._sessions))]
        self._sessions[key] = _Incoming(about, size, packets_n, broadcast, now_s + (T1_S if broadcast else T3_S))

    def _on_data(self, key: tuple[int, int], data: bytes, now_s: float) -> Message | None:
        session = self._sessions.get(key)
        if session is None:
            return None
        if data[0] != session.next_n:
            if session.broadcast:
                del self._sessions[key]
            return None
        session.data += data[1:]
        session.next_n += 1
        session.deadline_s = now_s + (T1_S if session.broadcast else T3_S)
        if session.next_n <= session.packets_n:
            return None
        del self._sessions[key]
        return Message(session.pgn, *key, bytes(session.data[: session.size]))
