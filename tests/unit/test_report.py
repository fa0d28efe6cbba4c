"""The report: what happened, told once, on a page that needs nothing else."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from graderd.cli import app as cli
from graderd.core import commands as cmd
from graderd.record.reader import Recording
from graderd.record.report import write
from tests.replay.test_recordings import RECORDINGS
from tests.unit.test_replay import WORK, recorded

EVIL = "<script>alert(1)</script>"


def test_it_tells_modes_decisions_faults_and_why_it_stopped(tmp_path: Path) -> None:
    work = [
        replace(sensed, commands=(cmd.Stop(reason=EVIL, client="b"),)) if number == 260 else sensed
        for number, sensed in enumerate(WORK)
    ]
    story = write(recorded(tmp_path / "rec", work), tmp_path / "out")
    assert story.ticks_n == len(WORK)
    assert story.duration_s == pytest.approx(WORK[-1].now_s - WORK[0].now_s, abs=0.05)
    # Automatic from the tick that took the command to the one in which the lost lift disarmed.
    assert story.time_in("auto") == pytest.approx((200 + 20 - 90) * 0.02, abs=0.42)
    assert {(decided.zone, decided.angle_deg) for decided in story.decisions} == {("left", 30.0)}
    assert "lift_left.no_feedback" in {span.name for span in story.faults}
    assert [span.name for span in story.stops] == ["disarmed", "stopped"] or [span.name for span in story.stops] == [
        "disarmed",
        "stopped",
        "disarmed",
    ]
    assert sum((span.to_s - span.from_s) for span in story.modes) == pytest.approx(story.duration_s, abs=0.05)
    page = (tmp_path / "out" / "index.html").read_text()
    assert EVIL not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    with (tmp_path / "out" / "ticks.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(WORK)
    assert table[150]["mode"] == "auto"
    assert float(table[150]["rotation_measured_deg"]) == pytest.approx(
        WORK[150].axes["rotation"].telemetry.position.value  # type: ignore[union-attr]
    )


@pytest.mark.parametrize("path", RECORDINGS[:1], ids=["grader"])
def test_a_page_needs_nothing_else_and_shows_depth_with_a_decision(path: Path, tmp_path: Path) -> None:
    story = write(Recording(path), tmp_path / "out")
    page = (tmp_path / "out" / "index.html").read_text()
    assert not re.search(r"(src|href)=.(?!data:)", page)
    assert "http" not in re.sub(r"data:image/jpeg;base64,[^']*", "", page)
    assert [decided.zone for decided in story.decisions] == ["left", "right"]
    assert [bool(decided.depth) for decided in story.decisions] == [False, True]
    assert page.count("<h2>") == 6
    with (tmp_path / "out" / "decisions.csv").open() as file:
        assert [row["angle_deg"] for row in csv.DictReader(file)] == ["30.0", "-30.0"]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(tmp_path / "rec").path
    assert cli.run_app(["report", str(path), "--to", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["event"] == "reported"
    assert found["ticks_n"] == len(WORK)
    assert cli.run_app(["report", str(path), "--to", str(tmp_path / "out")]) == 2
    assert "is there already" in capsys.readouterr().err
