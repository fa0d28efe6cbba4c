"""What recording costs, what a kill leaves: ``python -m benchmarks.record [--kills 100] [--first 0] [--cost-s 120]``.

Cost: an event loop ticks at 50 Hz as the daemon does; every ten seconds the recorder is given its ticks or not, in the
same run. Beside processor time of the whole process, the lateness of the ticks is compared. Kills: a process records at
50 Hz and is ended by SIGKILL at a moment of chance; its file must read to within a second of it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import resource
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from graderd.record.store import Store
from harness.recording import Feed, record_until_killed

WINDOW_S = 10.0
BESIDE_N = 2


def cpu_s() -> float:
    """Processor time of this process so far, all threads."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


async def cost(seconds: float, directory: Path) -> dict[str, float]:
    """Processor share and lateness with and without, window by window in turn."""
    feed = Feed(directory)
    task = asyncio.create_task(feed.recorder.run())
    spent: dict[bool, list[float]] = {True: [], False: []}
    late_ms: dict[bool, list[float]] = {True: [], False: []}
    for number in range(round(seconds / WINDOW_S / 2) * 2):
        recording = number % 2 == 0
        began_s, cpu_before = time.monotonic(), cpu_s()
        late_ms[recording] += await feed.ticks(WINDOW_S, recording)
        spent[recording].append((cpu_s() - cpu_before) / (time.monotonic() - began_s))
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)

    def p99(values: list[float]) -> float:
        return sorted(values)[int(0.99 * len(values))]

    with_it, without = (sorted(spent[on])[len(spent[on]) // 2] for on in (True, False))
    return {
        "cost_percent": round(100.0 * (with_it - without), 2),
        "late_p99_ms": round(p99(late_ms[True]), 3),
        "late_p99_without_ms": round(p99(late_ms[False]), 3),
        "late_p50_ms": round(sorted(late_ms[True])[len(late_ms[True]) // 2], 3),
        "late_p50_without_ms": round(sorted(late_ms[False])[len(late_ms[False]) // 2], 3),
        "mb_per_hour": round(
            sum(entry.size_n for entry in Store(directory, 0.0, 0.0).entries()) / 1e6 / (seconds / 2.0) * 3600.0, 1
        ),
    }


def kills(first_n: int, count_n: int, directory: Path) -> dict[str, float]:
    """Kill that many recording processes; every file must read, and what was lost at most. ``first_n``: so many of the
    series were made before; a hundred may be made in portions."""
    chance = random.Random(1)
    moments_s = [1.5 + chance.random() for _ in range(first_n + count_n)][first_n:]
    with ThreadPoolExecutor(BESIDE_N) as pool:
        lost_s = list(pool.map(record_until_killed, (directory / str(n) for n in range(count_n)), moments_s))
    lost_s.sort()
    return {
        "kills_n": count_n,
        "over_1_s_n": sum(lost > 1.0 for lost in lost_s),
        "lost_most_s": round(lost_s[-1], 3),
        "lost_mean_s": round(sum(lost_s) / count_n, 3),
    }


def main() -> int:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cost-s", type=float, default=120.0)
    options = parser.parse_args()
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        if options.cost_s:
            found |= asyncio.run(cost(options.cost_s, Path(folder) / "cost"))
        if options.kills:
            found |= kills(options.first, options.kills, Path(folder) / "kills")
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
