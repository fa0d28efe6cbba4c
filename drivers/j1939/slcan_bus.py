"""python-can's slcan bus, made fit for an event loop."""

from __future__ import annotations

import collections
import errno
import fcntl
import os
import select
import time
from typing import Final

from graderd.drivers.j1939.bus_health import REFUSED_N, BusEvent
from graderd.drivers.j1939.python_can import can, slcanBus

_OPEN_AGAIN_S: Final = 0.5
"""An adapter that has not answered so long after it was told to open its channel is told again."""


class QuietSlcanBus(slcanBus):
    """python-can's slcan bus without its waits: no byte-wise reads, no drain after each write, state lines kept.

    The port is ours alone from before the first byte: a second opener would close the channel and take half the frames.

    The kernel's slcan driver knows two lines that python-can ignores: ``s<a|w|p|b>RRRTTT`` (controller state and
    error counters) and ``e<n><codes>`` (errors; ``o`` and ``O`` are overruns). An adapter that answers NACK (BEL) again
    and again has forgotten that its channel is open; it is opened anew.

    Raises:
        ValueError: no adapter knows this bit rate.
        CanInitializationError: no such port, no right to it, or another program has it.
    """

    def __init__(self, channel: str, bitrate: int) -> None:
        if bitrate not in self._BITRATES:
            raise ValueError(f"bit rate {bitrate}; slcan knows {', '.join(map(str, self._BITRATES))}")
        self._opening = ("C", self._BITRATES[bitrate], "O")
        self._answers_n = 0
        self._refused_n = 0
        self.events: collections.deque[BusEvent] = collections.deque(maxlen=64)
        self._lines: collections.deque[str] = collections.deque()
        self._unsent = bytearray()
        self._lock_fd = _lock(channel.partition("@")[0])
        try:
            super().__init__(channel, sleep_after_open=0.0, timeout=0)
            self._open_channel()
        except BaseException:
            self._unlock()
            raise

    def open(self) -> None:
        """Nothing: python-can opens before the bit rate is set, and then again."""

    def wait_open(self, timeout_s: float) -> bool:
        """Wait until the adapter has answered the opening of its channel; False where it does not.

        A board that resets when its port is opened hears nothing while it boots, so it is told again. There are
        adapters that never answer and work all the same.

        Raises:
            CanOperationError: the adapter is gone.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            again_s = min(time.monotonic() + _OPEN_AGAIN_S, deadline_s)
            while (left_s := again_s - time.monotonic()) > 0:
                select.select([self.serialPortOrig.fileno()], [], [], left_s)
                self._fill()
                if self._answers_n >= len(self._opening):
                    self.events.clear()  # closing what was not open is refused, and no news
                    self._refused_n = 0
                    return True
            if time.monotonic() >= deadline_s:
                return False
            self._open_channel()

    def _open_channel(self) -> None:
        self._answers_n = 0
        for command in self._opening:
            self._write(command)

    def _write(self, string: str) -> None:
        self._unsent += string.encode() + self.LINE_TERMINATOR
        try:
            while self._unsent:
                del self._unsent[: os.write(self.serialPortOrig.fileno(), self._unsent)]
        except BlockingIOError as error:
            # nothing of this line is on its way: forget it; a line begun must be finished first
            line_n = len(string) + 1
            if len(self._unsent) >= line_n:
                del self._unsent[-line_n:]
                raise can.CanOperationError("transmit buffer full", errno.ENOBUFS) from error
        except OSError as error:
            raise can.CanOperationError(f"cannot write: {error.strerror}", error.errno) from error

    def _read(self, timeout: float | None) -> str | None:  # noqa: ARG002  (python-can's signature; never waits)
        if not self._lines:
            self._fill()
        while self._lines:
            line = self._lines.popleft()
            if line[:1] == "s":
                self._note_state(line)
            elif line[:1] == "e":
                if set(line[2:]) & {"o", "O"}:
                    self.events.append(BusEvent.QUEUE_OVERRUN)
            else:
                return line
        return None

    @property
    def pending(self) -> bool:
        """Whether complete lines wait in this object."""
        return bool(self._lines or self.events)

    def shutdown(self) -> None:
        """Close the channel and the port, even where the adapter is gone."""
        try:
            super().shutdown()
        except (can.CanError, OSError):
            self.serialPortOrig.close()
        finally:
            self._unlock()

    def _unlock(self) -> None:
        if self._lock_fd >= 0:
            os.close(self._lock_fd)
            self._lock_fd = -1

    def _fill(self) -> None:
        try:
            data = os.read(self.serialPortOrig.fileno(), 4096)
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"cannot read: {error.strerror}", error.errno) from error
        if not data:
            # With VMIN 0 a terminal without input reads as empty too: only the hang-up flag tells them apart.
            if self._hung_up():
                raise can.CanOperationError("the adapter hung up", errno.ENODEV)
            return
        self._buffer += data.replace(b"\a", b"\a\r")
        *lines, rest = self._buffer.split(b"\r")
        self._buffer = bytearray(rest[-128:])
        for line in lines:
            if line.endswith(b"\a"):
                self._note_refusal()
            elif not line or bytes(line) in (b"z", b"Z"):
                self._answers_n += 1
                self._refused_n = 0
            else:
                self._lines.append(line.decode("ascii", "replace") + "\r")

    def _note_refusal(self) -> None:
        self._answers_n += 1
        self._refused_n += 1
        self.events.append(BusEvent.REFUSED)
        if self._refused_n % REFUSED_N == 0:
            self._open_channel()

    def _hung_up(self) -> bool:
        poller = select.poll()
        poller.register(self.serialPortOrig.fileno(), select.POLLIN)
        return any(flags & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, flags in poller.poll(0))

    def _note_state(self, line: str) -> None:
        event = {
            "a": BusEvent.ERROR_ACTIVE,
            "w": BusEvent.ERROR_ACTIVE,
            "p": BusEvent.ERROR_PASSIVE,
            "b": BusEvent.BUS_OFF,
        }.get(line[1:2])
        if event is not None:
            self.events.append(event)


def _lock(port: str) -> int:
    """A descriptor whose lock on the port (the one that pyserial's exclusive mode takes too) lasts until it is closed.

    Raises:
        CanInitializationError: no such port, no right to it, or another program has it.
    """
    try:
        fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise can.CanInitializationError(f"{port}: {error.strerror}", error.errno) from error
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(fd)
        if error.errno == errno.EWOULDBLOCK:
            raise can.CanInitializationError("another program has it open", errno.EBUSY) from error
        raise can.CanInitializationError(f"{port}: {error.strerror}", error.errno) from error
    return fd
