"""The blade-rotation study's driver: what it costs over the bare engine, particle-steps a second, two workers against
one. ``python -m benchmarks.study [--grains N]``; needs ``make study`` and two cores of its own."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

from graderd.studies.blade_rotation import case as named
from graderd.studies.blade_rotation import engine, lammps, sweep
from graderd.studies.blade_rotation.case import Case, Work
from graderd.studies.blade_rotation.pile import poured
from graderd.studies.blade_rotation.run import run_case
from graderd.studies.blade_rotation.store import Result, Store

OVERHEAD_MAX = 0.05
SPEED_UP_MIN = 1.6


def main() -> int:
    """Measure, print, and tell by the exit status whether the bars are kept."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grains", type=int, default=1500)
    grains_n = parser.parse_args().grains
    with tempfile.TemporaryDirectory() as folder:
        overhead, speed = driver(Path(folder) / "one", grains_n)
        speed_up = workers(Path(folder), grains_n)
    kept = overhead <= OVERHEAD_MAX and speed_up >= SPEED_UP_MIN
    print(
        json.dumps(
            {
                "overhead_percent": round(100.0 * overhead, 1),
                "particle_steps_per_s": round(speed),
                "two_workers_speed_up": round(speed_up, 2),
                "kept": kept,
            }
        )
    )
    return 0 if kept else 1


def case_of(grains_n: int, seed: int = 1) -> Case:
    """Scattering work in the middle."""
    return Case(work=Work.MIDDLE, angle_deg=15, pile=named.SCATTERED, grains_n=grains_n, seed=seed)


def driver(folder: Path, grains_n: int) -> tuple[float, float]:
    """Share that the driver takes over the same input files given to the bare engine; particle-steps a second of it."""
    case, store = case_of(grains_n), Store(folder)
    warm = case_of(60, seed=9)
    run_case(warm, store)  # what is imported once is no run's
    began = time.monotonic()
    result = run_case(case, store)
    whole_s = time.monotonic() - began
    bare = folder / "bare" / "runs" / "again"
    pile = folder / "bare" / "piles" / case.pile_key()
    shutil.copytree(store.pile_folder(case), pile)
    bare.mkdir(parents=True)
    shutil.copy(store.run_folder(case) / "push.0.0.in", bare)
    (pile / "pile.data").write_text(lammps.data_file(case, poured(case)), encoding="ascii")
    bare_s = engine.run(engine.command(1, "settle.in", "settle.log"), pile, "settle.log")
    bare_s += engine.run(engine.command(1, "push.0.0.in", "push.log"), bare, "push.log")
    return whole_s / bare_s - 1.0, result.particle_steps_n / bare_s


def workers(folder: Path, grains_n: int) -> float:
    """How many times as fast two workers are as one, for four cases each; starting them counts."""
    taken = []
    for workers_n in (1, 2):
        cases = [case_of(grains_n, seed=100 * workers_n + n) for n in range(4)]
        began = time.monotonic()
        sweep.sweep(cases, Store(folder / f"workers-{workers_n}"), _ignored, workers_n=workers_n)
        taken.append(time.monotonic() - began)
    return taken[0] / taken[1]


def _ignored(case: Case, result: Result | None, why: str) -> None:
    del case, result, why


if __name__ == "__main__":
    sys.exit(main())
