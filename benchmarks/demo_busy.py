"""Whether the demonstration passes on a busy machine: ``python -m benchmarks.demo_busy [RUNS] [LOOPS] [CORES]``.

RUNS (20) demonstrations one after the other, beside LOOPS (10) processes that do nothing but compute, all of them on
CORES (2) processors. Prints a line a run, with what had to be done again, and one JSON object at the end. Status 0: all
passed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from typing import Any


def run() -> dict[str, Any]:
    """One demonstration: whether it passed, how long it took, the reason of what was broken off."""
    began_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "graderd", "demo", "--json"], stdout=subprocess.PIPE, text=True, check=False
    )
    events = [json.loads(line) for line in done.stdout.splitlines()]
    return {
        "passed": done.returncode == 0,
        "took_s": round(time.monotonic() - began_s, 1),
        "again": [event["reason"] for event in events if event["event"] == "again"],
        "reason": events[-1].get("reason", "") if events else "it said nothing",
    }


def main() -> int:
    runs_n, loops_n, cores_n = (
        int(given) if given else usual
        for given, usual in zip((*sys.argv[1:], "", "", "")[:3], (20, 10, 2), strict=True)
    )
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores_n])
    runs = []
    with ExitStack() as stack:
        for _ in range(loops_n):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(busy.kill)
        for _ in range(runs_n):
            runs.append(run())
            print(json.dumps(runs[-1]), flush=True)
    passed_n = sum(one["passed"] for one in runs)
    longest_s = max(one["took_s"] for one in runs)
    again_n = sum(len(one["again"]) for one in runs)
    print(json.dumps({"passed_n": passed_n, "of_n": runs_n, "again_n": again_n, "longest_s": longest_s}))
    return 0 if passed_n == runs_n else 1


if __name__ == "__main__":
    sys.exit(main())
