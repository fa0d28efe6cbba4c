"""What floods of requests do to the control tick and to a stop: ``python -m benchmarks.api [--json]``.

The interface runs over the state machine ticking at 50 Hz in one process, the flood in another, ``graderd stop`` in a
third. "Late" is how long after its due time a tick ran; "stop" is from starting the command to the latched stop.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from graderd.api.settings import ApiLimits
from graderd.core.machine import Mode
from harness.api_daemon import FakeDaemon, serving

FLOOD_S = 4.0
CASES = (("none", 0), ("ask", 100), ("ask", 400), ("hammer", 50), ("stop", 100))
UNLIMITED = ApiLimits(
    rate_hz=1e6,
    burst_n=10**6,
    accept_rate_hz=1e6,
    stop_rate_hz=1e6,
    active_n=10**5,
    waiting_n=10**5,
    connections_max_n=10**5,
)


def main() -> None:
    """Run all cases with and without the limits and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    as_json = parser.parse_args().json
    results = []
    for limits, text in ((ApiLimits(), "limits"), (UNLIMITED, "no limits")):
        for kind, connections_n in CASES:
            result = {"settings": text, **asyncio.run(measure(kind, connections_n, limits))}
            results.append(result)
            if not as_json:
                print("  ".join(f"{name} {value}" for name, value in result.items()), flush=True)
    if as_json:
        print(json.dumps({"results": results}))


async def measure(kind: str, connections_n: int, limits: ApiLimits) -> dict[str, Any]:
    """One flood."""
    with tempfile.TemporaryDirectory() as directory:
        async with serving(Path(directory), limits=limits) as (daemon, path):
            flood = await _start("harness.api_flood", str(path), str(FLOOD_S), kind, str(connections_n))
            await asyncio.sleep(1.0)
            daemon.late_s.clear()
            await asyncio.sleep(FLOOD_S / 4)
            stop_s = await _stop(daemon, path)
            counts = json.loads((await flood.communicate())[0])
            late_s = sorted(daemon.late_s)
    return {
        "flood": kind,
        "clients_n": connections_n,
        "late_p50_ms": round(late_s[len(late_s) // 2] * 1e3, 1),
        "late_p99_ms": round(late_s[int(len(late_s) * 0.99)] * 1e3, 1),
        "stop_s": round(stop_s, 2),
        "requests_per_s": round(counts.get("sent", 0) / FLOOD_S),
        "answers": counts,
    }


async def _stop(daemon: FakeDaemon, path: Path) -> float:
    """Seconds until ``graderd stop`` is in force (0 where the flood has stopped the machine itself)."""
    began_s = time.monotonic()
    stop = await _start("graderd.cli", "--socket", str(path), "stop")
    await daemon.until(lambda: daemon.state.mode is Mode.STOPPED, timeout_s=20.0)
    stopped_s = time.monotonic()
    await stop.communicate()
    return stopped_s - began_s


async def _start(module: str, *arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", module, *arguments, stdout=asyncio.subprocess.PIPE
    )


if __name__ == "__main__":
    main()
