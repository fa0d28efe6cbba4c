"""The seeded mistakes fit the tree as it is, and the script tells what is noticed from what is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.mutants_wide import API, DRIVERS, MUTANTS, RUNTIME
from harness.seeded import Mutant, copy_tree, misfit, table, try_mutant

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_each_can_be_made_and_its_tests_exist(mutant: Mutant) -> None:
    assert misfit(mutant) == "", "give it the text that the file has now, or another mistake in its place"
    text = (ROOT / mutant.file).read_text(encoding="utf-8")
    compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
    assert mutant.new != mutant.old


def test_there_are_thirty_over_the_three_rooms() -> None:
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) == 30
    assert {mutant.file.rpartition("/")[0].split("/")[0] for mutant in DRIVERS} == {"drivers"}
    assert all(mutant.file.startswith("graderd/runtime/") for mutant in RUNTIME)
    assert all(mutant.file.startswith(("graderd/api/", "graderd/tokens.py")) for mutant in API)
    assert [len(part) for part in (RUNTIME, DRIVERS, API)] == [10, 12, 8]


def test_the_page_tells_of_every_one() -> None:
    page = (ROOT / "docs/developers/mutation.md").read_text(encoding="utf-8")
    for mutant in MUTANTS:
        assert f"| {mutant.name} | `{mutant.file}` | {mutant.why} |" in page, "python -m harness.mutants_wide --table"


def seeded(new: str, old: str = "return a + b") -> Mutant:
    return Mutant("m", "sums.py", old, new, ("test_sums.py::test_sum",), "sums are wrong")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A product of one function with one test."""
    (tmp_path / "sums.py").write_text("def total(a, b):\n    return a + b\n")
    (tmp_path / "test_sums.py").write_text(
        "from sums import total\n\ndef test_sum():\n    assert total(2, 2) == 4\n    assert total(0, 0) == 0\n"
    )
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    return tmp_path


@pytest.mark.live
@pytest.mark.parametrize(
    ("new", "verdict", "by"), [("return a - b", "killed", "test_sum"), ("return a * b", "survived", "")]
)
def test_a_mistake_that_no_test_notices_is_a_survivor_and_the_tree_is_put_back(
    tree: Path, new: str, verdict: str, by: str
) -> None:
    before = (tree / "sums.py").read_bytes()
    result = try_mutant(tree, seeded(new))
    assert (result.verdict, result.by) == (verdict, by)
    assert (tree / "sums.py").read_bytes() == before
    assert f"| m | `sums.py` | sums are wrong | {verdict} | " in table([result])


@pytest.mark.live
def test_tests_that_do_not_run_are_no_verdict(tree: Path) -> None:
    (tree / "test_sums.py").write_text("def test_another(): pass\n")
    assert "pytest ended with 4" in try_mutant(tree, seeded("return 0")).verdict


def test_a_text_or_test_that_is_not_there_is_told(tree: Path) -> None:
    assert misfit(seeded(""), tree) == ""
    assert misfit(seeded("", old="return b"), tree) == "its text stands 0 times in the file, not once"
    assert misfit(seeded("", old="a"), tree).startswith("its text stands")
    (tree / "test_sums.py").write_text("")
    assert misfit(seeded(""), tree) == "there is no test_sums.py::test_sum"
    (tree / "sums.py").unlink()
    assert misfit(seeded(""), tree) == "its file is not there"


@pytest.mark.live
def test_the_copy_keeps_links_and_leaves_what_git_ignores(tmp_path: Path) -> None:
    copy_tree(tmp_path)
    assert (tmp_path / "graderd/drivers").is_symlink()
    assert (tmp_path / "graderd/drivers/dynamixel/bus.py").is_file()
    assert not (tmp_path / ".venv").exists()
