"""Rig and daemon as processes, a client of each, and what is measured while a fault is present.

A campaign that is killed takes them with it (:mod:`harness.bound`).
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from graderd.client import AsyncClient, ClientError, LeaseLostError, RefusedError
from graderd.hal.errors import DeviceError
from graderd.simulator.control_client import RigControl
from harness.bound import bound
from harness.campaign.watch import Watch

START_S = 60.0
CLIENT = "campaign"
RENEW_S = 0.08
JsonObject = dict[str, Any]

CONFIG = """\
[api]
socket = "{directory}/graderd.sock"
[can]
stop_pgn_n = 64999
[camera]
rate_hz = 10.0
color_width_px = 320
color_height_px = 200
depth_width_px = 424
depth_height_px = 240
[control]
memory_warn_mb = 260.0
overrun_s = 0.06
[recording]
directory = "{directory}/records"
min_free_mb = 0.0
[state]
directory = "{directory}/state"
[presets.high_left]
rotation_deg = 25.0
height_mm = 120.0
pitch_deg = 8.0
[presets.high_right]
rotation_deg = -25.0
height_mm = 120.0
pitch_deg = 8.0
[presets.low_left]
rotation_deg = 25.0
height_mm = 10.0
pitch_deg = -8.0
[presets.low_right]
rotation_deg = -25.0
height_mm = 10.0
pitch_deg = -8.0
[stop_input]
backend = "simulated"
stale_s = 1.0
"""
"""Ten pictures a second, small ones, keep a loaded machine free for what is measured: they take a third of the time of
full ones. The presets move all axes. The stop input is the rig's, which shares the machine with everything else: it is
given more time than a real one."""


class CampaignError(Exception):
    """The machine could not be brought to where the injection begins."""


class Stack:
    """One rig, one daemon attached to it. Used as ``async with Stack(directory) as stack``."""

    def __init__(self, directory: Path, broken: str = "") -> None:
        self.directory = directory
        self.config_path = directory / "graderd.toml"
        self.log_path = directory / "daemon.log"
        self.status: JsonObject = {}
        self.endured = {"daemon.lease_lapsed", "daemon.tick_overrun"}
        """Faults beside which the machine is ready all the same: a busy computer shows them."""
        self.watch = Watch(directory / "control.sock")
        self._broken = broken
        self._rig: asyncio.subprocess.Process | None = None
        self._daemon: asyncio.subprocess.Process | None = None
        self._control = RigControl(directory / "control.sock")
        self.client = AsyncClient(directory / "graderd.sock", name=CLIENT)
        self._mover: asyncio.Task[None] | None = None
        self._renewing = True
        self._log_read = 0

    # -- processes ----------------------------------------------------------------------------------------------------

    async def __aenter__(self) -> Stack:
        self.config_path.write_text(CONFIG.format(directory=self.directory), encoding="utf-8")
        (self.directory / "state").mkdir(exist_ok=True)
        await self.start_rig()
        await self.start_daemon()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.rest()
        await self.watch.stop()
        for process in (self._daemon, self._rig):
            if process is not None and process.returncode is None:
                with suppress(ProcessLookupError):
                    process.send_signal(signal.SIGCONT)
                    process.terminate()
                try:
                    async with asyncio.timeout(8.0):
                        await process.wait()
                except TimeoutError:
                    process.kill()
                    await process.wait()
        await self._control.close()

    async def start_rig(self) -> None:
        """Start the rig and wait until it is ready."""
        ready = self.directory / "rig.json"
        ready.unlink(missing_ok=True)
        self._rig = await asyncio.create_subprocess_exec(
            *bound(sys.executable, "-m", "graderd.simulator", "--dir", str(self.directory))
        )
        await self.until(ready.exists, START_S, "the rig does not get ready")
        await self._control.close()
        await self.watch.start()

    async def start_daemon(self) -> None:
        """Start the daemon and wait until it answers and all its devices stand by with pictures arriving."""
        await self.launch_daemon()
        await self.until_status(
            lambda s: s["soil"]["frames_per_s"] > 0 and all(a["lifecycle"] == "standby" for a in s["axes"].values()),
            START_S,
            "the daemon does not find its devices",
        )

    async def launch_daemon(self) -> None:
        """Start the daemon; its log is appended to the former's."""
        with self.log_path.open("ab") as log:
            self._daemon = await asyncio.create_subprocess_exec(
                *bound(sys.executable, "-m", "harness.campaign.daemon"),
                *("--config", str(self.config_path), "--rig-dir", str(self.directory)),
                env=os.environ | {"GRADERD_CAMPAIGN_BREAK": self._broken, "STATE_DIRECTORY": ""},
                stdout=log,
                stderr=log,
            )

    @property
    def daemon(self) -> asyncio.subprocess.Process:
        """The daemon's process."""
        assert self._daemon is not None
        return self._daemon

    @property
    def rig(self) -> asyncio.subprocess.Process:
        """The rig's process."""
        assert self._rig is not None
        return self._rig

    def hook(self, **wanted: float) -> None:
        """Let the daemon do something to itself; see ``harness.campaign.daemon``."""
        (self.directory / "hook.json").write_text(json.dumps(wanted), encoding="utf-8")
        self.daemon.send_signal(signal.SIGUSR1)

    def worker_pid(self) -> int:
        """Process id of the perception child."""
        children = Path(f"/proc/{self.daemon.pid}/task/{self.daemon.pid}/children").read_text(encoding="ascii").split()
        if not children:
            raise CampaignError("the daemon has no perception child now")
        return int(children[-1])

    async def guard(self) -> int:
        """Run ``graderd guard`` as systemd does after the daemon ended; returns its exit status."""
        process = await asyncio.create_subprocess_exec(
            *bound(sys.executable, "-m", "graderd", "guard", "--config", str(self.config_path)),
            env=os.environ | {"STATE_DIRECTORY": ""},
        )
        return await process.wait()

    # -- rig ----------------------------------------------------------------------------------------------------------

    async def ask_rig(self, command: str, /, **params: Any) -> JsonObject:
        """One request to the rig."""
        return await self._control.request(command, **params)

    # -- daemon -------------------------------------------------------------------------------------------------------

    async def read_status(self) -> JsonObject | None:
        """The daemon's status now, None where it does not answer."""
        try:
            self.status = await self.client.get("/v1/status")
        except ClientError:
            return None
        return self.status

    async def command(self, name: str, /, **fields: Any) -> JsonObject:
        """One command; ``accepted`` tells whether it was obeyed. A reset names the stop that is latched now."""
        try:
            reply = await (self.client.reset(**fields) if name == "reset" else self.client.command(name, **fields))
        except ClientError as error:
            return {"accepted": False, "error": error.cause, "where": error.where, "remedy": error.remedy}
        return reply.model_dump()

    async def service(self, name: str, /, **arguments: Any) -> JsonObject:
        """One device service."""
        try:
            return await self.client.service(name, **arguments)
        except RefusedError as error:
            return {"error": error.cause, "where": error.where, "remedy": error.remedy}

    async def until_status(
        self, reached: Callable[[JsonObject], bool], timeout_s: float, otherwise: str, poll_s: float = 0.02
    ) -> JsonObject:
        """Poll the status until it is as wanted.

        Raises:
            CampaignError: it does not get there.
        """
        end_s = time.monotonic() + timeout_s
        while True:
            status = await self.read_status()
            if status is not None and reached(status):
                return status
            if time.monotonic() > end_s:
                told = {key: self.status.get(key) for key in ("mode", "reason", "holding")}
                names = [fault["name"] for fault in self.status.get("faults", [])]
                raise CampaignError(f"{otherwise} within {timeout_s:g} s: {told}, faults {names}")
            await asyncio.sleep(poll_s)

    async def until(self, reached: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Poll anything.

        Raises:
            CampaignError: it does not come true.
        """
        end_s = time.monotonic() + timeout_s
        while not reached():
            if time.monotonic() > end_s:
                raise CampaignError(f"{otherwise} within {timeout_s:g} s")
            await asyncio.sleep(0.02)

    # -- moving by hand ------------------------------------------------------------------------------------------------

    async def move(self, name: str, /, **fields: Any) -> None:
        """Begin a jog or preset and keep its lease until :meth:`rest`."""
        await self.rest()
        self._renewing = True
        begun: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._mover = asyncio.create_task(self._keep(name, fields, begun), name="campaign-lease")
        if refusal := await begun:
            raise CampaignError(f"{name} {fields} was refused: {refusal}")

    async def _keep(self, name: str, fields: JsonObject, begun: asyncio.Future[str]) -> None:
        """Renew; a client that came late (a loaded machine) begins anew, one that is refused ends."""
        while True:
            try:
                async with self.client.lease() as lease:
                    await (lease.jog if name == "jog" else lease.preset)(**fields)
                    if not begun.done():
                        begun.set_result("")
                    while True:
                        await asyncio.sleep(RENEW_S)
                        if self._renewing:
                            await lease.renew()
            except ClientError as error:
                if not begun.done():
                    begun.set_result(str(error))
                if not isinstance(error, LeaseLostError):
                    return

    def fall_silent(self) -> None:
        """The client that moves the blade stands still, with its connection open: it renews its lease no more."""
        self._renewing = False

    async def rest(self) -> None:
        """Give the lease back, if it is still held."""
        mover, self._mover = self._mover, None
        if mover is not None:
            mover.cancel()
            await asyncio.gather(mover, return_exceptions=True)

    # -- log ----------------------------------------------------------------------------------------------------------

    def new_log_errors(self) -> list[str]:
        """Lines of level error or worse, and anything that is no log line, since the last call."""
        with suppress(FileNotFoundError):
            text = self.log_path.read_bytes()[self._log_read :]
            self._log_read += len(text)
            return [problem for line in text.decode(errors="replace").splitlines() if (problem := _error_in(line))]
        return []

    async def heal(self) -> None:
        """End every fault of the rig."""
        with suppress(DeviceError):
            await self.ask_rig("clear_faults")


def _error_in(line: str) -> str:
    try:
        record = json.loads(line)
    except ValueError:
        return line.strip()
    return str(record.get("message")) if record.get("level") in ("error", "critical") else ""


__all__ = ["CLIENT", "CampaignError", "JsonObject", "Stack"]
