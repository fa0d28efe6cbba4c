"""The safety concept's numbers are the settings' defaults, and the tests it names exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest

from graderd.config import Config
from graderd.hal.settings import Ph54Settings

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "integrators" / "safety.md").read_text("utf-8")
SETTINGS = re.findall(r"^\| `([a-z_0-9]+\.[a-z_0-9]+)` \| ([0-9.]+) \|", PAGE, re.MULTILINE)
TESTS = sorted(set(re.findall(r"`(tests/[a-z0-9_/]+\.py)::(test_[a-z0-9_]+)`", PAGE)))


def functions_of(path: Path) -> set[str]:
    tree = ast.parse(path.read_text("utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


@pytest.mark.parametrize(("key", "told"), SETTINGS)
def test_the_times_are_the_defaults(key: str, told: str) -> None:
    value: Any = Config()
    for name in key.split("."):
        value = getattr(value, name)
    assert float(value) == float(told)


@pytest.mark.parametrize(("file", "name"), TESTS)
def test_the_tests_named_exist(file: str, name: str) -> None:
    assert name in functions_of(ROOT / file)


def test_every_function_is_named_by_a_hazard_and_has_a_proof() -> None:
    hazards, functions = PAGE.split("## Functions, reaction times and proof")
    rows = dict(re.findall(r"^\| (F\d+) \|(.*)$", functions, re.MULTILINE))
    assert set(rows) == set(re.findall(r"\bF\d+\b", hazards))
    assert all("`tests/" in row for row in rows.values())
    assert len(SETTINGS) >= 15
    assert len(TESTS) >= 30


def test_braking_is_what_the_settings_give() -> None:
    config = Config()
    assert isinstance(config.rotation, Ph54Settings)
    speed, braking = config.rotation.speed_deg_per_s, config.rotation.profile_acceleration_deg_per_s2
    assert f"{speed / braking:.2f} s and {speed**2 / braking / 2:.1f}° from" in PAGE
