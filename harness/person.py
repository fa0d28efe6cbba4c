"""A person at a terminal, for tests and recordings: reads what a command shows on a real pseudo-terminal, and types.

What is shown can be kept as an asciinema recording (asciicast v2, which is text: one JSON array an output).
"""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

CONTROL = re.compile(r"\x1b(\[[0-9;?<>=]*[A-Za-z]|\][^\x07]*\x07|[()][A-Z0-9]|[=>78])|\r")


class PersonError(AssertionError):
    """What was waited for was not shown."""


class Person:
    """Somebody at a terminal of so many columns and lines that runs ``command``."""

    def __init__(
        self,
        command: Sequence[str],
        env: Mapping[str, str],
        *,
        columns_n: int = 80,
        lines_n: int = 24,
        cwd: Path | None = None,
    ) -> None:
        self._size = (columns_n, lines_n)
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines_n, columns_n, 0, 0))
        self.process = subprocess.Popen(
            list(command),
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env={**env, "TERM": "xterm-256color", "COLUMNS": str(columns_n), "LINES": str(lines_n)},
            cwd=cwd,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(slave)
        self._began_s = time.monotonic()
        self.events: list[tuple[float, str]] = []
        self.shown = ""
        self._seen_n = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(15.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def expect(self, text: str, timeout_s: float = 60.0) -> str:
        """Wait until ``text`` is shown after what was waited for before; returns what was shown up to it.

        Raises:
            PersonError: it was not within ``timeout_s``, or the command ended.
        """
        give_up_s = time.monotonic() + timeout_s
        while True:
            at = self.shown.find(text, self._seen_n)
            if at >= 0:
                before, self._seen_n = self.shown[self._seen_n : at], at + len(text)
                return before
            if not self._read(give_up_s - time.monotonic()):
                why = "ended" if self.process.poll() is not None else f"not within {timeout_s:g} s"
                raise PersonError(f"{text!r} was not shown ({why}); last: {self.shown[-1500:]!r}")

    def type(self, text: str, *, enter: bool = True) -> None:
        """Type, and press Enter."""
        os.write(self._master, text.encode() + (b"\r" if enter else b""))

    def interrupt(self) -> None:
        """Ctrl-C."""
        os.write(self._master, b"\x03")

    def end(self, timeout_s: float = 60.0) -> int:
        """Read on until the command has ended; its exit status, negative where a signal ended it."""
        give_up_s = time.monotonic() + timeout_s
        while self._read(give_up_s - time.monotonic()):
            pass
        return self.process.wait(max(0.1, give_up_s - time.monotonic()))

    def hang_up(self) -> None:
        """Close the terminal, as an SSH connection that broke does."""
        os.close(self._master)
        self._master = -1

    def freeze(self) -> None:
        """Halt the command where it is."""
        self.process.send_signal(signal.SIGSTOP)

    def cast(self, title: str) -> str:
        """What was shown, as an asciicast v2."""
        columns_n, lines_n = self._size
        head = {"version": 2, "width": columns_n, "height": lines_n, "title": title}
        return "\n".join([json.dumps(head), *(json.dumps([round(t, 3), "o", text]) for t, text in self.events)]) + "\n"

    def _read(self, timeout_s: float) -> bool:
        """Take in what is shown next; False: nothing came, or the terminal was left."""
        if timeout_s <= 0 or not select.select([self._master], [], [], timeout_s)[0]:
            return False
        try:
            data = os.read(self._master, 65536)
        except OSError:
            return False
        if not data:
            return False
        text = data.decode("utf-8", "replace")
        self.events.append((time.monotonic() - self._began_s, text))
        self.shown += CONTROL.sub("", text)
        return True
