"""The multibody machine by itself, and coupled with the engine: limit case, energy, size of the coupling step."""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from graderd.studies.blade_rotation import coupled, engine, run
from graderd.studies.blade_rotation.case import QUARTER_SIZE, Case, Pile, Work
from graderd.studies.blade_rotation.engine import Progress
from graderd.studies.blade_rotation.multibody import (
    READINGS,
    SERVO_LIMIT_NM,
    Holder,
    Machine,
    Multibody,
    Pose,
    Rigid,
    Wrench,
)
from graderd.studies.blade_rotation.run import run_case
from graderd.studies.blade_rotation.store import Result, Store

TRAVELLING = Pose((0.0, 0.0, 0.05), math.radians(30.0), (1.0, 0.0, 0.0), 0.0)
CASE = Case(
    work=Work.LEFT,
    angle_deg=30,
    offset_share=0.2,
    blade=QUARTER_SIZE,
    pile=Pile(length_m=0.5, width_m=0.3, height_m=0.2, study_grains_n=10_000),
    grains_n=150,
    travel_m=0.6,
    gap_m=0.02,
    floor="soil",
)


def held(machine: Machine, wrench: Wrench, seconds: float = 2.0) -> tuple[Multibody, dict[str, float]]:
    """A machine that a wrench has acted on for so long, and what it tells."""
    system = Multibody(machine, TRAVELLING)
    for _ in range(round(seconds / 1e-3)):
        system.advance(wrench, TRAVELLING.yaw_rad, 1e-3)
    return system, dict(zip(READINGS, system.readings().tolist(), strict=True))


def test_a_machine_that_nothing_acts_on_stays_as_it_is() -> None:
    _, told = held(Machine(), Wrench())
    assert told["x"] == pytest.approx(2.0, abs=1e-4)
    assert (told["y"], told["z"], told["yaw"]) == pytest.approx((0.0, 0.05, TRAVELLING.yaw_rad), abs=1e-5)
    weight_n = (Machine().blade_kg + Machine().drawbar_kg) * 9.81
    assert told["lift_left_n"] + told["lift_right_n"] == pytest.approx(-weight_n, rel=1e-3)
    assert told["draft_n"] == pytest.approx(0.0, abs=0.1)


def test_what_acts_on_the_blade_arrives_at_its_holders() -> None:
    """Statics: sum of forces on the chassis, moments on the lifts' lever and the tilt's, torque on the servo."""
    _, told = held(Machine(), Wrench((-200.0, 50.0, 40.0), (0.0, 0.0, 20.0)), 3.0)
    assert told["draft_n"] == pytest.approx(200.0, rel=2e-3)
    assert told["side_draft_n"] == pytest.approx(50.0, rel=2e-3)
    assert told["servo_nm"] == pytest.approx(-20.0, abs=Machine().servo_friction_nm + 0.1)
    _, bare = held(Machine(), Wrench())
    lifted = [told[name] - bare[name] for name in ("lift_left_n", "lift_right_n")]
    assert sum(lifted) == pytest.approx(40.0, rel=0.01)
    # The side force at the edge against the roll axis, 1.2 blade heights above it.
    lever_nm = (lifted[0] - lifted[1]) * Machine().lift_spacing_m / 2.0
    assert lever_nm == pytest.approx(50.0 * 1.2 * 0.25, rel=0.02)
    assert told["floor_n"] == 0.0


def test_a_lift_gives_way_by_a_millimetre_under_its_greatest_load() -> None:
    _, told = held(Machine(), Wrench((0.0, 0.0, 3400.0)))
    assert told["z"] - 0.05 == pytest.approx(1e-3, rel=0.01)


def test_the_servo_holds_what_it_can_and_no_more() -> None:
    _, told = held(Machine(), Wrench(moment_nm=(0.0, 0.0, 40.0)))
    assert told["yaw"] == pytest.approx(TRAVELLING.yaw_rad, abs=math.radians(0.2))
    _, told = held(Machine(), Wrench(moment_nm=(0.0, 0.0, 60.0)))
    assert told["servo_nm"] == pytest.approx(-SERVO_LIMIT_NM)
    assert told["yaw"] > TRAVELLING.yaw_rad + math.radians(30.0)


def test_a_blade_pressed_down_is_stopped_and_braked_by_the_floor() -> None:
    low = replace(TRAVELLING, place_m=(0.0, 0.0, 0.0))
    system = Multibody(Machine(), low)
    for _ in range(2000):
        system.advance(Wrench((0.0, 0.0, -500.0)), low.yaw_rad, 1e-3)
    told = dict(zip(READINGS, system.readings().tolist(), strict=True))
    assert -1e-4 < told["z"] <= 0.0
    assert 400.0 < told["floor_n"] <= 500.0
    assert told["draft_n"] == pytest.approx(0.37 * told["floor_n"], rel=0.02)


def test_a_machine_goes_on_from_what_it_told() -> None:
    push = Wrench((-150.0, 30.0, 20.0), (5.0, 0.0, 15.0))
    system, _ = held(Machine(), push, 0.05)
    other = Multibody(Machine(), TRAVELLING)
    other.restore(system.state())
    for each in (system, other):
        for _ in range(50):
            each.advance(push, TRAVELLING.yaw_rad, 1e-3)
    assert other.readings() == pytest.approx(system.readings(), rel=1e-6, abs=1e-6)


Coupled = Callable[..., Result]


@pytest.fixture
def in_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Coupled:
    """Runs a case coupled to a holder of the test's, the engine's library in this process."""
    ctypes.CDLL(f"{sys.prefix}/lib/libmpi.so.12", mode=ctypes.RTLD_GLOBAL)
    real = engine.run

    def run_(case: Case, holder: Callable[[Pose], Holder] | None = None, every_n: int = 1) -> Result:
        def instead(arguments: Sequence[str], folder: Path, log: str, progress: Progress | None = None) -> float:
            if run.COUPLED not in arguments:
                return real(arguments, folder, log, progress)
            coupled.run_leg(folder, arguments[-2], int(arguments[-1]), holder, every_n)
            return 0.0

        monkeypatch.setattr(engine, "run", instead)
        folder = tmp_path / f"{'machine' if holder is None else 'other'}-{every_n}"
        return run_case(case.model_copy(update={"motion": "coupled"}), Store(folder))

    return run_


def test_coupled_to_a_rigid_machine_the_run_is_the_imposed_one(tmp_path: Path, in_process: Coupled) -> None:
    one_way = run_case(CASE, Store(tmp_path / "imposed"))
    rigid = in_process(CASE, Rigid)
    for name in ("blade_load_n", "draft_n", "side_draft_n", "yaw_torque_nm", "spread_mass_90_mm"):
        assert rigid.measures[name] == pytest.approx(one_way.measures[name], rel=0.01), name
    assert rigid.checks["momentum_share"] == pytest.approx(one_way.checks["momentum_share"], abs=0.01)


def test_a_machine_ten_times_as_stiff_is_all_but_rigid(tmp_path: Path, in_process: Coupled) -> None:
    soft = Machine.of(CASE.blade)
    stiff = replace(
        soft,
        lift_n_per_m=10 * soft.lift_n_per_m,
        tilt_n_per_m=10 * soft.tilt_n_per_m,
        servo_limit_nm=1e6,
        servo_bandwidth_hz=2 * soft.servo_bandwidth_hz,
        drive_n_s_per_m=10 * soft.drive_n_s_per_m,
    )
    one_way = run_case(CASE, Store(tmp_path / "imposed"))
    held_ = in_process(CASE, partial(Multibody, stiff))
    assert held_.measures["yaw_off_max_deg"] < 0.3
    for name in ("blade_load_n", "draft_n", "spread_mass_90_mm"):
        assert held_.measures[name] == pytest.approx(one_way.measures[name], rel=0.05), name


def test_what_the_coupling_adds_is_little_and_its_step_does_not_matter(in_process: Coupled) -> None:
    whole, half = in_process(CASE, None, 2), in_process(CASE)
    assert half.measures["interface_share"] < whole.measures["interface_share"] < 0.01
    assert whole.checks["gained_share"] < 0.01
    # The soil's mean pull on the blade is what the chassis feels, but for what its speed stores.
    assert whole.measures["machine_draft_n"] == pytest.approx(whole.measures["draft_n"], rel=0.02)
    for name in ("blade_load_n", "draft_n", "spread_mass_90_mm"):
        assert half.measures[name] == pytest.approx(whole.measures[name], rel=0.03), name


def test_a_coupled_leg_goes_on_where_it_was(tmp_path: Path, in_process: Coupled) -> None:
    """A kept state of the machine is that of the step it was kept at."""
    in_process(CASE)
    kept = next(tmp_path.glob("*/runs/*/" + coupled.STATES)).read_text(encoding="utf-8").split("\n")
    assert len(kept) > 3
    assert np.all(np.diff([int(line.split(",")[0].split(":")[1]) for line in kept[:-1]]) == coupled.WINDOW_STEPS)
