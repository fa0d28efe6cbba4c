"""Virtual servos on a pseudo-terminal: any Protocol 2.0 software opens the link as if it were a USB adapter."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import functools
import os
import random
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from graderd.drivers.dynamixel.codec import StatusError, StreamDecoder, crc16, encode_status
from graderd.hal.clock import Clock, SystemClock
from graderd.simulator.servo.faults import ALERT_BITS, FAULTS
from graderd.simulator.servo.line import answers
from graderd.simulator.servo.servo import VirtualServo
from graderd.simulator.terminal import LinkedTerminal

_TICK_S = 0.01
_SPIN_S = 0.001
"""With wire time, the last part of a wait is spun: a sleeping process wakes too late by up to that much."""
_RETURN_DELAY_STEP_S = 2e-6
_PLAIN_REPLY_BYTES = 14
"""A ping's answer; it and shorter ones are the same from two servos of a kind."""
_STALL_S = 0.03
"""A pass of the loop that comes so late is our own stall, not the client's silence: no watchdog counts it."""


class VirtualServoBus:
    """Servos, the pty they share, and everything that can go wrong with it. Runs on the caller's event loop.

    Args:
        servos: at least one :class:`VirtualServo`, ids all different.
        link: symlink that points to the pty while the cable is plugged in.
        wire_time: answer as late as a real wire would: request bytes, return delay, reply bytes at the baud rate.
        clock: monotonic seconds for motion and watchdog.
        baud_n: bits per second of the wire; None: as the first servo's Baud Rate register says.
        strict_baud: answer only a client that set the port to that rate.
        byte_gap_s: a longer pause inside a packet drops it (the servo: 1.5 ms; hosts and ptys do not keep that).
        answer_crc_errors: reply CRC Error to a damaged instruction packet instead of silence.
        linger_s: after a reply keep looking for the next request so long without sleeping (benchmarks).
        heard: called with the client's bytes as they come, before anything is made of them or goes wrong with them.
        seed: for faults that strike with a probability.
    """

    def __init__(
        self,
        servos: Sequence[VirtualServo],
        link: Path,
        wire_time: bool = False,
        clock: Clock | None = None,
        *,
        baud_n: int | None = None,
        strict_baud: bool = False,
        byte_gap_s: float = 0.1,
        answer_crc_errors: bool = False,
        linger_s: float = 0.0,
        heard: Callable[[bytes], None] | None = None,
        seed: int = 0,
    ) -> None:
        if len({s.servo_id for s in servos}) != len(servos) or not servos:
            raise ValueError("a virtual bus needs at least one servo, and every servo its own id")
        self.servos = tuple(servos)
        self.link = Path(link)
        self.wire_time = wire_time
        self.requests_n = 0
        self.replies_n = 0
        self._baud_n = baud_n
        self._strict_baud = strict_baud
        self._byte_gap_s = byte_gap_s
        self._answer_crc_errors = answer_crc_errors
        self._linger_s = linger_s
        self._heard = heard
        self._clock: Clock = clock or SystemClock()
        self._random = random.Random(seed)
        self._faults: dict[str, dict[str, float]] = {}
        self._decoder = StreamDecoder()
        self._terminal: LinkedTerminal | None = None
        self._master = -1
        self._task: asyncio.Task[None] | None = None
        self._timers: set[asyncio.TimerHandle] = set()
        self._last_byte_s = 0.0
        self._turn_s = 0.0
        self._detour_s = 0.0

    # -- life ---------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Plug in and let time run."""
        loop = asyncio.get_running_loop()
        self._turn_s = self._clock.now_s()
        self._plug_in()
        self._task = loop.create_task(self._run(), name="virtual-servo-motion")

    async def close(self) -> None:
        """Unplug and stop; idempotent."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._pull_out()

    async def unplug(self) -> None:
        """Pull the cable: the port and its link vanish; the servos keep their power and their watchdogs."""
        self._pull_out()

    async def replug(self, link: Path | None = None) -> None:
        """Plug the cable in again, under another name where ``link`` is given."""
        if link is not None:
            self._pull_out()
            self.link = Path(link)
        if self._master < 0:
            self._plug_in()

    @property
    def plugged_in(self) -> bool:
        """Whether the pty exists."""
        return self._master >= 0

    @property
    def baud_n(self) -> int:
        """Bits per second of the wire."""
        if self._baud_n is not None:
            return self._baud_n
        rates = self.servos[0].table.profile["bus"]["baud_n"]
        return int(rates[min(self.servos[0].memory["baud_rate"], len(rates) - 1)])

    async def _run(self) -> None:
        while True:
            self._advance()
            await asyncio.sleep(_TICK_S)

    def _advance(self) -> None:
        now_s = self._clock.now_s()
        late_s = now_s - self._turn_s - _TICK_S
        for servo in self.servos:
            if late_s > _STALL_S:
                servo.forgive(late_s)
            servo.advance(now_s)
        self._turn_s = now_s

    def _plug_in(self) -> None:
        terminal = LinkedTerminal(self.link)
        self._detour_s = pty_round_trip_s(terminal.master, terminal.slave) if self.wire_time else 0.0
        self._terminal, self._master = terminal, terminal.master
        self._decoder.reset()
        asyncio.get_running_loop().add_reader(self._master, self._on_readable)

    def _pull_out(self) -> None:
        if self._terminal is None:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        self._terminal.close()
        self._terminal, self._master = None, -1

    # -- faults -------------------------------------------------------------------------------------------------

    @staticmethod
    def fault_names() -> tuple[str, ...]:
        """Everything :meth:`inject` accepts."""
        return tuple(FAULTS)

    def inject(self, fault: str, **params: float) -> None:
        """Make something go wrong until :meth:`clear_faults`; on the first servo where it is about a servo.

        Raises:
            ValueError: no such fault, or it has no such parameter.
        """
        kind = FAULTS.get(fault)
        if kind is None:
            raise ValueError(f"no fault {fault!r}; known: {', '.join(FAULTS)}")
        unknown = params.keys() - kind.params.keys()
        if unknown:
            raise ValueError(f"fault {fault!r} has no {', '.join(sorted(unknown))}; it has {sorted(kind.params)}")
        values = {**kind.params, **params}
        self._advance()
        self._faults[fault] = values
        action = self._servo_faults().get(fault)
        if action is not None:
            action(values)

    def clear_faults(self) -> None:
        """End every fault. What the servo latched (alerts, lost RAM, torque off) stays as it is in reality."""
        self._advance()
        servo = self.servos[0]
        faults, self._faults = self._faults, {}
        servo.plant.jammed = servo.plant.reversed_loop = servo.keeps_turns = False
        servo.refused = {}
        servo.misread_n = 0
        servo.forced_voltage_v = servo.forced_temperature_c = None
        if "push" in faults:
            servo.load_torque_nm = 0.0
        if "wrong_model" in faults:
            servo.memory["model_number"] = servo.table.model_number
        if "power_cut" in faults:
            servo.power(True)
        if "unplug" in faults and self._master < 0:
            self._plug_in()

    def _servo_faults(self) -> dict[str, Callable[[dict[str, float]], None]]:
        servo = self.servos[0]

        def power_cut(p: dict[str, float]) -> None:
            servo.power(False)
            if p["seconds"] > 0:
                self._later(p["seconds"], lambda: servo.power(True))

        def ram_reset(_: dict[str, float]) -> None:
            servo.power(False)
            servo.power(True)

        def misread(p: dict[str, float]) -> None:
            servo.misread_deg, servo.misread_n = p["deg"], int(p["reads_n"])

        def alert(bit: int) -> Callable[[dict[str, float]], None]:
            return lambda _: servo.raise_hardware_error(bit)

        return {
            "unplug": lambda _: self._pull_out(),
            "power_cut": power_cut,
            "ram_reset": ram_reset,
            "refuse": lambda p: servo.refused.__setitem__(int(p["address"]), int(p["error"])),
            "wrong_position": misread,
            "keeps_turns": lambda _: setattr(servo, "keeps_turns", True),
            "torque_off": lambda _: servo.switch_torque_off(),
            "turns_lost": lambda p: servo.lose_turns(int(p["turns_n"])),
            "wrong_model": lambda p: servo.memory.__setitem__("model_number", int(p["model_n"])),
            "jam": lambda _: setattr(servo.plant, "jammed", True),
            "wrong_way": lambda _: setattr(servo.plant, "reversed_loop", True),
            "push": lambda p: setattr(servo, "load_torque_nm", p["torque_nm"]),
            "voltage": lambda p: setattr(servo, "forced_voltage_v", p["volts"]),
            "temperature": lambda p: setattr(servo, "forced_temperature_c", p["celsius"]),
            **{name: alert(bit) for name, bit in ALERT_BITS.items()},
        }

    def _strikes(self, fault: str) -> bool:
        values = self._faults.get(fault)
        return values is not None and self._random.random() < values.get("rate", 1.0)

    # -- bytes --------------------------------------------------------------------------------------------------

    def _on_readable(self) -> None:
        data = self._take()
        if data:
            self._receive(data)

    def _take(self) -> bytes:
        try:
            return os.read(self._master, 1 if "trickle" in self._faults else 4096) if self._master >= 0 else b""
        except (BlockingIOError, OSError):
            return b""

    def _receive(self, data: bytes) -> None:
        now_s = self._clock.now_s()
        if self._heard is not None:
            self._heard(data)
        if "echo" in self._faults:
            self._put(data)
        if self._strict_baud and self._terminal and baud_of(self._terminal.slave) != self.baud_n:
            return
        if self._decoder.pending_n and now_s - self._last_byte_s > self._byte_gap_s:
            self._decoder.reset()
        self._last_byte_s = now_s
        errors_n = self._decoder.crc_errors_n
        packets = self._decoder.feed(data)
        packets = [p for p in packets if not self._strikes("drop_requests")]
        if packets:
            for servo in self.servos:
                if servo.listens(now_s):
                    servo.note_traffic(now_s)
        self._advance()
        for packet in packets:
            self.requests_n += 1
            baud_n = self.baud_n
            if self._strikes("damage_requests"):
                self._send(encode_status(packet.packet_id, StatusError.CRC), now_s)
                continue
            ready_s = now_s + wire_s(len(packet.raw), baud_n)
            for servo, reply in answers(self.servos, packet, now_s):
                ready_s += servo.memory["return_delay_time"] * _RETURN_DELAY_STEP_S + wire_s(len(reply), baud_n)
                self._send(reply, ready_s - self._detour_s if self.wire_time else now_s)
        if self._answer_crc_errors and self._decoder.crc_errors_n > errors_n:
            self._send(encode_status(self.servos[0].servo_id, StatusError.CRC), now_s)

    def _send(self, reply: bytes, ready_s: float) -> None:
        """Send a status packet so that its last byte arrives at ``ready_s``, as far as the faults let it."""
        if self._strikes("drop"):
            return
        reply = self._mangled(reply)
        self.replies_n += 1
        ready_s += self._faults.get("delay", {}).get("seconds", 0.0)
        ahead_s = ready_s - self._clock.now_s()
        if "trickle" in self._faults:
            gap_s = self._faults["trickle"]["gap_s"]
            for index, byte in enumerate(reply):
                self._later(max(0.0, ahead_s) + index * gap_s, functools.partial(self._put, bytes((byte,))))
        elif ahead_s > (_SPIN_S if self.wire_time else 0.0):
            early_s = _SPIN_S if self.wire_time else 0.0
            self._later(ahead_s - early_s, functools.partial(self._put_at, reply, ready_s))
        else:
            self._put_at(reply, ready_s)

    def _mangled(self, reply: bytes) -> bytes:
        if "foreign_id" in self._faults:
            head = reply[:4] + bytes((int(self._faults["foreign_id"]["servo_id"]),)) + reply[5:-2]
            reply = head + crc16(head).to_bytes(2, "little")
        if self._strikes("flip"):
            at = self._random.randrange(len(reply) * 8)
            reply = reply[: at // 8] + bytes((reply[at // 8] ^ 1 << at % 8,)) + reply[at // 8 + 1 :]
        if self._strikes("truncate"):
            reply = reply[: self._random.randrange(1, len(reply))]
        if "babble" in self._faults:
            reply = reply[:5] + int(self._faults["babble"]["length"]).to_bytes(2, "little") + reply
        if "collide" in self._faults and len(reply) > _PLAIN_REPLY_BYTES:
            # Neither wins the line: a bit that one of them pulls low is low.
            other = reply[:9] + self._random.randbytes(len(reply) - 9)
            reply = bytes(one & two for one, two in zip(reply, other, strict=True))
        if "twin" in self._faults:
            reply += reply
        if "noise" in self._faults:
            reply = self._random.randbytes(int(self._faults["noise"]["bytes_n"])) + reply
        return reply

    def _put_at(self, data: bytes, ready_s: float) -> None:
        if self.wire_time:
            busy_until(self._clock, ready_s)
        self._put(data)
        if self._linger_s:
            self._linger()

    def _linger(self) -> None:
        """Look out for the next request without going to sleep, so that our own waking up is not part of it."""
        heard = bytearray()

        def came() -> bool:
            heard.extend(self._take())
            return bool(heard)

        if busy_until(self._clock, self._clock.now_s() + self._linger_s, came):
            asyncio.get_running_loop().call_soon(self._receive, bytes(heard))

    def _put(self, data: bytes) -> None:
        if self._master >= 0:
            with contextlib.suppress(BlockingIOError, OSError):  # nobody reads: the bytes are gone, as on a wire
                os.write(self._master, data)

    def _later(self, delay_s: float, action: Callable[[], None]) -> None:
        def run() -> None:
            self._timers.discard(timer)
            action()

        timer = asyncio.get_running_loop().call_later(delay_s, run)
        self._timers.add(timer)


BITS_PER_BYTE = 10
"""8N1: start bit, eight data bits, stop bit."""

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_TCGETS2 = 0x802C542A  # Linux, asm-generic: read struct termios2, whose last two words are the speeds
_TERMIOS2 = struct.Struct("=4I20B2I")


def wire_s(bytes_n: int, baud_n: int) -> float:
    """Seconds that many bytes take on the wire."""
    return bytes_n * BITS_PER_BYTE / baud_n


def baud_of(fd: int) -> int:
    """Output speed set on a terminal, bits per second, arbitrary rates included.

    Raises:
        OSError: ``fd`` is no terminal, or the system is not Linux.
    """
    words = _TERMIOS2.unpack(fcntl.ioctl(fd, _TCGETS2, bytes(_TERMIOS2.size)))
    return int(words[-1])


def busy_until(clock: Clock, at_s: float, ready: Callable[[], bool] = bool) -> bool:
    """Spin until ``at_s``, or until ``ready()`` is true; for waits shorter than a timer can do. Returns ``ready()``."""
    while clock.now_s() < at_s:
        if ready():
            return True
    return False


def pty_round_trip_s(master: int, slave: int, rounds_n: int = 64) -> float:
    """What a byte needs through the pty and another one back, median, without anybody having to be woken up.

    A real adapter has no such detour: who imitates wire time takes it off. Both ends must be raw and nobody else may
    read them yet.
    """
    times_s = []
    blocking = os.get_blocking(master), os.get_blocking(slave)
    os.set_blocking(master, False)
    os.set_blocking(slave, False)
    for _ in range(rounds_n):
        began_s = time.perf_counter()
        for write_to, read_from in ((slave, master), (master, slave)):
            os.write(write_to, b"\0")
            while True:
                try:
                    if os.read(read_from, 1):
                        break
                except BlockingIOError:
                    continue
        times_s.append(time.perf_counter() - began_s)
    os.set_blocking(master, blocking[0])
    os.set_blocking(slave, blocking[1])
    return sorted(times_s)[rounds_n // 2]


def realtime_timers() -> None:
    """Ask Linux not to round this thread's sleeps (default slack: 50 µs). Without effect elsewhere."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
