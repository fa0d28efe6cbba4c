"""``make bench-hw`` with the simulated grader in the machine's place: what it asks, moves, measures and writes down."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from graderd.client import Client
from graderd.core.status import Status
from hil import bench
from tests.machine import PATIENT, machine

pytestmark = [pytest.mark.whole_machine, pytest.mark.xdist_group("beside a machine"), pytest.mark.timeout(240)]


def motions(asked: list[str]) -> list[str]:
    return [question.splitlines()[0] for question in asked]


def at_rest(status: Status) -> bool:
    """Everything found, pictures coming, nothing wrong."""
    met = all(r.met for r in status.readiness if r.mandatory)
    return bool(status.readiness) and met and status.soil.frames_per_s > 0 and not status.faults


async def test_every_motion_is_asked_for_and_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "RESULTS", tmp_path / "bench")
    asked: list[str] = []

    def yes(question: str) -> str:
        asked.append(question)
        return "yes"

    async with machine(tmp_path, PATIENT) as whole:
        await whole.until(at_rest)
        client = Client(tmp_path / "graderd.sock")
        session = bench.Bench(client, yes)
        await asyncio.to_thread(session.run)
        assert {r.name: r.outcome for r in session.results} == {
            "stop latches": "ok",
            "standby: readable, still": "ok",
            "step rotate +5 deg": "ok",
            "step rotate -5 deg": "ok",
            "step lift +15 mm": "ok",
            "step lift -15 mm": "ok",
            "step tilt +10 mm": "ok",
            "step tilt -10 mm": "ok",
            "stop in motion": "ok",
        }, session.results
        assert motions(asked) == [
            "rotate by +5 deg",
            "rotate by -5 deg",
            "lift by +15 mm",
            "lift by -15 mm",
            "tilt by +10 mm",
            "tilt by -10 mm",
            "rotate by +10 deg, stopped on the way",
        ]
        figures = {r.name: r.figures for r in session.results}
        assert 0.0 < float(figures["step rotate +5 deg"]["dead_time_s"]) < 1.0
        assert 0.0 < float(figures["stop in motion"]["further_deg"]) < 5.0
        state = await whole.status()
        assert state.mode == "disarmed"
        written = json.loads(bench.write_report(session.results, client.get("/v1/status")).read_text(encoding="utf-8"))
        assert written["simulated"] is True
        assert len(written["results"]) == len(session.results)


async def test_nothing_moves_where_the_person_does_not_say_yes(tmp_path: Path) -> None:
    async with machine(tmp_path, PATIENT) as whole:
        before = await whole.until(at_rest)
        session = bench.Bench(Client(tmp_path / "graderd.sock"), lambda _: "y")
        await asyncio.to_thread(session.run)
        assert [r.outcome for r in session.results].count("skipped") == 7
        after = await whole.status()
        assert after.mode == "disarmed"
        for name, axis in after.axes.items():
            assert axis.measured == pytest.approx(before.axes[name].measured, abs=0.3), name


def test_it_is_refused_without_the_word_and_without_a_person(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["bench-hw"])
    monkeypatch.delenv("GRADERD_BENCH", raising=False)
    assert bench.main() == 2
    monkeypatch.setenv("GRADERD_BENCH", "1")  # pytest's standard input is no terminal
    assert bench.main() == 2
    assert capsys.readouterr().err.count("bench-hw: refused") == 2
