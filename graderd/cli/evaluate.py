"""``graderd evaluate``: what passes were worth, from depth seen from above before and after them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graderd.cli.console import CliError, ExitCode, Json, example, print_error, print_json, print_table, print_text
from graderd.hal.errors import DeviceError

if TYPE_CHECKING:
    from graderd.evaluation.experiment import Experiment
    from graderd.evaluation.statistics import Difference, Row
    from graderd.evaluation.study import Finding
    from graderd.evaluation.trial import TrialResult


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command(
        epilog=example(
            "graderd evaluate experiment.toml",
            "graderd evaluate experiment.toml --save results/",
            "graderd evaluate --study",
            "graderd evaluate experiment.toml --json",
        )
    )
    def evaluate(
        experiment: Annotated[Path | None, typer.Argument(help="Experiment file (TOML).")] = None,
        save: Annotated[
            Path | None,
            typer.Option(metavar="DIR", help="Write index.html, rows.csv, trials.csv, differences.csv here."),
        ] = None,
        study: Annotated[
            bool, typer.Option("--study", help="The study's Table 4 instead of a file, and what its numbers come to.")
        ] = False,
        json: Json = False,
    ) -> None:
        """Measure the work of an experiment's passes, by case and blade angle.

        Height difference to the target plane for flattening, degree of spread for scattering, volume moved, windrow and
        blade load: each with mean, deviation and confidence interval, and a test whether the angles differ. How to lay
        out an experiment is in docs/operators/evaluation.md. Needs the packages of graderd[evaluation].
        """
        if study == (experiment is not None):
            cause = "give either an experiment file or --study"
            raise CliError("evaluate", cause, "graderd evaluate --help shows both", ExitCode.USAGE)
        try:
            import scipy.stats  # noqa: F401  (the command's own message where the extra is not installed)
        except ImportError:
            cause = "the package scipy is not installed"
            raise CliError("evaluate", cause, "Install graderd[evaluation]", ExitCode.USAGE) from None
        _run(experiment, save, json)


def _run(path: Path | None, save: Path | None, as_json: bool) -> None:
    # Heavy imports wait until the command really runs.
    from graderd.config.loader import ConfigError
    from graderd.evaluation import experiment as file
    from graderd.evaluation import page
    from graderd.evaluation.statistics import differences_of, interval, rows_of
    from graderd.evaluation.study import Study, data, findings, table_4_path
    from graderd.evaluation.trial import evaluate_trials

    given = path or table_4_path()
    try:
        experiment = file.load(given)
    except ConfigError as error:
        *others, last = error.problems
        for problem in others:
            print_error("", problem, "", False)
        raise CliError("", last, "", ExitCode.USAGE) from None
    level = experiment.confidence_percent / 100.0

    def told(trial: TrialResult) -> None:
        if as_json:
            measures = {}
            for name, found in trial.values.items():
                low, high = interval(found, level)
                measures[name] = {"value": found.value, "low": low, "high": high}
            print_json(
                {
                    "event": "trial_evaluated",
                    "case": trial.case,
                    "angle_deg": trial.angle_deg,
                    "trial": trial.number,
                    "measures": measures,
                }
            )

    try:
        trials = evaluate_trials(experiment, given.parent, told)
    except DeviceError as error:
        raise CliError(error.where, error.cause, error.remedy, ExitCode.USAGE) from None
    rows = rows_of(trials, level)
    differences = differences_of(rows, level)
    if save is not None:
        try:
            written = page.write(save, experiment, trials, rows, differences)
        except OSError as error:
            raise CliError(str(save), f"cannot be written ({error.strerror})", "", ExitCode.USAGE) from None
        if not as_json:
            print_text(f"wrote {', '.join(map(str, written))}")
    checked = findings(Study(data(), tuple(rows), tuple(differences))) if path is None else []
    if as_json:
        _print_json(rows, differences, checked)
    else:
        _print_text(experiment, rows, differences, checked)


def _print_json(rows: Sequence[Row], differences: Sequence[Difference], checked: Sequence[Finding]) -> None:
    for whole in differences:
        print_json({"event": "difference_tested", **asdict(whole)})
    for finding in checked:
        print_json({"event": "number_checked", **asdict(finding)})
    print_json({"event": "evaluation_finished", "rows": [row_object(row) for row in rows]})


def row_object(row: Row) -> dict[str, Any]:
    """One row for programs."""
    return {
        "case": row.case,
        "angle_deg": row.angle_deg,
        "measure": row.measure,
        "value": row.value,
        "low": row.low,
        "high": row.high,
        "trials_n": row.trials_n,
    }


def _print_text(
    experiment: Experiment, rows: Sequence[Row], differences: Sequence[Difference], checked: Sequence[Finding]
) -> None:
    from graderd.evaluation.page import number, p_text

    lines: list[tuple[str, ...]] = []
    for row in rows:
        sure = "" if row.low is None else f"{number(row.low)} to {number(row.high)}"
        cells = (row.case, f"{row.angle_deg:g}°", row.measure, number(row.value), number(row.deviation), sure)
        lines.append((*cells, str(row.trials_n)))
    interval = f"{experiment.confidence_percent:g} % interval"
    print_table(experiment.name, ("case", "angle", "measure", "mean", "deviation", interval, "trials"), lines)
    if differences:
        lines = []
        for whole in differences:
            lines.append((whole.case, whole.measure, "all angles", "", f"F = {whole.f:.3g}", p_text(whole.p)))
            for pair in whole.pairs:
                names = f"{pair.angle_deg:g}° less {pair.other_deg:g}°"
                bounds = f"{number(pair.low)} to {number(pair.high)}"
                lines.append((whole.case, whole.measure, names, number(pair.difference), bounds, p_text(pair.p)))
        header = ("case", "measure", "angles", "difference", interval, "p")
        print_table("Do the angles differ? (Welch; pairs by Games and Howell)", header, lines)
    if checked:
        print_table(
            "The study's numbers, computed again",
            ("where", "it says", "its own data give", ""),
            [(each.where, each.says, each.gives, str(each.verdict)) for each in checked],
        )
