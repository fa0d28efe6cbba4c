"""Serial ports: find the servo's adapter again after a replug, open it, and ask it not to hold bytes back."""

from __future__ import annotations

import errno
import logging
import re
import termios
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

import serial
import serial.tools.list_ports

from graderd.hal.errors import DeviceLostError, DeviceMissingError, DeviceRefusedError

log = logging.getLogger(__name__)


class PortInfo(Protocol):
    """What we use of pyserial's ``ListPortInfo``."""

    device: str
    serial_number: str | None


ListPorts = Callable[[], Iterable[PortInfo]]


def system_ports() -> Iterable[PortInfo]:
    """The machine's serial ports, as pyserial lists them."""
    ports: Iterable[PortInfo] = serial.tools.list_ports.comports()
    return ports


def find_port(port: str, usb_serial_number: str, list_ports: ListPorts = system_ports) -> str:
    """The port to open: by USB serial number where one is given, wherever the adapter is plugged in now.

    Raises:
        DeviceMissingError: no adapter with that serial number is plugged in; the message lists those that are.
    """
    if not usb_serial_number:
        return port
    seen = list(list_ports())
    for info in seen:
        if info.serial_number == usb_serial_number:
            return info.device
    present = ", ".join(f"{i.serial_number} at {i.device}" for i in seen if i.serial_number) or "none"
    raise DeviceMissingError(
        "servo adapter",
        f"no USB serial adapter with serial number {usb_serial_number!r} (present: {present})",
        "Plug it in, or correct rotation.usb_serial_number",
    )


def open_port(port: str, baud_n: int) -> serial.Serial:
    """Open ``port`` for us alone, raw, non-blocking; nothing is sent and no modem line is touched on purpose.

    Raises:
        DeviceMissingError: no such port, no right to open it, or another program holds it.
        DeviceRefusedError: the adapter cannot do ``baud_n``.
    """
    try:
        opened = serial.Serial(port, baud_n, timeout=0, write_timeout=0, exclusive=True)
    except serial.SerialException as e:
        raise DeviceMissingError(port, *_open_failure(e)) from e
    except (ValueError, OSError, termios.error) as e:
        raise DeviceRefusedError(port, f"the adapter refuses {baud_n} bit/s ({e})", "Choose another baud_n") from e
    try:
        # pyserial leaves VMIN 0, where "no byte yet" and "cable pulled" both read as b""; with 1 they differ.
        attributes = termios.tcgetattr(opened.fileno())
        attributes[6][termios.VMIN] = 1
        attributes[6][termios.VTIME] = 0
        termios.tcsetattr(opened.fileno(), termios.TCSANOW, attributes)
    except termios.error as e:
        opened.close()
        raise DeviceLostError(port, f"vanished while being opened ({e})") from e
    return opened


def _open_failure(error: serial.SerialException) -> tuple[str, str]:
    number = error.errno
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return "no such serial port", "Check the USB cable and rotation.port"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission to open it", "Add the user to the port's group (dialout), or install the udev rule"
    if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
        return "another program has the port open", "Stop that program; only one may own the servo's wire"
    return f"cannot be opened ({error})", "Check the USB cable and rotation.port"


def set_low_latency(opened: serial.Serial) -> bool:
    """Ask the driver to hand over bytes at once (FTDI: latency timer 16 ms -> 1 ms); whether it agreed.

    Ptys and many on-board UARTs know no such mode: there it is not needed and the answer is False.
    """
    try:
        opened.set_low_latency_mode(True)
    except (ValueError, OSError, NotImplementedError):  # the last is pyserial's word on systems that have no such mode
        return False
    return True


def latency_timer_ms(port: str, sysfs: Path = Path("/sys/bus/usb-serial/devices")) -> int | None:
    """The adapter's latency timer in ms, or None where it has none. 16 limits any client to about 60 requests/s."""
    name = Path(port).resolve().name
    try:
        text = (sysfs / name / "latency_timer").read_text(encoding="ascii")
    except OSError:
        return None
    return int(text) if re.fullmatch(r"\s*\d+\s*", text) else None
