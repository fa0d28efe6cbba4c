"""The in-process CAN wire that virtual actuators, adapters and test peers share."""

from __future__ import annotations

import collections
import contextlib
import os
import time
from collections.abc import Callable
from typing import Final

from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.python_can import can

_QUEUE_N: Final = 2000

Listener = Callable[[Frame], None]


class Wire:
    """A bus without delay: a frame sent by one node is heard by all others, in order.

    Frames sent while another is being delivered wait their turn, so that all nodes see one order.
    """

    def __init__(self) -> None:
        self._nodes: list[Listener] = []
        self._pending: collections.deque[tuple[Frame, Listener | None]] = collections.deque()
        self._delivering = False
        self.frames_n = 0
        """Frames carried so far."""

    def attach(self, listener: Listener) -> None:
        """Let ``listener`` hear every frame it did not send itself."""
        self._nodes.append(listener)

    def detach(self, listener: Listener) -> None:
        """Take a listener off; no error where it is not attached."""
        if listener in self._nodes:
            self._nodes.remove(listener)

    def send(self, frame: Frame, sender: Listener | None = None) -> None:
        """Put a frame on the bus; ``sender`` does not hear it."""
        self._pending.append((frame, sender))
        if self._delivering:
            return
        self._delivering = True
        try:
            while self._pending:
                item, origin = self._pending.popleft()
                self.frames_n += 1
                for node in tuple(self._nodes):
                    if node != origin:  # not "is": each access to a bound method makes a new object
                        node(item)
        finally:
            self._delivering = False


class WireBus(can.BusABC):
    """A python-can bus on a :class:`Wire`, with a file descriptor that becomes readable. One event loop only."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._queue: collections.deque[can.Message] = collections.deque()
        self._read_fd, self._write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._hear: Listener = self._on_frame
        self._failure: can.CanError | None = None
        self.lost_n = 0
        self.channel_info = "in-process wire"
        self._can_protocol = can.CanProtocol.CAN_20
        wire.attach(self._hear)
        super().__init__(channel="in-process")

    def fail(self, error: can.CanError) -> None:
        """Let every further call fail with ``error``, as when the interface goes down."""
        self._failure = error
        self._wake()

    def deliver(self, message: can.Message) -> None:
        """Hand a message (an error frame, for example) to this bus alone."""
        if len(self._queue) >= _QUEUE_N:
            self.lost_n += 1
            return
        if not self._queue:
            self._wake()
        self._queue.append(message)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002  (python-can's signature)
        """Put a message on the wire."""
        if self._failure:
            raise self._failure
        if self._write_fd < 0:
            raise can.CanOperationError("the bus is shut down")
        self._wire.send(Frame(msg.arbitration_id, bytes(msg.data), msg.is_extended_id), self._hear)

    def fileno(self) -> int:
        """Readable while messages wait."""
        return self._read_fd

    def shutdown(self) -> None:
        """Leave the wire; idempotent."""
        if self._write_fd >= 0:
            self._wire.detach(self._hear)
            os.close(self._read_fd)
            os.close(self._write_fd)
            self._read_fd = self._write_fd = -1
        super().shutdown()

    def _on_frame(self, frame: Frame) -> None:
        self.deliver(
            can.Message(
                arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended, timestamp=time.time()
            )
        )

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):  # the pipe is full, so the reader is awake anyway
            os.write(self._write_fd, b"\0")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:  # noqa: ARG002  (as above)
        if self._failure:
            raise self._failure
        if not self._queue:
            return None, False
        message = self._queue.popleft()
        if not self._queue:
            with contextlib.suppress(BlockingIOError):
                os.read(self._read_fd, 4096)
        return message, False
