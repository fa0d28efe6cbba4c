"""The little that survives a restart: why the machine stopped last, and whether somebody has reset that stop.

Written atomically and through to the disk, so that a power cut leaves the one before or this one; checked when read. A
thread writes: a disk that stalls must hold up neither a stop nor a tick.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

WRITE_MOST_S = 1.0
"""At its end the daemon waits so long for the last write."""
STALLED_S = 0.5
"""A write that takes longer is told: it takes some milliseconds."""


class LastStop(BaseModel):
    """The newest latched stop. ``reset``: a person has let go of it. ``stop_n``: its number; the count goes on from it
    after a restart, or a reset that was read of another day's stop would clear one of today's."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    reason: str
    wall_time: str
    reset: bool = False
    stop_n: int = 0

    def __str__(self) -> str:
        return f"{self.reason} ({self.wall_time})"


def _stop_now(reason: str, stop_n: int = 0) -> LastStop:
    return LastStop(reason=reason, wall_time=datetime.now(UTC).isoformat(timespec="seconds"), stop_n=stop_n)


class StateFile:
    """``last_stop.json`` in the state directory; without a directory nothing is kept."""

    def __init__(self, directory: str = "") -> None:
        directory = directory or os.environ.get("STATE_DIRECTORY", "")
        self._path = Path(directory) / "last_stop.json" if directory else None
        self._problem = ""
        self._to_write: LastStop | None = None
        self._writing_since_s: float | None = None
        self._changed = threading.Condition()

    @property
    def problem(self) -> str:
        """Why the file could not be read or written, or is not written yet; empty if all is well."""
        since_s = self._writing_since_s
        stalled = since_s is not None and time.monotonic() - since_s > STALLED_S
        return self._problem or (f"{self._path}: the disk takes long to write" if stalled else "")

    def load(self) -> LastStop | None:
        """The last stop, or None. A file that cannot be read is told in :attr:`problem`, and counts as a stop that
        nobody has reset: there may have been one. A copy is kept under ``.damaged``; it stays itself until there is
        another to write."""
        if self._path is None:
            return None
        try:
            return LastStop.model_validate_json(self._path.read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValidationError) as error:
            self._problem = f"{self._path}: {str(error).splitlines()[0]}"
            with contextlib.suppress(OSError):
                shutil.copyfile(self._path, self._path.with_suffix(".damaged"))
            return _stop_now("what stopped it last could not be read")

    def save(self, reason: str, stop_n: int) -> LastStop:
        """Have the reason of a stop written; a disk that is full or stalls is told in :attr:`problem`, never waited
        for and never raised into the control loop."""
        stop = _stop_now(reason, stop_n)
        self._write_soon(stop)
        return stop

    def save_reset(self, stop: LastStop, stop_n: int) -> LastStop:
        """Have it written that a person has let go of this stop, and of its repetitions up to ``stop_n``."""
        stop = stop.model_copy(update={"reset": True, "stop_n": stop_n})
        self._write_soon(stop)
        return stop

    def settle(self, most_s: float = WRITE_MOST_S) -> bool:
        """Wait until everything is written, not longer than ``most_s``, and say whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._writing_since_s is None, most_s)

    def _write_soon(self, stop: LastStop) -> None:
        if self._path is None:
            return
        with self._changed:
            self._to_write = stop
            if self._writing_since_s is not None:
                return
            self._writing_since_s = time.monotonic()
        # Not one of a pool: a pool waits for its threads at the end of the process.
        try:
            threading.Thread(target=self._write_all, args=(self._path,), name="state-file", daemon=True).start()
        except RuntimeError as error:  # no more threads
            self._writing_since_s = None
            self._problem = f"{self._path}: {error}"

    def _write_all(self, path: Path) -> None:
        """Write the newest until there is nothing newer."""
        while True:
            with self._changed:
                stop, self._to_write = self._to_write, None
                if stop is None:
                    self._writing_since_s = None
                    self._changed.notify_all()
                    return
            temporary = path.with_suffix(".new")
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                with temporary.open("w", encoding="utf-8") as file:
                    file.write(json.dumps(stop.model_dump()))
                    file.flush()
                    _through_to_disk(file.fileno())
                temporary.replace(path)
                directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
                try:
                    _through_to_disk(directory)
                finally:
                    os.close(directory)
                self._problem = ""
            except OSError as error:
                self._problem = f"{path}: {error.strerror}"


def _through_to_disk(fd: int) -> None:
    """Wait until it is on the disk; what knows no such thing (a directory of some network file systems) is done."""
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
