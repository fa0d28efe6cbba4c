"""Measured heights and widths against known ones: ``python -m benchmarks.evaluation [--beds 100] [--scans 10]``.

Beds of known spread and height, seen from 1.3 m above by a D455 with the noise measured on real ones (0.09 to 0.37 px,
neighbours erring together), tilted by up to 5 degrees, a fifth of the picture missing.
"""

from __future__ import annotations

import argparse

import numpy as np

from graderd.evaluation.statistics import interval
from harness.top_view import known_bed


def main() -> None:
    """Print the errors and how often the stated interval holds the truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--beds", type=int, default=100)
    parser.add_argument("--scans", type=int, default=10)
    parser.add_argument("--cell-mm", type=float, default=10.0)
    asked = parser.parse_args()
    found: dict[str, list[tuple[float, float, bool, float]]] = {}
    for seed in range(asked.beds):
        known = known_bed(seed, 500.0)
        for name, each in known.estimated(asked.scans, asked.cell_mm).items():
            truth = known.truth[name]
            low, high = interval(each, 0.95)
            assert low is not None
            assert high is not None
            error = each.value - truth
            found.setdefault(name, []).append((error, error / truth * 100.0, low <= truth <= high, (high - low) / 2.0))
    print(f"{asked.beds} beds, {asked.scans} scans each; 95 % intervals")
    for name, errors in found.items():
        table = np.array(errors, dtype=np.float64)
        off, unit = (table[:, 0], "mm") if name.startswith("height") else (table[:, 1], "%")
        print(
            f"{name:26}  mean {off.mean():+.2f}  rms {np.sqrt((off**2).mean()):.2f}  95 of 100 within "
            f"{np.percentile(np.abs(off), 95):.2f}  largest {np.abs(off).max():.2f} {unit}; truth within the interval "
            f"{table[:, 2].sum():.0f} of {len(table)}, half of it {np.median(table[:, 3]):.2f} mm"
        )


if __name__ == "__main__":
    main()
