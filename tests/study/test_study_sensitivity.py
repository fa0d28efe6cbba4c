"""Design, surrogate and page of the sensitivity study, on spreads whose laws are known."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from graderd.studies.blade_rotation import sensitivity
from graderd.studies.blade_rotation.case import Sense
from graderd.studies.blade_rotation.engine import StudyError
from graderd.studies.blade_rotation.sensitivity import ANGLES_DEG, CLAIMS, DEFINITIONS, DISTANCES_M, F64, FACTORS, Data
from graderd.studies.blade_rotation.store import Store

ANGLES = np.array(ANGLES_DEG)


def spreads(of: F64, noise_mm: float = 0.0) -> F64:
    """The pile's place decides: before the trailing end 30 degrees is best by far, before the leading end 15."""
    side = np.clip(of[:, :1] / 0.25, -1.0, 1.0)
    best = np.where(side > 0.0, 30.0, 15.0)
    found = 2000.0 - 600.0 * np.abs(side) * ((ANGLES - best) / 15.0) ** 2 + 3000.0 * of[:, 1:2]
    return np.asarray(found + np.random.default_rng(4).normal(0.0, noise_mm, found.shape))


@pytest.fixture(scope="module")
def data() -> Data:
    of = sensitivity.points(32)
    return Data(of, {key: spreads(of, 20.0) for key in product(DEFINITIONS[:2], DISTANCES_M[:1])})


def test_a_longer_design_begins_with_the_shorter_one() -> None:
    assert sensitivity.points(20)[:7] == pytest.approx(sensitivity.points(7))
    of = sensitivity.points(64)
    assert ((of >= sensitivity.LOW) & (of <= sensitivity.HIGH)).all()
    assert of.mean(axis=0) == pytest.approx((sensitivity.LOW + sensitivity.HIGH) / 2.0, rel=0.05, abs=0.02)


def test_the_three_runs_of_a_point_share_their_pile() -> None:
    runs = sensitivity.cases(4)
    assert [run.angle_deg for run in runs] == [*ANGLES_DEG] * 4
    assert len({run.pile_key() for run in runs}) == 4
    assert len({run.key() for run in runs}) == 12
    for run, point in zip(runs[::3], sensitivity.points(4), strict=True):
        assert (run.sense is Sense.TRAILS) is bool(point[0] >= 0.0)
        assert (run.blade.radius_m is None) is bool(point[3] <= 0.2)


def test_the_surrogate_finds_the_law_and_knows_its_error(data: Data) -> None:
    model = sensitivity.fit(data.points, data.spread_mm[DEFINITIONS[0], 2.0])
    assert model.explained > 0.9
    unseen = sensitivity.points(64)[32:]
    off_mm = float(np.sqrt(np.mean((model.spreads(unseen) - spreads(unseen)) ** 2)))
    assert off_mm == pytest.approx(model.error_mm, rel=0.6)
    assert model.covered > 0.85
    trailing, leading = (model.widest(sensitivity.usual(place, 0.04)) for place in (0.2, -0.2))
    assert trailing.argmax() == 1
    assert leading.argmax() == 0
    assert trailing[1] > 0.95


def test_the_surrogate_is_not_sure_of_chance() -> None:
    of = sensitivity.points(24)
    values = np.random.default_rng(2).normal(2000.0, 100.0, (24, 3))
    model = sensitivity.fit(of, values)
    assert model.explained < 0.5
    assert "**" not in sensitivity.page(Data(of, {(DEFINITIONS[0], 2.0): values})).split("| soil |")[1].split("##")[0]


def test_what_decides_is_found(data: Data) -> None:
    model = sensitivity.fit(data.points, data.spread_mm[DEFINITIONS[0], 2.0])
    shares = sensitivity.decided_by(model, 1, 0)
    assert shares["place_share"] > 0.8
    assert all(share < 0.2 for name, share in shares.items() if name != "place_share")


def test_the_page_says_where_the_rule_holds_and_where_not(data: Data) -> None:
    text = sensitivity.page(data)
    trails, leads, _ = (next(line for line in text.split("\n") if f"**Soil {claim.name}:" in line) for claim in CLAIMS)
    assert "the rule says 30°.** Of 4 combinations" in trails
    assert "widest in 4 with a chance" in trails
    assert "widest in 0 with a chance" in leads
    assert "15° in 4" in leads
    assert all(each.name in text for each in FACTORS)
    wins = sensitivity.counted(data, CLAIMS[0], (DEFINITIONS[0], 2.0))
    assert wins[1] == sum(wins) > 0


def test_points_without_all_their_runs_are_not_counted(tmp_path: Path) -> None:
    assert len(sensitivity.collect(Store(tmp_path), 8).points) == 0
    with pytest.raises(StudyError, match="0 piles have been run"):
        sensitivity.write(Store(tmp_path), 8)
