"""What the engine wrote, read back: frames of grains, forces on the blade, the load along it.

A run that was killed and went on leaves several files of a kind; a later one counts from its first step on, and half a
line at the end of an earlier one is nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from graderd.studies.blade_rotation.lammps import FORCES, PUSHED, TURNED
from graderd.studies.blade_rotation.pile import F64

GRAIN = ("id", "x", "y", "z", "radius", "vx", "vy", "vz")


def frames(folder: Path) -> dict[int, F64]:
    """Grains by step, rows of :data:`GRAIN` in the order of their numbers."""
    found: dict[int, F64] = {}
    for path in _in_order(folder, "frames.*.dump"):
        for step, grains in _frames_of(path):
            found[step] = grains
    return dict(sorted(found.items()))


def settled(path: Path) -> F64:
    """The grains of a settled pile."""
    return next(grains for _, grains in _frames_of(path))


def _frames_of(path: Path) -> Iterator[tuple[int, F64]]:
    for text in path.read_text(encoding="ascii").split("ITEM: TIMESTEP\n")[1:]:
        head, _, rows = text.partition("ITEM: ATOMS " + " ".join(GRAIN) + "\n")
        lines = head.split("\n")
        values = np.array(rows.split(), dtype=np.float64)
        if len(lines) > 2 and values.size == int(lines[2]) * len(GRAIN) and rows.endswith("\n"):
            yield int(lines[0]), values.reshape(-1, len(GRAIN))


def forces(folder: Path) -> F64:
    """Rows of :data:`~.lammps.FORCES` in the order of time."""
    pushed, turned = _means(folder, "forces", len(PUSHED)), _means(folder, "moments", len(TURNED))
    rows = [pushed[step] + turned[step] for step in sorted(pushed) if step in turned]
    return np.array(rows, dtype=np.float64).reshape(-1, len(FORCES))


def _means(folder: Path, kind: str, columns_n: int) -> dict[int, list[float]]:
    found: dict[int, list[float]] = {}
    for path in _in_order(folder, f"{kind}.*.txt"):
        for line in path.read_text(encoding="ascii").split("\n")[:-1]:
            if not line.startswith("#") and len(words := line.split()) == columns_n + 1:
                found[int(words[0])] = [float(word) for word in words[1:]]
    return found


def along(folder: Path) -> dict[int, F64]:
    """By step the mean load square to the face since the frame before, N, in parts from the right end to the left."""
    found: dict[int, F64] = {}
    for path in _in_order(folder, "along.*.txt"):
        lines = iter(path.read_text(encoding="ascii").split("\n")[:-1])
        for line in lines:
            if not line.startswith("#"):
                step, parts = map(int, line.split())
                rows = [row.split() for row in islice(lines, parts)]
                if len(rows) == parts and all(len(row) == 2 for row in rows):
                    found[step] = np.array([float(value) for _, value in rows])
    return dict(sorted(found.items()))


def _in_order(folder: Path, pattern: str) -> list[Path]:
    return sorted(folder.glob(pattern), key=lambda path: [int(n) for n in re.findall(r"\d+", path.name)])
