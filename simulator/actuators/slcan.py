"""A pseudo-terminal that behaves as an slcan (Lawicel) USB adapter on a virtual wire."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Final

from graderd.drivers.j1939.ids import Frame
from graderd.simulator.actuators.wire import Wire
from graderd.simulator.terminal import LinkedTerminal

_OK: Final = b"\r"
_ERROR: Final = b"\a"
_MAX_LINE: Final = 64


class SlcanAdapter:
    """One host, one adapter: commands ``S s O L C V v N F Z M m t T r R``, answers ``CR``, ``BEL``, ``z`` and ``Z``.

    ``link`` is a symbolic link to the terminal, replaced at every :meth:`plug`. Frames pass only after ``O`` or ``L``.
    """

    def __init__(self, wire: Wire, link: Path) -> None:
        self._wire = wire
        self._link = link
        self._terminal: LinkedTerminal | None = None
        self._master_fd = -1
        self._open = False
        self._listen_only = False
        self._line = bytearray()
        self._unsent = b""
        self._deaf = False
        self._bitrate_code = b""
        self._booted_at_s: float | None = None
        self.boot_s = 0.0
        """A board that resets when its port is opened: so long after the first byte it hears nothing."""
        self.refusing = False
        """Whether every frame is answered NACK."""
        self.echoing = False
        """Whether the host gets its own frames back, as self-reception does."""
        self.dropped_n = 0
        """Frames lost because the host did not read."""
        self.commands: list[str] = []
        """The newest commands of the host other than frames, at most 50."""
        self._hear = self._on_frame

    @property
    def plugged(self) -> bool:
        """Whether the terminal exists."""
        return self._master_fd >= 0

    @property
    def is_open(self) -> bool:
        """Whether the host opened the channel."""
        return self._open

    def plug(self) -> None:
        """Create the terminal and point the link to it."""
        if self.plugged:
            return
        self._terminal = LinkedTerminal(self._link)
        self._master_fd = self._terminal.master
        asyncio.get_running_loop().add_reader(self._master_fd, self._on_readable)
        self._wire.attach(self._hear)

    def unplug(self) -> None:
        """Take the terminal away: the host sees a hang-up, the link is gone."""
        if self._terminal is None:
            return
        self._wire.detach(self._hear)
        asyncio.get_running_loop().remove_reader(self._master_fd)
        self._terminal.close()
        self._terminal, self._master_fd = None, -1
        self._open = False
        self._booted_at_s = None
        self._unsent = b""
        self._line.clear()

    def reset(self) -> None:
        """Forget that the channel is open, as a board does whose supply failed for a moment."""
        self._open = False
        self._line.clear()

    def set_deaf(self, deaf: bool) -> None:
        """Stop reading what the host sends, as a hung adapter does; its buffer then fills up."""
        if not self.plugged or deaf == self._deaf:
            return
        self._deaf = deaf
        loop = asyncio.get_running_loop()
        if deaf:
            loop.remove_reader(self._master_fd)
        else:
            loop.add_reader(self._master_fd, self._on_readable)

    def send_line(self, line: bytes) -> None:
        """Send a raw line (``sb128256`` bus-off, ``e1c`` error report …) to the host; CR is added."""
        self._write(line + _OK)

    def _write(self, data: bytes) -> None:
        """Hand a whole line to the host, or none of it where its buffer is full; a line begun is finished first."""
        if not self.plugged:
            return
        if self._unsent:
            self._unsent = self._unsent[self._try_to_write(self._unsent) :]
        if self._unsent:
            self.dropped_n += 1
            return
        written_n = self._try_to_write(data)
        if written_n == 0:
            self.dropped_n += 1
        else:
            self._unsent = data[written_n:]

    def _try_to_write(self, data: bytes) -> int:
        try:
            return os.write(self._master_fd, data)
        except BlockingIOError:
            return 0

    def _on_frame(self, frame: Frame) -> None:
        if not self._open:
            return
        head = f"T{frame.can_id:08X}" if frame.extended else f"t{frame.can_id:03X}"
        self._write(f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode())

    def _on_readable(self) -> None:
        try:
            data = os.read(self._master_fd, 4096)
        except (BlockingIOError, OSError):
            return
        now_s = asyncio.get_running_loop().time()
        if self._booted_at_s is None:
            self._booted_at_s = now_s + self.boot_s
        if now_s < self._booted_at_s:
            return
        for byte in data:
            if byte == 0x0D:
                line, self._line = bytes(self._line), bytearray()
                self._write(self._answer(line))
                if not self.plugged:
                    return
            elif len(self._line) < _MAX_LINE:
                self._line.append(byte)

    def _answer(self, line: bytes) -> bytes:
        if not line:
            return _OK
        command = line[:1]
        if command in b"tTrR":
            return self._on_frame_line(line)
        self.commands = [*self.commands[-49:], line.decode("ascii", "replace")]
        match command:
            case b"O" | b"L":
                if self._open:
                    return _ERROR
                self._open, self._listen_only = True, command == b"L"
                return _OK
            case b"C":
                self._open = False
                return _OK
            case b"S" | b"s":
                if self._open:
                    return _ERROR
                self._bitrate_code = line
                return _OK
            case b"V":
                return b"V1013\r"
            case b"v":
                return b"v0107\r"
            case b"N":
                return b"NGRDR\r"
            case b"F":
                return b"F00\r" if self._open else _ERROR
            case b"Z" | b"M" | b"m" | b"X" | b"W":
                return _ERROR if self._open else _OK
            case _:
                return _ERROR

    def _on_frame_line(self, line: bytes) -> bytes:
        extended = line[:1] in b"TR"
        digits = 8 if extended else 3
        try:
            can_id = int(line[1 : 1 + digits], 16)
            length = int(line[1 + digits : 2 + digits])
            data = bytes.fromhex(line[2 + digits : 2 + digits + 2 * length].decode("ascii"))
        except (ValueError, UnicodeDecodeError):
            return _ERROR
        if not self._open or self._listen_only or length > 8 or self.refusing:
            return _ERROR
        if line[:1] in b"tT":
            if len(data) != length:
                return _ERROR
            self._wire.send(Frame(can_id, data, extended), self._hear)
            if self.echoing:
                self._write(line + _OK)
        return b"Z\r" if extended else b"z\r"
