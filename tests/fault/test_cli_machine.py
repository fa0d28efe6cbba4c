"""The command line against the whole machine as processes: what it says is what the simulated grader does."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from graderd.simulator.control_client import RigControl
from tests.machine import Served, standing_machine

pytestmark = [pytest.mark.whole_machine, pytest.mark.xdist_group("beside a machine"), pytest.mark.timeout(240)]


@pytest.fixture(scope="module")
def standing() -> Iterator[Served]:
    with tempfile.TemporaryDirectory(prefix="graderd-test-") as folder, standing_machine(Path(folder)) as served:
        yield served


@pytest.fixture
async def whole(standing: Served) -> Served:
    """The machine of all of them, disarmed and without a stop, whatever the test before left."""
    if (await standing.until(lambda _: True)).mode == "stopped":
        await standing.client.reset()
    await standing.command("disarm")
    await standing.until(lambda s: s.mode == "disarmed" and all(a.lifecycle == "standby" for a in s.axes.values()))
    return standing


async def start(directory: Path, *arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "GRADERD_SOCKET": str(directory / "graderd.sock")},
    )


async def graderd(directory: Path, *arguments: str) -> tuple[int | None, str, str]:
    """Exit status, stdout and stderr of one command."""
    process = await start(directory, *arguments)
    async with asyncio.timeout(90):
        out, err = await process.communicate()
    return process.returncode, out.decode(), err.decode()


async def armed(whole: Served) -> None:
    await whole.until(lambda s: bool(s.readiness) and all(r.met for r in s.readiness if r.mandatory))
    status, out, err = await graderd(whole.directory, "arm")
    assert status == 0, err
    assert "armed: manual" in out


async def test_jogs_move_what_they_say_and_no_further(whole: Served) -> None:
    async with RigControl(whole.directory / "control.sock") as rig:
        await armed(whole)
        for axis, value, device, ends_at, tolerance in (
            ("rotate", "+8deg", "rotation", 8.0, 0.6),
            ("rotate", "=-5deg", "rotation", -5.0, 0.6),
            ("lift", "+15mm", "lift_left", 115.0, 2.5),
            ("tilt", "60mm", "tilt", 60.0, 2.5),
        ):
            status, out, err = await graderd(whole.directory, "jog", axis, value, "--json")
            assert status == 0, err
            result = json.loads(out)
            assert result["arrived"] is True
            assert result["measured"][device] == pytest.approx(ends_at, abs=tolerance)
        state: dict[str, Any] = await rig.request("state")
        assert state["blade_deg"] == pytest.approx(-5.0, abs=0.6)
        status, _, err = await graderd(whole.directory, "jog", "rotate", "100deg")
        assert status == 1
        assert "beyond its limits" in err
        assert err.count("\n") == 1
        status, _, _ = await graderd(whole.directory, "stop", "--reason", "end of the test")
        assert status == 0
        status, _, err = await graderd(whole.directory, "jog", "rotate", "+5deg")
        assert status == 1
        assert "Reset, arm, then manual" in err
        assert (await whole.status()).last_stop.startswith("end of the test")


async def test_the_blade_stands_when_the_jogs_process_is_killed(whole: Served) -> None:
    async with RigControl(whole.directory / "control.sock") as rig:
        await armed(whole)
        jog = await start(whole.directory, "jog", "rotate", "50deg")
        state: dict[str, Any] = {"blade_velocity_deg_per_s": 0.0}
        async with asyncio.timeout(30):
            while abs(state["blade_velocity_deg_per_s"]) < 10.0:
                state = await rig.request("state")
                await asyncio.sleep(0.01)
        jog.send_signal(signal.SIGKILL)
        killed_s = time.monotonic()
        while abs(state["blade_velocity_deg_per_s"]) > 0.2:
            assert time.monotonic() - killed_s < 3.0
            state = await rig.request("state")
            await asyncio.sleep(0.01)
        await jog.communicate()
        held = await whole.until(lambda s: s.lease is None)
        assert held.mode == "manual"
        assert held.reason == "released"
        assert state["blade_deg"] < 40.0


@pytest.mark.parametrize("named", [False, True])
async def test_the_bus_of_the_running_daemon_is_dumped_through_it(whole: Served, named: bool) -> None:
    """Its serial adapter has one reader, and that is the daemon: frames of both directions, and nobody is disturbed."""
    await whole.until(lambda s: all(s.axes[name].measured is not None for name in ("lift_left", "tilt")))
    channel = (await whole.client.config())["can"]["channel"]
    dumping = await start(whole.directory, "can", "dump", *([channel] if named else []), "--json")
    assert dumping.stdout is not None
    seen: set[tuple[str, int]] = set()
    async with asyncio.timeout(60):
        while len(seen) < 6:
            frame = json.loads(await dumping.stdout.readline())
            if frame["name"] in ("ACM", "AFM"):
                seen.add((frame["name"], frame["destination" if frame["name"] == "ACM" else "source"]))
    assert seen == {(name, address) for name in ("ACM", "AFM") for address in (19, 20, 27)}
    dumping.send_signal(signal.SIGINT)
    async with asyncio.timeout(30):
        _, err = await dumping.communicate()
    assert err == b""
    assert (await whole.status()).axes["tilt"].lifecycle == "standby"


async def test_the_servos_wire_is_dumped_through_the_daemon(whole: Served) -> None:
    """Requests and answers with their registers, from the one owner of the port, which is not disturbed."""
    await whole.until(lambda s: s.axes["rotation"].measured is not None)
    dumping = await start(whole.directory, "rotation", "dump", "--json")
    assert dumping.stdout is not None
    seen: list[dict[str, Any]] = []
    wanted = {"present_position", "hardware_error_status"}
    async with asyncio.timeout(60):
        while not wanted <= {name for packet in seen for name in packet["registers"]}:
            seen.append(json.loads(await dumping.stdout.readline()))
    answers = [p for p in seen if "present_position" in p["registers"]]
    assert {(p["kind"], p["direction"], p["id"], p["error"]) for p in answers} == {("status", "rx", 1, "")}
    assert all(p["registers"]["present_temperature"]["unit"] == "degC" for p in answers)
    asked = {p["address"] for p in seen if p["kind"] == "read" and p["direction"] == "tx"}
    assert {p["address"] for p in answers} <= asked
    assert [p for p in seen if p["kind"] == "damaged"] == []
    dumping.send_signal(signal.SIGINT)
    async with asyncio.timeout(30):
        _, err = await dumping.communicate()
    assert err == b""
    assert (await whole.status()).axes["rotation"].lifecycle == "standby"


async def test_a_wrong_configuration_is_told_and_nothing_starts(tmp_path: Path) -> None:
    config = tmp_path / "wrong.toml"
    config.write_text("[rotation]\nmax_dg = 45.0\n")
    status, out, err = await graderd(tmp_path, "run", "--config", str(config))
    assert status == 2
    assert out == ""
    assert "Did you mean rotation.max_deg?" in err
    assert "Traceback" not in err
