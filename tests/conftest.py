"""Shared by all tests: a task left running on the event loop fails the test that left it."""

from __future__ import annotations

import asyncio
import gc
import inspect
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from _pytest.nodeid import NodeId
from hypothesis import HealthCheck, settings

# Loaded machines draw slowly: no test of ours may depend on that. The same examples every time, so that a green commit
# stays green; the fuzz scripts under benchmarks/ look further with seeds of their own.
settings.register_profile(
    "graderd", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("graderd")

# A script's background job ignores SIGINT from its start, and so would every process that a test starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


UNIT = Path(__file__).with_name("unit")
RERUNS_MOST_N = 2


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """A unit test that is not ``live`` is ``pure``; whole machines take turns, in three groups, whatever else runs
    beside them; every asynchronous test gets the check for leaked tasks, synchronous ones need no event loop."""
    for item in items:
        if UNIT in item.path.parents and not item.get_closest_marker("live"):
            item.add_marker("pure")
        else:
            # What runs in real time misses deadlines where others take the processors: once more, and told as a rerun.
            item.add_marker(pytest.mark.flaky(reruns=1))
        if item.get_closest_marker("whole_machine") and not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group("whole machine"))
        if isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj):
            item.fixturenames.insert(0, "no_leaked_tasks")
        group = item.get_closest_marker("xdist_group")
        if group and getattr(config.option, "loadgroup", False):
            # xdist 3.8 writes the group where pytest 9.2 no longer looks: no group was kept together, nothing said so.
            item._id = NodeId.parse(f"{item.nodeid}@{group.args[0]}")
            assert item.nodeid.endswith(f"@{group.args[0]}")


def pytest_collection_finish() -> None:
    """What collecting thousands of tests left behind is no garbage of a test's: a full collection through it holds an
    event loop for 0.1 to 0.2 s. Daemon and rig do the same after their start."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """A run in which more than a few were made once more has failed: what fails often is no busy machine."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and len(reporter.stats.get("rerun", ())) > RERUNS_MOST_N:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture
async def no_leaked_tasks() -> AsyncIterator[None]:
    """Fail a test whose tasks outlive it. Fixtures that start tasks end them in their own teardown first."""
    before = asyncio.all_tasks()
    yield
    await asyncio.sleep(0)
    here = asyncio.current_task()
    leaked = [task for task in asyncio.all_tasks() - before if not task.done() and task is not here]
    names = ", ".join(sorted(task.get_name() for task in leaked))
    for task in leaked:
        task.cancel()
    if leaked:
        await asyncio.gather(*leaked, return_exceptions=True)
        pytest.fail(f"tasks left running: {names}")
