"""A rig and a daemon attached to it, as processes of their own, for tests of the whole machine."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graderd.client import AsyncClient, NoDaemonError
from graderd.core.commands import Reply
from graderd.core.status import Status
from graderd.simulator.control_client import RigControl

READY_S = 60.0


@dataclass
class Machine:
    """A rig and a daemon attached to it, as processes of their own."""

    directory: Path
    rig: asyncio.subprocess.Process
    daemon: asyncio.subprocess.Process
    client: AsyncClient

    async def status(self) -> Status:
        return await self.client.status()

    async def command(self, name: str, **fields: Any) -> Reply:
        return await self.client.command(name, **fields)

    async def until(self, reached: Callable[[Status], bool], timeout_s: float = READY_S) -> Status:
        async with asyncio.timeout(timeout_s):
            while True:
                with suppress(NoDaemonError):
                    status = await self.status()
                    if reached(status):
                        return status
                await asyncio.sleep(0.02)

    async def turn(self) -> None:
        """Arm, and let automatic operation turn the blade to the even angle; returns in the middle of the turn."""
        await self.until(lambda s: all(r.met for r in s.readiness if r.mandatory) and s.soil.frames_per_s > 0)
        async with RigControl(self.directory / "control.sock") as rig:
            await rig.request("scene", zone="even")
        await self.command("arm")
        await self.until(lambda s: s.mode == "manual")
        await self.command("auto")
        await self.until(lambda s: (s.axes["rotation"].measured or 0.0) > 8.0)


async def start_rig(directory: Path) -> asyncio.subprocess.Process:
    """A rig in ``directory``, ready."""
    (directory / "rig.json").unlink(missing_ok=True)
    rig = await asyncio.create_subprocess_exec(sys.executable, "-m", "graderd.simulator", "--dir", str(directory))
    async with asyncio.timeout(READY_S):
        while not (directory / "rig.json").exists():
            assert rig.returncode is None
            await asyncio.sleep(0.05)
    return rig


@asynccontextmanager
async def machine(directory: Path, more_config: str = "") -> AsyncIterator[Machine]:
    """Start both, give the machine, end both whatever happened. ``more_config`` is further TOML."""
    rig = await start_rig(directory)
    socket_path = directory / "graderd.sock"
    (directory / "graderd.toml").write_text(f'[api]\nsocket = "{socket_path}"\n{more_config}', encoding="utf-8")
    daemon = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "run"),
        *("--config", str(directory / "graderd.toml"), "--rig-dir", str(directory)),
    )
    async with AsyncClient(socket_path, name="test", timeout_s=10.0) as client:
        whole = Machine(directory, rig, daemon, client)
        try:
            yield whole
        finally:
            for process in (whole.daemon, whole.rig):
                if process.returncode is None:
                    process.kill()
                await process.wait()
