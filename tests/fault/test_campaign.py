"""The shortened fault campaign passes, and a spoiled reaction turns it red."""

from __future__ import annotations

import asyncio
import json
import os
import select
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import catalogue_key
from harness.bound import bound
from harness.campaign.__main__ import CASES, about, chosen, joined
from harness.campaign.daemon import BREAKS
from harness.campaign.model import Outcome, Phase
from harness.campaign.page import write
from harness.campaign.stack import Stack

SHORT_S = 240.0
KEYS = {
    "fault", "phase", "detected", "detection_s", "safe", "standstill_s", "final_state", "recovered_as_catalogued"
}  # fmt: skip


async def campaign(*arguments: str) -> tuple[int, list[dict[str, Any]]]:
    """Run it as ``make faults`` does; status and results of its last line."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "harness.campaign", "--json", *arguments),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ.copy(),
    )
    out, _ = await process.communicate()
    assert process.returncode is not None
    return process.returncode, json.loads(out.splitlines()[-1])["results"]


def test_the_table_is_large_enough_and_every_name_is_in_the_catalogue() -> None:
    assert len({case.name for case in CASES}) == len(CASES) >= 40
    assert len(chosen(True, [], [])) >= 20
    assert {phase for _, phase in chosen(True, [], [])} == set(Phase)
    assert len(chosen(False, [], [])) >= 40 * len(Phase)
    for case in CASES:
        for fault in case.faults:
            device, _, condition = fault.partition(".")
            assert catalogue_key(device, condition) in CATALOGUE
        assert case.faults or case.conduct is not None


def test_parts_make_up_the_whole(tmp_path: Path) -> None:
    for short in (True, False):
        parts = [chosen(short, [], [], (number, 3)) for number in (1, 2, 3)]
        assert [pair for part in parts for pair in part] == chosen(short, [], [])
    files = []
    for number, part in enumerate(parts):
        results = [Outcome(case.name, phase).as_json() for case, phase in part]
        files.append(tmp_path / f"{number}.json")
        files[-1].write_text(json.dumps({"about": about(60.0), "results": results}), encoding="utf-8")
    data = joined(files)
    assert data["about"]["took_s"] == 180
    assert len(data["results"]) == len(CASES) * len(Phase)
    write(data, CASES, tmp_path)
    assert f"0 of {len(data['results'])} injections passed" in (tmp_path / "fault-campaign.md").read_text("utf-8")


async def test_a_campaign_that_is_killed_takes_its_processes_with_it() -> None:
    code = """
import subprocess, sys, time
from harness.bound import bound
child = subprocess.Popen(bound(sys.executable, "-c", "import time; print('here', flush=True); time.sleep(60)"))
print(child.pid, flush=True)
child.wait()
"""
    campaign = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", code), stdout=asyncio.subprocess.PIPE, env=os.environ | {"PYTHONPATH": os.getcwd()}
    )
    assert campaign.stdout is not None
    async with asyncio.timeout(30.0):
        said = {(await campaign.stdout.readline()).strip() for _ in range(2)}
    (pid,) = (int(line) for line in said - {b"here"})
    child = os.pidfd_open(pid)
    try:
        os.kill(pid, signal.SIGSTOP)  # one that is halted goes too
        campaign.kill()
        await campaign.wait()
        ended, _, _ = await asyncio.to_thread(select.select, [child], [], [], 10.0)
        assert ended
    finally:
        os.close(child)


async def test_every_process_of_a_campaign_is_bound_to_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[tuple[str, ...]] = []

    async def start(*command: str, **_: Any) -> None:
        started.append(command)
        raise OSError("seen enough")

    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)
    stack = Stack(tmp_path)
    for begin in (stack.start_rig, stack.launch_daemon, stack.guard):
        with pytest.raises(OSError, match="seen enough"):
            await begin()
    assert [command[:3] for command in started] == [bound()[:3]] * 3


@pytest.mark.whole_machine
@pytest.mark.xdist_group("beside a machine")
@pytest.mark.timeout(SHORT_S + 60.0)
async def test_the_shortened_campaign_passes() -> None:
    status, results = await campaign("--short")
    bad = {f"{r['fault']}, {r['phase']}": r["problems"] for r in results if not r["passed"]}
    assert bad == {}
    assert status == 0
    assert [(r["fault"], r["phase"]) for r in results] == [(c.name, p) for c, p in chosen(True, [], [])]
    for result in results:
        assert result.keys() >= KEYS
        assert result["detected"] is True
        assert result["safe"] is True
        assert result["recovered_as_catalogued"] is True
        assert isinstance(result["detection_s"], float)
        assert isinstance(result["standstill_s"], float)


@pytest.mark.whole_machine
@pytest.mark.xdist_group("beside a machine")
@pytest.mark.timeout(120.0)
@pytest.mark.parametrize(
    ("broken", "fault", "phase", "told"),
    [
        ("camera_missing_only_warns", "camera_unplug", "turning", "the catalogue says manual"),
        ("held_axes_go_on", "camera_stall", "turning", "went on for"),
        ("latches_let_go", "servo_torque_off", "idle", "went away by itself"),
    ],
)
async def test_a_spoiled_reaction_turns_it_red(broken: str, fault: str, phase: str, told: str) -> None:
    assert broken in BREAKS
    status, results = await campaign("--break", broken, "--fault", fault, "--phase", phase)
    assert status == 1
    (result,) = results
    assert not result["passed"]
    assert any(told in problem for problem in result["problems"]), result["problems"]
