"""Damaged texts: no parser raises what it does not document, nor takes memory without end."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from harness.fuzz_parsers import MOST_BYTES, fuzz, targets

NAMES = (
    "config", "migration", "manifest", "camera file", "profile name", "child", "state file", "client command",
    "rig command",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_damaged_texts(tmp_path: Path, name: str) -> None:
    found = fuzz(name, targets(tmp_path)[name], 100, random.Random(7))
    assert found["first_escaped"] == []
    assert float(str(found["most_mb"])) * 1e6 < MOST_BYTES


def test_every_target_is_fuzzed(tmp_path: Path) -> None:
    assert set(targets(tmp_path)) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_damaged_was_sound(tmp_path: Path, name: str) -> None:
    target = targets(tmp_path)[name]
    for text in target.corpus:
        target.parse(text)
