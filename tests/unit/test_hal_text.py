"""Text from outside cannot end a line, nor command a terminal; what prints is left as it is."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.hal.text import printable, terminal_safe_json


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("30° left, 5 µm – \"Müller\" 'x' \\ 日本", "30° left, 5 µm – \"Müller\" 'x' \\ 日本"),
        ("a\nb\rc\td", "a\\nb\\rc\\td"),
        ("\x1b[2J\x07\x7f\x9b", "\\x1b[2J\\x07\\x7f\\x9b"),
        ("\u2028\u2029\x85\x0b\x0c", "\\u2028\\u2029\\x85\\x0b\\x0c"),
        ("user\u202egnp.exe\u200b\ufeff", "user\\u202egnp.exe\\u200b\\ufeff"),
        ("\ud800\U000e0001", "\\ud800\\U000e0001"),
    ],
)
def test_what_does_not_print_is_shown_by_its_number(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text())
def test_it_is_one_line_that_prints_and_doing_it_twice_changes_nothing(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert len(shown.splitlines()) <= 1
    assert printable(shown) == shown


@given(st.text())
def test_json_for_a_terminal_means_the_same_and_carries_nothing_raw(text: str) -> None:
    shown = terminal_safe_json(json.dumps({"reason": text}, ensure_ascii=False))
    assert json.loads(shown) == {"reason": text}
    assert not any(
        0x7F <= ord(c) < 0xA0 or ord(c) < 0x20 or 0xD800 <= ord(c) < 0xE000 or c in "\u202e\u2028" for c in shown
    )
