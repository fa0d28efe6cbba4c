"""Writes what the machine did: one JSON object a line, the first holds versions and the resolved configuration.

The tick only appends to a bounded queue; a thread of its own task writes. Full disk or slow disk costs records, never
control, and is told as a fault.
"""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import shutil
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from graderd.config import Config
from graderd.core.status import Status
from graderd.hal.fault import DeviceFault, PresentFaults

WRITE_EVERY_S = 0.5
QUEUE_N = 2000
FAULT_SHOWN_S = 5.0

log = logging.getLogger(__name__)


class Recorder:
    """One file per daemon run under ``recording.directory``; without a directory it does nothing."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._settings = config.recording
        self._queue: deque[str] = deque(maxlen=QUEUE_N)
        self._due_s = 0.0
        self._faults = PresentFaults("daemon")  # written by the writer's thread
        self._now_s = 0.0
        self._path: Path | None = None

    @property
    def path(self) -> Path | None:
        """The file of this run, once it is open."""
        return self._path

    def take(self, now_s: float, status: Callable[[], Status]) -> None:
        """Called every tick; asks for a status only as often as records are wanted."""
        self._now_s = now_s
        if self._settings.directory and now_s >= self._due_s:
            self._due_s = now_s + 1.0 / self._settings.rate_hz
            self._queue.append(status().model_dump_json(exclude={"readiness", "presets"}))

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
        lines = [self._queue.popleft() for _ in range(len(self._queue))]
        try:
            self._write(lines)
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
        if self._path is None:
            stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
            self._path = directory / f"graderd-{stamp}.jsonl"
            lines.insert(0, self._header())
            self._make_room(directory)
        with self._path.open("a", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in lines)

    def _header(self) -> str:
        return json.dumps(
            {
                "event": "recording",
                "version": version("graderd"),
                "started": datetime.now(UTC).isoformat(timespec="seconds"),
                "config": self._config.model_dump(mode="json"),
            }
        )

    def _make_room(self, directory: Path) -> None:
        files = sorted(directory.glob("graderd-*.jsonl"), key=lambda p: p.stat().st_mtime)
        total_mb = sum(p.stat().st_size for p in files) / 1e6
        while files and total_mb > self._settings.max_mb:
            oldest = files.pop(0)
            total_mb -= oldest.stat().st_size / 1e6
            oldest.unlink()

    def _tell(self, condition: str, detail: str) -> None:
        if self._faults.tell(condition, detail, self._now_s, FAULT_SHOWN_S):
            log.warning("recording: %s", detail)
        self._faults.clear(*({"disk_full", "recorder_failed"} - {condition}))
