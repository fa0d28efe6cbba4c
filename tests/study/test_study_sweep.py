"""Sweeps on Dask: workers that are killed, what is done already, and the commands over it."""

from __future__ import annotations

import json
import os
import random
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import dask
import pytest
from distributed import LocalCluster

from graderd.cli.app import run_app
from graderd.studies.blade_rotation import sweep
from graderd.studies.blade_rotation.case import Case
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.store import Result, Store
from tests.study.test_study_run import CASE

SWEEP = """
[case]
work = "left"
offset_share = 0.2
blade = { length_m = 1.0, height_m = 0.25, radius_m = 0.25 }
pile = { length_m = 0.5, width_m = 0.3, height_m = 0.2, study_grains_n = 10_000 }
grains_n = 100
travel_m = 0.3
floor = "soil"

[sweep]
angle_deg = [15, 45]
sense = ["trails", "leads"]
"""


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": sweep.DEATHS_N}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50) as found,
    ):
        yield found


def test_killed_workers_lose_nothing_but_the_runs_in_flight(tmp_path: Path, cluster: LocalCluster) -> None:
    store, rng = Store(tmp_path), random.Random(1)
    cases = [CASE.model_copy(update={"angle_deg": angle, "seed": seed}) for angle in (15.0, 45.0) for seed in (7, 8)]
    done: list[Result | None] = []
    over, killed = threading.Event(), list[int]()

    def kill() -> None:
        """A worker at random, whenever a run is under way, three times."""
        while len(killed) < 3 and not over.wait(0.05):
            writing = [
                path for path in tmp_path.glob("runs/*/push.*.log") if not (path.parent / "manifest.json").exists()
            ]
            if len(writing) > len(killed):
                pid = rng.choice(list(cluster.workers.values())).pid
                if pid:
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        sweep.sweep(
            cases, store, lambda _case, result, _why: done.append(result), scheduler=cluster.scheduler_address,
            restart_particle_steps=1e5,
        )  # fmt: skip
    finally:
        over.set()
        killer.join()
    assert killed
    assert {result.key for result in done if result} == {case.key() for case in cases}
    again = sum(len(list(store.run_folder(case).glob("push.*.in"))) for case in cases) - len(cases)
    assert again <= len(killed), "a death takes the one run that its worker had"
    assert all(result.checks["grains_lost_n"] == 0 for result in store.results())


def test_a_sweep_does_only_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sweep.toml").write_text(SWEEP, encoding="utf-8")
    assert run_app(["study", "sweep", "sweep.toml", "--json"]) == 0
    events = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert events[0]["event"] == "study_estimated"
    assert (events[0]["cases_n"], events[0]["done_n"]) == (4, 0)
    assert [event["event"] for event in events[1:]] == ["case_finished"] * 4
    monkeypatch.setattr("distributed.LocalCluster", lambda **_: pytest.fail("nothing is left to do"))
    assert run_app(["study", "sweep", "sweep.toml", "--json"]) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[0])["done_n"] == 4
    assert run_app(["study", "report", "blade-rotation-study"]) == 0
    page = Path("blade-rotation-study/index.html").read_text(encoding="utf-8")
    assert "Table 2" in page
    assert run_app(["study", "rule", "--save", "rule.toml"]) == 0
    assert "left_deg" in Path("rule.toml").read_text(encoding="utf-8")


def test_a_run_that_fails_for_good_is_told_and_the_others_are_done(tmp_path: Path) -> None:
    small = CASE.model_copy(update={"grains_n": 60, "travel_m": 0.2})
    wrong = small.model_copy(update={"angle_deg": 20.0})
    store, told = Store(tmp_path), dict[str, str]()
    store.run_folder(wrong).parent.mkdir(parents=True)
    store.run_folder(wrong).write_text("no folder")

    def finished(case: Case, result: Result | None, why: str) -> None:
        told[case.key()] = why if result is None else ""

    with pytest.raises(StudyError, match="1 of 2 runs failed"):
        sweep.sweep([wrong, small], store, finished)
    assert told[small.key()] == ""
    assert "File exists" in told[wrong.key()]


def test_no_scheduler_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="no Dask scheduler answers"):
        sweep.sweep([CASE], Store(tmp_path), lambda *_: None, scheduler="nonsense://nowhere:1")
