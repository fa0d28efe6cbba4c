"""The report page of results that are made up: it says what the intervals carry, and needs nothing beside it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from graderd.studies.blade_rotation import matrix, report
from graderd.studies.blade_rotation.case import Case, Work
from graderd.studies.blade_rotation.lammps import ALONG_N
from graderd.studies.blade_rotation.matrix import HEIGHT, LOAD, SPREAD
from graderd.studies.blade_rotation.store import Result, Store

NAMES = ("flattening", "middle", "middle, decided again", "middle, half the step", "quarter, middle")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    every = matrix.lines
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matrix, "lines", lambda size: [line for line in every(size) if line.name in NAMES])
        store = Store(tmp_path_factory.mktemp("store"))
        for case in matrix.cases(matrix.lines(matrix.QUICK)):
            keep(store, case)
        path = report.write(store)
    return path, path.read_text(encoding="utf-8")


def keep(store: Store, case: Case) -> None:
    """A result whose spread falls with the angle, clearly, and whose load is chance."""
    rng = np.random.default_rng((case.seed, int(case.angle_deg)))
    scatter = float(rng.normal(0.0, 5.0))
    spread = 2200.0 - 8.0 * case.angle_deg + scatter - (300.0 if case.decision == "again" else 0.0)
    main = {HEIGHT: -5.0 + scatter / 10.0} if case.work is Work.FLATTENING else {SPREAD: spread}
    measures = {**main, LOAD: 1000.0 + 20.0 * scatter}
    sound = ("grains_lost_n", "momentum_share", "gained_share", "pace_max_m_per_s", "dangerous_builds_n")
    travel = {"travel_m": [0.0, 1.0], **{name: [0.0, value] for name, value in main.items()}}
    grains = rng.uniform(-0.5, 0.5, (2, 40)).astype(np.float32)
    soil = {
        "frame": np.repeat(np.arange(2, dtype=np.int32), 20),
        "x": grains[0],
        "y": grains[1],
        "z": np.full(40, 0.03, np.float32),
        "radius": np.full(40, 0.03, np.float32),
    }
    frames = {"time_s": [0.0, 1.0], "travel_m": [0.0, 1.0], "x": [-1.0, 0.0], "y": [0.0, 0.0], "yaw_rad": [0.3, 0.3]}
    store.run_folder(case).mkdir(parents=True)
    store.keep(
        Result(case.key(), case, "lammps 1", measures, dict.fromkeys(sound, 0.0), 10**6, 2.0, 2.1),
        {
            "travel": pa.table(travel),
            "along": pa.table({"until_s": [1.0], "load_n": [np.full(ALONG_N, 50.0)]}),
            "soil": pa.table(soil),
            "frames": pa.table(frames),
        },
    )


def test_orders_are_told_as_the_intervals_have_them(page: tuple[Path, str]) -> None:
    orders = re.search(r"by the measure that it decides by:</p><ul>(.*?)</ul>", page[1], re.DOTALL)
    assert orders
    assert "<li>reproduced: 2 of 3 (middle; quarter, middle)" in orders[1]
    assert "<li>the intervals do not tell: 1 of 3 (flattening)" in orders[1]
    assert "the study claims none" in page[1], "of heights that it calls similar"


def test_every_number_of_table_3_stands_beside_ours(page: tuple[Path, str]) -> None:
    text = re.sub(r"<svg.*?</svg>", "", page[1], flags=re.DOTALL)
    for value in ("2190.5", "2081.9", "1981.4", "1207.1", "1173.1", "1147.3", "679.1", "607.3", "511.1"):
        assert f"<td>{value}<td>" in text


def test_behaviour_and_errors_are_compared_with_intervals(page: tuple[Path, str]) -> None:
    again = re.search(r"The daemon's behaviour</h2>(.*?)</table>", page[1], re.DOTALL)
    assert again
    cell = r"<td>(.*?)(?=<)"
    row = re.search(r"<td>middle, 15°<td>spread extreme \[mm\]" + 4 * cell, again[1])
    assert row
    difference, (low, high) = float(row[3].split()[0]), map(float, row[4].split(" to "))
    assert low < difference < high < 0.0, "300 mm less, beyond chance"
    assert "half the step" in page[1]


def test_it_needs_nothing_beside_it(page: tuple[Path, str]) -> None:
    path, text = page
    named = re.findall(r"(?:src|href)=['\"]([^'\"]*)", text)
    assert named
    assert all(name.startswith(("data:", "#")) for name in named)
    assert "data:image/webp;base64," in text
    assert text.count("data:image/png;base64,") > 10
    table = pq.read_table(path.parent / report.RESULTS)
    assert table.num_rows == len(list(path.parent.glob("runs/*/manifest.json")))
    assert {"key", "blade.length_m", SPREAD, "grains_lost_n"} <= set(table.column_names)
