"""How sure a measure is: what repeated scans say, and a bootstrap of what the bare ground shows.

Repeats tell how the scans differ among themselves; the measure is taken with each of them left out (jackknife). What a
sensor shows in every scan alike (its fixed pattern, unevenness of the ground) they cannot tell: for that, blocks of
what the bare ground shows beside its plane are laid over the whole map at random, the cells that were not seen are
taken away elsewhere, ground and holes are done again, and the measure is taken anew. The larger of the two counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graderd.evaluation.bed import Bed, LevelFit, fill
from graderd.evaluation.ground import F64
from graderd.evaluation.measures import NothingThereError

RESAMPLES_N = 80
BLOCK_MM = 200.0
"""Side of a block: far wider than a stereo camera's neighbours err together."""
BLOCK_SHARE = 0.8
"""At least this share of a block is bare ground; the rest of it is taken as free of noise."""

Measure = Callable[[Sequence[F64]], Mapping[str, float]]
"""Takes the maps of the states (before and after, or after alone) to the measures."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A measure with its standard uncertainty, which has ``freedom_n`` degrees of freedom; inf deviation: unknown."""

    value: float
    deviation: float
    freedom_n: float


def estimate(beds: Sequence[Bed], measure: Measure, seed: int = 1) -> dict[str, Estimate]:
    """Each measure of the beds' maps with its uncertainty; one that is not there in every resample is unsure.

    Raises:
        NothingThereError: nothing can be measured in the maps as they are.
    """
    value = measure([bed.heights_mm for bed in beds])

    def again(maps: Sequence[F64]) -> Mapping[str, float]:
        try:
            return measure(maps)
        except NothingThereError:
            return {}

    repeated = _repeated(beds, again, value)
    resampled = _resampled(beds, again, value, np.random.default_rng(seed))
    return {
        name: Estimate(value[name], *max((repeated[name], resampled[name]), key=lambda found: found[0]))
        for name in value
    }


def _repeated(beds: Sequence[Bed], measure: Measure, value: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Jackknife over the scans, state by state."""
    variance = dict.fromkeys(value, 0.0)
    freedom = dict.fromkeys(value, np.inf)
    for at, bed in enumerate(beds):
        n = len(bed.repeats_mm)
        if n < 3:
            continue
        maps = [other.heights_mm for other in beds]
        found = [measure([*maps[:at], each, *maps[at + 1 :]]) for each in bed.repeats_mm]
        for name in value:
            each = np.array([one.get(name, np.nan) for one in found])
            variance[name] += float(((each - each.mean()) ** 2).sum()) * (n - 1) / n
            freedom[name] = min(freedom[name], n - 1)
    return {name: (_sane(variance[name] ** 0.5), freedom[name]) for name in value}


def _resampled(
    beds: Sequence[Bed], measure: Measure, value: Mapping[str, float], rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    noises = [_Noise(bed, rng) for bed in beds]
    if not all(noise.known for noise in noises):
        return dict.fromkeys(value, (0.0 if all(len(bed.repeats_mm) > 2 for bed in beds) else np.inf, np.inf))
    found = [measure([noise.disturbed() for noise in noises]) for _ in range(RESAMPLES_N)]
    return {name: (_sane(float(np.std([one.get(name, np.nan) for one in found], ddof=1))), np.inf) for name in value}


def _sane(deviation: float) -> float:
    return deviation if np.isfinite(deviation) else np.inf


class _Noise:
    """What the bare ground of one bed shows, laid over its map in blocks."""

    def __init__(self, bed: Bed, rng: np.random.Generator) -> None:
        self._bed, self._rng = bed, rng
        self._side = min(bed.grid.cells(BLOCK_MM), *bed.residual_mm.shape)
        known = np.isfinite(bed.residual_mm)
        held = np.cumsum(np.cumsum(np.pad(known, ((1, 0), (1, 0))), axis=0), axis=1)
        n = self._side
        share = (held[n:, n:] - held[:-n, n:] - held[n:, :-n] + held[:-n, :-n]) / n**2
        self._corners = np.argwhere(share >= BLOCK_SHARE)
        self._residual = np.where(known, bed.residual_mm, 0.0)
        self._level = LevelFit(bed.ground, bed.grid) if bed.ground.any() else None
        self.known = len(self._corners) > n**2

    def disturbed(self) -> F64:
        """The map with another draw of the noise on it and other cells unseen."""
        bed, n = self._bed, self._side
        shape = bed.heights_mm.shape
        rows, columns = -(-shape[0] // n), -(-shape[1] // n)
        at = self._corners[self._rng.integers(0, len(self._corners), rows * columns)]
        sign = self._rng.choice((-1.0, 1.0), rows * columns)
        span = np.arange(n)
        blocks = self._residual[at[:, 0, None, None] + span[:, None], at[:, 1, None, None] + span] * sign[:, None, None]
        noise = (
            blocks.reshape(rows, columns, n, n).swapaxes(1, 2).reshape(rows * n, columns * n)[: shape[0], : shape[1]]
        )
        if self._level is not None:
            noise = noise - self._level.of(noise)
        shift = (int(self._rng.integers(shape[0])), int(self._rng.integers(shape[1])))
        unseen = np.roll(bed.inside & ~bed.measured, shift, axis=(0, 1))
        return fill(np.where(unseen, np.nan, bed.heights_mm + noise), bed.inside)
