"""Many cases on Dask: one task is one run is one subprocess. Local workers unless a scheduler is named.

A worker that dies takes with it what it was computing, no more: the scheduler gives the run to another one, which goes
on from its restart file. What is done is in the store and is not submitted again: a sweep that was killed itself is
simply started once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from graderd.studies.blade_rotation import lammps, run
from graderd.studies.blade_rotation.case import Case
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.store import Result, Store

RETRIES_N = 2
DEATHS_N = 25
"""So many workers may die under one run before it is given up."""
PARTICLE_STEPS_PER_S = 1.2e6
"""Of one core, until the store tells better: LAMMPS 22 Jul 2025 on a Xeon of 2.5 GHz, moldboard and floor."""

Finished = Callable[[Case, Result | None, str], None]
"""Is told of each case, with its result, or without and why."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """What is left to do, and about how long it takes."""

    cases_n: int
    done_n: int
    particle_steps_n: float
    particle_steps_per_s: float
    hours: float


def estimate(cases: Sequence[Case], store: Store, at_once_n: int, ranks_n: int = 1) -> Estimate:
    """What is left of cases, by the speed of the runs that the store has."""
    left = [case for case in cases if store.get(case) is None]
    speeds = [
        found.particle_steps_n / found.engine_s
        for found in store.results()
        if found.particle_steps_n and found.engine_s > 1.0
    ]
    speed = sorted(speeds)[len(speeds) // 2] if speeds else PARTICLE_STEPS_PER_S * ranks_n
    piles = {case.pile_key(): case for case in left if not (store.pile_folder(case) / "settled.restart").exists()}
    steps = sum(case.grains_n * _pass_steps(case) for case in left)
    steps += sum(case.grains_n * lammps.settle_steps(case) for case in piles.values())
    return Estimate(len(cases), len(cases) - len(left), steps, speed, steps / speed / max(1, at_once_n) / 3600.0)


def _pass_steps(case: Case) -> float:
    """With a run-up of half a metre or so before the soil is met."""
    return (case.travel_m + 0.5) / case.speed_m_per_s / lammps.step_s(case)


def sweep(
    cases: Sequence[Case],
    store: Store,
    finished: Finished,
    workers_n: int = 2,
    scheduler: str | None = None,
    ranks_n: int = 1,
    restart_particle_steps: float = run.RESTART_PARTICLE_STEPS,
) -> None:
    """Compute what the store has not of ``cases``; ``finished`` is told of all of them, in the order they end.

    ``scheduler``: address of a Dask scheduler whose workers have graderd[study] and see the store's folder under the
    same path; else ``workers_n`` workers on this machine.

    Raises:
        StudyError: the scheduler does not answer, or runs failed for good.
    """
    left: dict[str, Case] = {}
    for case in cases:
        if found := store.get(case):
            finished(case, found, "")
        else:
            left[case.key()] = case.canonical
    if not left:
        return
    import dask
    from distributed import Client, LocalCluster, as_completed

    failed: list[str] = []
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": DEATHS_N}))
        if scheduler is None:
            local = LocalCluster(
                n_workers=workers_n,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                silence_logs=50,
            )
            scheduler = stack.enter_context(local).scheduler_address
        try:
            client = stack.enter_context(Client(scheduler, timeout="20s"))
        except (OSError, ValueError) as error:
            raise StudyError(
                str(scheduler), f"no Dask scheduler answers ({error})", "Start one, or leave it out"
            ) from None
        folder = str(store.folder.resolve())
        task = partial(_one, folder=folder, ranks_n=ranks_n, restart_particle_steps=restart_particle_steps)
        futures = {
            client.submit(task, case.model_dump_json(), key=key, retries=RETRIES_N, priority=-number): case
            for number, (key, case) in enumerate(left.items())
        }
        for future in as_completed(futures):
            case = futures[future]
            failure = future.exception()
            if failure is None:
                finished(case, store.get(case), "")
            else:
                why = ": ".join(map(str, failure.args[:2])) or type(failure).__name__
                failed.append(why)
                finished(case, None, why)
    if failed:
        raise StudyError("sweep", f"{len(failed)} of {len(left)} runs failed, the first: {failed[0]}", "Start it again")


def _one(case: str, folder: str, ranks_n: int, restart_particle_steps: float) -> None:
    """A run, on a worker: what it comes to goes to the store, not over the wire."""
    run.run_case(
        Case.model_validate_json(case),
        Store(Path(folder)),
        ranks_n=ranks_n,
        restart_particle_steps=restart_particle_steps,
    )
