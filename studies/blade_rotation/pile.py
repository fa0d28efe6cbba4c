"""Soil before it falls: grains of seeded sizes at seeded places, none touching another."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from graderd.studies.blade_rotation.case import SPREAD_OF_SIZES, Case

F64 = npt.NDArray[np.float64]


def poured(case: Case) -> F64:
    """``grains_n`` rows of x, y, z, radius (m): layers of a jittered lattice over the pile's box, from the floor up.

    Diameters are uniform about their mean and scaled so that the solid volume is the study's whatever the seed.
    """
    rng = np.random.default_rng((case.seed, case.grains_n))
    radius = case.grain_m / 2.0 * rng.uniform(1.0 - SPREAD_OF_SIZES, 1.0 + SPREAD_OF_SIZES, case.grains_n)
    radius *= (case.grains_n * (case.grain_m / 2.0) ** 3 / (radius**3).sum()) ** (1.0 / 3.0)
    widest = 2.0 * float(radius.max())
    pitch = 1.05 * widest
    columns, rows = (max(1, math.floor(side / pitch)) for side in (case.pile.length_m, case.pile.width_m))
    place = np.arange(case.grains_n)
    layer, within = np.divmod(place, columns * rows)
    i, j = np.divmod(within, rows)
    # Every layer is shifted at random as a whole, so that grains do not fall straight onto each other.
    shift = rng.uniform(-0.5, 0.5, (int(layer.max()) + 1, 2)) * pitch
    jitter = rng.uniform(-0.5, 0.5, (case.grains_n, 3)) * (pitch - widest)
    x = (i - (columns - 1) / 2.0) * pitch + shift[layer, 0] + jitter[:, 0]
    y = (j - (rows - 1) / 2.0) * pitch + shift[layer, 1] + jitter[:, 1]
    z = (layer + 0.5) * pitch + jitter[:, 2]
    return np.column_stack((x, y, z, radius))
