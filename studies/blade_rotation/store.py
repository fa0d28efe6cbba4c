"""Where results are kept: under the hash of what was computed, Parquet for the numbers, a small manifest last of all.

A result is there when its manifest is; whatever was killed before leaves a folder that the next one goes on with. A
folder belongs to one process at a time (``flock``, which ends with its holder).
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graderd.studies.blade_rotation.case import Case

if TYPE_CHECKING:
    import pyarrow as pa

MANIFEST = "manifest.json"


@dataclass(frozen=True, slots=True)
class Result:
    """What one run came to.

    ``measures``: by name with the unit in it, as ``graderd.evaluation`` names them. ``checks``: mass, momentum, energy
    and the engine's own doubts (:mod:`.outcome`). ``engine_s``, ``wall_s``: in the engine, and in all.
    """

    key: str
    case: Case
    engine: str
    measures: dict[str, float]
    checks: dict[str, float]
    particle_steps_n: int
    engine_s: float
    wall_s: float
    notes: dict[str, Any] = field(default_factory=dict)


class Store:
    """A folder of results."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def run_folder(self, case: Case) -> Path:
        """Where a case's result is, or is being made."""
        return self.folder / "runs" / case.key()

    def pile_folder(self, case: Case) -> Path:
        """Where its settled pile is."""
        return self.folder / "piles" / case.pile_key()

    def get(self, case: Case) -> Result | None:
        """The result of a case, None where it has not been computed."""
        return self._read(self.run_folder(case) / MANIFEST)

    def results(self) -> list[Result]:
        """All of them."""
        found = (self._read(path) for path in sorted(self.folder.glob(f"runs/*/{MANIFEST}")))
        return [result for result in found if result is not None]

    def table(self, case: Case, name: str) -> pa.Table:
        """One of the tables kept beside a result: ``travel``, ``forces``, ``along``, ``soil``."""
        import pyarrow.parquet as pq

        return pq.read_table(self.run_folder(case) / f"{name}.parquet")

    def keep(self, result: Result, tables: dict[str, pa.Table]) -> None:
        """Write tables, then the manifest, which makes the result one."""
        import pyarrow.parquet as pq

        folder = self.run_folder(result.case)
        for name, table in tables.items():
            pq.write_table(table, folder / f"{name}.parquet", compression="zstd")
        data = asdict(result) | {"case": result.case.model_dump(mode="json")}
        written(folder / MANIFEST, json.dumps(data, indent=1, allow_nan=False))

    @contextlib.contextmanager
    def alone(self, folder: Path) -> Iterator[None]:
        """Hold a folder against all other processes."""
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def _read(self, path: Path) -> Result | None:
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return None
        return Result(**data | {"case": Case.model_validate(data["case"])})


def written(path: Path, text: str) -> None:
    """Write a file as a whole or not at all."""
    part = path.with_name(f"{path.name}.part")
    with part.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
