"""Run times by file, at the end of a run of several (``-p tests.run_times``): where time went, into work or waiting."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Generator, Iterable

import pytest

MIN_SHOWN_S = 1.0
_spent_s = 0.0


def _processor_s() -> float:
    """Processor time of this process and of its ended children so far."""
    return sum(os.times()[:4])


def pytest_collection_finish() -> None:
    """What importing the tests took belongs to no file."""
    global _spent_s
    _spent_s = _processor_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Give each report (set-up, call, teardown) the processor time since the one before; xdist carries it home."""
    global _spent_s
    report = yield
    before, _spent_s = _spent_s, _processor_s()
    report.user_properties.append(("processor_s", _spent_s - before))
    return report


def by_file(reports: Iterable[pytest.TestReport]) -> list[tuple[str, float, float, int]]:
    """`(file, wall_s, processor_s, tests)`, longest wall time first."""
    wall_s: dict[str, float] = defaultdict(float)
    processor_s: dict[str, float] = defaultdict(float)
    tests: dict[str, set[str]] = defaultdict(set)
    for report in reports:
        file = report.nodeid.partition("::")[0]
        wall_s[file] += report.duration
        processor_s[file] += sum(
            seconds for name, seconds in report.user_properties if name == "processor_s" and isinstance(seconds, float)
        )
        tests[file].add(report.nodeid)
    return [(f, wall_s[f], processor_s[f], len(tests[f])) for f in sorted(wall_s, key=wall_s.__getitem__, reverse=True)]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    rows = by_file(r for rs in terminalreporter.stats.values() for r in rs if isinstance(r, pytest.TestReport))
    if len(rows) < 2:
        return
    terminalreporter.section("run times by file")
    terminalreporter.write_line(f"{'wall s':>8} {'processor s':>12} {'tests':>6}")
    for file, wall_s, processor_s, tests in rows:
        if wall_s >= MIN_SHOWN_S:
            terminalreporter.write_line(f"{wall_s:8.1f} {processor_s:12.1f} {tests:6}  {file}")
    total_s, total_processor_s = sum(row[1] for row in rows), sum(row[2] for row in rows)
    count = sum(row[3] for row in rows)
    terminalreporter.write_line(f"{total_s:8.1f} {total_processor_s:12.1f} {count:6}  all {len(rows)} files")
