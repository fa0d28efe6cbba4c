"""How many lines a daemon without any device logs in 24 hours: ``python -m benchmarks.log_volume [SECONDS]``.

Runs the daemon for SECONDS (300) with nothing plugged in and takes every record it logs, before anything is left out.
What came in the second half, when every retry has reached its longest pause, is repeated until 24 hours are full and
sent through the filter of the daemon's log at the times it would have had. Prints one JSON object.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

from graderd.config import parse
from graderd.runtime.app.daemon import Daemon
from graderd.runtime.app.journal import RepeatFilter

DAY_S = 86_400.0
ABSENT = {
    "rotation": {"port": "/nonexistent/servo"},
    "can": {"interface": "socketcan", "channel": "absent0"},
}


class _Collector(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.records: list[tuple[float, logging.LogRecord]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append((time.monotonic(), record))


def collect(seconds: float) -> tuple[float, list[tuple[float, logging.LogRecord]]]:
    """Run the daemon; every record with its time since the start, and how long it ran."""
    collector = _Collector()
    logging.basicConfig(level=logging.INFO, handlers=[collector], force=True)
    with tempfile.TemporaryDirectory() as directory:
        sections = {"api": {"socket": str(Path(directory) / "api.sock")}, "state": {"directory": directory}}
        began_s = time.monotonic()
        timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
        timer.start()
        asyncio.run(Daemon(parse({**ABSENT, **sections}), None).run())
        ran_s = time.monotonic() - began_s
    return ran_s, [(at_s - began_s, record) for at_s, record in collector.records]


def told_in_a_day(ran_s: float, records: list[tuple[float, logging.LogRecord]]) -> int:
    """Lines left of 24 hours, the second half of the run repeated to fill them."""
    half_s = ran_s / 2
    steady = [(at_s - half_s, record) for at_s, record in records if half_s <= at_s < ran_s - 1.0]
    now_s = 0.0
    repeats = RepeatFilter(lambda: now_s)
    told_n = 0
    for at_s, record in _day(records, steady, half_s):
        now_s = at_s
        told_n += repeats.filter(logging.makeLogRecord(record.__dict__))
    return told_n


def _day(
    records: list[tuple[float, logging.LogRecord]], steady: list[tuple[float, logging.LogRecord]], half_s: float
) -> list[tuple[float, logging.LogRecord]]:
    day = [(at_s, record) for at_s, record in records if at_s < half_s]
    rounds_n = int((DAY_S - half_s) / half_s)
    for number in range(1, rounds_n + 1):
        day += [(number * half_s + at_s, record) for at_s, record in steady]
    return day


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 300.0
    ran_s, records = collect(seconds)
    print(
        json.dumps(
            {
                "measured_s": round(ran_s, 1),
                "records_n": len(records),
                "records_per_hour_unfiltered": round(len(records) * 3600 / ran_s),
                "lines_in_24_h": told_in_a_day(ran_s, records),
                "messages": sorted({record.getMessage()[:120] for _, record in records})[:20],
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
