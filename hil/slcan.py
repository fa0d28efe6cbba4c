"""An emulated slcan USB adapter under the kernel's own slcan driver.

``Adapter`` holds a pseudo-terminal; its slave end gets the slcan line discipline, so the kernel makes a CAN interface
of it with bit rate, states and error counters. What the interface sends goes to a vcan that plays the wire, and back.
It can report what a real adapter would: no acknowledgement, error-passive, bus-off. Closing it is pulling the plug.

The adapter's lines are those of Lawicel's CAN232 manual (``T`` and ``t`` frames, ``S``, ``O``, ``C``); ``s…`` and
``e…`` are the state and error reports that Linux 6.0 and later understand (drivers/net/can/slcan/slcan-core.c).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import selectors
import socket
import struct
import termios
import tty
from threading import Lock, Thread
from types import TracebackType
from typing import Final, Self

N_SLCAN: Final = 17
SIOCGIFNAME: Final = 0x8910
EXTENDED: Final = 0x8000_0000
FRAME: Final = struct.Struct("=IB3x8s")

NO_ACKNOWLEDGE: Final = b"e1a\r"
ERROR_PASSIVE: Final = b"sp130130\r"
ERROR_ACTIVE: Final = b"sa000000\r"
BUS_OFF: Final = b"sb256256\r"


class Adapter:
    """One adapter between a new CAN interface (:attr:`interface`) and the wire, an existing vcan."""

    def __init__(self, wire: str) -> None:
        self.commands: list[str] = []
        """Every command the driver gave, in order: ``C``, ``S5``, ``O``."""
        self._off = False
        self._lock = Lock()
        self._wire = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._wire.bind((wire,))
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave, termios.TCSANOW)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = Thread(target=self._run, name=f"slcan adapter on {wire}", daemon=True)
        self._thread.start()
        fcntl.ioctl(self._slave, termios.TIOCSETD, struct.pack("i", N_SLCAN))
        name = fcntl.ioctl(self._slave, SIOCGIFNAME, bytes(32))
        self.interface = name.split(b"\0", 1)[0].decode()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()

    @property
    def bitrate_code(self) -> str:
        """The ``S`` command given last, for example ``S5`` (250 kbit/s); empty before the first."""
        return next((command for command in reversed(self.commands) if command.startswith("S")), "")

    def report(self, line: bytes) -> None:
        """Give the driver one of the reports above. After :data:`BUS_OFF` no frame passes until it opens again."""
        with self._lock:
            self._off = self._off or line == BUS_OFF
            os.write(self._master, line)

    def unplug(self) -> None:
        """Close the terminal: the kernel takes the interface away. Idempotent."""
        if self._master < 0:
            return
        os.write(self._wake_write, b"x")
        self._thread.join()
        # The master goes first: that is the hang-up the driver sees.
        for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._master = -1
        self._wire.close()

    def _run(self) -> None:
        rest = b""
        with selectors.DefaultSelector() as selector:
            for source in (self._master, self._wire.fileno(), self._wake_read):
                selector.register(source, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    if key.fd == self._wake_read:
                        return
                    if key.fd == self._master:
                        *lines, rest = (rest + os.read(self._master, 4096)).split(b"\r")
                        for line in lines:
                            self._from_driver(line.decode("ascii", "replace"))
                    else:
                        self._from_wire(self._wire.recv(FRAME.size))

    def _from_driver(self, line: str) -> None:
        kind = line[:1]
        if kind in ("T", "t") and not self._off:
            digits = 8 if kind == "T" else 3
            can_id = int(line[1 : 1 + digits], 16) | (EXTENDED if kind == "T" else 0)
            length = int(line[1 + digits])
            data = bytes.fromhex(line[2 + digits : 2 + digits + 2 * length])
            # A full queue on the wire is a lost frame there, as it would be on copper.
            with contextlib.suppress(OSError):
                self._wire.send(FRAME.pack(can_id, length, data))
        elif kind and kind not in "Tt":
            self.commands.append(line)
            if kind == "O":
                self._off = False

    def _from_wire(self, frame: bytes) -> None:
        can_id, length, data = FRAME.unpack(frame)
        head = f"T{can_id & 0x1FFFFFFF:08X}" if can_id & EXTENDED else f"t{can_id & 0x7FF:03X}"
        with self._lock:
            if not self._off:
                os.write(self._master, f"{head}{length}{data[:length].hex().upper()}\r".encode("ascii"))
