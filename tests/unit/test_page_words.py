"""The daemon's words on the page in Korean: every sentence that it can say has one there, and none is left over.

How the page finds them is tested in the browser (``tests/browser/test_page_words.py``).
"""

from __future__ import annotations

import ast
import json
import re
from importlib.resources import files
from pathlib import Path

import pytest

from graderd.core.axes import AXES, JOG_AXES
from graderd.core.commands import Jog, Preset
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Clear, Reaction
from graderd.core.machine import Mode
from graderd.core.readiness import AUTOMATIC
from graderd.core.soil import Zone
from graderd.hal.device import Lifecycle

SOURCE = Path(str(files("graderd")))
PATH = Path(str(files("graderd.web"))) / "korean.json"
WORDS: dict[str, str] = json.loads(PATH.read_text("utf-8"))
TELLERS = (
    *(f"core/{name}.py" for name in ("commands", "gate", "lift_pair", "machine", "motion", "plausibility")),
    *(f"core/{name}.py" for name in ("readiness", "rule", "soil", "status", "tick", "faults/monitor")),
    *(f"perception/{name}.py" for name in ("classifier", "decide", "depth", "health")),
    *(f"runtime/{name}.py" for name in ("control", "health", "perception_supervisor", "stop_input")),
)
"""All that they word may be shown."""
REFUSERS = ("api/http_routes.py", "api/limiter.py", "api/session.py", "api/tcp_guard.py", "perception/settings.py")
"""Of these only what is given to one of these calls, or returned."""
REFUSALS = ("Problem", "ProblemError", "ServiceError")
UNSHOWN = ("Field", "ValueError", "TypeError", "create_task", "_answered")
"""Descriptions, mistakes of who writes programs and the names of tasks."""
UNITS = {"{} mm", "{} at {}"}
"""A number with its unit, a client with its place: there is no sentence in them."""
NAMES = (
    {"stop", "camera", AUTOMATIC, *AXES, *JOG_AXES}
    | {str(value) for kind in (Zone, Mode, Lifecycle, Clear) for value in kind}
    | {reaction.name.lower() for reaction in Reaction}
    | {command.model_fields["command"].default for command in (Jog, Preset)}
    | {"armed", "arming", "reset", "renewed", "released", "limit", "colour", "depth", "% of each third"}
    | {"stop command", "stop request", "STOP on the page"}
)
"""Words that stand by themselves or are put into a sentence: what a requirement is called, what a mode, what ends a
fault, what came of a command, and why a machine was stopped where nobody says why."""


class Worded(ast.NodeVisitor):
    """The sentences of a module: texts of more than one word, ``{}`` for what is put in."""

    def __init__(self) -> None:
        self.found: set[str] = set()

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # else it is documentation
            self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        of = node.func.value.id if isinstance(getattr(node.func, "value", None), ast.Name) else ""  # type: ignore[attr-defined]
        if called not in UNSHOWN and of != "log":
            self.generic_visit(node)

    def visit_Dict(self, node: ast.Dict) -> None:
        for key, value in zip(node.keys, node.values, strict=True):
            if not isinstance(key, ast.Constant) or key.value != "description":
                self.visit(value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        self._take("".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values))
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                self.visit(part.value)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str):
            self._take(node.value)

    def _take(self, text: str) -> None:
        if re.search(r"[a-z]{2}", text) and " " in text and not text.startswith("# "):
            # What is added to a sentence, or begins one.
            text = re.sub(r"^(?=[ .;,])", "{}", text)
            text = re.sub(r"(?<= )$", "{}", text)
            self.found.add(re.sub(r"(\{\})+", "{}", text))


def worded() -> set[str]:
    everything, refusals = Worded(), Worded()
    for name in TELLERS:
        everything.visit(ast.parse((SOURCE / name).read_text("utf-8")))
    for name in REFUSERS:
        for node in ast.walk(ast.parse((SOURCE / name).read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in REFUSALS:
                refusals.generic_visit(node)
            elif isinstance(node, ast.Return) and isinstance(node.value, ast.JoinedStr | ast.IfExp):
                refusals.visit(node.value)
    rows = {text for row in CATALOGUE.values() for text in (row.reads, row.remedy)}
    return (everything.found | refusals.found | rows) - UNITS


def test_every_sentence_has_a_korean_one_and_none_is_left_over() -> None:
    said = worded() | NAMES
    assert len(said) > 350
    assert said - WORDS.keys() == set(), "not in web/korean.json"
    assert WORDS.keys() - said == set(), "nobody says it any more"


@pytest.mark.parametrize("english", WORDS)
def test_it_is_korean_and_puts_in_all_that_is_put_in(english: str) -> None:
    korean = WORDS[english]
    assert re.search("[가-힣]", korean) or not re.search("[a-z]{2}", korean)
    assert sorted(set(re.findall(r"\{(\d*)\}", korean))) == [str(n) for n in range(english.count("{}"))]
    assert not re.search(r"\{(?!\d\})|(?<!\d)\}", korean)
    # 'graderd auto' is the page's button "automatic", whose name stands there in Korean.
    typed = set(re.findall(r"(?<=')graderd [^']*(?=')|\w+_\w+", english)) - {"graderd auto", *AXES}
    assert {name for name in typed if name not in korean} == set(), "what is typed or set is named as it is"


def test_no_sentence_is_there_twice() -> None:
    pairs = json.loads(PATH.read_text("utf-8"), object_pairs_hook=list)
    assert len(pairs) == len(dict(pairs))
