"""python-can's slcan bus, made fit for an event loop."""

from __future__ import annotations

import collections
import errno
import fcntl
import os
import select

import can
from can.interfaces.slcan import slcanBus

from graderd.drivers.j1939.bus_health import BusEvent


class QuietSlcanBus(slcanBus):
    """python-can's slcan bus without its waits: no byte-wise reads, no drain after each write, state lines kept.

    The port is ours alone from before the first byte: a second opener would close the channel and take half the frames.

    The kernel's slcan driver knows two lines that python-can ignores: ``s<a|w|p|b>RRRTTT`` (controller state and
    error counters) and ``e<n><codes>`` (errors; ``o`` and ``O`` are overruns).
    """

    def __init__(self, channel: str, bitrate: int) -> None:
        self.events: collections.deque[BusEvent] = collections.deque(maxlen=64)
        self._lines: collections.deque[str] = collections.deque()
        self._unsent = bytearray()
        self._lock_fd = _lock(channel.partition("@")[0])
        try:
            super().__init__(channel, bitrate=bitrate, sleep_after_open=0.0, timeout=0)
        except BaseException:
            self._unlock()
            raise

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
        self._lines.extend(line.decode("ascii", "replace") + "\r" for line in lines if line and line != b"\a")

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
