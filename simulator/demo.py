"""The demonstration: a client like any other that arms the simulated grader and drives four passes.

It starts the rig and the daemon as processes of their own, lays a pile left, center, right and an even layer in front
of the blade, and lets automatic operation answer each; then the machine drives through the soil.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import sys
import time
from collections.abc import AsyncIterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import httpx

from graderd.core.status import Status
from graderd.hal.errors import DeviceError
from graderd.runtime.app.sim import RigProcess, new_rig_directory
from graderd.simulator.control_client import RigControl
from graderd.simulator.show import Show, make_show

ZONES = ("left", "center", "right", "even")
CLIENT = "demo"
POLL_S = 0.05
RENEW_S = 0.1
START_TIMEOUT_S = 60.0
DECISION_TIMEOUT_S = 20.0
SETTLE_TIMEOUT_S = 15.0
SETTLED_DEG = 0.5
SETTLED_FOR_S = 0.5
DRIVE_M = 3.0
DRIVE_M_PER_S = 1.0


class DemoFailedError(Exception):
    """Something the demonstration waited for did not happen."""


@dataclass(frozen=True, slots=True)
class Pass:
    """One pass: what was decided, what was reached, and how long the turn took from the decision."""

    zone: str
    decided: str
    requested_deg: float
    measured_deg: float
    settle_s: float


def run_demo(as_json: bool) -> int:
    """Run the demonstration. Returns 0 if every pass settled at the angle its soil asks for, else 1."""
    show = make_show(as_json)
    try:
        with show:
            return asyncio.run(_demo(show))
    except KeyboardInterrupt:
        return 130


async def _demo(show: Show) -> int:
    directory = new_rig_directory()
    passes: list[Pass] = []
    problem = ""
    try:
        async with _machine(directory, show) as client, RigControl(directory / "control.sock") as control:
            demo = _Demo(client, control, show)
            await demo.arm()
            for zone in ZONES:
                passes.append(await demo.one_pass(zone))
            await demo.command("disarm")
    except (DemoFailedError, DeviceError, httpx.HTTPError, OSError) as error:
        problem = str(error) or repr(error)
    finally:
        shutil.rmtree(directory, ignore_errors=True)
    if problem:
        show.event("demo_failed", error=problem)
    show.event("demo_finished", passes=[asdict(p) for p in passes])
    good = len(passes) == len(ZONES) and all(p.zone == p.decided for p in passes)
    return 0 if good and not problem else 1


@contextlib.asynccontextmanager
async def _machine(directory: Path, show: Show) -> AsyncIterator[httpx.AsyncClient]:
    """Rig and daemon, started and ended in order; a client connected to the daemon."""
    rig = RigProcess(directory)
    socket_path = directory / "graderd.sock"
    config_path = directory / "demo.toml"
    config_path.write_text(f'[api]\nsocket = "{socket_path}"\n', encoding="utf-8")
    show.event("starting", what="rig")
    await rig.start()
    log_path = directory / "daemon.log"
    with log_path.open("wb") as log_file:
        daemon = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "graderd", "run"),
            *("--config", str(config_path), "--rig-dir", str(directory)),
            stdout=log_file,
            stderr=log_file,
        )
    show.event("starting", what="daemon")
    try:
        transport = httpx.AsyncHTTPTransport(uds=str(socket_path))
        async with httpx.AsyncClient(transport=transport, base_url="http://graderd", timeout=5.0) as client:
            await _answering(client, daemon, log_path)
            yield client
    finally:
        if daemon.returncode is None:
            daemon.terminate()
        try:
            async with asyncio.timeout(5.0):
                await daemon.wait()
        except TimeoutError:
            daemon.kill()
            await daemon.wait()
        await rig.stop()


async def _answering(client: httpx.AsyncClient, daemon: asyncio.subprocess.Process, log_path: Path) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        if daemon.returncode is not None:
            said = await asyncio.to_thread(log_path.read_text, errors="replace")
            raise DemoFailedError(f"the daemon ended at its start: {said[-500:]}")
        with contextlib.suppress(httpx.TransportError):
            if (await client.get("/v1/status")).status_code == 200:
                return
        await asyncio.sleep(0.1)
    raise DemoFailedError(f"the daemon did not answer within {START_TIMEOUT_S:g} s")


class _Demo:
    """The steps of the demonstration."""

    def __init__(self, client: httpx.AsyncClient, rig: RigControl, show: Show) -> None:
        self._client = client
        self._rig = rig
        self._show = show

    async def status(self) -> Status:
        status = Status.model_validate((await self._client.get("/v1/status")).json())
        self._show.status(status)
        return status

    async def command(self, name: str, must: bool = True, **fields: Any) -> bool:
        response = await self._client.post("/v1/commands", json={"command": name, "client": CLIENT, **fields})
        if response.status_code != 200 and must:
            raise DemoFailedError(f"{name} was refused: {response.text}")
        return response.status_code == 200

    async def arm(self) -> None:
        """Wait until everything mandatory is met, arm, and wait for manual mode."""
        await self._until(
            lambda s: all(r.met for r in s.readiness if r.mandatory) and s.soil.frames_per_s > 0,
            START_TIMEOUT_S,
            lambda s: "not ready: " + "; ".join(f"{r.name}: {r.reason}" for r in s.readiness if not r.met),
        )
        await self.command("arm")
        await self._until(lambda s: s.mode == "manual", 10.0, lambda s: f"not armed: {s.reason}")
        self._show.event("armed")

    async def one_pass(self, zone: str) -> Pass:
        """Square blade, new soil, automatic operation, settle, drive."""
        await self.command("manual")
        await self._rig.request("scene", zone="none")
        await self._rig.request("reset_vehicle")
        await self._square()
        await self._rig.request("scene", zone=zone)
        self._show.event("scene", zone=zone)
        await self.command("auto")
        started = await self._until(
            lambda s: s.decision.zone is not None,
            DECISION_TIMEOUT_S,
            lambda s: f"no decision on soil {zone}: {s.soil.zone} ({s.soil.reason}); {'; '.join(s.holding)}",
        )
        requested_deg = started.decision.angle_deg
        assert started.decision.zone is not None
        assert requested_deg is not None
        decided = str(started.decision.zone)
        self._show.event("decision", zone=decided, requested_deg=requested_deg, confidence=started.soil.confidence)
        decided_s = started.time_s - (started.decision.age_s or 0.0)
        settled_s, measured_deg = await self._settled(requested_deg)
        result = Pass(zone, decided, requested_deg, round(measured_deg, 3), round(settled_s - decided_s, 3))
        self._show.event("settled", **asdict(result))
        await self._drive()
        return result

    async def _square(self) -> None:
        """Jog the blade back to 0, holding the lease."""
        await self.command("jog", axis="rotate", value=0.0)
        renewed_s = time.monotonic()
        deadline_s = renewed_s + SETTLE_TIMEOUT_S
        while time.monotonic() < deadline_s:
            measured = (await self.status()).axes["rotation"].measured
            if measured is not None and abs(measured) < SETTLED_DEG:
                await self.command("release")
                return
            if time.monotonic() - renewed_s > RENEW_S:
                renewed_s = time.monotonic()
                if not await self.command("renew", must=False):
                    await self.command("jog", axis="rotate", value=0.0)
            await asyncio.sleep(POLL_S)
        raise DemoFailedError("the blade did not come back to 0°")

    async def _settled(self, goal_deg: float) -> tuple[float, float]:
        """When the measured angle came to the goal to stay, and where it is after it stayed for a while."""
        first: Status | None = None
        deadline_s = time.monotonic() + SETTLE_TIMEOUT_S
        while time.monotonic() < deadline_s:
            status = await self.status()
            measured = status.axes["rotation"].measured
            if measured is None or abs(measured - goal_deg) > SETTLED_DEG:
                first = None
            elif first is None:
                first = status
            elif status.time_s - first.time_s >= SETTLED_FOR_S:
                return first.time_s, measured
            await asyncio.sleep(POLL_S)
        raise DemoFailedError(f"the blade did not settle at {goal_deg:+.0f}°")

    async def _drive(self) -> None:
        """Drive through the soil, automatic operation going on."""
        await self._rig.request("drive", speed_m_per_s=DRIVE_M_PER_S, distance_m=DRIVE_M)
        end_s = time.monotonic() + DRIVE_M / DRIVE_M_PER_S + 0.5
        while time.monotonic() < end_s:
            await self.status()
            await asyncio.sleep(POLL_S)
        state = await self._rig.request("state")
        self._show.event("driven", distance_m=DRIVE_M, soil_mass_kg=state.get("soil_mass_kg"))

    async def _until(self, reached: Any, timeout_s: float, otherwise: Any) -> Status:
        deadline_s = time.monotonic() + timeout_s
        while True:
            status = await self.status()
            if reached(status):
                return status
            if time.monotonic() > deadline_s:
                raise DemoFailedError(otherwise(status))
            await asyncio.sleep(POLL_S)


if __name__ == "__main__":
    sys.exit(run_demo("--json" in sys.argv[1:]))
