"""The little that survives a restart: why the machine stopped last. Written atomically, checked when read."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError


class LastStop(BaseModel):
    """The newest latched stop."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    reason: str
    wall_time: str

    def __str__(self) -> str:
        return f"{self.reason} ({self.wall_time})"


class StateFile:
    """``last_stop.json`` in the state directory; without a directory nothing is kept."""

    def __init__(self, directory: str = "") -> None:
        directory = directory or os.environ.get("STATE_DIRECTORY", "")
        self._path = Path(directory) / "last_stop.json" if directory else None
        self.problem = ""
        """Why the file could not be read or written; empty if all is well."""

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
        """Write the reason of a stop; a full disk is told in :attr:`problem`, never raised into the control loop."""
        stop = LastStop(reason=reason, wall_time=datetime.now(UTC).isoformat(timespec="seconds"))
        if self._path is not None:
            temporary = self._path.with_suffix(".new")
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                temporary.write_text(json.dumps(stop.model_dump()), encoding="utf-8")
                temporary.replace(self._path)
                self.problem = ""
            except OSError as error:
                self.problem = f"{self._path}: {error.strerror}"
        return stop
