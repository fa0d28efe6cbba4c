"""Keeps the live view for Foxglove running: a process of its own (``graderd.runtime.app.live_view_child``).

Nothing of it runs in the daemon's process: what its library does, or how it ends, is no affair of the control tick.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from pathlib import Path

from graderd.config.models import FoxgloveSettings

MODULE = "graderd.runtime.app.live_view_child"
PAUSES_S = (1.0, 5.0, 30.0)

log = logging.getLogger(__name__)


class LiveView:
    """Keeps that process running, for the daemon."""

    def __init__(self, settings: FoxgloveSettings, socket: Path) -> None:
        self._words = (str(socket), str(settings.port_n), str(settings.rate_hz), str(settings.pictures_hz))

    async def run(self) -> None:
        """Until cancelled; a process that ends is started again, later each time."""
        ended_n = 0
        while True:
            began_s = time.monotonic()
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-P", "-m", MODULE, *self._words),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.DEVNULL,
                process_group=0,  # as perception's: Ctrl-C is the daemon's
            )
            try:
                status = await process.wait()
            finally:
                if process.returncode is None:
                    process.kill()
                    await process.wait()
            ended_n = 0 if time.monotonic() - began_s > PAUSES_S[-1] else ended_n + 1
            pause_s = PAUSES_S[min(ended_n, len(PAUSES_S) - 1)]
            log.warning("the live view ended (status %d), and is started again in %g s", status, pause_s)
            await asyncio.sleep(pause_s)
