"""A steady grid of wake-ups for a task: from the kernel's timer where there is one, else from the event loop.

The event loop's own timers are rounded up to whole milliseconds and set anew each time; a timerfd keeps its grid in
the kernel and wakes the loop like any other file descriptor. (``os.timerfd_create`` exists from Python 3.13 on; until
then the C library is asked.)

A wake-up is late by what the scheduler and the event loop need, and never twice by the same. Where that matters, the
ticker wakes its task a little ahead of the grid: time to prepare what is to be done, and :meth:`Ticker.meet` to do it
on the point.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import sys
from typing import Final

_CLOCK_MONOTONIC: Final = 1
_TFD_TIMER_ABSTIME: Final = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


class Ticker:
    """Wakes every ``period_s``, by ``ahead_s`` early. ``kernel`` False: on the event loop's time, which tests may
    simulate, and on the point."""

    def __init__(self, period_s: float, *, kernel: bool, ahead_s: float = 0.0) -> None:
        self._period_s = period_s
        self._loop = asyncio.get_running_loop()
        self._start_s = self._loop.time()
        self._ticks_n = 0
        self._woken = asyncio.Event()
        self._fd = _timerfd(self._start_s + period_s - ahead_s, period_s) if kernel else -1
        if self._fd >= 0:
            self._loop.add_reader(self._fd, self._woken.set)

    @property
    def late_s(self) -> float:
        """How long ago the last wake-up's point of the grid was."""
        return max(0.0, self._loop.time() - self._start_s - self._ticks_n * self._period_s)

    def meet(self) -> None:
        """Spin for what is left until the point of the grid that the last wake-up belongs to (``ahead_s`` at most)."""
        if self._fd >= 0:
            at_s = self._start_s + self._ticks_n * self._period_s
            while self._loop.time() < at_s:
                pass

    async def wait(self) -> int:
        """Wait for the next point of the grid; how many there were since the last call (more than 1: some missed)."""
        if self._fd < 0:
            due_n = self._ticks_n + 1
            await asyncio.sleep(max(0.0, self._start_s + due_n * self._period_s - self._loop.time()))
            passed_n = max(due_n, int((self._loop.time() - self._start_s) / self._period_s)) - self._ticks_n
        else:
            passed_n = 0
            while not passed_n:
                await self._woken.wait()
                self._woken.clear()
                with contextlib.suppress(BlockingIOError):
                    passed_n = int.from_bytes(os.read(self._fd, 8), sys.byteorder)
        self._ticks_n += passed_n
        return passed_n

    def close(self) -> None:
        """End the timer; idempotent."""
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1


def _timerfd(first_s: float, period_s: float) -> int:
    """A periodic, non-blocking timerfd on the event loop's clock; -1 where the C library has none."""
    try:
        library = ctypes.CDLL(None, use_errno=True)
        create, settime = library.timerfd_create, library.timerfd_settime
    except (OSError, AttributeError):
        return -1
    fd = int(create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC))
    if fd < 0:
        return -1
    timing = _Itimerspec(_timespec(period_s), _timespec(first_s))
    if settime(fd, _TFD_TIMER_ABSTIME, ctypes.byref(timing), None) != 0:
        os.close(fd)
        return -1
    return fd


def _timespec(time_s: float) -> _Timespec:
    seconds = int(time_s)
    return _Timespec(seconds, int((time_s - seconds) * 1e9))
