"""Seeds mistakes in a copy of the tree, one after the other, and says which tests notice each.

A mistake is made where the tests nearest to it run. One that they pass is a survivor: a test is missing. What they fail
on stands beside it. First all those tests run without any change: what fails by itself notices nothing.

Exit status: 0 all noticed, 1 a survivor, 2 the list does not fit the tree (a text that is not there, or more than once;
a test that fails without a change).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
TIMEOUT_S: Final = 600.0
"""The slowest of the tests takes some seconds; a change may make one wait for ever, which is noticed too."""
ONE_FAILED: Final = 1
"""pytest's exit status where tests ran and at least one failed."""
TOO_LONG: Final = 124
"""As timeout(1) says it."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One mistake: ``old`` stands exactly once in ``file``; ``why`` says what it would do to the machine."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    why: str


@dataclass(frozen=True, slots=True)
class Result:
    """``verdict``: killed, survived, or why there is none; ``by``: the first test that failed."""

    mutant: Mutant
    verdict: str
    by: str = ""
    seconds: float = 0.0


def misfit(mutant: Mutant, root: Path = ROOT) -> str:
    """Why the mutant cannot be made in this tree; empty where it can."""
    path = root / mutant.file
    if not path.is_file():
        return "its file is not there"
    found_n = path.read_text(encoding="utf-8").count(mutant.old)
    if found_n != 1:
        return f"its text stands {found_n} times in the file, not once"
    missing = [test for test in mutant.tests if not _has_test(root, test)]
    return f"there is no {missing[0]}" if missing else ""


def _has_test(root: Path, node: str) -> bool:
    file, _, name = node.partition("::")
    if not (root / file).is_file():
        return False
    function = name.rpartition("::")[2].partition("[")[0]
    own, inherited = root / file, root / Path(file).with_name("conformance.py")
    return not function or any(
        path.is_file() and f"def {function}(" in path.read_text(encoding="utf-8") for path in (own, inherited)
    )


def copy_tree(target: Path, root: Path = ROOT) -> None:
    """What git knows or would take, with links as links; a mutant never touches the tree that people work in."""
    command = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, capture_output=True, check=True).stdout.decode().split("\0")
    for name in filter(None, listed):
        source, to = root / name, target / name
        if not os.path.lexists(source):
            continue  # taken away, and git not told yet
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, to, follow_symlinks=False)


def run_tests(tree: Path, tests: Sequence[str], *, first_only: bool) -> tuple[int, list[str], str]:
    """pytest's exit status (:data:`TOO_LONG` where it was ended), the tests that failed, and the end of its text."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", *tests]
    if first_only:
        command.insert(4, "-x")
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return TOO_LONG, [], f"not done within {TIMEOUT_S:g} s"
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return done.returncode, failed, (done.stdout + done.stderr)[-2000:]


def imported_from(tree: Path) -> Path:
    """Where a process in the copy gets the product from: a mutant that nobody imports survives for nothing."""
    command = [sys.executable, "-P", "-c", "import graderd.api.server; print(graderd.api.server.__file__)"]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=True)
    return Path(done.stdout.strip()).resolve()


def try_mutant(tree: Path, mutant: Mutant) -> Result:
    """Make the mutant in the copy, run its tests, and put the copy back."""
    path, started_s = tree / mutant.file, time.monotonic()
    text = path.read_text(encoding="utf-8")
    changed = text.replace(mutant.old, mutant.new)
    compile(changed, mutant.file, "exec")  # one that is no Python is noticed by everything
    path.write_text(changed, encoding="utf-8")
    try:
        status, failed, said = run_tests(tree, mutant.tests, first_only=True)
    finally:
        path.write_text(text, encoding="utf-8")
    seconds = time.monotonic() - started_s
    if status == 0:
        return Result(mutant, "survived", "", seconds)
    if status == TOO_LONG:
        return Result(mutant, "killed", said, seconds)
    if status == ONE_FAILED and failed:
        return Result(mutant, "killed", failed[0].rpartition("::")[2], seconds)
    return Result(mutant, f"pytest ended with {status}: {said[-300:]}", "", seconds)


def run(mutants: Sequence[Mutant], tell: bool) -> list[Result]:
    """All of them, one after the other, in one copy."""
    results = [Result(mutant, f"does not fit: {why}") for mutant in mutants if (why := misfit(mutant))]
    fitting = [mutant for mutant in mutants if not misfit(mutant)]
    with tempfile.TemporaryDirectory(prefix="graderd-mutants-") as folder:
        tree = Path(folder).resolve()
        copy_tree(tree)
        if not imported_from(tree).is_relative_to(tree):
            raise SystemExit(f"the copy in {tree} is not what its tests import: {imported_from(tree)}")
        tests = sorted({test for mutant in fitting for test in mutant.tests})
        _, broken, said = run_tests(tree, tests, first_only=False) if tests else (0, [], "")
        # A deadline missed on a busy machine is no verdict: what failed once is run again, alone.
        again = broken and run_tests(tree, broken, first_only=False)
        still = again[1] if again else []
        if tell and still:
            print(said, file=sys.stderr)
        for mutant in fitting:
            own = [test for test in still if any(test.startswith(nearest) for nearest in mutant.tests)]
            result = Result(mutant, f"fails without a change: {own[0]}") if own else try_mutant(tree, mutant)
            results.append(result)
            if tell:
                print(f"{result.verdict:<10} {mutant.name:<24} {result.seconds:6.1f} s  {result.by}", flush=True)
    return sorted(results, key=lambda result: mutants.index(result.mutant))


def table(results: Sequence[Result]) -> str:
    """The results as the page has them."""
    lines = ["| mutant | file | what it would do | verdict | noticed by |", "|---|---|---|---|---|"]
    lines += [f"| {r.mutant.name} | `{r.mutant.file}` | {r.mutant.why} | {r.verdict} | `{r.by}` |" for r in results]
    return "\n".join(lines)


def command_line(prog: str, description: str, mutants: Sequence[Mutant]) -> int:
    """See the module's text."""
    parser = argparse.ArgumentParser(prog=prog, description=description)
    parser.add_argument("names", nargs="*", help="only these mutants")
    parser.add_argument("--fits", action="store_true", help="only say which of them no longer fit the tree")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--table", action="store_true", help="print the page's table at the end")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - {mutant.name for mutant in mutants}
    if unknown:
        parser.error(f"no such mutant: {', '.join(sorted(unknown))}")
    chosen = [mutant for mutant in mutants if not arguments.names or mutant.name in arguments.names]
    if arguments.fits:
        results = [Result(mutant, f"does not fit: {why}") for mutant in chosen if (why := misfit(mutant))]
    else:
        results = run(chosen, tell=not arguments.json)
    unfit = [result for result in results if result.verdict not in ("killed", "survived")]
    survived = [result for result in results if result.verdict == "survived"]
    if arguments.json:
        found = [{"name": r.mutant.name, "verdict": r.verdict, "by": r.by} for r in results]
        print(json.dumps({"mutants": found, "survived": len(survived), "unfit": len(unfit)}))
    else:
        if arguments.table:
            print(table(results))
        for result in unfit:
            print(f"{result.mutant.name}: {result.verdict}", file=sys.stderr)
        print(f"{len(results)} mutants: {len(survived)} survived, {len(unfit)} without a verdict")
    return 2 if unfit else 1 if survived else 0
