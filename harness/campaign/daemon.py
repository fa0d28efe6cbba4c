"""The daemon with handles for what cannot be done to a process from outside: ``python -m harness.campaign.daemon``.

Nothing of the product knows of this. On SIGUSR1 the process does what ``hook.json`` in its rig's directory says:
``block_s`` stops the event loop, ``clock_step_s`` shows the daemon a stepped wall clock, ``slept_s`` a sleep of the
computer, ``memory_mb`` takes memory, ``disk_full`` says that no space is left, ``disk_stalled`` has no write to a
recording answered.
``GRADERD_CAMPAIGN_BREAK`` spoils one safety reaction, to prove that the campaign notices (see ``BREAKS``).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from graderd.core import machine, tick
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Clear, FaultRow, Reaction
from graderd.runtime.app import daemon as product
from graderd.runtime.perception_supervisor import PerceptionSupervisor

WORKER = "harness.campaign.worker"


def _replace_catalogue(rows: Mapping[str, FaultRow]) -> None:
    vars(tick)["CATALOGUE"] = rows


def _only_warn(key: str) -> None:
    _replace_catalogue(dict(CATALOGUE) | {key: dataclasses.replace(CATALOGUE[key], reaction=Reaction.WARN)})


def _hold_nothing() -> None:
    vars(machine)["held_axes"] = lambda _: {}


def _forget_latches() -> None:
    _replace_catalogue({key: dataclasses.replace(row, clear=Clear.WHEN_GONE) for key, row in CATALOGUE.items()})


BREAKS: dict[str, Callable[[], None]] = {
    "camera_missing_only_warns": partial(_only_warn, "camera.missing"),
    "held_axes_go_on": _hold_nothing,
    "latches_let_go": _forget_latches,
}
"""Defects of one reaction each; every one must turn the campaign red."""


class Hooks:
    """Does to this process what its signal asks for."""

    def __init__(self, directory: Path) -> None:
        self._file = directory / "hook.json"
        self._kept: list[bytearray] = []
        self._time = time.time
        self._disk_usage = shutil.disk_usage
        self._write = os.write
        self._step_s = 0.0
        self._clock_ns = time.clock_gettime_ns
        self._slept_ns = 0

    def on_signal(self, _: int, __: FrameType | None) -> None:
        """Runs in the main thread, between two instructions of the event loop."""
        wanted: dict[str, Any] = json.loads(self._file.read_text(encoding="utf-8"))
        if "block_s" in wanted:
            time.sleep(wanted["block_s"])
        if "clock_step_s" in wanted:
            self._step_s += wanted["clock_step_s"]
            step_s = self._step_s
            time.time = lambda: self._time() + step_s
        if "slept_s" in wanted:
            self._slept_ns += int(wanted["slept_s"] * 1e9)
            boot_ns, slept_ns = self._clock_ns, self._slept_ns
            time.clock_gettime_ns = lambda clock: boot_ns(clock) + slept_ns * (clock == time.CLOCK_BOOTTIME)
        if "disk_full" in wanted:
            usage = self._disk_usage
            # Less than nothing: below any limit that may be configured, 0 included.
            shutil.disk_usage = (lambda path: usage(path)._replace(free=-1)) if wanted["disk_full"] else usage
        if "disk_stalled" in wanted:
            vars(os)["write"] = self._hang if wanted["disk_stalled"] else self._write
        if "memory_mb" in wanted:
            threading.Thread(target=self._take_memory, args=(int(wanted["memory_mb"]),), daemon=True).start()

    def _hang(self, file: int, data: bytes) -> int:
        """As a system call that waits for a disk: it ends with the process, or with the disk's answer."""
        while threading.current_thread().name == "recorder" and os.write == self._hang:
            time.sleep(0.05)
        return self._write(file, data)

    def _take_memory(self, wanted_mb: int) -> None:
        """Little by little beside the event loop, as a leak does."""
        self._kept.clear()
        for _ in range(wanted_mb):
            self._kept.append(bytearray(b"\x01") * (1 << 20))
            time.sleep(0.005)


def main() -> int:
    """``graderd run`` with the handles."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--rig-dir", type=Path, required=True)
    options = parser.parse_args()
    broken = os.environ.get("GRADERD_CAMPAIGN_BREAK", "")
    if broken:
        BREAKS[broken]()
    signal.signal(signal.SIGUSR1, Hooks(options.rig_dir).on_signal)
    os.environ["GRADERD_CAMPAIGN_LIE"] = str(options.rig_dir / "lie.json")
    command = (sys.executable, "-m", WORKER)
    vars(product)["PerceptionSupervisor"] = partial(PerceptionSupervisor, command=command)
    return product.run_daemon(options.config, False, options.rig_dir, True)


if __name__ == "__main__":
    sys.exit(main())
