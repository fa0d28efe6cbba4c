"""A mistake in the configuration names its place, its cause and what to write instead."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.config import Config, ConfigError, load, parse
from graderd.hal.settings import ElectrakSettings


def problems(text: str, path: Path) -> list[str]:
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load(path)
    return caught.value.problems


def test_no_file_is_the_defaults() -> None:
    assert parse({}) == Config()


def test_an_unknown_key_names_line_and_nearest_right_one(tmp_path: Path) -> None:
    path = tmp_path / "graderd.toml"
    (problem,) = problems("# site 7\n[rotation]\nsped_deg_per_s = 20\n", path)
    assert problem == f"{path}:3: rotation.sped_deg_per_s: unknown key. Did you mean rotation.speed_deg_per_s?"
    (problem,) = problems("[rotaton]\nport = 'x'\n", path)
    assert "Did you mean rotation?" in problem
    (problem,) = problems("[perception.depth]\ncel_m = 0.01\n", path)
    assert "Did you mean perception.depth.cell_m?" in problem


def test_all_mistakes_at_once(tmp_path: Path) -> None:
    found = problems("[rotation]\nbaud_n = -1\nservo_id_n = 300\n[can]\nbitrate_n = 'fast'\n", tmp_path / "g.toml")
    assert len(found) == 3
    assert all("g.toml:" in problem for problem in found)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[rotation]\nmin_deg = 10\nmax_deg = -10\n", "min_deg (10.0) must be below max_deg (-10.0)"),
        ("[rule]\nleft_deg = 80\n", "rule.left_deg (80) lies outside rotation.min_deg"),
        ("[camera]\nrate_hz = 1.9\n", "until their product is 3 or more"),
        ("[lift_left]\naddress_n = 20\n", "4 different addresses"),
        ("[rule]\nleft_deg = nan\n", "finite"),
        ("[control]\nshutdown_order = ['rotation']\n", "shutdown_order"),
        ("version = 3\n", "version"),
    ],
)
def test_values_that_make_no_sense_together(tmp_path: Path, text: str, said: str) -> None:
    assert said in "\n".join(problems(text, tmp_path / "g.toml"))


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "absent.toml")
    path = tmp_path / "g.toml"
    path.write_bytes(b"# one\nport = '\xff'\n")
    with pytest.raises(ConfigError, match=r"g\.toml:2: not UTF-8 text at byte 14"):
        load(path)
    assert "not valid TOML" in problems("[rotation\n", path)[0]


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        ("[can]\n".encode("utf-8-sig"), "g.toml:1: begins with a byte order mark, not TOML. Save it as UTF-8 without"),
        ("[can]\n".encode("utf-16"), "g.toml:1: begins with UTF-16 text"),
        (b"[can]\nbitrate_n = 250000\r[tilt]\n", "g.toml:2: a carriage return without a line feed"),
        (b"[can]\n\x00\n", "not valid TOML"),
    ],
)
def test_what_editors_do_to_a_file(tmp_path: Path, raw: bytes, said: str) -> None:
    path = tmp_path / "g.toml"
    path.write_bytes(raw)
    with pytest.raises(ConfigError) as caught:
        load(path)
    (problem,) = caught.value.problems
    assert said in problem


def test_line_ends_of_windows_are_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_bytes(b"# site 7\r\n[tilt]\r\nmax_mm = 90.0\r\n")
    assert load(path).tilt.max_mm == 90.0
    assert "g.toml:3: tilt.max_m" in problems("[tilt]\n# \u2028 \x85\nmax_m = 90.0\n", path)[0]


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=12), inner, max_size=3),
    max_leaves=8,
)
sections = st.dictionaries(st.sampled_from([*Config.model_fields, "x"]), values, max_size=4)


@given(sections)
def test_nonsense_never_raises_anything_else(data: dict[str, object]) -> None:
    with suppress(ConfigError):
        parse(data)


def test_a_section_given_in_part_keeps_its_own_defaults_for_the_rest() -> None:
    config = parse({"lift_right": {"speed_percent": 60}, "tilt": {"speed_percent": 60}})
    sections = [config.lift_left, config.lift_right, config.tilt]
    assert [section.model_dump()["address_n"] for section in sections] == [19, 20, 27]
    assert isinstance(config.tilt, ElectrakSettings)
    assert config.tilt.profile == "electrak_md_a050"
    assert config.tilt.max_mm == 97.0
