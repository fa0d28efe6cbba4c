"""Every function of the safety concept is taken out by at least one claim, and the tests are those the page names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from harness.claims import CLAIMS
from harness.seeded import Mutant, misfit

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/integrators/safety.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| ([FI]\d+) \|(.*)$", PAGE.split("## Functions, reaction times and proof")[1], re.MULTILINE))
BY_NAME = {claim.name: claim for claim in CLAIMS}


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_each_can_be_taken_out_and_its_tests_are_named(claim: Mutant) -> None:
    assert misfit(claim) == "", "give it the text that the file has now"
    text = (ROOT / claim.file).read_text(encoding="utf-8")
    compile(text.replace(claim.old, claim.new), claim.file, "exec")
    row = ROWS[claim.name.partition("-")[0]]
    for test in claim.tests:
        assert f"::{test.rpartition('::')[2]}`" in row, "the page does not name it"


def test_no_function_is_left_out() -> None:
    functions = {name for name in ROWS if name.startswith("F")}
    assert {claim.name.partition("-")[0] for claim in CLAIMS if claim.name.startswith("F")} == functions
    assert len(BY_NAME) == len(CLAIMS)


@pytest.mark.parametrize("number", range(1, 18))
def test_what_happened_once_is_noticed_by_tests_that_were_seen_to_notice(number: int) -> None:
    told = re.findall(r"`(tests/[^`]+)` \(([FI]\d+-[a-z-]+)\)", ROWS[f"I{number}"])
    assert told
    for test, name in told:
        assert test in BY_NAME[name].tests
    own = {claim.name for claim in CLAIMS if claim.name.startswith(f"I{number}-")}
    assert own <= {name for _, name in told}


def test_the_page_of_results_tells_of_every_one() -> None:
    page = (ROOT / "docs/developers/mutation.md").read_text(encoding="utf-8")
    for claim in CLAIMS:
        assert f"| {claim.name} | `{claim.file}` | {claim.why} | killed |" in page, "python -m harness.claims --table"
