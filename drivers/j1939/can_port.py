"""Ways onto a CAN bus: any python-can bus made readable by the event loop, with its troubles told apart.

python-can's own asyncio ``Notifier`` loses exceptions, so its readers wait for ever once an interface is gone. Here a
port is a file descriptor and three calls that never block; every failure is a :class:`PortLostError` with a condition
name of the fault catalogue, every controller state a :class:`BusEvent`.
"""

from __future__ import annotations

import collections
import contextlib
import errno
import os
import select
import socket
import struct
from pathlib import Path
from typing import ClassVar, Final, Literal

from graderd.drivers.j1939.bus_health import ERROR_FRAMES, BusEvent, event_of
from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.python_can import SocketcanBus, can
from graderd.drivers.j1939.slcan_bus import QuietSlcanBus
from graderd.hal.errors import DeviceMissingError
from graderd.hal.settings import CanSettings

_SYS_NET: Final = Path("/sys/class/net")
_IFF_UP: Final = 1
_SO_RXQ_OVFL: Final = 40
_BRIDGE_N: Final = 4000
_READ_N: Final = 8
"""Frames taken in one go: a quarter of a millisecond. A flood, or what piled up in a slow adapter, keeps neither the
event loop nor the next control message waiting."""

LostCondition = Literal["interface_down", "unplugged"]


class PortLostError(Exception):
    """The way onto the bus is gone. ``condition`` is ``interface_down`` or ``unplugged``."""

    def __init__(self, condition: LostCondition, detail: str) -> None:
        super().__init__(condition, detail)
        self.condition: LostCondition = condition
        self.detail = detail


class PortFullError(Exception):
    """The transmit queue is full; the frame was not sent."""


def lost_from(error: BaseException) -> PortLostError:
    """Tell by the error number whether the interface is down or gone."""
    number = getattr(error, "error_code", None) or getattr(error, "errno", None)
    if number is None and error.__cause__ is not None:
        number = getattr(error.__cause__, "errno", None)
    condition: LostCondition = "interface_down" if number == errno.ENETDOWN else "unplugged"
    return PortLostError(condition, str(error) or type(error).__name__)


class BusPort:
    """Any python-can bus with a file descriptor; without one, a thread carries its frames to a pipe.

    ``refuses_later``: a frame that :meth:`send` took may be refused afterwards, by a :attr:`BusEvent.REFUSED`.
    """

    refuses_later: ClassVar[bool] = False

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self.rx_lost_n = 0
        self._bridge: _Bridge | None = None
        try:
            self._fd = bus.fileno()
        except NotImplementedError:  # python-can's word for a bus without a descriptor
            self._fd = -1
        if self._fd < 0:
            self._bridge = _Bridge(bus)
            self._fd = self._bridge.fileno()

    def fileno(self) -> int:
        """Readable when frames wait or the port is lost."""
        return self._fd

    def wait_ready(self, timeout_s: float) -> bool:  # noqa: ARG002  (only an adapter has to be waited for)
        """Block until frames can be sent; False where that is not known after ``timeout_s``.

        Raises:
            PortLostError: the interface or adapter is gone.
        """
        return True

    def read(self) -> list[Frame | BusEvent]:
        """Some of the frames and events that wait, without blocking; see :attr:`pending`.

        Raises:
            PortLostError: the interface or adapter is gone.
        """
        return [item for message in self.read_messages() if (item := from_message(message)) is not None]

    def read_messages(self) -> list[can.Message]:
        """As :meth:`read`, and everything as python-can tells it.

        Raises:
            PortLostError: the interface or adapter is gone.
        """
        if self._bridge is not None:
            return self._bridge.read()
        out: list[can.Message] = []
        try:
            for _ in range(_READ_N):
                message = self.bus.recv(0)
                if message is not None:
                    out.append(message)
                elif not self._more():
                    break
        except (can.CanError, OSError) as error:
            raise lost_from(error) from error
        except ValueError:
            pass  # a garbled line of a serial adapter: that frame is lost
        return out

    @property
    def pending(self) -> bool:
        """Whether something is left that does not make the descriptor readable."""
        return False

    def send(self, frame: Frame) -> None:
        """Send one frame without blocking.

        Raises:
            PortFullError: the transmit queue is full.
            PortLostError: the interface or adapter is gone.
        """
        message = can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended)
        try:
            self.bus.send(message, timeout=0)
        except (can.CanError, OSError) as error:
            number = getattr(error, "error_code", None) or getattr(error, "errno", None)
            if number in (errno.ENOBUFS, errno.EAGAIN) or "buffer full" in str(error).lower():
                raise PortFullError(str(error)) from error
            raise lost_from(error) from error

    def close(self) -> None:
        """Let go of the bus; idempotent, no error leaves it."""
        if self._bridge is not None:
            self._bridge.close()
        with contextlib.suppress(can.CanError, OSError, ValueError):
            self.bus.shutdown()

    def _more(self) -> bool:
        """Whether the descriptor still has something; raises where it has hung up."""
        poller = select.poll()
        poller.register(self._fd, select.POLLIN)
        events = poller.poll(0)
        if not events:
            return False
        flags = events[0][1]
        if flags & (select.POLLHUP | select.POLLERR | select.POLLNVAL) and not flags & select.POLLIN:
            raise PortLostError("unplugged", "the adapter hung up")
        return bool(flags & select.POLLIN)


class SocketCanPort(BusPort):
    """A SocketCAN bus, read straight from its socket: several times cheaper than one python-can message each."""

    _HEAD: Final = struct.Struct("=IB3x8s")

    def __init__(self, bus: SocketcanBus) -> None:
        super().__init__(bus)
        self._socket: socket.socket = bus.socket
        self._dropped_n = 0
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)

    def read(self) -> list[Frame | BusEvent]:
        """As :meth:`BusPort.read`; frames the kernel dropped give a queue overrun."""
        out: list[Frame | BusEvent] = []
        try:
            for _ in range(_READ_N):
                data, ancillary, _, _ = self._socket.recvmsg(72, 128, socket.MSG_DONTWAIT)
                if len(data) < self._HEAD.size:
                    continue
                raw_id, length, payload = self._HEAD.unpack_from(data)
                if raw_id & socket.CAN_ERR_FLAG:
                    event = event_of(raw_id & socket.CAN_ERR_MASK, payload)
                    if event is not None:
                        out.append(event)
                elif not raw_id & socket.CAN_RTR_FLAG:
                    extended = bool(raw_id & socket.CAN_EFF_FLAG)
                    mask = socket.CAN_EFF_MASK if extended else socket.CAN_SFF_MASK
                    out.append(Frame(raw_id & mask, payload[: min(length, 8)], extended))
                if self._overrun(ancillary):
                    out.append(BusEvent.QUEUE_OVERRUN)
        except BlockingIOError:
            pass
        except OSError as error:
            raise lost_from(error) from error
        return out

    def _overrun(self, ancillary: list[tuple[int, int, bytes]]) -> bool:
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL:
                total_n = int.from_bytes(value[:4], "little")
                new_n, self._dropped_n = total_n - self._dropped_n, total_n
                self.rx_lost_n += max(0, new_n)
                return new_n > 0
        return False


class SlcanPort(BusPort):
    """An slcan adapter on a serial port or pseudo-terminal."""

    refuses_later = True

    def __init__(self, bus: QuietSlcanBus) -> None:
        super().__init__(bus)
        self._slcan = bus

    def wait_ready(self, timeout_s: float) -> bool:
        """As :meth:`BusPort.wait_ready`: until the adapter has opened its channel."""
        try:
            return self._slcan.wait_open(timeout_s)
        except can.CanError as error:
            raise lost_from(error) from error

    def read(self) -> list[Frame | BusEvent]:
        """As :meth:`BusPort.read`, with the adapter's state lines and NACKs as events."""
        out = super().read()
        while self._slcan.events:
            out.append(self._slcan.events.popleft())
        return out

    @property
    def pending(self) -> bool:
        """Whether lines are left that were read from the port already."""
        return self._slcan.pending

    def _more(self) -> bool:
        return self._slcan.pending or super()._more()


def from_message(message: can.Message) -> Frame | BusEvent | None:
    """A python-can message as a frame or event; None for remote and FD frames, and error frames without news."""
    if message.is_error_frame:
        return event_of(message.arbitration_id, bytes(message.data))
    if message.is_remote_frame or message.is_fd:  # J1939 knows neither
        return None
    return Frame(message.arbitration_id, bytes(message.data), message.is_extended_id)


READY_S: Final = 2.5
"""A board that resets when its port is opened takes one to two seconds to boot."""


def open_port(settings: CanSettings, *, fd: bool = False) -> BusPort:
    """Open the bus of the settings; where it is an adapter that boots first, see :meth:`BusPort.wait_ready`.

    May take some milliseconds; call it off the event loop. ``fd``: hear CAN FD frames too, by ``read_messages``.

    Raises:
        DeviceMissingError: no such interface or port, it is down, or this kernel has no CAN.
    """
    where = f"CAN {settings.interface} {settings.channel}"
    if settings.interface == "virtual":
        return BusPort(can.Bus(interface="virtual", channel=settings.channel))
    try:
        if settings.interface == "socketcan":
            _check_interface(where, settings.channel)
            bus = SocketcanBus(channel=settings.channel, fd=fd)
            # python-can's own reader fails at a count of dropped frames, which SocketCanPort asks the kernel for.
            return BusPort(bus) if fd else SocketCanPort(bus)
        return SlcanPort(QuietSlcanBus(settings.channel, settings.bitrate_n))
    except (can.CanError, OSError, ValueError) as error:
        remedy = "Is the adapter plugged in, and may this user open it (group dialout)?"
        if getattr(error, "error_code", None) == errno.EBUSY:
            remedy = "An adapter has one reader; a running graderd shares it: 'graderd can dump' without a port"
        if getattr(error, "errno", None) == errno.EAFNOSUPPORT:
            remedy = "This kernel has no CAN support: modprobe can_raw, or use an slcan adapter (interface = 'slcan')"
        raise DeviceMissingError(where, f"cannot be opened: {error}", remedy) from error


def _check_interface(where: str, channel: str) -> None:
    flags_file = _SYS_NET / channel / "flags"
    try:
        flags = int(flags_file.read_text(encoding="ascii"), 16)
    except (OSError, ValueError):
        known = sorted(path.name for path in _SYS_NET.glob("*can*")) if _SYS_NET.exists() else []
        remedy = f"CAN interfaces here: {', '.join(known)}" if known else "This machine has no CAN interface now"
        raise DeviceMissingError(where, "no such network interface", remedy) from None
    if not flags & _IFF_UP:
        raise DeviceMissingError(where, "the interface is down", f"ip link set {channel} up type can bitrate 250000")


class _Bridge(can.Listener):
    """Carries the messages of a bus without a file descriptor from python-can's thread to a pipe."""

    def __init__(self, bus: can.BusABC) -> None:
        self._messages: collections.deque[can.Message] = collections.deque(maxlen=_BRIDGE_N)
        self._error: BaseException | None = None
        self._read_fd, self._write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._notifier = can.Notifier(bus, [self], timeout=0.05)

    def fileno(self) -> int:
        return self._read_fd

    def read(self) -> list[can.Message]:
        with contextlib.suppress(BlockingIOError):
            os.read(self._read_fd, 4096)
        out: list[can.Message] = []
        while self._messages and len(out) < _READ_N:
            out.append(self._messages.popleft())
        if self._messages:
            self._wake()
        elif self._error is not None and not out:
            raise lost_from(self._error) from self._error
        return out

    def close(self) -> None:
        self._notifier.stop(timeout=1.0)
        for fd in (self._read_fd, self._write_fd):
            with contextlib.suppress(OSError):
                os.close(fd)

    def on_message_received(self, msg: can.Message) -> None:
        if len(self._messages) == _BRIDGE_N:
            class_bits, data = ERROR_FRAMES[BusEvent.QUEUE_OVERRUN]
            msg = can.Message(arbitration_id=class_bits, data=data, is_error_frame=True)
        self._messages.append(msg)
        self._wake()

    def on_error(self, exc: Exception) -> None:
        self._error = exc  # whatever ended the thread is raised to the reader, never lost with it
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):
            os.write(self._write_fd, b"\0")
