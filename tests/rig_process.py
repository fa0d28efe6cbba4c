"""Starts the rig as a process of its own, or on the test's own loop, for tests of other rooms too."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

from graderd.simulator.control_client import RigControl
from graderd.simulator.process import Rig

START_TIMEOUT_S = 40.0


def wait_for_ready(directory: Path, process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """The content of ``rig.json`` once this process wrote it (a killed one leaves its own behind)."""
    deadline_s = time.monotonic() + START_TIMEOUT_S
    ready = directory / "rig.json"
    while True:
        content: dict[str, Any] = json.loads(ready.read_text()) if ready.exists() else {}
        if content.get("pid") == process.pid:
            return content
        assert process.poll() is None, f"the rig ended with status {process.returncode}"
        assert time.monotonic() < deadline_s, "the rig did not become ready"
        time.sleep(0.02)


@contextlib.contextmanager
def running_rig(directory: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[bytes], dict[str, Any]]]:
    """A rig that lives in ``directory`` while the block runs: its process and its ``rig.json``."""
    process = subprocess.Popen([sys.executable, "-m", "graderd.simulator", "--dir", str(directory), *arguments])
    try:
        yield process, wait_for_ready(directory, process)
    finally:
        process.kill()
        process.wait()


@contextlib.asynccontextmanager
async def rig_here(directory: Path) -> AsyncIterator[tuple[Rig, RigControl]]:
    """A rig on this test's own loop, and a client."""
    rig = Rig(directory, seed=1)
    running = asyncio.create_task(rig.run(), name="rig-under-test")
    async with asyncio.timeout(START_TIMEOUT_S):
        while not rig.paths.ready.exists():
            assert not running.done(), running.exception()
            await asyncio.sleep(0.02)
    control = RigControl(rig.paths.control)
    yield rig, control
    await control.close()
    rig.stop()
    async with asyncio.timeout(START_TIMEOUT_S):
        await running
