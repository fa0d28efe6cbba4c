"""The folder of recordings: what is in it, what must go to make room, and how long the room lasts.

::

    graderd-20260102T030405Z-000.mcap            a run, in parts
    graderd-20260102T030405Z-000.frames.mcap     its raw pictures, where they were asked for
    graderd-20260102T031122Z-000.incident.mcap   what the black box kept around a stop, a disarm, a fault or a mark
"""

from __future__ import annotations

import errno
import itertools
import os
import shutil
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from graderd.record.layout import FRAMES_SUFFIX, INCIDENT_SUFFIX, PREFIX, SUFFIX

PARTS_N = 10
"""A part of a run takes at most this part of what all recordings may take: so much goes at once to make room."""
_FORMER_SUFFIX = ".jsonl"
"""Recordings of graderd 0.2 and older."""


def directory_of(configured: str) -> Path | None:
    """Where recordings lie: ``recording.directory``, else in systemd's state directory; None: nowhere."""
    if configured:
        return Path(configured)
    state = os.environ.get("STATE_DIRECTORY", "")
    return Path(state) / "recordings" if state else None


def kind_of(path: Path) -> str:
    """``run``, ``frames`` or ``incident``."""
    for kind, suffix in (("incident", INCIDENT_SUFFIX), ("frames", FRAMES_SUFFIX), ("incident", ".incident.jsonl")):
        if path.name.endswith(suffix):
            return kind
    return "run"


@dataclass(frozen=True, slots=True)
class Entry:
    """One file in the folder."""

    path: Path
    kind: str
    size_n: int
    changed_ns: int


class Store:
    """The folder, kept within ``max_mb`` and with ``min_free_mb`` left on its disk."""

    def __init__(self, directory: Path, max_mb: float, min_free_mb: float) -> None:
        self.directory = directory
        self._max_mb = max_mb
        self._min_free_mb = min_free_mb

    @property
    def part_most_bytes(self) -> float:
        """A part of a run that grew to this is finished."""
        return self._max_mb * 1e6 / PARTS_N

    def entries(self) -> list[Entry]:
        """Its recordings, oldest first."""
        found = []
        for path in self.directory.glob(f"{PREFIX}*"):
            if path.suffix in (SUFFIX, _FORMER_SUFFIX):
                try:
                    stat = path.stat()
                except FileNotFoundError:  # gone meanwhile
                    continue
                found.append(Entry(path, kind_of(path), stat.st_size, stat.st_mtime_ns))
        return sorted(found, key=lambda entry: (entry.changed_ns, entry.path.name))

    def new_path(self, now: datetime, suffix: str = SUFFIX) -> Path:
        """A name that no file has; the folder is made where it is not there.

        Raises:
            OSError: it cannot be made.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        stamp = now.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
        names = (f"{PREFIX}{stamp}-{number:03d}" for number in itertools.count())
        taken = {path.name.partition(".")[0] for path in self.directory.glob(f"{PREFIX}{stamp}-*")}
        return self.directory / f"{next(name for name in names if name not in taken)}{suffix}"

    def no_room(self) -> str:
        """Why nothing may be written now; empty where something may.

        Raises:
            OSError: the folder cannot be looked at.
        """
        free_mb = shutil.disk_usage(self.directory).free / 1e6
        if free_mb < self._min_free_mb:
            return f"{self.directory}: {free_mb:.0f} MB free, {self._min_free_mb:g} MB are kept free"
        return ""

    def make_room(self, needed_n: int, kept: Collection[Path] = ()) -> list[Path]:
        """Take away files until ``needed_n`` bytes more fit: the oldest runs first, then incidents; ``kept`` never.

        Raises:
            OSError: ENOSPC; they do not fit whatever goes.
        """
        entries = self.entries()
        total_n = sum(entry.size_n for entry in entries) + needed_n
        order = sorted((e for e in entries if e.path not in kept), key=lambda e: (e.kind == "incident", e.changed_ns))
        gone = []
        while total_n > self._max_mb * 1e6:
            if not order:
                raise OSError(errno.ENOSPC, f"recording.max_mb ({self._max_mb:g}) is full", str(self.directory))
            entry = order.pop(0)
            entry.path.unlink(missing_ok=True)
            gone.append(entry.path)
            total_n -= entry.size_n
        return gone
