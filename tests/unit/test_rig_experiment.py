"""The experiment on the virtual bed: what its camera sees, what its folder says, and one whole trial."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import AsyncMock, Mock

import numpy as np
import pytest

from graderd.config import parse
from graderd.core.soil import Zone
from graderd.evaluation import experiment as file
from graderd.evaluation.trial import evaluate_trials
from graderd.simulator.camera.top import TopCamera, save
from graderd.simulator.experiment import (
    CAMERA_HEIGHT_M,
    CAMERA_X_M,
    EXPERIMENT,
    TARGET_MM,
    ZONES,
    Folder,
    Trial,
    main,
    rule_for,
    seen_from_above,
    trials,
)
from graderd.simulator.grader.soil import SoilField
from graderd.simulator.operator import Operator, Pass, PassFailedError

PASS = Pass(
    "left", "left", 30.0, 30.1, 1.0, tuple(
        {"time_s": 0.1 * n, "vehicle_x_m": 1.2 + n, "load_force_n": 100.0 * n, "driving": n < 2} for n in range(3)
    )
)  # fmt: skip


def scanned(folder: Folder, trial: Trial, field: SoilField) -> None:
    """A trial of which both states are this bed."""
    camera = TopCamera(height_mm=CAMERA_HEIGHT_M * 1e3, noise_px=0.1, hole_share=0.02)
    surface = seen_from_above(field.heights_m, field.cell_m)
    for state in ("before", "after"):
        save(folder.path, f"{trial.name}-{state}", camera.scans_mm(surface, 2))
    folder.finish(trial, PASS)


def test_the_soil_is_where_the_bed_has_it_and_as_wide(tmp_path: Path) -> None:
    """A ridge on the left, ahead of the camera: a picture mirrored or turned would have it elsewhere."""
    field, folder, trial = SoilField(), Folder(tmp_path), Trial("left", 30.0, 1)
    along = np.clip((0.4 - np.abs(field.x_m - CAMERA_X_M - 0.7)) / 0.15, 0.0, 1.0)
    across = np.clip((0.25 - np.abs(field.y_m - 0.3)) / 0.125, 0.0, 1.0)
    field.heights_m[:] = 0.1 * np.outer(along, across)
    scanned(folder, trial, field)
    (result,) = evaluate_trials(file.load(folder.write_experiment([trial])), tmp_path)
    assert result.values["spread_extreme_mm"].value == pytest.approx(475.0, abs=15.0)  # 10 mm high
    assert result.map_mm is not None
    assert result.grid is not None
    high = np.argwhere(result.map_mm > 50.0).mean(axis=0)
    assert result.grid.x_mm[round(high[0])] == pytest.approx(700.0, abs=30.0)
    assert result.grid.y_mm[round(high[1])] == pytest.approx(300.0, abs=30.0)
    assert result.values["blade_load_n"].value == 50.0
    assert result.values["volume_moved_l"].value == pytest.approx(0.0, abs=1.0)


def test_flattening_is_measured_where_the_blade_went_and_stands_beside_scattering(tmp_path: Path) -> None:
    """A mound with a swath through it, 3 mm too high: what the blade left at both sides is no part of the layer."""
    field, folder = SoilField(), Folder(tmp_path)
    along = np.clip((0.9 - np.abs(field.x_m - CAMERA_X_M + 0.4)) / 0.1, 0.0, 1.0)
    mound = 0.06 * np.outer(along, np.clip((0.7 - np.abs(field.y_m)) / 0.1, 0.0, 1.0))
    left = np.where(np.abs(field.y_m) < 0.35, np.minimum(mound, TARGET_MM / 1e3 + 0.003), mound)
    before, after = (seen_from_above(heights, field.cell_m) for heights in (mound, left))
    camera, trial = TopCamera(height_mm=CAMERA_HEIGHT_M * 1e3, noise_px=0.1), Trial("even", 30.0, 1)
    for state, surface in (("before", before), ("after", after)):
        save(folder.path, f"{trial.name}-{state}", camera.scans_mm(surface, 2))
    folder.finish(trial, PASS)
    scanned(folder, Trial("left", 30.0, 1), _heap())
    found = evaluate_trials(file.load(folder.write_experiment([trial, Trial("left", 30.0, 1)])), tmp_path)
    scattering, flattening = found
    assert [each.case for each in found] == ["Scattering work (soil left)", "Flattening work"]
    assert "spread_extreme_mm" in scattering.values
    assert flattening.values["height_difference_mm"].value == pytest.approx(3.0, abs=1.0)
    assert flattening.values["volume_moved_l"].value == pytest.approx(
        float((mound - left).sum()) * field.cell_m**2 * 1e3, rel=0.05
    )


def test_trials_are_told_from_one_another_and_compared_on_the_same_soil() -> None:
    wanted = trials((15.0, 30.0, 45.0), ZONES, 5)
    assert len({trial.name for trial in wanted}) == 60
    assert [trial.mound is not None for trial in wanted] == [trial.zone == "even" for trial in wanted]
    assert {trial.angle_deg < 0 for trial in wanted if trial.zone == "right"} == {True}
    assert len({trial.seed for trial in wanted}) == 20


@pytest.mark.parametrize("angle_deg", [15.0, 45.0])
def test_the_rule_under_test_turns_to_the_angle_wherever_the_soil_lies(angle_deg: float) -> None:
    rule = parse({"rule": dict(line.split(" = ") for line in rule_for(angle_deg).splitlines())}).rule
    found = [rule.angle_deg(zone) for zone in (Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN)]
    assert found == [angle_deg, angle_deg, -angle_deg, angle_deg]


def test_a_trial_that_was_broken_off_is_none(tmp_path: Path) -> None:
    folder, trial = Folder(tmp_path), Trial("left", 30.0, 1)
    assert folder.done(trial) is None
    (tmp_path / "left-30-1.json").write_text('{"zone": "le', encoding="utf-8")
    assert folder.done(trial) is None
    folder.finish(trial, PASS)
    assert folder.done(trial) == {**PASS.told(), "blade_x_mm": round((3.2 - CAMERA_X_M) * 1e3, 1)}


def test_what_is_no_experiment_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for words in (["--angles", "80"], ["--angles", "x"], ["--zones", "up"], ["--trials", "0"], []):
        with pytest.raises(SystemExit) as ended:
            main([*([] if words == [] else ["--out", str(tmp_path)]), *words])
        assert ended.value.code == 2
        assert "graderd rig experiment: error: " in capsys.readouterr().err


@pytest.mark.live
@pytest.mark.whole_machine
@pytest.mark.xdist_group("beside a machine")
@pytest.mark.timeout(240)
async def test_a_trial_goes_through_the_whole_daemon_and_is_measured(tmp_path: Path) -> None:
    """The others of its experiment are there already: only what is missing is driven."""
    out = tmp_path / "an experiment"
    out.mkdir()
    for angle_deg in (15.0, 45.0):
        scanned(Folder(out), Trial("left", angle_deg, 1), _heap())
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "rig", "experiment", "--out", str(out), "--quick", "--json"),
        stdout=asyncio.subprocess.PIPE,
    )
    said, _ = await process.communicate()
    events = [json.loads(line) for line in said.splitlines()]
    assert process.returncode == 0, events[-1]
    driven = [event for event in events if event["event"] == "trial_driven"]
    assert [(event["trial"], event["decided"]) for event in driven] == [("left-30-1", "left")]
    rows = events[-1]["rows"]
    assert events[-1]["event"] == "evaluation_finished"
    (spread,) = [r for r in rows if (r["measure"], r["angle_deg"]) == ("spread_extreme_mm", 30.0)]
    assert 300.0 < spread["value"] < 1000.0
    (load,) = [r for r in rows if (r["measure"], r["angle_deg"]) == ("blade_load_n", 30.0)]
    assert load["value"] > 20.0
    assert (out / EXPERIMENT).is_file()
    assert (out / "results" / "index.html").is_file()


def _heap() -> SoilField:
    field = SoilField()
    field.heights_m[150:170, 40:60] = 0.1
    return field


async def test_a_way_on_which_the_machine_leaves_its_operation_is_no_trial() -> None:
    """The blade is held from there on: what lies behind it is not of the angle that the trial is filed under."""
    said = iter(["auto", "auto", "auto", "disarmed"])
    client = AsyncMock()
    client.status.side_effect = lambda: SimpleNamespace(mode=next(said), reason="lift_left is lost")
    rig = AsyncMock()
    rig.request.return_value = {"driving": True}
    operator = Operator(client, rig, Mock())
    with pytest.raises(PassFailedError, match="auto operation ended on the way: disarmed, lift_left is lost"):
        await operator._drive()
