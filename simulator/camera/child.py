"""The parent's end of the rig's camera process: start it, tell it of changes, notice its death, end it."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from graderd.hal.errors import DeviceLostError

_START_S = 15.0
_ANSWER_S = 10.0
_END_S = 1.0


class CameraChild:
    """The camera process of one rig. ``descriptor``: of the shared scene; ``path``: where it serves its clients."""

    def __init__(self, descriptor: int, path: Path, seed: int) -> None:
        self._descriptor = descriptor
        self._path = path
        self._seed = seed
        self._process: asyncio.subprocess.Process | None = None
        self._telling = asyncio.Lock()
        self._changes_n = 0

    @property
    def pid(self) -> int:
        """Its process id; 0 where it does not run."""
        return self._process.pid if self._process else 0

    async def start(self) -> None:
        """Start it and wait until it serves.

        Raises:
            DeviceLostError: it ended, or did not say that it is ready.
        """
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "graderd.simulator.camera.process"),
            *("--memory", str(self._descriptor), "--socket", str(self._path), "--seed", str(self._seed)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self._descriptor,),
            start_new_session=True,  # its pictures take most of the processor: not the rig's part of it
        )
        if not await self._says("ready", _START_S):
            raise DeviceLostError("rig camera", "its process did not start", "See its message above")

    async def watch(self) -> None:
        """Wait for its end, which is always a surprise.

        Raises:
            DeviceLostError: it ended.
        """
        assert self._process is not None
        status = await self._process.wait()
        raise DeviceLostError("rig camera", f"its process ended with status {status}", "Start the rig again")

    async def end(self) -> None:
        """Hang up and wait for its end; kill it where that takes long. Idempotent."""
        process = self._process
        if process is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            async with asyncio.timeout(_END_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()

    async def tell(self, message: dict[str, Any]) -> None:
        """Change it: ``look``, ``fault`` with ``params``, or ``clear``; a picture asked for afterwards shows it.

        Raises:
            DeviceLostError: it does not say that it did so.
        """
        assert self._process is not None
        assert self._process.stdin is not None
        async with self._telling:
            self._changes_n += 1
            self._process.stdin.write(json.dumps({"number": self._changes_n, **message}).encode() + b"\n")
            await self._process.stdin.drain()
            if not await self._says(f"changed {self._changes_n}", _ANSWER_S):
                raise DeviceLostError("rig camera", "its process does not answer", "Start the rig again")

    async def _says(self, text: str, within_s: float) -> bool:
        """Whether it says so in time. Answers that nobody waited for any more are passed over."""
        assert self._process is not None
        assert self._process.stdout is not None
        try:
            async with asyncio.timeout(within_s):
                while line := await self._process.stdout.readline():
                    if line.decode().rstrip() == text:
                        return True
        except TimeoutError:
            pass
        return False
