"""The study's numbers: shipped as printed, computed again, and judged rightly."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import scipy

from graderd.evaluation.statistics import differences_of
from graderd.evaluation.study import (
    ANGLES_DEG,
    CASES,
    Finding,
    Study,
    Verdict,
    data,
    evaluated,
    findings,
    page,
    table_4_path,
    wider_percent,
)

PAPER = Path(__file__).parents[2] / "docs" / "operators" / "study.md"


@pytest.fixture(scope="module")
def study() -> Study:
    return evaluated()


def about(study: Study, where: str, says: str) -> Finding:
    (found,) = (each for each in findings(study) if where in each.where and says in each.says)
    return found


def test_the_page_is_what_the_data_give(study: Study) -> None:
    assert page(study) in PAPER.read_text("utf-8"), "write it again: python -m graderd.cli.docs"


def test_sixteen_percent_is_against_15_degrees_and_not_45(study: Study) -> None:
    assert wider_percent(525.3, 463.9) == pytest.approx(13.2, abs=0.05)
    assert wider_percent(525.3, 451.8) == pytest.approx(16.3, abs=0.05)
    found = about(study, "4.1, soil on the left", "16 %")
    assert found.verdict is Verdict.DOES_NOT
    assert "13.2 % against 45°" in found.gives
    assert "15° (451.8 mm): 16.3 %" in found.gives
    assert about(study, "5", "approximately 16 %").verdict is Verdict.DOES_NOT
    assert about(study, "4.1, soil in the middle", "10 %").verdict is Verdict.ADDS_UP


def test_every_average_of_table_4_is_the_mean_of_its_trials(study: Study) -> None:
    judged = [each for each in findings(study) if "average" in each.says and each.where.startswith("Table 4")]
    assert len(judged) == 9
    assert {each.verdict for each in judged} == {Verdict.ADDS_UP}
    assert [row.trials_n for row in study.rows] == [5] * 9


def test_what_else_does_not_add_up(study: Study) -> None:
    wrong = {(each.where, each.says[:24]) for each in findings(study) if each.verdict is Verdict.DOES_NOT}
    assert wrong == {
        ("2.4, 3.3", "both tasks' environment "),
        ("4.1, soil on the left", "16 % wider than at the b"),
        ("5", "soil on one side: approx"),
        ("5", "flattening showed a simi"),
        ("4.1, flattening", "consistent with the simu"),
    }
    assert "13 of 30 values are less" in about(study, "3.3, Table 4", "degree of spread").gives


def test_a_verdict_follows_its_numbers(study: Study) -> None:
    """Were the numbers others, so would be the verdicts: none is written down."""
    given = data()
    given["table_4_averages"]["flattening"][0] = -3.7
    given["table_4_averages"]["left"][2] = 452.9
    given["table_3"]["left"]["spread_mm"][2] = 1832.0
    other = replace(study, given=given)
    assert about(other, "Table 4, Flattening", "15°").verdict is Verdict.DOES_NOT
    assert about(other, "4.1, soil on the left", "16 %").verdict is Verdict.ADDS_UP
    assert about(study, "2.5, soil on the left", "about 15 %").verdict is Verdict.IN_PART
    assert about(other, "2.5, soil on the left", "about 15 %").verdict is Verdict.ADDS_UP


def test_intervals_and_tests_are_those_of_the_textbook(study: Study) -> None:
    left = study.row("left", 30)
    whole = scipy.stats.ttest_1samp(left.values, 0.0).confidence_interval(0.95)
    assert (left.low, left.high) == pytest.approx((whole.low, whole.high))
    (difference,) = (each for each in study.differences if each.case == CASES["left"])
    pairs = {(pair.angle_deg, pair.other_deg): pair for pair in difference.pairs}
    assert list(pairs) == [(15.0, 30.0), (15.0, 45.0), (30.0, 45.0)]
    welch = scipy.stats.ttest_ind(study.row("left", 30).values, study.row("left", 45).values, equal_var=False)
    assert pairs[30.0, 45.0].difference == pytest.approx(61.38)
    assert pairs[30.0, 45.0].p > welch.pvalue  # adjusted for three pairs
    assert difference.p < 1e-6
    flat = next(each for each in study.differences if each.case == CASES["flattening"])
    assert [pair.p < 0.05 for pair in flat.pairs] == [True, False, True]


@pytest.mark.parametrize("angles_n", [2, 3])
def test_pairs_are_those_of_games_and_howell(study: Study, angles_n: int) -> None:
    """scipy's own; its intervals take seconds to ask for, but a sample shifted by a bound has p of 5 %."""
    rows = [row for row in study.rows if row.case == CASES["flattening"]][:angles_n]
    (tested,) = differences_of(rows, 0.95)
    samples = [np.array(row.values) for row in rows]
    for pair, (a, b) in zip(tested.pairs, combinations(range(angles_n), 2), strict=True):
        for shift, p in ((0.0, pair.p), (pair.low, 0.05), (pair.high, 0.05)):
            shifted = [*samples[:a], samples[a] - shift, *samples[a + 1 :]]
            assert scipy.stats.tukey_hsd(*shifted, equal_var=False).pvalue[a, b] == pytest.approx(p, rel=1e-6)


def test_table_4_is_an_experiment_file_like_any_other() -> None:
    assert table_4_path().is_file()
    assert len(ANGLES_DEG) * 3 * 5 == table_4_path().read_text("utf-8").count("angle_deg")
