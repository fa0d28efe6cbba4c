"""From trials to a table: means with their intervals, and whether the angles differ. All of it scipy's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # its statistics, a second of processor time, are imported where they are used first

from graderd.evaluation.trial import TrialResult
from graderd.evaluation.uncertainty import Estimate


@dataclass(frozen=True, slots=True)
class Row:
    """One measure at one angle of one case. ``deviation``: standard deviation of the trials, None for a single one.
    ``low`` and ``high``: confidence interval of the mean by Student's t over the trials; for a single trial the
    measurement's own; None where neither is known."""

    case: str
    angle_deg: float
    measure: str
    values: tuple[float, ...]
    value: float
    deviation: float | None
    low: float | None
    high: float | None

    @property
    def trials_n(self) -> int:
        """How many trials are in it."""
        return len(self.values)


@dataclass(frozen=True, slots=True)
class Pair:
    """Mean at the first angle less mean at the second, with its interval and p adjusted for all pairs "
    "(Games-Howell)."""

    angle_deg: float
    other_deg: float
    difference: float
    low: float
    high: float
    p: float


@dataclass(frozen=True, slots=True)
class Difference:
    """Whether a measure differs between the angles of a case: Welch's analysis of variance, then the pairs."""

    case: str
    measure: str
    f: float
    p: float
    pairs: tuple[Pair, ...]


def rows_of(trials: Sequence[TrialResult], confidence: float) -> list[Row]:
    """The table's rows: cases and measures in the order they came, angles in rising order."""
    groups: dict[tuple[str, str, float], list[Estimate]] = {}
    for trial in trials:
        for measure, found in trial.values.items():
            groups.setdefault((trial.case, measure, trial.angle_deg), []).append(found)
    order = list(dict.fromkeys((case, measure) for case, measure, _ in groups))
    cases = list(dict.fromkeys(case for case, _ in order))
    keys = sorted(groups, key=lambda key: (cases.index(key[0]), order.index(key[:2]), key[2]))
    return [_row(*key, groups[key], confidence) for key in keys]


def _row(case: str, measure: str, angle_deg: float, found: Sequence[Estimate], confidence: float) -> Row:
    values = tuple(each.value for each in found)
    mean = float(np.mean(values))
    if len(values) == 1:
        low, high = interval(found[0], confidence)
        return Row(case, angle_deg, measure, values, mean, None, low, high)
    deviation = float(np.std(values, ddof=1))
    if deviation > 0.0:
        low, high = scipy.stats.t.interval(confidence, len(values) - 1, mean, deviation / math.sqrt(len(values)))
    else:
        low = high = mean
    return Row(case, angle_deg, measure, values, mean, deviation, float(low), float(high))


def interval(found: Estimate, confidence: float) -> tuple[float | None, float | None]:
    """Confidence interval of one measurement; None where its uncertainty is not known."""
    if not math.isfinite(found.deviation):
        return None, None
    half = float(scipy.stats.t.ppf((1.0 + confidence) / 2.0, found.freedom_n)) * found.deviation
    return found.value - half, found.value + half


def differences_of(rows: Sequence[Row], confidence: float) -> list[Difference]:
    """A test for every case and measure with two angles or more of two trials each; none where trials have no "
    "scatter."""
    found = []
    for case, measure in dict.fromkeys((row.case, row.measure) for row in rows):
        group = [row for row in rows if (row.case, row.measure) == (case, measure)]
        if len(group) < 2 or any(not row.deviation for row in group):
            continue
        samples = [row.values for row in group]
        whole = scipy.stats.f_oneway(*samples, equal_var=False)
        pairs = tuple(_pair(a, b, len(group), confidence) for a, b in combinations(group, 2))
        found.append(Difference(case, measure, float(whole.statistic), float(whole.pvalue), pairs))
    return found


def _pair(one: Row, other: Row, angles_n: int, confidence: float) -> Pair:
    """Games and Howell's test of two rows out of ``angles_n``: scipy's ``tukey_hsd``, which takes three times as long,
    as it integrates for each pair both ways round, and for each angle against itself."""
    shares = [float(np.var(row.values, ddof=1)) / row.trials_n for row in (one, other)]
    freedom = sum(shares) ** 2 / sum(
        share**2 / (row.trials_n - 1) for share, row in zip(shares, (one, other), strict=True)
    )
    error = math.sqrt(sum(shares) / 2.0)
    difference = one.value - other.value
    if angles_n == 2:  # the range of two is Student's t, without an integral
        half = float(scipy.stats.t.ppf((1.0 + confidence) / 2.0, freedom)) * math.sqrt(2.0) * error
        p = 2.0 * float(scipy.stats.t.sf(abs(difference) / error / math.sqrt(2.0), freedom))
    else:
        half = float(scipy.stats.studentized_range.ppf(confidence, angles_n, freedom)) * error
        p = float(scipy.stats.studentized_range.sf(abs(difference) / error, angles_n, freedom))
    return Pair(one.angle_deg, other.angle_deg, difference, difference - half, difference + half, p)
