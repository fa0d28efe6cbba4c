"""The check for leaked tasks itself: it must be able to fail."""

from __future__ import annotations

from pathlib import Path

import pytest

import tests.conftest

pytestmark = pytest.mark.live

pytest_plugins = ["pytester"]

CONFTEST = Path(tests.conftest.__file__).read_text(encoding="utf-8")


def test_a_leaked_task_fails_its_test(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function\n")
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(
        """
        import asyncio

        async def test_leaks():
            asyncio.get_running_loop().create_task(asyncio.sleep(60), name="left-behind")

        async def test_does_not():
            await asyncio.create_task(asyncio.sleep(0))
        """
    )
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:rerunfailures")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*tasks left running: left-behind*"])
