"""The whole machine as processes: demonstration, death of the daemon in mid-turn, death of the rig in mid-turn."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

from graderd.client import RefusedError
from graderd.simulator.control_client import RigControl
from tests.machine import READY_S, attached, machine, start_rig
from tests.rig_process import running_rig

pytestmark = [pytest.mark.whole_machine, pytest.mark.timeout(240)]


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder whose name leaves a socket's name its room, as a worker's ``tmp_path`` does not."""
    with tempfile.TemporaryDirectory(prefix="graderd-test-") as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def grader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a rig for one daemon after the other."""
    directory = tmp_path_factory.mktemp("grader")
    with running_rig(directory):
        yield directory


@dataclass(frozen=True)
class Demonstrations:
    """Two that ran beside each other: each one's events and exit status, and what they left behind."""

    events: list[list[dict[str, Any]]]
    statuses: list[int | None]
    left: list[Path]


@pytest.fixture(scope="module")
def two_demonstrations() -> Iterator[Demonstrations]:
    """Two checkouts, or two users, with one place for run-time files."""
    with tempfile.TemporaryDirectory(prefix="graderd-test-") as folder:
        running = [
            subprocess.Popen(
                [sys.executable, "-m", "graderd", "demo", "--json"],
                stdout=subprocess.PIPE,
                env={**os.environ, "XDG_RUNTIME_DIR": folder},
            )
            for _ in range(2)
        ]
        said = [process.communicate()[0] for process in running]  # a pipe holds all that one says
        events = [[json.loads(line) for line in out.splitlines()] for out in said]
        yield Demonstrations(events, [process.returncode for process in running], list(Path(folder).iterdir()))


def test_the_demonstration_turns_the_blade_by_what_the_camera_sees(two_demonstrations: Demonstrations) -> None:
    for events, status in zip(two_demonstrations.events, two_demonstrations.statuses, strict=True):
        assert status == 0, events[-5:]
        last = events[-1]
        assert last["event"] == "demo_finished"
        reached = {one["zone"]: (one["requested_deg"], one["measured_deg"]) for one in last["passes"]}
        assert {zone: requested for zone, (requested, _) in reached.items()} == {
            "left": 30.0, "center": 15.0, "right": -30.0, "even": 45.0
        }  # fmt: skip
        for requested_deg, measured_deg in reached.values():
            assert measured_deg == pytest.approx(requested_deg, abs=0.5)


def test_two_demonstrations_beside_each_other_pass(two_demonstrations: Demonstrations) -> None:
    """Nothing of one is the other's, whatever the place for run-time files."""
    for events in two_demonstrations.events:
        assert [one["decided"] for one in events[-1]["passes"]] == ["left", "center", "right", "even"], events[-1]
    assert two_demonstrations.statuses == [0, 0]
    assert two_demonstrations.left == []


async def test_a_demonstration_that_fails_says_why_in_its_last_event(short_path: Path) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "demo", "--json"),
        stdout=asyncio.subprocess.PIPE,
        env={**os.environ, "XDG_RUNTIME_DIR": str(short_path)},
    )
    assert process.stdout is not None
    while json.loads(await process.stdout.readline())["event"] != "armed":
        pass
    (directory,) = short_path.iterdir()
    os.kill(json.loads((directory / "rig.json").read_text())["pid"], signal.SIGKILL)
    out, _ = await process.communicate()
    last = json.loads(out.splitlines()[-1])
    assert process.returncode == 1
    assert last["event"] == "demo_finished"
    assert last["passes"] == []
    # Whoever notices first: the demonstration, which asks the rig, or the daemon, whose devices are gone.
    assert re.search(r"control\.sock|\w+\.(unplugged|no_reply|no_feedback|missing)", last["reason"]), last
    assert list(short_path.iterdir()) == []


async def test_a_pass_that_a_busy_machine_broke_off_is_driven_anew() -> None:
    """A daemon without a processor: the servo's own watchdog ends motion, and the daemon disarms when it sees why."""
    demo = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "demo", "--json"), stdout=asyncio.subprocess.PIPE
    )
    assert demo.stdout is not None
    events: list[str] = []

    async def until(wanted: str) -> dict[str, Any]:
        while True:
            event: dict[str, Any] = json.loads(await demo.stdout.readline())  # type: ignore[union-attr]
            events.append(event["event"])
            assert "demo_finished" not in events, event
            if event["event"] == wanted:
                return event

    try:
        await until("decision")
        (daemon,) = (one for one in psutil.Process(demo.pid).children() if "run" in one.cmdline())
        daemon.suspend()
        await asyncio.sleep(0.6)
        daemon.resume()
        again = await until("again")
        assert again["scene"] == "left"
        assert again["reason"]
        assert (await until("settled"))["zone"] == "left"
    finally:
        demo.send_signal(signal.SIGINT)
        await demo.communicate()


async def test_a_demonstration_ended_from_outside_says_so_and_leaves_nothing(short_path: Path) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "demo", "--json"),
        stdout=asyncio.subprocess.PIPE,
        env={**os.environ, "XDG_RUNTIME_DIR": str(short_path)},
    )
    assert process.stdout is not None
    while json.loads(await process.stdout.readline()) != {"event": "starting", "what": "daemon"}:
        pass
    process.terminate()
    out, _ = await process.communicate()
    assert json.loads(out.splitlines()[-1]) == {"event": "demo_finished", "passes": [], "reason": "ended by SIGTERM"}
    assert process.returncode == 1
    assert list(short_path.iterdir()) == []


async def test_the_servo_stops_by_its_own_watchdog_when_the_daemon_is_killed(grader: Path) -> None:
    async with attached(grader) as whole:
        await whole.turn()
        async with RigControl(grader / "control.sock") as rig:
            moving = await rig.request("state")
            assert abs(moving["blade_velocity_deg_per_s"]) > 5.0
            whole.daemon.send_signal(signal.SIGKILL)
            killed_s = time.monotonic()
            await whole.daemon.wait()
            state = moving
            while abs(state["blade_velocity_deg_per_s"]) > 0.2:
                assert time.monotonic() - killed_s < 5.0
                state = await rig.request("state")
                await asyncio.sleep(0.01)
            stopped_s = time.monotonic() - killed_s
            later = state
            # It stands where its last goal was, too, which is never far away: what ended it has to be the watchdog.
            while not later["servo_watchdog_tripped"]:
                assert time.monotonic() - killed_s < 2.0
                await asyncio.sleep(0.01)
                later = await rig.request("state")
        assert abs(later["blade_deg"] - state["blade_deg"]) < 0.3
        assert later["blade_deg"] < 40.0
        # 200 ms of watchdog and the way to a standstill at 60 deg/s2; the rest is for a loaded machine.
        assert stopped_s < 2.0


async def test_a_dead_rig_is_named_held_and_back_in_standby_when_it_returns(tmp_path: Path) -> None:
    async with machine(tmp_path) as whole:
        await whole.turn()
        whole.rig.send_signal(signal.SIGKILL)
        killed_s = time.monotonic()
        lost = await whole.until(lambda s: any(f.name.startswith("rotation.") for f in s.faults), 5.0)
        assert time.monotonic() - killed_s < 2.0
        assert lost.time_s - killed_s < 0.5 + 0.2  # 0.5 s promised; the poll and a loaded machine have the rest
        everything = await whole.until(lambda s: {"can"} <= {f.name.split(".")[0] for f in s.faults}, 5.0)
        assert everything.mode == "disarmed"
        whole.rig = await start_rig(tmp_path)
        back = await whole.until(lambda s: all(a.lifecycle == "standby" for a in s.axes.values()))
        assert back.mode == "disarmed"
        await whole.until(lambda s: s.soil.frames_per_s > 0)
        await asyncio.sleep(0.5)
        assert (await whole.status()).mode == "disarmed"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
async def test_a_signal_in_mid_turn_ends_everything_within_two_seconds(grader: Path, number: signal.Signals) -> None:
    async with attached(grader) as whole:
        await whole.turn()
        told_s = time.monotonic()
        whole.daemon.send_signal(number)
        status = await whole.daemon.wait()
        assert status == 0
        assert time.monotonic() - told_s < 2.0
        async with RigControl(grader / "control.sock") as rig:
            state = await rig.request("state")
        assert abs(state["blade_velocity_deg_per_s"]) < 0.5
        assert not (grader / "graderd.sock").exists()


async def test_a_second_daemon_on_the_same_socket_says_so_and_disturbs_nothing(grader: Path) -> None:
    async with attached(grader) as whole:
        await whole.until(lambda s: all(a.lifecycle == "standby" for a in s.axes.values()))
        second = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "graderd", "run"),
            *("--config", str(grader / "graderd.toml"), "--rig-dir", str(grader)),
            stderr=asyncio.subprocess.PIPE,
        )
        _, said = await second.communicate()
        assert second.returncode == 1
        assert b"another daemon" in said
        await asyncio.sleep(0.3)
        status = await whole.status()
        assert all(a.lifecycle == "standby" for a in status.axes.values())
        assert status.mode == "disarmed"


async def test_a_colour_method_that_nobody_measured_here_does_not_drive(grader: Path) -> None:
    async with attached(grader, '[perception]\nmethod = "fast_color"\n') as whole:
        await whole.until(lambda s: all(r.met for r in s.readiness if r.mandatory))
        await whole.command("arm")
        await whole.until(lambda s: s.mode == "manual")
        with pytest.raises(RefusedError, match="fast_color, whose worth on this site nobody has measured") as refused:
            await whole.command("auto")
        assert "graderd calibrate color" in refused.value.remedy
        status = await whole.status()
        assert status.mode == "manual"
        assert not next(r.met for r in status.readiness if r.name == "automatic")


async def test_without_any_device_it_says_what_is_missing_and_refuses_to_arm(tmp_path: Path) -> None:
    socket_path = tmp_path / "graderd.sock"
    (tmp_path / "graderd.toml").write_text(
        f'[api]\nsocket = "{socket_path}"\n[rotation]\nport = "{tmp_path}/no-servo"\n'
        f'[can]\ninterface = "slcan"\nchannel = "{tmp_path}/no-can"\n'
        f'[camera]\nsource = "recording"\npath = "{tmp_path}/no.db3"\n',
        encoding="utf-8",
    )
    daemon = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "run", "--config", str(tmp_path / "graderd.toml")),
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        environment = os.environ | {"GRADERD_SOCKET": str(socket_path)}
        async with asyncio.timeout(READY_S):
            while not socket_path.exists():
                await asyncio.sleep(0.05)
            await asyncio.sleep(3.0)
        arm = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "graderd", "arm"), env=environment, stderr=asyncio.subprocess.PIPE
        )
        _, said = await arm.communicate()
        assert arm.returncode == 1
        assert b"rotation" in said
        assert b"lift_left: closed" in said
        assert b"no-can" in said
    finally:
        daemon.terminate()
        _, log = await daemon.communicate()
    assert daemon.returncode == 0
    text = log.decode()
    for name in ("no-servo", "no-can", "no.db3"):
        assert name in text
