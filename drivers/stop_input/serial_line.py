"""The stop loop on a serial port's modem lines: an output (RTS or DTR) drives it, an input (CTS, DSR or CD) reads it.

Any USB serial adapter with these lines will do (RS-232 or TTL). Lines and ioctls: tty_ioctl(4), TIOCMGET and TIOCMSET,
through pyserial.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import serial

from graderd.drivers.stop_input.loop import LoopStopInput
from graderd.hal.settings import StopInputSettings


class ModemPort(Protocol):
    """What is used of ``serial.Serial``."""

    rts: bool
    dtr: bool

    @property
    def cts(self) -> bool:
        """Clear to send."""
        ...

    @property
    def dsr(self) -> bool:
        """Data set ready."""
        ...

    @property
    def cd(self) -> bool:
        """Carrier detect."""
        ...

    def close(self) -> None:
        """Close the port."""
        ...


def _open_port(port: str) -> ModemPort:
    opened: ModemPort = serial.Serial(port, exclusive=True, timeout=0)
    return opened


class _ModemWire:
    """Two modem lines of an open port."""

    def __init__(self, port: ModemPort, settings: StopInputSettings) -> None:
        self._port = port
        self._settings = settings

    def drive(self, on: bool) -> None:
        setattr(self._port, self._settings.drive, on)

    def reads(self) -> bool:
        return bool(getattr(self._port, self._settings.line))

    def close(self) -> None:
        self._port.close()


class SerialStopInput(LoopStopInput):
    """See the module's text. ``open_port`` and ``sleep`` are for tests."""

    def __init__(
        self,
        settings: StopInputSettings,
        open_port: Callable[[str], ModemPort] = _open_port,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(
            f"{settings.port} {settings.line.upper()}",
            "stop_input.port",
            lambda: _ModemWire(open_port(settings.port), settings),
            sleep,
        )
