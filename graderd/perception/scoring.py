"""How well a classifier did on labelled frames: accuracy, answered share, confusion matrix, time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graderd.core.soil import OPPOSITE, SoilObservation, Zone
from graderd.perception.settings import COLOR_METHODS, LABELS, PerceptionSettings, SiteFigure

PILES = (Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN)


@dataclass
class Score:
    """Counts over frames. Frames without a label, or labelled unknown, count for the times alone."""

    confusion: dict[str, dict[str, int]] = field(
        default_factory=lambda: {str(label): {str(zone): 0 for zone in Zone} for label in Zone}
    )
    cpu_ms: list[float] = field(default_factory=list)
    labelled_n: int = 0
    clear_n: int = 0
    clear_answered_n: int = 0

    def add(self, label: Zone | None, observation: SoilObservation, ambiguous: bool = False) -> None:
        """Count one frame; ``ambiguous``: its truth lies near a border, so that no answer is a fair answer."""
        self.cpu_ms.append(observation.cpu_ms)
        if label is None or label is Zone.UNKNOWN:
            return
        self.labelled_n += 1
        self.confusion[label][observation.zone] += 1
        if not ambiguous:
            self.clear_n += 1
            self.clear_answered_n += observation.zone is not Zone.UNKNOWN

    @property
    def answered_n(self) -> int:
        """Labelled frames with another answer than unknown."""
        return self.labelled_n - sum(row[Zone.UNKNOWN] for row in self.confusion.values())

    @property
    def accuracy(self) -> float:
        """Right answers over answers; 0 where there is none."""
        right = sum(self.confusion[zone][zone] for zone in Zone if zone is not Zone.UNKNOWN)
        return right / self.answered_n if self.answered_n else 0.0

    @property
    def answered_share(self) -> float:
        """Answers over labelled frames."""
        return self.answered_n / self.labelled_n if self.labelled_n else 0.0

    @property
    def answered_share_unambiguous(self) -> float:
        """Answers over labelled frames that are not ambiguous."""
        return self.clear_answered_n / self.clear_n if self.clear_n else 0.0

    @property
    def left_right_n(self) -> int:
        """Frames in which one side was taken for the other."""
        return sum(self.confusion[one][other] for one, other in OPPOSITE.items())

    @property
    def false_pile_share(self) -> float:
        """Share of the empty beds that were called a pile (or an even layer)."""
        row = self.confusion[Zone.NONE]
        total = sum(row.values())
        return sum(row[zone] for zone in PILES) / total if total else 0.0

    def summary(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        return {
            "frames_n": len(self.cpu_ms),
            "labelled_n": self.labelled_n,
            "accuracy": round(self.accuracy, 4),
            "answered_share": round(self.answered_share, 4),
            "answered_share_unambiguous": round(self.answered_share_unambiguous, 4),
            "left_right_n": self.left_right_n,
            "false_pile_share": round(self.false_pile_share, 4),
            "confusion": {label: row for label, row in self.confusion.items() if sum(row.values())},
            "cpu_ms_median": round(float(np.median(self.cpu_ms)), 3) if self.cpu_ms else None,
            "cpu_ms_p99": round(float(np.percentile(self.cpu_ms, 99)), 3) if self.cpu_ms else None,
        }


def site_figure(score: Score, settings: PerceptionSettings, measured_at: str) -> SiteFigure:
    """What ``settings.method``, a colour method, was worth on the frames of ``score``.

    Raises:
        ValueError: the method is none that goes by colour alone.
    """
    method = next((method for method in COLOR_METHODS if method == settings.method), None)
    if method is None:
        raise ValueError(f"{settings.method} does not go by colour")
    return SiteFigure(
        method=method,
        settings_mark=settings.color_mark(),
        measured_at=measured_at,
        frames_least_n=min(sum(score.confusion[label].values()) for label in LABELS),
        right_percent=round(100.0 * score.accuracy, 2),
        answered_percent=round(100.0 * score.answered_share, 2),
        sides_swapped_n=score.left_right_n,
        false_piles_percent=round(100.0 * score.false_pile_share, 2),
    )
