"""A loop of wire on a serial port's modem lines: an output (RTS or DTR) drives it, an input (CTS, DSR or CD) reads it.

Any USB serial adapter with these lines will do (RS-232 or TTL). Lines and ioctls: tty_ioctl(4), TIOCMGET and TIOCMSET,
through pyserial. The loop starts at the output, goes through the normally closed contacts and ends at the input.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import serial

from graderd.hal.errors import DeviceLostError, DeviceMissingError
from graderd.hal.settings import StopInputSettings

FOLLOW_S = 0.03
"""USB adapters tell a changed line after some 1 to 16 ms."""
_LOOK_EVERY_S = 0.001


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


class SerialStopInput:
    """See the module's text. ``open_port`` and ``sleep`` are for tests."""

    def __init__(
        self,
        settings: StopInputSettings,
        open_port: Callable[[str], ModemPort] = _open_port,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._settings = settings
        self._open_port = open_port
        self._sleep = sleep
        self._port: ModemPort | None = None

    @property
    def where(self) -> str:
        """Port and line, for people."""
        return f"{self._settings.port} {self._settings.line.upper()}"

    def open(self) -> None:
        """See the contract."""
        self.close()
        try:
            self._port = self._open_port(self._settings.port)
            self._drive(self._port, True)
            self._read(self._port)
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            self.close()
            raise DeviceMissingError(
                self.where, f"cannot be used as stop input ({error})", "Check its cable and stop_input.port"
            ) from error

    def is_closed(self) -> bool:
        """See the contract."""
        return self._guarded(self._read)

    def follows(self) -> bool:
        """See the contract."""
        return self._guarded(self._pulse)

    def close(self) -> None:
        """See the contract."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _guarded(self, ask: Callable[[ModemPort], bool]) -> bool:
        if self._port is None:
            raise DeviceLostError(self.where, "is not open")
        try:
            return ask(self._port)
        except OSError as error:
            self.close()
            raise DeviceLostError(self.where, f"is gone ({error})", "Plug the adapter in again") from error

    def _read(self, port: ModemPort) -> bool:
        return bool(getattr(port, self._settings.line))

    def _drive(self, port: ModemPort, on: bool) -> None:
        setattr(port, self._settings.drive, on)

    def _pulse(self, port: ModemPort) -> bool:
        try:
            self._drive(port, False)
            opened = self._becomes(port, False)
        finally:
            self._drive(port, True)
        # Back before the next look at the loop, or the pulse itself would be taken for a press.
        self._becomes(port, True)
        return opened

    def _becomes(self, port: ModemPort, wanted: bool) -> bool:
        for _ in range(round(FOLLOW_S / _LOOK_EVERY_S)):
            if self._read(port) is wanted:
                return True
            self._sleep(_LOOK_EVERY_S)
        return False
