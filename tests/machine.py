"""A rig and a daemon attached to it, as processes of their own, for tests of the whole machine."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graderd.client import AsyncClient, NoDaemonError
from graderd.core.commands import Reply
from graderd.core.status import Status
from graderd.simulator.control_client import RigControl
from tests.rig_process import running_rig

READY_S = 60.0
CONFIG = """\
[api]
socket = "{socket}"
"""
PICTURES = """\
[camera]
rate_hz = 6.0
color_width_px = 320
color_height_px = 200
depth_width_px = 424
depth_height_px = 240
"""
"""Few and small pictures: nobody here looks at them but perception, which sees soil in them all the same."""

PATIENT = """\
[machine]
lease_s = 1.0
[control]
overrun_s = 0.3
[rotation]
watchdog_s = 0.4
goal_timeout_s = 0.4
reply_timeout_s = 0.5
max_age_s = 0.4
[lift_pair]
silent_s = 0.4
reading_max_age_s = 0.6
""" + "\n".join(
    f"[{axis}]\nmax_age_s = 0.6\nfeedback_timeout_s = 0.6\ntarget_timeout_s = 0.5"
    for axis in ("lift_left", "lift_right", "tilt")
)
"""Twice the patience with all that moves, where no time is judged: a busy machine is no fault of the grader's."""


@dataclass
class Served:
    """A machine that is there, wherever its processes came from; a client of its daemon, the rig's control beside."""

    directory: Path
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
        """Arm, and let automatic operation turn the blade to the even angle, or to the right one where it is past half
        of the way already; returns in the middle of the turn."""
        ready = await self.until(lambda s: all(r.met for r in s.readiness if r.mandatory) and s.soil.frames_per_s > 0)
        from_deg = ready.axes["rotation"].measured or 0.0
        async with RigControl(self.directory / "control.sock") as rig:
            await rig.request("scene", zone="even" if from_deg < 20.0 else "right")
        await self.command("arm")
        await self.until(lambda s: s.mode == "manual")
        await self.command("auto")
        await self.until(lambda s: abs((s.axes["rotation"].measured or 0.0) - from_deg) > 8.0)


@dataclass
class Attached(Served):
    """A daemon as a process of its own, attached to a rig that others may use after it."""

    daemon: asyncio.subprocess.Process


@dataclass
class Machine(Attached):
    """A rig and a daemon attached to it, as processes of their own, to be ended as a test likes."""

    rig: asyncio.subprocess.Process


async def start_rig(directory: Path) -> asyncio.subprocess.Process:
    """A rig in ``directory``, ready."""
    (directory / "rig.json").unlink(missing_ok=True)
    rig = await asyncio.create_subprocess_exec(sys.executable, "-m", "graderd.simulator", "--dir", str(directory))
    async with asyncio.timeout(READY_S):
        while not (directory / "rig.json").exists():
            assert rig.returncode is None
            await asyncio.sleep(0.05)
    return rig


async def _ended(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()
    await process.wait()


@asynccontextmanager
async def attached(directory: Path, more_config: str = "") -> AsyncIterator[Attached]:
    """Start a daemon on the rig in ``directory``, give it, end it whatever happened. ``more_config``: further TOML, of
    the camera too."""
    socket_path = directory / "graderd.sock"
    config = CONFIG.format(socket=socket_path) + ("" if "[camera]" in more_config else PICTURES) + more_config
    (directory / "graderd.toml").write_text(config, encoding="utf-8")
    daemon = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "run"),
        *("--config", str(directory / "graderd.toml"), "--rig-dir", str(directory)),
    )
    try:
        async with AsyncClient(socket_path, name="test", timeout_s=10.0) as client:
            yield Attached(directory, client, daemon)
    finally:
        await _ended(daemon)


@asynccontextmanager
async def machine(directory: Path, more_config: str = "") -> AsyncIterator[Machine]:
    """Start both, give the machine, end both whatever happened. ``more_config``: as for :func:`attached`."""
    rig = await start_rig(directory)
    try:
        async with attached(directory, more_config) as one:
            whole = Machine(directory, one.client, one.daemon, rig)
            try:
                yield whole
            finally:
                rig = whole.rig
    finally:
        await _ended(rig)


@contextmanager
def standing_machine(directory: Path, more_config: str = "") -> Iterator[Served]:
    """A patient one for several tests, each with an event loop of its own, which leave it armed or not, but alive.
    ``more_config``: further TOML."""
    socket_path = directory / "graderd.sock"
    config = CONFIG.format(socket=socket_path) + PICTURES + PATIENT + more_config
    (directory / "graderd.toml").write_text(config, encoding="utf-8")
    words = ("run", "--config", str(directory / "graderd.toml"), "--rig-dir", str(directory))
    with running_rig(directory), subprocess.Popen([sys.executable, "-m", "graderd", *words]) as daemon:
        try:
            yield Served(directory, AsyncClient(socket_path, name="test", timeout_s=10.0))
            assert daemon.poll() is None
        finally:
            daemon.kill()
