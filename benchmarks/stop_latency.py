"""From a stop to the last motion command on both wires: ``python -m benchmarks.stop_latency [--rounds N]``.

The whole machine as processes: the rig notes when goals were written to its servo and when messages that allow motion
came to its actuators, on the clock that the stop's sender reads too. Every round moves the lifts and stops them in
mid-motion, from a process started for it, on the stop socket; time begins when that process connects. Promised: one
control tick (20 ms) and the wire's time.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

from graderd.hal.settings import CanSettings
from harness.campaign.model import Phase
from harness.campaign.stack import Stack
from harness.stops import stopped_in_motion

TICK_MS = 20.0
LIMITS_MS = {"servo": TICK_MS + 8.0, "can": TICK_MS + 1.8}
"""Servo: a write of profile and goal (35 bytes) with its answer (11 bytes) at 57,600 bit/s. CAN: three control messages
of 160 bits at 250 kbit/s."""
COLD = """
import socket, sys, time
with socket.socket(socket.AF_UNIX) as connection:
    print(time.monotonic())
    connection.connect(sys.argv[1])
    connection.sendall(b"benchmark")
    assert connection.recv(4096).split()[1] == b"200"
"""
CLAIM_ID = 0x18EEFF00
Load = Callable[[Stack], AbstractAsyncContextManager[None]]


@asynccontextmanager
async def idle(_: Stack) -> AsyncIterator[None]:
    yield


@asynccontextmanager
async def flooded(stack: Stack) -> AsyncIterator[None]:
    flood = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "harness.api_flood", str(stack.directory / "graderd.sock"), "600", "ask", "400"),
        stdout=asyncio.subprocess.DEVNULL,
    )
    await asyncio.sleep(1.5)
    try:
        yield
    finally:
        flood.kill()
        await flood.wait()


@asynccontextmanager
async def stalled_state(stack: Stack) -> AsyncIterator[None]:
    """A file whose opening hangs."""
    path = stack.directory / "state" / "last_stop.new"
    os.mkfifo(path)
    try:
        yield
    finally:
        os.close(os.open(path, os.O_RDONLY | os.O_NONBLOCK))
        path.unlink(missing_ok=True)


@asynccontextmanager
async def full_bus(stack: Stack) -> AsyncIterator[None]:
    async def send() -> None:
        while True:
            await stack.ask_rig("can_frame", can_id=0x18FF1080, data_hex="0011223344556677")

    tasks = [asyncio.create_task(send(), name=f"bus load {n}") for n in range(4)]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@asynccontextmanager
async def address_lost(stack: Stack) -> AsyncIterator[None]:
    """A node whose name wins claims the daemon's address."""
    await stack.ask_rig("can_frame", can_id=CLAIM_ID | CanSettings().source_address_n, data_hex="00" * 8)
    yield


LOADS: dict[str, Load] = {
    "idle": idle,
    "400 clients flooding": flooded,
    "state directory stalled": stalled_state,
    "CAN bus loaded": full_bus,
    "address lost": address_lost,
}


async def measure(rounds_n: int, stderr_blocked: bool) -> list[tuple[str, str, float, float]]:
    """Rows of load, wire, median and worst in milliseconds."""
    loads = {"standard error blocked": idle} if stderr_blocked else LOADS
    found = []
    with tempfile.TemporaryDirectory() as directory:
        stack = Stack(Path(directory))
        reader = _blocked(stack.log_path) if stderr_blocked else None
        async with stack:
            for load_name, load in loads.items():
                rounds = [await _once(stack, load) for _ in range(rounds_n)]
                for wire in LIMITS_MS:
                    times_ms = [1e3 * one[wire] for one in rounds]
                    found.append((load_name, wire, statistics.median(times_ms), max(times_ms)))
        if reader is not None:
            os.close(reader)
    return found


def _blocked(path: Path) -> int:
    """A pipe as the daemon's standard error that is full and that nobody reads."""
    os.mkfifo(path)
    reader = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        while True:
            os.write(reader, b"x" * 4096)
    except BlockingIOError:
        return reader


async def _once(stack: Stack, load: Load) -> dict[str, float]:
    """Seconds from the connect to the last motion command, by wire."""
    began_s, connected_s = 0.0, 0.0

    async def stop(stack: Stack) -> None:
        nonlocal began_s, connected_s
        began_s = time.monotonic()
        async with load(stack):
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-S", "-c", COLD, str(stack.directory / "graderd.stop")),
                stdout=asyncio.subprocess.PIPE,
            )
            told, _ = await process.communicate()
            connected_s = float(told)

    found = await stopped_in_motion(stack, Phase.LIFTING, stop)
    return {wire: found[f"{wire}_s"] - (connected_s - began_s) for wire in LIMITS_MS}


def main() -> int:
    """Command line; status 1 where a median is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20, metavar="N")
    rounds_n = parser.parse_args().rounds
    found = [row for blocked in (False, True) for row in asyncio.run(measure(rounds_n, blocked))]
    print("| load | wire | median | worst | one tick and the wire |\n|---|---|---|---|---|")
    for load, wire, median_ms, worst_ms in found:
        print(f"| {load} | {wire} | {median_ms:.1f} ms | {worst_ms:.1f} ms | {LIMITS_MS[wire]:.1f} ms |")
    print(f"\n{rounds_n} rounds each; load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    return int(any(median_ms > LIMITS_MS[wire] for _, wire, median_ms, _ in found))


if __name__ == "__main__":
    sys.exit(main())
