"""The page on the house says where to look: what it names is there, and the walks stay short enough to be walked."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
PAGE = (PROJECT / "docs" / "developers" / "architecture.md").read_text(encoding="utf-8")
WALKS = {
    title: re.findall(r"`([\w/]+\.py)`", text)
    for title, text in re.findall(r"^\*\*([^*]+)\*\* — (.+?)(?=\n\n)", PAGE, re.MULTILINE | re.DOTALL)
}
LONGEST_N = {
    "A frame becomes goal bytes": 20,
    "A jog reaches the CAN bus": 22,
    "A fault becomes text": 11,
    "A key of the configuration comes to use": 11,
    "A stop reaches the wires": 13,
}


@pytest.mark.parametrize("title", LONGEST_N)
def test_a_walk_leads_over_files_that_are_there_and_is_short(title: str) -> None:
    files = WALKS[title]
    assert len(files) == len(set(files)) <= LONGEST_N[title]
    assert [name for name in files if not (PROJECT / name).is_file()] == []


def test_what_a_walk_names_is_in_its_file() -> None:
    """A name behind a file, in brackets, is what to look for there."""
    named = [
        (file, name)
        for file, text in re.findall(r"`([\w/]+\.py)`\s+\(([^)]*)\)", PAGE)
        for name in re.findall(r"`(\w+)`", text)
    ]
    assert len(named) > 3
    for file, name in named:
        assert re.search(rf"(def|class|import) {name}\b|\b{name}\(", (PROJECT / file).read_text(encoding="utf-8")), name


def test_no_walk_without_a_bound() -> None:
    assert set(WALKS) == set(LONGEST_N)


def test_rooms_of_the_page_are_folders() -> None:
    listing = PAGE.partition("```")[2].partition("```")[0]
    for room in re.findall(r"^(\w+)/", listing, re.MULTILINE):
        assert (PROJECT / room).is_dir(), room
    for room in re.findall(r"^  (\w+)/", listing, re.MULTILINE):
        assert (PROJECT / "graderd" / room).is_dir() or (PROJECT / "drivers" / room).is_dir(), room


ROOMS = {
    "core": {"graderd.core", "graderd.hal", "numpy", "pydantic"},
    "hal": {"graderd.hal", "numpy", "pydantic"},
}
"""What the rooms that compute may import beside the standard library; a contract of import-linter can only forbid."""
NOT_PURE = {"asyncio", "datetime", "os", "random", "secrets", "socket", "subprocess", "threading", "time"}
CLOCKS = {("hal", "time")}
"""``hal/clock.py`` is the one clock."""


def imported(path: Path) -> set[str]:
    """The modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def within(name: str, rooms: set[str]) -> bool:
    return any(name == room or name.startswith(f"{room}.") for room in rooms)


@pytest.mark.parametrize("room", ROOMS)
def test_core_and_hal_import_what_computes_and_nothing_else(room: str) -> None:
    pure = sys.stdlib_module_names - NOT_PURE
    wrong = {
        (path.name, name)
        for path in (PROJECT / "graderd" / room).rglob("*.py")
        for name in imported(path)
        if name.partition(".")[0] not in pure and not within(name, ROOMS[room])
    }
    assert {(room, name) for _, name in wrong} <= CLOCKS
    assert {name for name, _ in wrong} <= {"clock.py"}


def test_drivers_import_of_graderd_the_contracts_and_the_facts_of_devices() -> None:
    theirs = {"graderd.hal", "graderd.drivers", "graderd.firmware_profiles"}
    wrong = {
        (path.name, name)
        for path in (PROJECT / "drivers").rglob("*.py")
        for name in imported(path)
        if within(name, {"graderd"}) and not within(name, theirs)
    }
    assert wrong == set()
