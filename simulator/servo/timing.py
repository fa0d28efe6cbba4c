"""Time on the wire, and what speed a client has set on the pty."""

from __future__ import annotations

import ctypes
import fcntl
import os
import struct
import time
from collections.abc import Callable

from graderd.hal.clock import Clock

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


def busy_until(clock: Clock, at_s: float, look: Callable[[], bool] = bool) -> bool:
    """Spin until ``at_s``, or until ``look()`` is true; for waits shorter than a timer can do. Returns ``look()``."""
    while clock.now_s() < at_s:
        if look():
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
