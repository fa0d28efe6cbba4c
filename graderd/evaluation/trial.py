"""One trial: its scans to measures with their uncertainty, and to a map."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graderd.evaluation.bed import Bed, Grid, Points, bed_of, common_grid
from graderd.evaluation.depth_files import Reader, find, span_of
from graderd.evaluation.experiment import Area, Case, Experiment, Trial
from graderd.evaluation.ground import F64, NoGroundError
from graderd.evaluation.load import load
from graderd.evaluation.measures import (
    EVERYWHERE,
    Blade,
    Interval,
    NothingThereError,
    Rules,
    height_difference,
    spread,
    volume_moved,
    windrow,
)
from graderd.evaluation.uncertainty import Estimate, estimate
from graderd.hal.errors import DeviceMissingError, ProtocolError


@dataclass(frozen=True, slots=True, eq=False)
class TrialResult:
    """What one trial came to. ``number``: among those of its case and angle, from 1. ``map_mm``: heights after the
    pass, above the target plane where there is one, else above the ground; None for a trial without scans.
    ``before_mm``: the same before the pass, of the same cells; None without scans of that."""

    case: str
    angle_deg: float
    number: int
    values: Mapping[str, Estimate]
    grid: Grid | None = None
    map_mm: F64 | None = None
    before_mm: F64 | None = None
    scans_n: int = 0


def evaluate_trials(
    experiment: Experiment, folder: Path, done: Callable[[TrialResult], None] = lambda _: None
) -> list[TrialResult]:
    """All trials in the file's order; file names count from ``folder``; ``done`` is told of each.

    Raises:
        DeviceMissingError, ProtocolError: a file is missing or wrong, or nothing can be measured in it; ``where`` names
            file or trial.
    """
    camera = folder / experiment.camera if experiment.camera else None
    reader = Reader(camera, experiment.travel, experiment.cloud_up, experiment.cloud_travel)
    bare = _scans(reader, folder, experiment.ground, "ground")
    results: list[TrialResult] = []
    for case in experiment.case:
        seen: dict[float, int] = {}
        for at, trial in enumerate(case.trial, 1):
            seen[trial.angle_deg] = number = seen.get(trial.angle_deg, 0) + 1
            where = f"{case.name}, trial[{at}]"
            one = _Work(experiment, case, trial, reader, folder, where)
            results.append(one.result(number, bare))
            done(results[-1])
    return results


def _scans(reader: Reader, folder: Path, names: Iterable[str], where: str) -> list[Points]:
    found: list[Points] = []
    for name in names:
        pattern, span = span_of(name, where)
        for path in find(folder, pattern, where):
            found += reader.scans(path, span)
    return found


def _rules(experiment: Experiment, area: Area) -> Rules:
    return Rules(
        experiment.edge_mm,
        Interval(*area.x_mm) if area.x_mm else EVERYWHERE,
        Interval(*area.y_mm) if area.y_mm else EVERYWHERE,
    )


class _Work:
    def __init__(
        self, experiment: Experiment, case: Case, trial: Trial, reader: Reader, folder: Path, where: str
    ) -> None:
        self._experiment, self._case, self._trial = experiment, case, trial
        self._reader, self._folder, self._where = reader, folder, where
        self._rules = _rules(experiment, experiment.area)
        self._layer = _rules(experiment, case.layer or experiment.area)

    def result(self, number: int, bare: Sequence[Points]) -> TrialResult:
        trial = self._trial
        values = {name: Estimate(value, math.inf, math.inf) for name, value in trial.measured.items()}
        if trial.load_csv:
            values |= self._load()
        if not trial.after:
            return TrialResult(self._case.name, trial.angle_deg, number, values)
        states = [
            _scans(self._reader, self._folder, names, self._where) for names in (trial.before, trial.after) if names
        ]
        try:
            grid = common_grid(states, self._experiment.cell_mm, bare)
            beds = [bed_of(scans, self._experiment.cell_mm, grid, bare) for scans in states]
            seen = estimate(beds, lambda maps: self._measures(beds, maps))
        except NoGroundError as error:
            remedy = "Name scans of the empty bed from the same place as ground, or free a part of the view"
            raise ProtocolError(self._where, str(error), remedy) from None
        except NothingThereError as error:
            remedy = "Look at the scans, at area and at edge_mm"
            raise ProtocolError(self._where, str(error), remedy) from None
        target_mm = self._case.target_height_mm or 0.0
        *before, after = (bed.heights_mm - target_mm for bed in beds)
        return TrialResult(
            self._case.name,
            trial.angle_deg,
            number,
            seen | values,
            grid,
            after,
            before[0] if before else None,
            len(states[-1]),
        )

    def _measures(self, beds: Sequence[Bed], maps: Sequence[F64]) -> dict[str, float]:
        bed, after, rules = beds[-1], maps[-1], self._rules
        grid, noise = bed.grid, bed.noise_mm
        found: dict[str, float] = {}
        if self._case.work == "flattening":
            target_mm = self._case.target_height_mm or 0.0
            found |= height_difference(after, grid, target_mm, noise, bed.cell_noise_mm, self._layer)
            found |= windrow(after, grid, noise, rules)
        else:
            found |= spread(after, grid, noise, rules, self._experiment.spread, self._blade())
        if len(maps) == 2:
            found |= volume_moved(maps[0], after, grid, math.hypot(noise, beds[0].noise_mm), rules)
        return found

    def _blade(self) -> Blade | None:
        trial, experiment = self._trial, self._experiment
        if trial.blade_x_mm is None:
            return None
        size = experiment.blade_length_mm, experiment.blade_reach_mm
        return Blade(trial.blade_x_mm, trial.blade_y_mm, trial.angle_deg, *size)

    def _load(self) -> dict[str, Estimate]:
        """Mean and greatest blade load of a recording."""
        (path,) = find(self._folder, self._trial.load_csv, self._where)[:1]
        column = self._trial.load_column
        try:
            rows = csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines())
            if column not in (rows.fieldnames or ()):
                raise ProtocolError(f"{path}:1", f"has no column {column!r}", "Name it in load_column")
            loads = []
            for row in rows:
                if text := (row[column] or "").strip():
                    loads.append(float(text))
        except OSError as error:
            raise DeviceMissingError(str(path), f"cannot be read ({error.strerror})") from None
        except UnicodeDecodeError:
            raise ProtocolError(str(path), "is not UTF-8 text", "Save it as CSV in UTF-8") from None
        except (ValueError, csv.Error) as error:
            raise ProtocolError(f"{path}:{rows.line_num}", f"{column}: {error}", "Newtons as plain numbers") from None
        if not loads or not np.isfinite(loads).all():
            raise ProtocolError(str(path), f"column {column} holds no finite loads", "Newtons as plain numbers")
        return {name: Estimate(value, math.inf, math.inf) for name, value in load(loads).items()}
