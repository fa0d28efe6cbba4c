"""Small cases on the engine: what must hold whatever the soil does, and what a killed run loses."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from graderd.studies.blade_rotation import case as cases
from graderd.studies.blade_rotation import engine, pile
from graderd.studies.blade_rotation.case import BladeShape, Case, Pile, Work
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.run import run_case
from graderd.studies.blade_rotation.store import Store

SMALL = Pile(length_m=0.5, width_m=0.3, height_m=0.2, study_grains_n=10_000)
BLADE = BladeShape(length_m=1.0, height_m=0.25, radius_m=0.25)
CASE = Case(
    work=Work.LEFT, angle_deg=30, offset_share=0.2, blade=BLADE, pile=SMALL, grains_n=150, travel_m=0.6, floor="soil"
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(tmp_path_factory.mktemp("store"))


@pytest.mark.parametrize("radius_m", [0.25, None])
def test_a_pass_keeps_mass_momentum_and_energy(store: Store, radius_m: float | None) -> None:
    case = CASE.model_copy(update={"blade": BLADE.model_copy(update={"radius_m": radius_m})})
    result = run_case(case, store)
    assert result.checks["grains_lost_n"] == 0
    assert result.checks["momentum_share"] < 0.001
    assert result.checks["gained_share"] < 0.01
    assert result.checks["dangerous_builds_n"] == 0
    assert result.checks["pace_max_m_per_s"] < 5.0
    # What is pushed over the floor at a steady pace resists by its friction and no more.
    weight_n = 2650.0 * cases.PACKING * 0.5 * 0.3 * 0.2 * cases.NEWTON_G_M_PER_S2
    assert 0.1 * weight_n < result.measures["draft_n"] < 1.0 * weight_n
    shares = [result.measures[f"load_{third}_percent"] for third in ("left", "center", "right")]
    assert sum(shares) == pytest.approx(100.0)
    assert shares[0] + shares[1] > 90.0, "the pile lies before the left half"


def test_a_done_case_is_not_done_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    first = run_case(CASE, store)
    monkeypatch.setattr(engine, "run", lambda *_: pytest.fail("the engine was started"))
    assert run_case(CASE, store) == first
    mirrored = run_case(CASE.model_copy(update={"work": Work.RIGHT}), store)
    assert mirrored == first


def test_a_pile_that_is_mirrored_gives_a_result_that_is(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """The right is not computed but taken from the left; here it is computed, from the mirrored pile."""
    left = run_case(CASE, store)
    poured = pile.poured
    monkeypatch.setattr(pile, "poured", lambda case: poured(case) * (1.0, -1.0, 1.0, 1.0))
    monkeypatch.setattr(Case, "canonical", property(lambda self: self))
    right = run_case(CASE.model_copy(update={"work": Work.RIGHT}), Store(store.folder / "mirrored"))
    for name in ("spread_mass_90_mm", "blade_load_n", "draft_n"):
        assert right.measures[name] == pytest.approx(left.measures[name], rel=0.1)
    assert right.measures["side_draft_n"] == pytest.approx(-left.measures["side_draft_n"], rel=0.2)
    assert right.measures["load_right_percent"] == pytest.approx(left.measures["load_left_percent"], abs=5.0)


def test_a_pile_settles_to_rest(store: Store) -> None:
    run_case(CASE, store)
    from graderd.studies.blade_rotation import files

    grains = files.settled(store.pile_folder(CASE) / "settled.dump")
    assert len(grains) == CASE.grains_n
    assert np.median(np.linalg.norm(grains[:, 5:8], axis=1)) < 0.01
    assert float(grains[:, 3].max()) < 0.3


def test_deciding_again_turns_the_blade_in_mid_pass(store: Store) -> None:
    """A pile in the middle has spread along the blade by then and looks even: the rule has 45 degrees for that."""
    middle = {"work": Work.MIDDLE, "offset_share": 0.0, "decision": "again", "travel_m": 2.0}
    result = run_case(CASE.model_copy(update=middle), store)
    assert result.notes["angles_deg"] == [30.0, 30.0, 45.0]
    frames = store.table(result.case, "frames").to_pydict()
    turned = np.degrees(frames["yaw_rad"])
    assert turned[0] == pytest.approx(30.0)
    assert turned[-1] == pytest.approx(45.0)
    assert np.abs(np.diff(turned) / np.diff(frames["time_s"])).max() <= 25.0 + 1e-6, "no faster than the servo"
    assert result.checks["momentum_share"] < 0.005


def test_a_killed_run_goes_on_where_its_last_restart_file_is(tmp_path: Path) -> None:
    whole, broken = Store(tmp_path / "whole"), Store(tmp_path / "broken")
    case = CASE.model_copy(update={"seed": 5})
    expected = run_case(case, whole)
    code = (
        "import sys; from pathlib import Path; from graderd.studies.blade_rotation.case import Case\n"
        "from graderd.studies.blade_rotation.run import run_case\n"
        "from graderd.studies.blade_rotation.store import Store\n"
        "run_case(Case.model_validate_json(sys.argv[1]), Store(Path(sys.argv[2])), restart_particle_steps=1.0)"
    )
    child = subprocess.Popen([sys.executable, "-c", code, case.model_dump_json(), str(broken.folder)])
    folder = broken.run_folder(case)
    try:
        while not list(folder.glob("at.*.restart")):
            assert child.poll() is None, "it ended before it was killed"
            time.sleep(0.01)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    with broken.alone(folder):
        pass  # nobody holds it any more
    result = run_case(case, broken)
    assert len(list(folder.glob("push.0.*.in"))) == 2
    assert 0 < result.particle_steps_n < expected.particle_steps_n
    assert result.checks["grains_lost_n"] == 0
    travelled = [store.table(case, "travel").to_pydict()["travel_m"] for store in (whole, broken)]
    assert travelled[0] == pytest.approx(travelled[1])
    for name in ("spread_mass_90_mm", "blade_load_n"):
        assert result.measures[name] == pytest.approx(expected.measures[name], rel=0.1)


def test_two_ranks_are_one_run(tmp_path: Path) -> None:
    case = CASE.model_copy(update={"grains_n": 60, "travel_m": 0.2, "seed": 3})
    one, two = run_case(case, Store(tmp_path / "one")), run_case(case, Store(tmp_path / "two"), ranks_n=2)
    log = next((tmp_path / "two").glob("runs/*/push.0.0.log")).read_text(encoding="utf-8")
    assert "on 2 procs" in log
    assert two.checks["grains_lost_n"] == 0
    assert two.measures["blade_load_n"] == pytest.approx(one.measures["blade_load_n"], rel=0.1)


def test_the_engines_own_error_is_told(tmp_path: Path) -> None:
    (tmp_path / "wrong.in").write_text("units nonsense\n")
    with pytest.raises(StudyError, match=r"ERROR.*units"):
        engine.run(engine.command(1, "wrong.in", "wrong.log"), tmp_path, "wrong.log")
