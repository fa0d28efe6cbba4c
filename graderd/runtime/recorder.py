"""Writes what the machine did: one JSON object a line, the first of a file holds versions and the configuration.

The tick only appends to a bounded queue; a thread of its own task writes. Full disk or slow disk costs records, never
control, and is told as a fault. A run is written in parts, so that ``recording.max_mb`` can be kept while it goes on:
the oldest parts make room. A part in which something went wrong, and the one before it, are marked by their names
(``.incident.jsonl``) and go only when nothing else is left to go.
"""

from __future__ import annotations

import asyncio
import errno
import itertools
import json
import logging
import shutil
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from graderd.config import Config
from graderd.core.faults.monitor import Reaction
from graderd.core.machine import ARMED, Mode
from graderd.core.status import Status
from graderd.hal.fault import DeviceFault, PresentFaults

WRITE_EVERY_S = 0.5
QUEUE_N = 2000
FAULT_SHOWN_S = 5.0
PREFIX = "graderd-"
SUFFIX = ".jsonl"
MARKED_SUFFIX = ".incident.jsonl"
PARTS_N = 10
"""What goes at once to make room is this part of ``recording.max_mb``; at its default about twenty minutes."""

log = logging.getLogger(__name__)


class Recorder:
    """One file or more per daemon run under ``recording.directory``; without a directory it does nothing."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._settings = config.recording
        self._queue: deque[tuple[str, bool]] = deque(maxlen=QUEUE_N)
        self._due_s = 0.0
        self._faults = PresentFaults("daemon")  # written by the writer's thread
        self._now_s = 0.0
        self._path: Path | None = None
        self._former: Path | None = None
        self._incidents = IncidentWatch()
        self._to_mark = False

    @property
    def path(self) -> Path | None:
        """The part being written, once there is one."""
        return self._path

    def take(self, now_s: float, status: Callable[[], Status]) -> None:
        """Called every tick; asks for a status only as often as records are wanted."""
        self._now_s = now_s
        if self._settings.directory and now_s >= self._due_s:
            self._due_s = now_s + 1.0 / self._settings.rate_hz
            taken = status()
            incident = self._incidents.seen_in(taken)
            self._queue.append((taken.model_dump_json(exclude={"readiness", "presets"}), incident))

    def expect_stop(self) -> None:
        """The machine stops now because the daemon ends with nothing to interrupt: that is no incident."""
        self._incidents.expect_stop()

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """Why nothing is written now."""
        return self._faults.present(now_s)

    async def run(self) -> None:
        """Write until cancelled; the last lines are written on the way out."""
        if not self._settings.directory:
            return
        try:
            while True:
                await asyncio.sleep(WRITE_EVERY_S)
                await asyncio.to_thread(self._write_guarded)
        finally:
            self._write_guarded()

    def _write_guarded(self) -> None:
        taken = [self._queue.popleft() for _ in range(len(self._queue))]
        self._to_mark = self._to_mark or any(incident for _, incident in taken)
        try:
            self._write([line for line, _ in taken])
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            self._tell("disk_full" if full else "recorder_failed", f"{self._settings.directory}: {error.strerror}")

    def _write(self, lines: list[str]) -> None:
        directory = Path(self._settings.directory)
        directory.mkdir(parents=True, exist_ok=True)
        free_mb = shutil.disk_usage(directory).free / 1e6
        if free_mb < self._settings.min_free_mb:
            self._tell(
                "disk_full", f"{directory}: {free_mb:.0f} MB free, {self._settings.min_free_mb:g} MB are kept free"
            )
            return
        data = "".join(f"{line}\n" for line in lines).encode()
        part_most_bytes = self._settings.max_mb * 1e6 / PARTS_N
        path = self._path
        if path is None or not path.exists() or path.stat().st_size + len(data) > part_most_bytes:
            self._begin_part(directory, data)
        else:
            self._make_room(directory, len(data))
            with path.open("ab") as file:
                file.write(data)
        if self._to_mark:
            self._mark()
            self._to_mark = False

    def _begin_part(self, directory: Path, data: bytes) -> None:
        data = self._header().encode() + b"\n" + data
        self._make_room(directory, len(data))
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        paths = (directory / f"{PREFIX}{stamp}-{number:03d}{SUFFIX}" for number in itertools.count())
        # Under both names: what is marked must never be written over by what is marked later.
        path = next(path for path in paths if not path.exists() and not _marked_name(path).exists())
        path.write_bytes(data)
        self._former, self._path = self._path, path

    def _mark(self) -> None:
        """Keep this part and the one before it longest: what led to an incident is worth more than what came after."""
        self._path, self._former = _marked(self._path), _marked(self._former)

    def _header(self) -> str:
        return json.dumps(
            {
                "event": "recording",
                "version": version("graderd"),
                "started": datetime.now(UTC).isoformat(timespec="seconds"),
                "config": self._config.model_dump(mode="json"),
            }
        )

    def _make_room(self, directory: Path, needed_n: int) -> None:
        """Take away parts until ``needed_n`` bytes fit: oldest first, then those of incidents, and after them the one
        just finished, which an incident now would want; the one being written never.

        Raises:
            OSError: ENOSPC; they do not fit into ``max_mb`` whatever goes.
        """
        sizes_n = {path: path.stat() for path in directory.glob(f"{PREFIX}*{SUFFIX}")}
        total_n = sum(stat.st_size for stat in sizes_n.values()) + needed_n
        dispensable = (path for path in sizes_n if path != self._path)
        worth = {path: 2 if path == self._former else int(_is_marked(path)) for path in sizes_n}
        order = sorted(dispensable, key=lambda p: (worth[p], sizes_n[p].st_mtime_ns, p.name))
        while total_n > self._settings.max_mb * 1e6:
            if not order:
                raise OSError(errno.ENOSPC, f"recording.max_mb ({self._settings.max_mb:g}) is full")
            path = order.pop(0)
            total_n -= sizes_n[path].st_size
            path.unlink()

    def _tell(self, condition: str, detail: str) -> None:
        if self._faults.tell(condition, detail, self._now_s, FAULT_SHOWN_S):
            log.warning("recording: %s", detail)
        self._faults.clear(*({"disk_full", "recorder_failed"} - {condition}))


class IncidentWatch:
    """Finds in the statuses what a recording is looked at for: a stop, and a fault that holds an armed machine or takes
    it out of operation."""

    def __init__(self) -> None:
        self._mode = Mode.DISARMED
        self._faults: frozenset[str] = frozenset()

    def expect_stop(self) -> None:
        """The next stop is none."""
        self._mode = Mode.STOPPED

    def seen_in(self, status: Status) -> bool:
        """Whether one has come with this status."""
        faults = frozenset(f.name for f in status.faults if f.reaction != Reaction.WARN.name.lower())
        stopped = status.mode is Mode.STOPPED and self._mode is not Mode.STOPPED
        disturbed = self._mode in ARMED and bool(faults - self._faults)
        self._mode, self._faults = status.mode, faults
        return stopped or disturbed


def _is_marked(path: Path) -> bool:
    return path.name.endswith(MARKED_SUFFIX)


def _marked(path: Path | None) -> Path | None:
    """The part under the name of one with an incident; None where it is gone."""
    if path is None or _is_marked(path) or not path.exists():
        return path
    return path.rename(_marked_name(path))


def _marked_name(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(SUFFIX) + MARKED_SUFFIX)
