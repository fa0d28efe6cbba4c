"""Servo bus beside dynamixel-sdk and rustypot: transactions, CPU and event-loop lateness on one virtual wire.

``python benchmarks/dynamixel.py [--seconds S] [--rounds N] [--json]``. For each baud rate the virtual servo runs in a
process of its own and answers as late as a real wire would (request bytes, the factory's 500 µs return delay, reply
bytes). Each client runs in a process of its own too, on an asyncio loop with a 5 ms ticker beside it: ours natively,
the others in a thread, as an asyncio program would have to. One transaction reads 25 bytes: our telemetry block;
rustypot, whose addresses end at 255, reads as many from address 0.

What is counted as a client's CPU: that of its process, less what the same process takes with the same ticker and the
same pacing (a sleep between two reads where a rate is asked for) and no transaction at all. The hand-over to a thread
and back belongs to the clients that need it.

Other programs on the machine can only slow things down: of N rounds, in each of which everything is measured once,
the best is shown, and the column p10 is what an exchange takes when they leave it alone. Reads at the same rate are
few: their measurements last three times as long.

The bars: at least 90 % of what the wire allows, and at most a tenth of the SDK's CPU at the same rate.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

BAUDS = (57_600, 1_000_000)
NOTHING = "no transaction"
CLIENTS = ("graderd", "dynamixel-sdk in a thread", "rustypot in a thread")
REQUEST_BYTES, REPLY_BYTES, BLOCK_BYTES = 14, 36, 25
RETURN_DELAY_S = 500e-6
TICK_S = 0.005
SAME_RATE_HZ = 50.0
SAME_RATE_LONGER = 3


def wire_limit_hz(baud_n: int) -> float:
    """Transactions a second if nobody needed any time but the wire."""
    return 1.0 / ((REQUEST_BYTES + REPLY_BYTES) * 10 / baud_n + RETURN_DELAY_S)


# -- the clients: each returns "do one transaction" ------------------------------------------------------------------


async def _ours(port: str, baud_n: int) -> tuple[Callable[[], Awaitable[bool]], Callable[[], None]]:
    from graderd.drivers.dynamixel.bus import ServoBus
    from graderd.hal.errors import DeviceTimeoutError

    bus = ServoBus(port, baud_n)
    bus.open()

    async def once() -> bool:
        try:
            return len((await bus.read(1, 570, BLOCK_BYTES, attempts_n=1)).data) == BLOCK_BYTES
        except DeviceTimeoutError:
            return False

    return once, bus.close


async def _sdk(port: str, baud_n: int) -> tuple[Callable[[], Awaitable[bool]], Callable[[], None]]:
    from dynamixel_sdk import PacketHandler, PortHandler

    handler, packets = PortHandler(port), PacketHandler(2.0)
    assert handler.openPort()
    assert handler.setBaudRate(baud_n)

    def once() -> bool:
        data, result, error = packets.readTxRx(handler, 1, 570, BLOCK_BYTES)
        return bool(result == 0 and error == 0 and len(data) == BLOCK_BYTES)

    async def in_thread() -> bool:
        return await asyncio.to_thread(once)

    return in_thread, handler.closePort


async def _rustypot(port: str, baud_n: int) -> tuple[Callable[[], Awaitable[bool]], Callable[[], None]]:
    from rustypot import Xl430PyController

    bus = Xl430PyController(port, baud_n, 0.1)

    def once() -> bool:
        try:
            return len(bus.read_raw_data(1, 0, BLOCK_BYTES)) == BLOCK_BYTES
        except OSError:
            return False

    async def in_thread() -> bool:
        return await asyncio.to_thread(once)

    return in_thread, bus.close


async def _nothing(port: str, baud_n: int) -> tuple[Callable[[], Awaitable[bool]], Callable[[], None]]:
    del port, baud_n

    async def once() -> bool:
        return True

    return once, lambda: None


async def _measure(client: str, port: str, baud_n: int, seconds: float, rate_hz: float | None) -> dict[str, float]:
    make = dict(zip((*CLIENTS, NOTHING), (_ours, _sdk, _rustypot, _nothing), strict=True))[client]
    once, close = await make(port, baud_n)
    for _ in range(20):
        await once()
    if client == NOTHING and rate_hz is None:
        rate_hz = 10.0
    late_s: list[float] = []
    stop = asyncio.Event()

    async def ticker() -> None:
        loop = asyncio.get_running_loop()
        while not stop.is_set():
            due_s = loop.time() + TICK_S
            await asyncio.sleep(TICK_S)
            late_s.append(loop.time() - due_s)

    ticking = asyncio.create_task(ticker(), name="ticker")
    good_n = bad_n = 0
    times_s: list[float] = []
    before, began_s = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    next_s = began_s
    while (now_s := time.monotonic()) < began_s + seconds:
        if await once():
            good_n += 1
        else:
            bad_n += 1
        times_s.append(time.monotonic() - now_s)
        if rate_hz is not None:
            next_s += 1.0 / rate_hz
            await asyncio.sleep(max(0.0, next_s - time.monotonic()))
    spent_s = time.monotonic() - began_s
    after = resource.getrusage(resource.RUSAGE_SELF)
    stop.set()
    await ticking
    close()
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    late_s.sort()
    times_s.sort()
    return {
        "rate_hz": good_n / spent_s,
        "errors_n": bad_n,
        "cpu_percent": 100 * cpu_s / spent_s,
        "transaction_p10_ms": 1e3 * times_s[len(times_s) // 10],
        "transaction_p50_ms": 1e3 * times_s[len(times_s) // 2],
        "transaction_p99_ms": 1e3 * times_s[int(len(times_s) * 0.99)],
        "loop_late_p99_ms": 1e3 * late_s[int(len(late_s) * 0.99)],
        "loop_late_max_ms": 1e3 * late_s[-1],
    }


# -- the run --------------------------------------------------------------------------------------------------------


def run(seconds: float, rounds_n: int) -> dict[str, Any]:
    """All clients at all rates; the result as plain data."""
    rates_hz = (None, SAME_RATE_HZ)
    tries: dict[tuple[int, str, float | None], list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for baud_n in BAUDS:
            with _servo(Path(folder) / f"servo{baud_n}", baud_n) as port:
                for _, rate_hz, client in itertools.product(range(rounds_n), rates_hz, (NOTHING, *CLIENTS)):
                    lasting_s = seconds if rate_hz is None else SAME_RATE_LONGER * seconds
                    measured = _client(client, port, baud_n, lasting_s, rate_hz)
                    tries.setdefault((baud_n, client, rate_hz), []).append(measured)
    idle_percent = {
        (baud_n, rate_hz): min(m["cpu_percent"] for m in tries[baud_n, NOTHING, rate_hz])
        for baud_n in BAUDS
        for rate_hz in rates_hz
    }
    rows = []
    for (baud_n, client, rate_hz), measured_n in tries.items():
        if client != NOTHING:
            best = (
                max(measured_n, key=lambda m: m["rate_hz"])
                if rate_hz is None
                else min(measured_n, key=lambda m: m["cpu_percent"])
            )
            rows.append(_row(client, baud_n, rate_hz, best, idle_percent[baud_n, rate_hz]))
    bars = [_bars(rows, baud_n) for baud_n in BAUDS]
    return {"load_average": os.getloadavg()[0], "cpus_n": os.cpu_count(), "rows": rows, "bars": bars}


@contextlib.contextmanager
def _servo(link: Path, baud_n: int) -> Iterator[str]:
    """A virtual servo on a wire that takes its time, in a process of its own; the port's path."""
    command = [sys.executable, "-m", "graderd.simulator.servo", "--link", str(link)]
    command += ["--baud", str(baud_n), "--wire-time"]
    servo = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
    try:
        assert servo.stdout is not None
        servo.stdout.readline()
        yield str(link)
    finally:
        servo.terminate()
        servo.wait()


def _client(client: str, port: str, baud_n: int, seconds: float, rate_hz: float | None) -> dict[str, float]:
    command = [sys.executable, __file__, "--client", client, "--port", port, "--baud", str(baud_n)]
    command += ["--seconds", str(seconds)]
    if rate_hz is not None:
        command += ["--rate", str(rate_hz)]
    measured: dict[str, float] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return measured


def _row(
    client: str, baud_n: int, rate_hz: float | None, measured: dict[str, float], idle_percent: float
) -> dict[str, Any]:
    limit_hz = wire_limit_hz(baud_n)
    cpu_percent = max(0.01, measured["cpu_percent"] - idle_percent)
    return {
        **measured,
        "client": client,
        "baud_n": baud_n,
        "asked_hz": rate_hz,
        "wire_limit_hz": limit_hz,
        "of_limit_percent": 100 * measured["rate_hz"] / limit_hz,
        "cpu_percent": cpu_percent,
        "idle_percent": idle_percent,
        "cpu_us_per_transaction": 1e4 * cpu_percent / max(1e-9, measured["rate_hz"]),
    }


def _bars(rows: list[dict[str, Any]], baud_n: int) -> dict[str, Any]:
    def find(client: str, rate_hz: float | None) -> dict[str, Any]:
        return next(r for r in rows if (r["client"], r["baud_n"], r["asked_hz"]) == (client, baud_n, rate_hz))

    ours, sdk = CLIENTS[:2]
    return {
        "baud_n": baud_n,
        "of_limit_percent": find(ours, None)["of_limit_percent"],
        "of_limit_bar_met": find(ours, None)["of_limit_percent"] >= 90.0,
        "cpu_ratio_at_full_rate": find(sdk, None)["cpu_us_per_transaction"]
        / find(ours, None)["cpu_us_per_transaction"],
        "cpu_ratio_at_same_rate": find(sdk, SAME_RATE_HZ)["cpu_percent"] / find(ours, SAME_RATE_HZ)["cpu_percent"],
    }


def _print(result: dict[str, Any]) -> None:
    print(f"{result['cpus_n']} CPUs, load average {result['load_average']:.1f}; 25-byte reads, 500 µs return delay")
    for row in result["rows"]:
        if row["client"] == CLIENTS[0]:
            pacing = f" and the pacing of {row['asked_hz']:.0f} reads/s" if row["asked_hz"] else ""
            print(f"{row['baud_n']:>8} baud, not counted: the ticker{pacing}: {row['idle_percent']:.2f} % CPU")
    head = f"{'baud':>8} {'client':<26} {'asked':>6} {'rate':>7} {'limit':>6} {'errors':>6} {'CPU':>7} {'CPU/read':>9}"
    print(f"{head} {'p10':>7} {'p50':>7} {'p99':>7} {'late p99':>9} {'late max':>9}")
    for r in result["rows"]:
        asked = "full" if r["asked_hz"] is None else f"{r['asked_hz']:.0f}/s"
        print(
            f"{r['baud_n']:>8} {r['client']:<26} {asked:>6} {r['rate_hz']:>5.0f}/s {r['of_limit_percent']:>5.1f}% "
            f"{r['errors_n']:>6.0f} {r['cpu_percent']:>6.1f}% {r['cpu_us_per_transaction']:>6.0f} µs "
            f"{r['transaction_p10_ms']:>4.2f} ms {r['transaction_p50_ms']:>4.2f} ms {r['transaction_p99_ms']:>4.1f} ms "
            f"{r['loop_late_p99_ms']:>6.2f} ms {r['loop_late_max_ms']:>6.2f} ms"
        )
    for b in result["bars"]:
        print(
            f"{b['baud_n']:>8} baud: {b['of_limit_percent']:.1f} % of the wire's limit (bar 90 %); the SDK takes "
            f"{b['cpu_ratio_at_full_rate']:.1f} times our CPU a read at full rate, "
            f"{b['cpu_ratio_at_same_rate']:.1f} times at {SAME_RATE_HZ:.0f} reads/s (bar 10)"
        )


def main() -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seconds", type=float, default=5.0, help="of each measurement at full rate (default %(default)s)"
    )
    parser.add_argument("--rounds", type=int, default=3, help="of which the best is shown (default %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.add_argument("--client", choices=(*CLIENTS, NOTHING), help=argparse.SUPPRESS)
    parser.add_argument("--port", help=argparse.SUPPRESS)
    parser.add_argument("--baud", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--rate", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.client:
        print(json.dumps(asyncio.run(_measure(args.client, args.port, args.baud, args.seconds, args.rate))))
        return 0
    result = run(args.seconds, args.rounds)
    if args.json:
        print(json.dumps(result))
    else:
        _print(result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
