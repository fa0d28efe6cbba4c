"""What a pass costs the blade: its load over the pass, and where along the blade it lies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graderd.evaluation.ground import F64


def load(forces_n: F64 | Sequence[float]) -> dict[str, float]:
    """Mean and greatest load of one pass, from samples evenly spaced in time from first contact to the end.

    ``forces_n``: magnitudes, or rows of components whose magnitude is the load.
    """
    forces = np.asarray(forces_n, dtype=np.float64)
    loads = np.linalg.norm(forces, axis=1) if forces.ndim == 2 else np.abs(forces)
    return {"blade_load_n": float(loads.mean()), "blade_load_max_n": float(loads.max())}


def load_along(parts_n: F64) -> dict[str, float]:
    """Which share of the load each third of the blade bears, the operator's left and right.

    ``parts_n``: load square to the face by equal parts of the blade's length, from its right end to its left. Nothing
    where there is no load.
    """
    total = float(parts_n.sum())
    if total <= 0.0:
        return {}
    held = np.concatenate(([0.0], np.cumsum(parts_n)))
    right, both = np.interp(np.array((1.0, 2.0)) / 3.0 * parts_n.size, np.arange(held.size), held) / total * 100.0
    return {
        "load_left_percent": float(100.0 - both),
        "load_center_percent": float(both - right),
        "load_right_percent": float(right),
    }
