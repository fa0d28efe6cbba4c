"""The servo wire: one owner, one request in flight, every request with a deadline. Asyncio over the port's own fd.

How a late reply is kept from being taken for another one's: Protocol 2.0 has no sequence numbers. After a request
timed out, a fence is sent next, and everything that comes before the fence's reply is thrown away: replies keep their
order, and a fence's reply has a length that nothing else has which is still owed. It is a ping, and where that is owed
itself, a read from address 0 of so many bytes. Deadlines follow what the line was measured to need (as TCP does it), so
that a slow adapter costs no retries and a quick one no waiting; a reply that comes late says how late the line is.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import serial

from graderd.drivers.dynamixel import serial_port
from graderd.drivers.dynamixel.codec import (
    BROADCAST_ID,
    MAX_ID,
    Instruction,
    Packet,
    StatusError,
    StreamDecoder,
    encode,
)
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.errors import DeviceError, DeviceLostError, DeviceRefusedError, DeviceTimeoutError

_ALLOWANCE_MIN_S: Final = 0.020
_ALLOWANCE_START_S: Final = 0.060
_ALLOWANCE_MAX_S: Final = 0.100
_ROOM_S: Final = 0.1
"""So long an adapter may take no bytes before the request counts as unanswered."""
MAX_REPLY_LENGTH: Final = 96
"""Length field of the longest reply to a request of ours, fully stuffed; a header that claims more is babble."""
"""Bounds of what a reply may take beyond wire time: scheduling at the low end, a bad USB adapter at the high one."""


class WireAccess:
    """One at a time; the others wait in order, urgent ones ahead of them. ``taken``: whether somebody has it."""

    def __init__(self) -> None:
        self.taken = False
        self._queue: deque[asyncio.Future[None]] = deque()

    async def take(self, urgent: bool) -> None:
        """Wait for the wire; it is given back with :meth:`give_back`."""
        if not self.taken:
            self.taken = True
            return
        granted: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        if urgent:
            self._queue.appendleft(granted)
        else:
            self._queue.append(granted)
        try:
            await granted
        except asyncio.CancelledError:
            if granted.done() and not granted.cancelled():
                self.give_back()
            raise

    def give_back(self) -> None:
        """It goes over to the next one at once."""
        while self._queue:
            granted = self._queue.popleft()
            if not granted.done():
                granted.set_result(None)  # the line stays taken: it goes over to the next one
                return
        self.taken = False


class Allowance:
    """What a reply may take beyond its time on the wire, learned from what replies took (RFC 6298).

    ``now_s`` is the present allowance: smoothed mean plus four times the smoothed spread, within bounds.
    """

    def __init__(self) -> None:
        self.now_s = _ALLOWANCE_START_S
        self._most_s = _ALLOWANCE_MAX_S
        self._smooth_s = 0.0
        self._spread_s = 0.0

    def learn(self, extra_s: float) -> None:
        """A reply took so much longer than the wire needs."""
        self._spread_s += 0.25 * (abs(extra_s - self._smooth_s) - self._spread_s)
        self._smooth_s += 0.125 * (extra_s - self._smooth_s)
        wanted_s = self._smooth_s + 4 * self._spread_s + 0.25 * _ALLOWANCE_MIN_S
        self.now_s = min(_ALLOWANCE_MAX_S, max(_ALLOWANCE_MIN_S, wanted_s))
        self._most_s = min(_ALLOWANCE_MAX_S, 2.0 * self.now_s)

    def widen(self) -> None:
        """No reply came in time: at most to twice what was learned, so that losses do not eat the time for repeats."""
        self.now_s = min(self._most_s, self.now_s * 1.5)

    def late(self, extra_s: float) -> None:
        """A reply to a request given up came so much later than the wire needs."""
        if extra_s <= self.now_s:
            return  # widened enough meanwhile
        self._most_s = _ALLOWANCE_MAX_S
        self.now_s = min(_ALLOWANCE_MAX_S, 1.25 * extra_s)


@dataclass(frozen=True, slots=True)
class _Owed:
    """The reply to a request that was given up: it may still come. ``due_s``: when it was due, with no allowance."""

    data_n: int | None
    due_s: float


log = logging.getLogger(__name__)

BusTap = Callable[[float, Literal["tx", "rx"], bytes], None]
"""Called with monotonic seconds, direction and bytes of everything that crosses the wire."""

_BITS_PER_BYTE: Final = 10
_STATUS_BYTES: Final = 11  # a status packet without data
_PING_DATA_BYTES: Final = 3
_FENCES: Final = (_PING_DATA_BYTES, *(n for n in range(1, 15) if n != _PING_DATA_BYTES))
"""Lengths that a fence's reply may have: every P-series table begins with 14 bytes of registers."""
_FORGIVEN_S: Final = 0.5
"""What has not come by then does not come: its length may serve again."""


@functools.lru_cache(maxsize=64)  # polling asks the same few questions for ever
def _read_packet(servo_id: int, address: int, size: int) -> bytes:
    params = bytes((address & 0xFF, address >> 8, size & 0xFF, size >> 8))
    return encode(servo_id, Instruction.READ, params)


class ServoRefusedError(DeviceRefusedError):
    """The servo answered with an error number; ``error`` is its
    :class:`~graderd.drivers.dynamixel.codec.StatusError` value."""

    def __init__(self, where: str, request: str, error: int) -> None:
        known = error in StatusError.__members__.values()
        name = StatusError(error).name.lower() if known else f"error {error}"
        super().__init__(where, f"servo refused {request}: {name}")
        self.error = error


class NotCarriedOutError(DeviceTimeoutError):
    """Nothing of it was done: each attempt arrived damaged, by the servo's word, or was not made."""


class ServoBus:
    """One serial port with Protocol 2.0 servos on it.

    Args:
        port: path of the port.
        baud_n: bits per second.
        clock: monotonic seconds for the log's times.
        taps: called with every chunk of bytes sent and received; the list may change meanwhile.
        return_delay_s: the servos' Return Delay Time (factory 500 µs), part of each deadline.

    ``last_valid_s``: clock time of the last valid status packet; ``unanswered_n``: requests without one since;
    ``heard_s``: when the servo had heard the request it answered last, which is when it measured (read it before
    anything else is awaited).
    """

    def __init__(
        self,
        port: str,
        baud_n: int,
        *,
        clock: Clock | None = None,
        taps: Sequence[BusTap] = (),
        return_delay_s: float = 0.000508,
    ) -> None:
        self.port = port
        self.baud_n = baud_n
        self.low_latency = False
        self.latency_timer_ms: int | None = None
        self.last_valid_s = self.heard_s = float("-inf")
        self.unanswered_n = 0
        self._clock: Clock = clock or SystemClock()
        self._taps = taps
        self._byte_s = _BITS_PER_BYTE / baud_n
        self._return_delay_s = return_delay_s
        self._serial: serial.Serial | None = None
        self._fd = -1
        self._decoder = StreamDecoder(MAX_REPLY_LENGTH)
        self._access = WireAccess()
        self._allowance = Allowance()
        self._reply: asyncio.Future[Packet | None] | None = None
        self._room: asyncio.Future[None] | None = None
        self._everybody: list[Packet] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._wanted_id = 0
        self._wanted_data_n: int | None = None
        self._owed: deque[_Owed] = deque()
        self._counters = dict.fromkeys(
            (
                "requests_n", "replies_n", "retries_n", "timeouts_n", "refused_n", "foreign_n", "late_n", "echo_n",
                "invalid_n", "fences_n", "damaged_requests_n", "blocked_n", "doubled_n",
            ),
            0,
        )  # fmt: skip

    # -- life ---------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open the port; nothing is sent.

        Raises:
            DeviceMissingError: no such port, or it may not be opened.
            DeviceRefusedError: the adapter cannot do the baud rate.
        """
        self._serial = serial_port.open_port(self.port, self.baud_n)
        self.low_latency = serial_port.set_low_latency(self._serial)
        self.latency_timer_ms = serial_port.latency_timer_ms(self.port)
        if (self.latency_timer_ms or 0) > 2:
            log.warning(
                "%s: the adapter holds replies back for %d ms (low_latency not available): at most %d requests "
                "a second. Set its latency_timer to 1 with the udev rule",
                self.port, self.latency_timer_ms, 1000 // (self.latency_timer_ms or 1),
            )  # fmt: skip
        self._fd = self._serial.fileno()
        os.set_blocking(self._fd, False)
        asyncio.get_running_loop().add_reader(self._fd, self._on_readable)

    def close(self) -> None:
        """Let go of the port; a request in flight fails. Idempotent."""
        self._shut(DeviceLostError(self.port, "the port was closed"))

    @property
    def is_open(self) -> bool:
        """Whether the port is open and was not lost."""
        return self._fd >= 0

    def _shut(self, error: DeviceError) -> None:
        if self._fd >= 0:
            asyncio.get_running_loop().remove_reader(self._fd)
            asyncio.get_running_loop().remove_writer(self._fd)
            self._fd = -1
        if self._serial is not None:
            opened, self._serial = self._serial, None
            try:
                opened.close()
            except (OSError, serial.SerialException) as e:
                log.debug("%s: closing a vanished port: %s", self.port, e)
        for waiting in (self._reply, self._room):
            if waiting is not None and not waiting.done():
                waiting.set_exception(error)

    def counters(self) -> dict[str, int]:
        """What happened on the wire since the bus was made."""
        return {
            **self._counters,
            "crc_errors_n": self._decoder.crc_errors_n,
            "stray_bytes_n": self._decoder.stray_n,
            "low_latency_n": int(self.low_latency),
        }

    @property
    def allowance_s(self) -> float:
        """What a reply may take now beyond its time on the wire."""
        return self._allowance.now_s

    @property
    def damaged_n(self) -> int:
        """Packets that came damaged: replies here, requests at the servo."""
        return self._decoder.crc_errors_n + self._counters["invalid_n"] + self._counters["damaged_requests_n"]

    # -- requests -----------------------------------------------------------------------------------------------

    async def ping(self, servo_id: int, *, attempts_n: int = 2) -> tuple[int, int]:
        """Model number and firmware version of the servo with that id.

        Raises:
            DeviceTimeoutError, DeviceLostError: as :meth:`request`.
        """
        data = (await self.request(servo_id, Instruction.PING, b"", _PING_DATA_BYTES, attempts_n=attempts_n)).data
        return data[0] | data[1] << 8, data[2]

    async def ping_all(self) -> list[tuple[int, int, int]]:
        """Id, model number and firmware version of all that answer a broadcast ping, each in its turn."""
        await self._access.take(False)
        heard: list[Packet] = []
        self._everybody = heard
        try:
            await self._transmit(encode(BROADCAST_ID, Instruction.PING))
            answer_s = (_STATUS_BYTES + _PING_DATA_BYTES) * self._byte_s + self._return_delay_s
            await asyncio.sleep(_ALLOWANCE_MAX_S + MAX_ID * answer_s)
        finally:
            self._everybody = None
            self._owe(_PING_DATA_BYTES)
            self._access.give_back()
        pings = [p for p in heard if len(p.data) == _PING_DATA_BYTES]
        return [(p.packet_id, p.data[0] | p.data[1] << 8, p.data[2]) for p in pings]

    @property
    def doubled_n(self) -> int:
        """Answers beyond the first one to a request, with the id that was asked and none owed: a second servo's."""
        return self._counters["doubled_n"]

    async def answers_twice(self) -> bool:
        """Whether a request so far drew two answers; waits until the second to the last one had its time."""
        await asyncio.sleep(self._allowance.now_s)
        return self.doubled_n > 0

    async def read(self, servo_id: int, address: int, size: int, *, attempts_n: int = 2) -> Packet:
        """``size`` bytes from ``address``; the packet's ``data`` holds exactly that many, ``alert`` stands beside it.

        Raises:
            ServoRefusedError: the servo answered with an error.
            DeviceTimeoutError, DeviceLostError: as :meth:`request`.
        """
        if size == _PING_DATA_BYTES or size <= 0:
            raise ValueError(f"a read of {size} bytes could not be told from other replies")
        return await self._ask(servo_id, _read_packet(servo_id, address, size), size, attempts_n, False)

    async def write(
        self, servo_id: int, address: int, data: bytes, *, attempts_n: int = 2, urgent: bool = False
    ) -> Packet:
        """Write absolute values (writing them twice does no harm) and wait for the servo's word.

        Raises:
            ServoRefusedError: the servo answered with an error; nothing was written.
            DeviceTimeoutError, DeviceLostError: as :meth:`request`; it may have been written.
        """
        params = address.to_bytes(2, "little") + data
        return await self.request(servo_id, Instruction.WRITE, params, 0, attempts_n=attempts_n, urgent=urgent)

    async def send(self, servo_id: int, instruction: int, params: bytes = b"") -> None:
        """Send an instruction that nobody answers (broadcasts; a servo whose status return level is unknown)."""
        await self._access.take(False)
        try:
            if servo_id != BROADCAST_ID:
                self._owe(0)  # should it answer after all, that is not the next one's reply
            await self._transmit(encode(servo_id, instruction, params))
            await asyncio.sleep(self._byte_s * (12 + len(params)) + self._return_delay_s)
        finally:
            self._access.give_back()

    async def request(
        self,
        servo_id: int,
        instruction: int,
        params: bytes = b"",
        reply_data_n: int | None = 0,
        *,
        attempts_n: int = 1,
        urgent: bool = False,
    ) -> Packet:
        """Send an instruction and return its valid status packet.

        ``attempts_n`` bounds the sends; more than 1 only for what may be carried out twice (reads, absolute writes).
        ``urgent`` requests go ahead of all others that wait, also between another one's attempts, and are sent once
        more where it is not yet known that the line is clear: only for what may be carried out twice.

        Raises:
            ServoRefusedError: the servo answered with an error number.
            DeviceTimeoutError: no valid reply in any attempt.
            DeviceLostError: the port is gone.
        """
        return await self._ask(servo_id, encode(servo_id, instruction, params), reply_data_n, attempts_n, urgent)

    async def _ask(
        self, servo_id: int, packet: bytes, reply_data_n: int | None, attempts_n: int, urgent: bool
    ) -> Packet:
        access = self._access
        in_doubt = False  # whether the servo may have carried it out
        for attempt in range(attempts_n):
            if access.taken:
                await access.take(urgent)
            else:
                access.taken = True
            try:
                if attempt:
                    self._counters["retries_n"] += 1
                if self._owed and urgent:
                    in_doubt = True
                    await self._transmit(packet)  # a stop does not wait until the line is known to be clear
                    self._owe(reply_data_n)
                if self._owed and not await self._fence(servo_id):
                    continue
                reply = await self._exchange(packet, servo_id, reply_data_n)
            finally:
                access.give_back()
            if reply is None:
                in_doubt = True
                continue
            error = reply.error
            if not error:
                return reply
            if error == StatusError.CRC:  # it did not understand: a lost packet, whatever is left to try
                self._counters["damaged_requests_n"] += 1
                continue
            self._counters["refused_n"] += 1
            raise ServoRefusedError(self._where(servo_id), _describe(packet), error)
        raise (DeviceTimeoutError if in_doubt else NotCarriedOutError)(
            self._where(servo_id),
            f"no valid status packet to {_describe(packet)} in {attempts_n} attempt(s)",
            "Check power, cable, id and baud rate",
        )

    def _where(self, servo_id: int) -> str:
        return f"servo {servo_id} at {self.port}"

    def _owe(self, data_n: int | None) -> None:
        self._owed.append(_Owed(data_n, asyncio.get_running_loop().time()))

    async def _fence(self, servo_id: int) -> bool:
        """Make sure that nothing of former requests is still on its way."""
        self._counters["fences_n"] += 1
        self._decoder.reset()
        since_s = asyncio.get_running_loop().time() - _FORGIVEN_S
        owed = {reply.data_n for reply in self._owed if reply.due_s > since_s}
        data_n = next((n for n in _FENCES if n not in owed), None)
        if data_n is None:  # fourteen questions within half a second, and no answer
            await asyncio.sleep(self._allowance.now_s)
            return False
        ping = encode(servo_id, Instruction.PING)
        fence = ping if data_n == _PING_DATA_BYTES else _read_packet(servo_id, 0, data_n)
        if await self._exchange(fence, servo_id, data_n) is None:
            return False
        self._owed.clear()
        return True

    async def _exchange(self, packet: bytes, servo_id: int, reply_data_n: int | None) -> Packet | None:
        """One send and the wait for its reply; None where the deadline passed."""
        loop = asyncio.get_running_loop()
        on_wire_s = (len(packet) + _STATUS_BYTES + (reply_data_n or 0)) * self._byte_s + self._return_delay_s
        self._decoder.reset()
        self._wanted_id, self._wanted_data_n = servo_id, reply_data_n
        self._reply = reply = loop.create_future()
        self._counters["requests_n"] += 1
        due_s = loop.time() + on_wire_s
        try:
            if not await self._transmit(packet):
                reply.set_result(None)
            due_s = loop.time() + on_wire_s
            heard_s = self._clock.now_s() + len(packet) * self._byte_s
            self._await(reply, due_s)
            answer: Packet | None = await reply
        except BaseException:
            self._owed.append(_Owed(reply_data_n, due_s))
            raise
        finally:
            self._reply = None
            if self._timer is not None:
                self._timer.cancel()
        if answer is None:
            self._owed.append(_Owed(reply_data_n, due_s))
            self.unanswered_n += 1
            self._counters["timeouts_n"] += 1
            self._allowance.widen()
            return None
        self.heard_s = min(heard_s, self._clock.now_s())
        self._allowance.learn(max(0.0, loop.time() - due_s))
        return answer

    def _await(self, reply: asyncio.Future[Packet | None], due_s: float) -> None:
        """Give the reply up at its deadline, which moves with what is learned of the line meanwhile."""
        loop, until_s = asyncio.get_running_loop(), due_s + self._allowance.now_s

        def deadline() -> None:
            if not reply.done():
                self._on_readable()  # a busy loop may be late for bytes that were in time
            if reply.done():
                return
            if due_s + self._allowance.now_s > until_s:
                self._await(reply, due_s)
            else:
                reply.set_result(None)

        self._timer = loop.call_at(until_s, deadline)

    # -- bytes --------------------------------------------------------------------------------------------------

    async def _transmit(self, packet: bytes) -> bool:
        """Write it whole, in as many pieces as the adapter takes; False where it took no more in time."""
        loop = asyncio.get_running_loop()
        left, until_s = packet, loop.time() + _ROOM_S
        while True:
            left = left[self._write(left) :]
            if not left:
                break
            self._counters["blocked_n"] += 1
            if not await self._wait_for_room(until_s):
                return False
        for tap in self._taps:
            tap(self._clock.now_s(), "tx", packet)
        return True

    def _write(self, data: bytes) -> int:
        if self._fd < 0:
            raise DeviceLostError(self.port, "the port is not open", "Check the USB cable")
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as e:
            error = DeviceLostError(self.port, f"writing failed ({e.strerror})", "Check the USB cable")
            self._reply = None  # the request learns of it here and now
            self._shut(error)
            raise error from e

    async def _wait_for_room(self, until_s: float) -> bool:
        loop, fd = asyncio.get_running_loop(), self._fd
        self._room = room = loop.create_future()
        loop.add_writer(fd, _there_is, room)
        try:
            async with asyncio.timeout_at(until_s):
                await room
        except TimeoutError:
            return False
        finally:
            self._room = None
            if self._fd == fd:
                loop.remove_writer(fd)
        return True

    def _on_readable(self) -> None:
        if self._fd < 0:
            return
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        except OSError as e:
            self._shut(DeviceLostError(self.port, f"reading failed ({e.strerror})", "Check the USB cable"))
            return
        if not data:
            self._shut(DeviceLostError(self.port, "the port vanished", "Check the USB cable"))
            return
        for tap in self._taps:
            tap(self._clock.now_s(), "rx", data)
        for packet in self._decoder.feed(data):
            self._sort(packet)

    def _sort(self, packet: Packet) -> None:
        """Decide whether a packet is the reply that is waited for."""
        counters, reply = self._counters, self._reply
        if not packet.is_status:
            counters["echo_n"] += 1
        elif self._everybody is not None:
            self._everybody.append(packet)
        elif reply is None or reply.done():
            if packet.packet_id == self._wanted_id and not self._owed:
                counters["doubled_n"] += 1  # nothing that was given up could still be late
            self._note_late(packet)
        elif packet.packet_id != self._wanted_id:
            counters["foreign_n"] += 1
        elif self._wanted_data_n is not None and len(packet.data) != self._wanted_data_n and not packet.error:
            if self._owed:
                self._note_late(packet)
            else:
                counters["invalid_n"] += 1
        elif packet.error and self._owed:
            self._note_late(packet)  # a fence is never refused: this belongs to a former request
        else:
            counters["replies_n"] += 1
            self.last_valid_s = self._clock.now_s()
            self.unanswered_n = 0
            reply.set_result(packet)

    def _note_late(self, packet: Packet) -> None:
        """Whose it was says how late the line is; what was owed before that one does not come any more."""
        self._counters["late_n"] += 1
        late = next((r for r in self._owed if r.data_n == len(packet.data)), None)
        if late is None or packet.packet_id != self._wanted_id:
            return
        self._allowance.late(asyncio.get_running_loop().time() - late.due_s)
        while len(self._owed) > 1 and self._owed[0] is not late:
            self._owed.popleft()


def _there_is(room: asyncio.Future[None]) -> None:
    if not room.done():
        room.set_result(None)


def _describe(packet: bytes) -> str:
    """A request in words."""
    instruction = packet[7]
    if instruction not in Instruction.__members__.values():
        return hex(instruction)
    name = Instruction(instruction).name.lower()
    if instruction in (Instruction.READ, Instruction.WRITE, Instruction.REG_WRITE):
        return f"{name} at address {packet[8] | packet[9] << 8}"
    return name
