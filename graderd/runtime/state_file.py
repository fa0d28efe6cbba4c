"""The little that survives a restart: why the machine stopped last, and whether somebody has reset that stop.

Written atomically, checked when read. A thread writes: a disk that stalls must hold up neither a stop nor a tick.
"""

from __future__ import annotations

import json
import os
import threading
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

WRITE_MOST_S = 1.0
"""At its end the daemon waits so long for the last write."""


class LastStop(BaseModel):
    """The newest latched stop. ``reset``: a person has let go of it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    reason: str
    wall_time: str
    reset: bool = False

    def __str__(self) -> str:
        return f"{self.reason} ({self.wall_time})"


class StateFile:
    """``last_stop.json`` in the state directory; without a directory nothing is kept."""

    def __init__(self, directory: str = "") -> None:
        directory = directory or os.environ.get("STATE_DIRECTORY", "")
        self._path = Path(directory) / "last_stop.json" if directory else None
        self.problem = ""
        """Why the file could not be read or written; empty if all is well."""
        self._to_write: LastStop | None = None
        self._writing = False
        self._changed = threading.Condition()

    def load(self) -> LastStop | None:
        """The last stop, or None. A damaged file is kept aside under ``.damaged`` and told in :attr:`problem`."""
        if self._path is None or not self._path.exists():
            return None
        try:
            return LastStop.model_validate_json(self._path.read_bytes())
        except (OSError, ValidationError) as error:
            self.problem = f"{self._path}: {str(error).splitlines()[0]}"
            try:
                self._path.replace(self._path.with_suffix(".damaged"))
            except OSError:
                self.problem += " (and cannot be set aside)"
            return None

    def save(self, reason: str) -> LastStop:
        """Have the reason of a stop written; a disk that is full or stalls is told in :attr:`problem`, never waited
        for and never raised into the control loop."""
        stop = LastStop(reason=reason, wall_time=datetime.now(UTC).isoformat(timespec="seconds"))
        self._write_soon(stop)
        return stop

    def save_reset(self, stop: LastStop) -> LastStop:
        """Have it written that a person has let go of this stop."""
        stop = stop.model_copy(update={"reset": True})
        self._write_soon(stop)
        return stop

    def settle(self, most_s: float = WRITE_MOST_S) -> bool:
        """Wait until everything is written, not longer than ``most_s``, and say whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._writing, most_s)

    def _write_soon(self, stop: LastStop) -> None:
        if self._path is None:
            return
        with self._changed:
            self._to_write = stop
            if self._writing:
                self.problem = self.problem or f"{self._path}: the disk takes long to write"
                return
            self._writing = True
        # Not one of a pool: a pool waits for its threads at the end of the process.
        try:
            threading.Thread(target=self._write_all, args=(self._path,), name="state-file", daemon=True).start()
        except RuntimeError as error:  # no more threads
            self._writing = False
            self.problem = f"{self._path}: {error}"

    def _write_all(self, path: Path) -> None:
        """Write the newest until there is nothing newer."""
        while True:
            with self._changed:
                stop, self._to_write = self._to_write, None
                if stop is None:
                    self._writing = False
                    self._changed.notify_all()
                    return
            temporary = path.with_suffix(".new")
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary.write_text(json.dumps(stop.model_dump()), encoding="utf-8")
                temporary.replace(path)
                self.problem = ""
            except OSError as error:
                self.problem = f"{path}: {error.strerror}"
