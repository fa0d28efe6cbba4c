"""The soil in the test bed: a height field whose mass is conserved and whose slopes settle to an angle of repose.

Bed frame: x along the bed in the direction of travel, 0 at its start; y to the operator's left, 0 on the centre line;
z up from the bed's floor, metres. The bed is 8 m x 2 m, as in section 3.3 of *Strategy for Motor Grader Blade Rotation
considering Soil Distribution*; its floor and sides are plywood and let nothing through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

BED_LENGTH_M = 8.0
BED_WIDTH_M = 2.0

_RATE = 0.35
"""Share of a too steep step that moves in one pass over one direction at most; stable up to 0.5."""
_NEIGHBOURS: tuple[tuple[tuple[slice, slice], tuple[slice, slice], float], ...] = (
    ((slice(None, -1), slice(None)), (slice(1, None), slice(None)), 1.0),
    ((slice(None), slice(None, -1)), (slice(None), slice(1, None)), 1.0),
    ((slice(None, -1), slice(None, -1)), (slice(1, None), slice(1, None)), math.sqrt(2.0)),
    ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1)), math.sqrt(2.0)),
)


@dataclass(frozen=True, slots=True)
class SoilProperties:
    """All that tells one soil from another here: what is fitted to a real one, or to a simulation by discrete elements.

    ``repose_deg``: angle of repose; sand has 30 to 35 degrees, moist earth 36 to 45. ``steel_friction``: mean
    coefficient of friction on the blade (Table 2 of the paper): how far the blade's own sideways way takes soil along.
    ``soil_friction``: coefficient of friction within the soil (Table 2), by which a pushed heap drags over the ground.
    ``density_kg_per_m3``: loose, in bulk. ``slide_m``: how readily a slope follows a moving blade: square metres of
    section that slide down it for each metre of the blade's way, for each unit of slope above that of repose; large:
    slopes stand no steeper than at rest.
    """

    repose_deg: float = 40.0
    steel_friction: float = 0.37
    soil_friction: float = 0.49
    density_kg_per_m3: float = 1600.0
    slide_m: float = 0.06

    @property
    def repose_slope(self) -> float:
        """Rise over run at the angle of repose."""
        return math.tan(math.radians(self.repose_deg))


MOIST_LOAM = SoilProperties()
"""What lies in the bed where nobody says otherwise."""


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of cells, ``[x0, x1) x [y0, y1)``."""

    x0: int
    x1: int
    y0: int
    y1: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """For indexing a field array."""
        return slice(self.x0, self.x1), slice(self.y0, self.y1)


@dataclass(frozen=True, slots=True)
class Wall:
    """An obstacle inside a window: soil cannot enter its cells below its top.

    ``mask``: window-shaped; ``flat``: the same as flat indices; ``top_m``: height of the top for each of ``flat``.
    """

    mask: BoolArray
    flat: npt.NDArray[np.intp]
    top_m: FloatArray


class SoilField:
    """Heights of loose soil above the bed's floor on a regular grid.

    ``heights_m`` is ``(cells along x, cells along y)``; cell ``(i, j)`` has its centre at
    ``((i + 0.5) cell_m, (j + 0.5) cell_m - width_m / 2)``. Every change of it conserves the sum, apart from
    :meth:`add` and :meth:`clear`, which say what they add or take.
    """

    def __init__(
        self,
        *,
        cell_m: float = 0.02,
        length_m: float = BED_LENGTH_M,
        width_m: float = BED_WIDTH_M,
        soil: SoilProperties = MOIST_LOAM,
        heights_m: FloatArray | None = None,
    ) -> None:
        self.cell_m = cell_m
        self.length_m = length_m
        self.width_m = width_m
        self.soil = soil
        shape = (round(length_m / cell_m), round(width_m / cell_m))
        if heights_m is not None and heights_m.shape != shape:
            raise ValueError(f"heights have shape {heights_m.shape}, the bed has {shape} cells")
        self.heights_m: FloatArray = np.zeros(shape) if heights_m is None else heights_m.astype(np.float64)
        self.x_m: FloatArray = (np.arange(shape[0], dtype=np.float64) + 0.5) * cell_m
        self.y_m: FloatArray = (np.arange(shape[1], dtype=np.float64) + 0.5) * cell_m - width_m / 2.0

    @property
    def volume_m3(self) -> float:
        """All soil in the bed."""
        return float(self.heights_m.sum()) * self.cell_m**2

    def clear(self) -> None:
        """Take all soil out."""
        self.heights_m[:] = 0.0

    def add(self, heights_m: FloatArray) -> None:
        """Pour soil: ``heights_m`` (the field's shape, not negative) is added and settles where it fell."""
        self.heights_m += heights_m
        wet_x, wet_y = (np.flatnonzero(heights_m.any(axis=axis)) for axis in (1, 0))
        if wet_x.size == 0:
            return
        margin = math.ceil(float(self.heights_m.max()) / self.soil.repose_slope / self.cell_m) + 4
        n_x, n_y = self.heights_m.shape
        x0, x1 = max(int(wet_x[0]) - margin, 0), min(int(wet_x[-1]) + margin, n_x)
        y0, y1 = max(int(wet_y[0]) - margin, 0), min(int(wet_y[-1]) + margin, n_y)
        self.settle(Window(x0, x1, y0, y1))

    def height_at(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Heights of the cells nearest to points of the bed frame."""
        n_x, n_y = self.heights_m.shape
        ix = np.clip(np.floor(x_m / self.cell_m), 0, n_x - 1).astype(np.intp)
        iy = np.clip(np.floor((y_m + self.width_m / 2.0) / self.cell_m), 0, n_y - 1).astype(np.intp)
        return np.asarray(self.heights_m[ix, iy])

    @property
    def whole(self) -> Window:
        """The window of the whole bed."""
        return Window(0, self.heights_m.shape[0], 0, self.heights_m.shape[1])

    def window(self, x_min_m: float, x_max_m: float, y_min_m: float, y_max_m: float) -> Window:
        """The cells touched by a rectangle in the bed frame, clipped to the bed; never empty."""
        n_x, n_y = self.heights_m.shape
        half = self.width_m / 2.0
        x0 = min(max(math.floor(x_min_m / self.cell_m), 0), n_x - 2)
        x1 = min(max(math.ceil(x_max_m / self.cell_m), x0 + 2), n_x)
        y0 = min(max(math.floor((y_min_m + half) / self.cell_m), 0), n_y - 2)
        y1 = min(max(math.ceil((y_max_m + half) / self.cell_m), y0 + 2), n_y)
        return Window(x0, x1, y0, y1)

    def follow(self, window: Window, wall: Wall | None, way_m: float) -> None:
        """Let slopes steeper than the repose angle slide as far as they do while a blade goes ``way_m``; on every grid
        alike. Further as :meth:`relax`."""
        share = self.soil.slide_m * way_m / self.cell_m**2
        passes = max(1, math.ceil(share / _RATE))
        self.relax(window, wall, passes, share / passes)

    def relax(self, window: Window, wall: Wall | None = None, passes: int = 1, rate: float = _RATE) -> float:
        """Let slopes steeper than the repose angle slide, ``passes`` times over the eight neighbour directions;
        ``rate``: share of a too steep step that moves in one pass over one direction.

        Soil climbs onto a ``wall`` only where it stands above the wall's top (it then lies in the wall's cells, for
        the caller to carry on), and never leaves a wall's cell. Nothing crosses the window's border.

        Returns:
            The largest height moved between two cells in the last pass, metres: near zero once settled.
        """
        heights = self.heights_m[window.slices]
        surface = heights
        if wall is not None:
            surface = heights.copy()
            surface.reshape(-1)[wall.flat] = wall.top_m
            free = ~wall.mask
        drop_m = self.cell_m * self.soil.repose_slope
        largest = 0.0
        for number in range(passes):
            for upper, lower, distance in _NEIGHBOURS:
                down = surface[upper] - surface[lower]
                down -= np.maximum(np.minimum(down, drop_m * distance), -drop_m * distance)
                if wall is not None:
                    down *= np.where(down > 0.0, free[upper], free[lower])
                down *= rate
                if number == passes - 1:
                    largest = max(largest, float(down.max(initial=0.0)), -float(down.min(initial=0.0)))
                heights[upper] -= down
                heights[lower] += down
                if wall is not None:
                    np.copyto(surface, heights)
                    surface.reshape(-1)[wall.flat] = np.maximum(wall.top_m, heights.reshape(-1)[wall.flat])
        return largest

    def settle(self, window: Window, wall: Wall | None = None, tolerance_m: float = 2e-5, limit: int = 3000) -> None:
        """Relax until nothing larger than ``tolerance_m`` moves (at most ``limit`` passes)."""
        for _ in range(0, limit, 10):
            if self.relax(window, wall, passes=10) < tolerance_m:
                return

    def deposit(self, window: Window, wall: Wall, x_m: FloatArray, y_m: FloatArray, heights_m: FloatArray) -> None:
        """Put columns of soil down at points of the bed outside ``wall``, shared among those of the four cells around
        each that are not the wall's.

        Points outside the window go to its nearest cells. ``heights_m``: height of each column over one cell.
        """
        view = self.heights_m[window.slices]
        n_x, n_y = view.shape
        column_x = np.clip(x_m / self.cell_m - 0.5 - window.x0, 0.0, n_x - 1.001)
        column_y = np.clip((y_m + self.width_m / 2.0) / self.cell_m - 0.5 - window.y0, 0.0, n_y - 1.001)
        ix, iy = column_x.astype(np.intp), column_y.astype(np.intp)
        fx, fy = column_x - ix, column_y - iy
        cells = (ix * n_y + iy) + np.array([0, 1, n_y, n_y + 1])[:, None]
        shares = np.stack(((1.0 - fx) * (1.0 - fy), (1.0 - fx) * fy, fx * (1.0 - fy), fx * fy))
        free = shares * ~wall.mask.reshape(-1)[cells]
        given = free.sum(axis=0)
        shares = np.where(given > 1e-9, free / np.maximum(given, 1e-9), shares)
        view += np.bincount(cells.ravel(), (shares * heights_m).ravel(), minlength=n_x * n_y).reshape(n_x, n_y)
