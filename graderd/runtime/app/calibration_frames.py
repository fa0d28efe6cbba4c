"""Pictures of the empty blade on their way to the client: they travel over the interface, not through the file system.

So the rights of the socket decide who gets them, whoever the client is and wherever the daemon may write.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from graderd.hal.errors import CommandRangeError

PREFIX = "calibration-"


class CalibrationFrames:
    """At most one frame set, in the daemon's own directory; each file goes when it was fetched, the rest with the next
    set or with the daemon. ``configured``: ``state.directory``."""

    def __init__(self, configured: str = "") -> None:
        self._base = os.environ.get("STATE_DIRECTORY") or configured or None
        self._folder: Path | None = None
        atexit.register(self.discard)
        if self._base is not None:  # what a killed daemon left
            for left in Path(self._base).glob(f"{PREFIX}*"):
                shutil.rmtree(left, ignore_errors=True)

    def begin(self) -> Path:
        """An empty folder for a new set; a former one goes.

        Raises:
            OSError: it cannot be made.
        """
        self.discard()
        if self._base is not None:
            Path(self._base).mkdir(parents=True, exist_ok=True)
        self._folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=self._base))
        return self._folder

    def names(self) -> list[str]:
        """The files that were not fetched yet."""
        return sorted(os.listdir(self._folder)) if self._folder is not None else []

    def take(self, name: str) -> bytes:
        """The content of one file, which then goes.

        Raises:
            CommandRangeError: there is no such file.
        """
        names = self.names()
        if self._folder is None or name not in names:
            raise CommandRangeError("file", f"no file {name!r} waits", "Calibrate again")
        path = self._folder / name
        data = path.read_bytes()
        path.unlink()
        if names == [name]:
            self.discard()
        return data

    def discard(self) -> None:
        """Remove what is there; idempotent."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
