"""The simulated grader: starts the rig as a process of its own, or attaches to one that runs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from graderd.config import Config
from graderd.hal.errors import DeviceMissingError
from graderd.hal.settings import Ph54Settings

STALLED_S = 30.0
START_CPU_S = 60.0
"""A start may take as long as it gets on, on a machine busy with other things: until it has not run at all for the one
time, or has used the other of a processor (an idle machine: 3 s)."""
RESTART_PAUSE_S = 1.0
RIG_FRAME_AGE_S = 0.4
"""A rendered picture is as old as its rendering took, which a busy machine stretches; a real camera has 0.1 s."""
LINGER_S = 10.0
"""The rig outlives a killed daemon by so much, so that what the servo's watchdog does then can be seen."""
RIG_STREAMS = {
    "color_width_px": 640,
    "color_height_px": 400,
    "depth_width_px": 424,
    "depth_height_px": 240,
    "rate_hz": 15.0,
}
"""The most that the rig renders in time on one core beside everything else; who configured less gets less."""

log = logging.getLogger(__name__)


class Starting:
    """Watches a process that starts: whether it still gets on, by the processor time it takes."""

    def __init__(self, pid: int) -> None:
        self._path = Path(f"/proc/{pid}/schedstat")
        self._ran_s = 0.0
        self._since_s = time.monotonic()

    def has_stalled(self) -> bool:
        """Whether it has not run for ``STALLED_S``, or for ``START_CPU_S`` in vain."""
        try:
            ran_s = int(self._path.read_text(encoding="ascii").split()[0]) / 1e9
        except OSError:
            return False  # it has ended, which its parent sees
        now_s = time.monotonic()
        if ran_s != self._ran_s:
            self._ran_s, self._since_s = ran_s, now_s
        return now_s - self._since_s > STALLED_S or ran_s > START_CPU_S


class RigProcess:
    """``python -m graderd.simulator`` in ``directory``; kept alive while :meth:`run` runs."""

    def __init__(self, directory: Path, arguments: tuple[str, ...] = ()) -> None:
        self.directory = directory
        self._arguments = arguments
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start the rig and wait until it says it is ready.

        Raises:
            DeviceMissingError: it ended or did not get ready.
        """
        ready = self.directory / "rig.json"
        ready.unlink(missing_ok=True)
        self._process = await asyncio.create_subprocess_exec(
            *(
                sys.executable,
                "-P",
                "-m",
                "graderd.simulator",
                "--dir",
                str(self.directory),
                "--linger-s",
                f"{LINGER_S:g}",
            ),
            *self._arguments,
            stdin=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        starting = Starting(self._process.pid)
        while not ready.exists():
            if self._process.returncode is not None:
                raise DeviceMissingError("rig", f"ended with status {self._process.returncode} before it was ready")
            if starting.has_stalled():
                await self.stop()
                raise DeviceMissingError("rig", "does not get ready")
            await asyncio.sleep(0.02)

    async def run(self) -> None:
        """Start it again whenever it ends, until cancelled."""
        try:
            while True:
                if self._process is not None:
                    await self._process.wait()
                    log.warning("the rig ended (status %s): starting it again", self._process.returncode)
                    await asyncio.sleep(RESTART_PAUSE_S)
                await self.start()
        finally:
            await self.stop()

    async def stop(self) -> None:
        """End the rig and wait for it."""
        process, self._process = self._process, None
        if process is None or process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            async with asyncio.timeout(2.0):
                await process.wait()
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


def new_rig_directory() -> Path:
    """A private directory for the rig's sockets and ptys."""
    base = os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR")
    return Path(tempfile.mkdtemp(prefix="graderd-rig-", dir=base if base and os.access(base, os.W_OK) else None))


def attach(config: Config, directory: Path) -> Config:
    """The configuration with every wire replaced by the rig's.

    A camera that plays files, and what has a driver from elsewhere, is left as it is.

    Raises:
        DeviceMissingError: no rig is ready in that directory.
    """
    path = directory / "rig.json"
    try:
        rig: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DeviceMissingError(
            str(path), f"no rig is ready there ({error})", "Start one: graderd rig --dir DIR"
        ) from None
    plays_files = config.camera.source not in ("realsense", "rig")
    camera: dict[str, Any] = {}
    if not plays_files:
        streams = {name: min(getattr(config.camera, name), most) for name, most in RIG_STREAMS.items()}
        camera = {"source": "rig", "path": rig["camera"], **streams}
    age_s = max(config.perception.decision.max_frame_age_s, RIG_FRAME_AGE_S)
    decision = config.perception.decision.model_copy(update={"max_frame_age_s": age_s})
    changes = {
        "simulated": True,
        "perception": config.perception.model_copy(update={"decision": decision}),
        "camera": config.camera.model_copy(update=camera),
        "can": config.can.model_copy(update=rig["can"]),
    }
    if isinstance(config.rotation, Ph54Settings):
        on_rig = {"port": rig["servo"], "usb_serial_number": ""}
        changes["rotation"] = config.rotation.model_copy(update=on_rig)
    if config.vehicle.source != "j1939":
        changes["vehicle"] = config.vehicle.model_copy(update={"source": "simulated", "path": rig["control"]})
    if config.stop_input.backend == "simulated":
        changes["stop_input"] = config.stop_input.model_copy(update={"port": rig["stop_input"]})
    return config.model_copy(update=changes)
