"""Somebody at the daemon's interface: starts rig and daemon, arms the machine, and drives passes over soil it lays.

A client like any other. What the demonstration shows, and an experiment measures, is driven by this.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from graderd.client import AsyncClient, ClientError, LeaseLostError, RefusedError
from graderd.core.status import Status
from graderd.runtime.app.sim import RigProcess, Starting
from graderd.simulator.control_client import RigControl
from graderd.simulator.show import Show

POLL_S = 0.05
STALLED_S = 60.0
"""What is waited for may take as long as it gets on. A machine busy with other things is slow: it is not broken."""
DECISION_FRAMES_N = 300
CONFIG = """\
[api]
socket = "{socket}"
[camera]
rate_hz = 8.0
color_width_px = 640
color_height_px = 400
stale_s = 1.5
restart_s = 15.0
[perception.decision]
max_frame_age_s = 1.0
[rule]
vote_max_age_s = 5.0
"""
"""Beside ten others a picture is half a second in the making, and comes twice a second. The machine stands while it
looks: an older picture shows it the same soil, eight smaller ones a second all that happens to it."""
ATTEMPTS_N = 5
RECOVERY_S = 30.0
"""A pass that the machine broke off is driven anew, so often, once the machine could be armed again within this
time. A busy machine starves its own servo's watchdog or its camera; what is broken stays broken."""
SETTLED_DEG = 0.5
SETTLED_MM = 1.0
SETTLED_FOR_S = 0.5


class PassFailedError(Exception):
    """Something that was waited for did not happen."""


@dataclass(frozen=True, slots=True)
class Pass:
    """One pass: what was decided, what was reached, and how long the turn took from the decision; ``states``: what was
    true of the machine while it drove, as the rig tells it."""

    zone: str
    decided: str
    requested_deg: float
    measured_deg: float
    settle_s: float
    states: tuple[dict[str, Any], ...] = ()

    def told(self) -> dict[str, Any]:
        """For an event: without the states."""
        return {name: getattr(self, name) for name in ("zone", "decided", "requested_deg", "measured_deg", "settle_s")}


@dataclass(frozen=True, slots=True)
class Mound:
    """Soil to flatten: the heap that the rig is to pour, and the blade's height over the ground to go over it at."""

    heap: Mapping[str, float]
    blade_mm: float


@dataclass(frozen=True, slots=True)
class Way:
    """How far a pass goes once the blade has settled, and how fast."""

    distance_m: float = 3.0
    speed_m_per_s: float = 1.0


@contextlib.asynccontextmanager
async def ended_by_sigterm() -> AsyncIterator[None]:
    """SIGTERM ends the block like an error: rig and daemon go too, and the last event tells."""
    task = asyncio.current_task()
    assert task is not None
    loop, told = asyncio.get_running_loop(), False

    def end() -> None:
        nonlocal told
        told = True
        task.cancel()

    loop.add_signal_handler(signal.SIGTERM, end)
    try:
        yield
    except asyncio.CancelledError:
        if not told:
            raise
        task.uncancel()
        raise PassFailedError("ended by SIGTERM") from None
    finally:
        loop.remove_signal_handler(signal.SIGTERM)


@contextlib.asynccontextmanager
async def whole_machine(directory: Path, show: Show, rule: str = "") -> AsyncIterator[AsyncClient]:
    """Rig and daemon in ``directory``, started and ended in order; a client of the daemon, which answers.

    ``rule``: further keys of the configuration's section of that name (TOML).
    """
    rig = RigProcess(directory)
    socket_path = directory / "graderd.sock"
    config_path = directory / "graderd.toml"
    config_path.write_text(CONFIG.format(socket=socket_path) + rule, encoding="utf-8")
    show.event("starting", what="rig")
    await rig.start()
    log_path = directory / "daemon.log"
    # A demonstration started by a service is not that service, and keeps nothing in its directories.
    environment = {k: v for k, v in os.environ.items() if k not in ("NOTIFY_SOCKET", "STATE_DIRECTORY")}
    try:
        with log_path.open("wb") as log_file:
            daemon = await asyncio.create_subprocess_exec(
                *(sys.executable, "-P", "-m", "graderd", "run"),
                *("--config", str(config_path), "--rig-dir", str(directory)),
                stdout=log_file,
                stderr=log_file,
                env=environment,
                # As the rig and its camera: Linux shares its processors among sessions first (sched_autogroup), so that
                # what else this terminal does leaves each of them its part. And Ctrl-C is ours alone to pass on.
                start_new_session=True,
            )
        show.event("starting", what="daemon")
        try:
            client = AsyncClient(socket_path, name="demo", timeout_s=STALLED_S)
            await _answering(client, daemon, log_path)
            yield client
        finally:
            await _end(daemon)
    finally:
        await rig.stop()


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.terminate()
    try:
        async with asyncio.timeout(5.0):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()


async def _answering(client: AsyncClient, daemon: asyncio.subprocess.Process, log_path: Path) -> None:
    starting = Starting(daemon.pid)
    while True:
        with contextlib.suppress(ClientError, TimeoutError):
            async with asyncio.timeout(5.0):  # its socket may be there long before it answers
                await client.status()
            return
        why = "ended" if daemon.returncode is not None else "stalled" if starting.has_stalled() else ""
        if why:
            said = await asyncio.to_thread(log_path.read_text, errors="replace")
            raise PassFailedError(f"the daemon {why} at its start: {said[-500:]}")
        await asyncio.sleep(0.1)


class Operator:
    """Drives passes."""

    def __init__(self, client: AsyncClient, rig: RigControl, show: Show, way: Way | None = None) -> None:
        self._client = client
        self._rig = rig
        self._show = show
        self._way = Way() if way is None else way

    async def status(self) -> Status:
        status = await self._client.status()
        self._show.status(status)
        return status

    async def arm(self) -> None:
        """Wait until everything mandatory is met, arm, and wait for manual mode."""
        deadline_s = time.monotonic() + STALLED_S
        while True:
            await self._until(
                lambda s: all(r.met for r in s.readiness if r.mandatory) and s.soil.frames_per_s > 0,
                lambda s: [(r.name, r.met) for r in s.readiness],
                lambda s: "not ready: " + "; ".join(f"{r.name}: {r.reason}" for r in s.readiness if not r.met),
            )
            try:
                await self._client.command("arm")
                break
            except RefusedError:
                # One reading was not fresh just then; a busy machine has such moments.
                if time.monotonic() > deadline_s:
                    raise
        armed = await self._until(
            lambda s: not s.arming, lambda s: [a.lifecycle for a in s.axes.values()], lambda s: f"arming: {s.reason}"
        )
        if armed.mode != "manual":
            raise PassFailedError(f"not armed: {armed.mode}, {armed.reason}")
        self._show.event("armed")

    async def _command(self, name: str) -> None:
        """One command; a refusal is told with what brought the machine to where it is refused."""
        try:
            await self._client.command(name)
        except RefusedError as error:
            status = await self.status()
            raise PassFailedError(f"{error}; {status.mode}: {status.reason}") from None

    async def drive_pass(
        self,
        zone: str,
        seed: int = 0,
        laid: Callable[[], Awaitable[None]] | None = None,
        mound: Mound | None = None,
    ) -> Pass:
        """One pass; anew where the machine stepped back from it by itself and has nothing any more that keeps it.

        ``seed``: of the heap's form. ``laid``: called once the soil lies there, before automatic operation begins.
        ``mound``: to flatten, in place of what the rig lays for the zone.

        Raises:
            PassFailedError, ClientError: it did not come to its end.
        """
        attempt_n = 1
        while True:
            try:
                if (await self.status()).mode == "disarmed":
                    await self.arm()
                return await self._one_pass(zone, seed, laid, mound)
            except (PassFailedError, ClientError) as error:
                if attempt_n == ATTEMPTS_N or not await self._stepped_back():
                    raise
                self._show.event("again", scene=zone, reason=str(error))
                attempt_n += 1

    async def _stepped_back(self) -> bool:
        """Whether it is disarmed, or manual, without a stop, and could be armed again within ``RECOVERY_S``."""
        deadline_s = time.monotonic() + RECOVERY_S
        await self._rig.request("state")  # without a rig nothing comes back
        while (status := await self.status()).mode in ("disarmed", "manual"):
            if all(need.met for need in status.readiness if need.mandatory):
                return True
            if time.monotonic() > deadline_s:
                break
            await asyncio.sleep(POLL_S)
        return False

    async def _one_pass(
        self, zone: str, seed: int, laid: Callable[[], Awaitable[None]] | None, mound: Mound | None
    ) -> Pass:
        """Square blade, new soil, automatic operation, settle, drive."""
        await self._command("manual")
        await self._rig.request("scene", zone="none")
        await self._rig.request("reset_vehicle")
        await self._jog("rotate", 0.0, lambda s: s.axes["rotation"].measured, SETTLED_DEG)
        if mound is None:
            await self._rig.request("scene", zone=zone, seed=seed)
        else:
            await self._jog("height", mound.blade_mm, lambda s: s.attitude.height_mm, SETTLED_MM)
            await self._rig.request("place", **mound.heap, seed=seed)
        self._show.event("scene", zone=zone)
        if laid is not None:
            await laid()
        await self._command("auto")
        started = await self._decision(zone)
        requested_deg = started.decision.angle_deg
        assert started.decision.zone is not None
        assert requested_deg is not None
        decided = str(started.decision.zone)
        self._show.event("decision", zone=decided, requested_deg=requested_deg, confidence=started.soil.confidence)
        decided_s = started.time_s - (started.decision.age_s or 0.0)
        settled_s, measured_deg = await self._settled(requested_deg)
        result = Pass(zone, decided, requested_deg, round(measured_deg, 3), round(settled_s - decided_s, 3))
        self._show.event("settled", **result.told())
        return replace(result, states=tuple(await self._drive()))

    async def _decision(self, zone: str) -> Status:
        """The status with the decision; one that is not made of so many pictures does not come."""
        first_n = (await self.status()).soil.frame_number_n

        def why(status: Status) -> str:
            soil = status.soil
            return (
                f"no decision on soil {zone}: {status.mode}, {status.reason}; {soil.zone} ({soil.reason}); "
                f"{'; '.join(status.holding)}"
            )

        status = await self._until(
            lambda s: (
                s.decision.zone is not None or s.mode != "auto" or s.soil.frame_number_n - first_n > DECISION_FRAMES_N
            ),
            lambda s: s.soil.frame_number_n,
            why,
        )
        if status.decision.zone is None:
            raise PassFailedError(why(status))
        return status

    async def _jog(self, axis: str, goal: float, measured: Callable[[Status], float | None], within: float) -> None:
        """Jog the blade there. A renewal that came late on a busy machine ended the jog: it begins anew."""
        deadline_s = time.monotonic() + STALLED_S
        while True:
            try:
                async with self._client.lease() as lease:
                    await lease.jog(axis, goal)
                    async for status in lease.statuses():
                        self._show.status(status)
                        there = measured(status)
                        if there is not None and abs(there - goal) < within:
                            return
                        if time.monotonic() > deadline_s:
                            raise PassFailedError(f"{axis} did not come to {goal:g}: {'; '.join(status.holding)}")
            except LeaseLostError:
                if (await self.status()).mode != "manual" or time.monotonic() > deadline_s:
                    raise

    async def _settled(self, goal_deg: float) -> tuple[float, float]:
        """When the measured angle came to the goal to stay, and where it is after it stayed for a while."""
        first: Status | None = None

        def stayed(status: Status) -> bool:
            nonlocal first
            measured = status.axes["rotation"].measured
            if measured is None or abs(measured - goal_deg) > SETTLED_DEG:
                first = None
            elif first is None:
                first = status
            else:
                return status.time_s - first.time_s >= SETTLED_FOR_S
            return status.mode != "auto"

        last = await self._until(
            stayed,
            # At the goal, time is the progress.
            lambda s: (round(s.axes["rotation"].measured or 0.0, 1), first is not None and s.time_s),
            lambda s: f"the blade did not settle at {goal_deg:+.0f}°: {s.mode}, {s.reason}; {'; '.join(s.holding)}",
        )
        measured = last.axes["rotation"].measured
        if first is None or measured is None or last.mode != "auto":
            raise PassFailedError(f"the blade did not settle at {goal_deg:+.0f}°: {last.mode}, {last.reason}")
        return first.time_s, measured

    async def _drive(self) -> list[dict[str, Any]]:
        """Drive through the soil, automatic operation going on; the rig's truth on the way."""
        way = self._way
        mode = (await self.status()).mode
        await self._rig.request("drive", speed_m_per_s=way.speed_m_per_s, distance_m=way.distance_m)
        deadline_s = time.monotonic() + way.distance_m / way.speed_m_per_s + STALLED_S
        states = []
        while True:
            status = await self.status()
            if status.mode != mode:  # what the blade does from here on is no trial of its angle
                raise PassFailedError(f"{mode} operation ended on the way: {status.mode}, {status.reason}")
            states.append(await self._rig.request("state"))
            if not states[-1]["driving"]:
                break
            if time.monotonic() > deadline_s:
                raise PassFailedError("the machine did not come to the end of its way")
            await asyncio.sleep(POLL_S)
        self._show.event("driven", distance_m=way.distance_m, soil_mass_kg=states[-1].get("soil_mass_kg"))
        return states

    async def _until(
        self,
        reached: Callable[[Status], bool],
        progress: Callable[[Status], object],
        otherwise: Callable[[Status], str],
    ) -> Status:
        """The first status that is as wanted; waited for as long as ``progress`` goes on changing.

        Raises:
            PassFailedError: nothing changed for ``STALLED_S``; ``otherwise`` says what was waited for.
        """
        seen: object = None
        deadline_s = time.monotonic() + STALLED_S
        while True:
            status = await self.status()
            if reached(status):
                return status
            now = progress(status)
            if now != seen:
                seen, deadline_s = now, time.monotonic() + STALLED_S
            elif time.monotonic() > deadline_s:
                raise PassFailedError(otherwise(status))
            await asyncio.sleep(POLL_S)
