"""The programs under examples/ do on the simulated machine what they say."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest

from tests.machine import machine

pytestmark = [pytest.mark.whole_machine, pytest.mark.timeout(240)]
EXAMPLES = Path(__file__).parents[2] / "examples"


async def run(name: str, *arguments: str) -> tuple[int | None, str]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, str(EXAMPLES / name), *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    out, _ = await process.communicate()
    return process.returncode, out.decode()


async def test_watch_jog_and_stop(tmp_path: Path) -> None:
    socket = str(tmp_path / "graderd.sock")
    async with machine(tmp_path) as whole:
        await whole.until(lambda s: bool(s.readiness) and all(r.met for r in s.readiness if r.mandatory))
        status, out = await run("watch_status.py", socket, "3")
        assert status == 0, out
        assert out.count("disarmed (") == 3
        status, out = await run("jog_with_lease.py", socket, "6")
        assert status == 0, out
        assert "arrived at +" in out
        after = await whole.until(lambda s: s.mode == "disarmed" and s.lease is None)
        assert after.axes["rotation"].measured == pytest.approx(6.0, abs=0.6)
        status, out = await run("stop.py", socket)
        assert status == 0, out
        assert (await whole.status()).mode == "stopped"
        status, out = await run("jog_with_lease.py", socket, "6")
        assert status == 1
        assert out.startswith("arm: stopped: example")
    status, out = await run("stop.py", str(tmp_path / "gone.sock"))
    assert status == 1
    assert out.startswith("NOT STOPPED, use the emergency stop")


def test_every_example_is_run_here() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == {"watch_status.py", "jog_with_lease.py", "stop.py"}
