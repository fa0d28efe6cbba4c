"""From a stop to the last motion command on both wires: ``python -m benchmarks.stop_latency [--rounds N]``.

The whole machine as processes. In every round the lifts, the tilt and the blade move, and are stopped in mid-motion by
a client started for it (Python cold): time begins when it calls, before it has connected. The rig notes on the same
clock when the servo got its last goal and each actuator the message that takes its leave to move back. Promised: one
control tick (20 ms) and the wire's time.

The daemon is scheduled as the service with ``systemd/dropins/realtime.conf``; so are the rig, for hardware takes no
processor time, and the client that stops. The clients that flood are not. ``--ordinary`` does without.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import statistics
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

from graderd.hal.settings import CanSettings
from harness.campaign.conduct import come_to
from harness.campaign.model import Phase
from harness.campaign.stack import Stack
from harness.stops import what_came_of

TICK_MS = 20.0
LIMITS_MS = {"servo": TICK_MS + 14.0, "can": TICK_MS + 1.8}
"""Servo, at 57,600 bit/s: the exchange under way (14 and 29 bytes) is waited for, then the hold goes out (35 bytes).
CAN: three control messages of 160 bits at 250 kbit/s."""
COLD = """
import sys, time
from graderd.client import Client
client = Client(sys.argv[1], name="benchmark")
print(time.monotonic())
client.post("/v1/stop", {"client": "benchmark", "reason": "benchmark"})
print(time.monotonic())
"""
CLAIM_ID = 0x18EEFF00
FULL_BUS_HZ = 1900.0
"""250 kbit/s in frames of 131 bits, the shortest with 8 bytes of data."""
FLOOD_BEFORE_S = 0.3
PRIORITY_RIG_N, PRIORITY_DAEMON_N, PRIORITY_CLIENT_N = 30, 20, 10
Load = Callable[[], AbstractAsyncContextManager[None]]


@asynccontextmanager
async def idle(_: Stack) -> AsyncIterator[Load]:
    @asynccontextmanager
    async def load() -> AsyncIterator[None]:
        yield

    yield load


@asynccontextmanager
async def flooded(stack: Stack, kind: str = "ask") -> AsyncIterator[Load]:
    """400 clients in a process of their own, that stands between two rounds: the machine shall come into motion."""
    flood = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "harness.api_flood", str(stack.directory / "graderd.sock"), "3600", kind, "400"),
        stdout=asyncio.subprocess.DEVNULL,
    )

    @asynccontextmanager
    async def load() -> AsyncIterator[None]:
        flood.send_signal(signal.SIGCONT)
        try:
            await asyncio.sleep(FLOOD_BEFORE_S)
            yield
        finally:
            flood.send_signal(signal.SIGSTOP)

    await asyncio.sleep(2.0)  # all of them are connected
    flood.send_signal(signal.SIGSTOP)
    try:
        yield load
    finally:
        flood.kill()
        await flood.wait()


@asynccontextmanager
async def stalled_state(stack: Stack) -> AsyncIterator[Load]:
    @asynccontextmanager
    async def load() -> AsyncIterator[None]:
        """A file whose opening hangs."""
        path = stack.directory / "state" / "last_stop.new"
        os.mkfifo(path)
        try:
            yield
        finally:
            os.close(os.open(path, os.O_RDONLY | os.O_NONBLOCK))
            path.unlink(missing_ok=True)

    yield load


@asynccontextmanager
async def full_bus(stack: Stack) -> AsyncIterator[Load]:
    @asynccontextmanager
    async def load() -> AsyncIterator[None]:
        await stack.ask_rig("actuator_fault", name="flood", device=None, params={"rate_hz": FULL_BUS_HZ})
        try:
            await asyncio.sleep(FLOOD_BEFORE_S)
            yield
        finally:
            await stack.heal()

    yield load


@asynccontextmanager
async def address_lost(stack: Stack) -> AsyncIterator[Load]:
    @asynccontextmanager
    async def load() -> AsyncIterator[None]:
        """A node whose name wins claims the daemon's address."""
        await stack.ask_rig("can_frame", can_id=CLAIM_ID | CanSettings().source_address_n, data_hex="00" * 8)
        yield

    yield load


LOADS: dict[str, Callable[[Stack], AbstractAsyncContextManager[Load]]] = {
    "idle": idle,
    "400 clients flooding": flooded,
    "state directory stalled": stalled_state,
    "CAN bus at 100 %": full_bus,
    "address lost": address_lost,
}
STANDARD_ERROR = "standard error blocked"
STOPS = "400 clients that stop"
"""The first of them has stopped the machine: what is measured is how soon one more is answered."""


async def measure(load: str, rounds_n: int, realtime: bool) -> list[dict[str, float]]:
    """What each round came to, in seconds and degrees; see :func:`harness.stops.what_came_of`."""
    with tempfile.TemporaryDirectory() as directory:
        stack = Stack(Path(directory))
        reader = _blocked(stack.log_path) if load == STANDARD_ERROR else None
        try:
            async with stack:
                if realtime:
                    for pid, priority_n in ((stack.rig.pid, PRIORITY_RIG_N), (stack.daemon.pid, PRIORITY_DAEMON_N)):
                        _schedule(pid, os.SCHED_RR, priority_n)
                if load == STOPS:
                    async with flooded(stack, "stop") as during, during():
                        return [{"answer_s": (await _cold_stop(stack, realtime))[1]} for _ in range(rounds_n)]
                async with LOADS.get(load, idle)(stack) as during:
                    return [await _once(stack, during, realtime) for _ in range(rounds_n)]
        finally:
            if reader is not None:
                os.close(reader)


def _schedule(pid: int, policy: int, priority_n: int) -> None:
    os.sched_setscheduler(pid, policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority_n))


def _blocked(path: Path) -> int:
    """A pipe as the daemon's standard error that is full and that nobody reads."""
    os.mkfifo(path)
    reader = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        while True:
            os.write(reader, b"x" * 4096)
    except BlockingIOError:
        return reader


async def _once(stack: Stack, load: Load, realtime: bool) -> dict[str, float]:
    await come_to(stack, Phase.LIFTING)
    async with load():
        called_s, answer_s = await _cold_stop(stack, realtime)
    return {"answer_s": answer_s, **await what_came_of(stack, called_s)}


async def _cold_stop(stack: Stack, realtime: bool) -> tuple[float, float]:
    """When a new process called, and seconds until it had its answer."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", COLD, str(stack.directory / "graderd.sock")), stdout=asyncio.subprocess.PIPE
    )
    if realtime:
        _schedule(process.pid, os.SCHED_RR, PRIORITY_CLIENT_N)
    told, _ = await process.communicate()
    called_s, answered_s = map(float, told.split())
    return called_s, answered_s - called_s


def main() -> int:
    """Command line; status 1 where a median is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20, metavar="N")
    parser.add_argument("--ordinary", action="store_true", help="no real-time scheduling")
    asked = parser.parse_args()
    rounds_n, realtime = asked.rounds, not asked.ordinary
    if realtime:
        _schedule(0, os.SCHED_RR, PRIORITY_CLIENT_N)
    missed = False
    print("| beside the stop | servo | CAN | answer | all axes stand | the blade turned |\n|---|---|---|---|---|---|")
    for load in (*LOADS, STANDARD_ERROR, STOPS):
        rounds = asyncio.run(measure(load, rounds_n, realtime))
        columns = {name: [one[name] for one in rounds] for name in rounds[0]}
        cells = [
            _cell(columns.get(name), factor, unit)
            for name, factor, unit in (
                ("servo_s", 1e3, "ms"),
                ("can_s", 1e3, "ms"),
                ("answer_s", 1e3, "ms"),
                ("still_s", 1e3, "ms"),
                ("way_deg", 1.0, "°"),
            )
        ]
        print(f"| {load} | {' | '.join(cells)} |", flush=True)
        missed |= any(
            1e3 * statistics.median(columns[f"{wire}_s"]) > most_ms
            for wire, most_ms in LIMITS_MS.items()
            if load != STOPS
        )
    limits = ", ".join(f"{wire} {limit_ms:.1f} ms" for wire, limit_ms in LIMITS_MS.items())
    print(f"\nMedian and worst of {rounds_n} rounds; one tick and the wire: {limits}.")
    print(f"Load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores.")
    return int(missed)


def _cell(values: list[float] | None, factor: float, unit: str) -> str:
    if values is None:
        return ""
    digits = 1 if unit == "°" else 0
    median, worst = (f"{factor * value:.{digits}f}" for value in (statistics.median(values), max(values)))
    return f"{median}, {worst}{unit}" if unit == "°" else f"{median}, {worst} {unit}"


if __name__ == "__main__":
    sys.exit(main())
