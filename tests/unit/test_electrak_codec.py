"""Control and feedback messages: bytes of a real unit, cantools as an oracle, profiles against their schema."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

import cantools.database
import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd import firmware_profiles
from graderd.drivers.electrak.codec import Control, ElectrakCodec, Feedback, load_database
from graderd.drivers.electrak.profile import load_profile
from graderd.hal.errors import WrongDeviceError

PROFILES = [name for name in firmware_profiles.names() if name.startswith("electrak_")]
HD, MD = ElectrakCodec("electrak_hd"), ElectrakCodec("electrak_md")

# First and the four feedback vectors: bytes of a real Electrak HD (capture github.com/collinbrake/electrakHDCAN);
# the other control vectors: computed by hand from the manual's bit positions.
CONTROL_VECTORS = [
    ("DC05191500000000", Control(150.0, 10.0, 50, motion_enable=True)),
    ("E8C3081600000000", Control(100.0, 3.5, 60, motion_enable=True)),
    ("B80B2D1A00000000", Control(300.0, 18.0, 100, motion_enable=True)),
    ("00800C0200000000", Control(0.0, 5.0, 20, motion_enable=False)),
]
FEEDBACK_VECTORS = [
    ("86050000C0FFFFFF", Feedback(141.4, 0.0, 0, moving=False, flags=frozenset())),
    ("88858002C1FFFFFF", Feedback(141.6, 0.2, 25, moving=True, flags=frozenset())),
    ("A9450505C1FFFFFF", Feedback(144.9, 2.1, 50, moving=True, flags=frozenset())),
    ("1F870705C9FFFFFF", Feedback(182.3, 3.0, 50, moving=True, flags=frozenset({"parameter"}))),
]


@pytest.mark.parametrize(("data", "control"), CONTROL_VECTORS)
def test_control_vectors_both_ways(data: str, control: Control) -> None:
    for codec in (HD, MD):
        assert codec.encode_control(control).hex().upper() == data
        assert codec.decode_control(bytes.fromhex(data)) == control


@pytest.mark.parametrize(("data", "feedback"), FEEDBACK_VECTORS)
def test_feedback_vectors_both_ways(data: str, feedback: Feedback) -> None:
    for codec in (HD, MD):
        assert codec.decode_feedback(bytes.fromhex(data)) == feedback
        assert codec.encode_feedback(feedback).hex().upper() == data


def test_control_with_the_unused_bits_all_one_reads_the_same() -> None:
    assert HD.decode_control(bytes.fromhex("B80B2DFAFFFFFFFF")) == Control(300.0, 18.0, 100, motion_enable=True)


@pytest.mark.parametrize(
    ("byte_5", "flag"),
    [(0xC2, "overload"), (0xC4, "backdrive"), (0xC8, "parameter"), (0xD0, "saturation"), (0xE0, "fatal")],
)
def test_each_flag_has_its_bit_whatever_the_factory_bits_are(byte_5: int, flag: str) -> None:
    for factory in (0xC0, 0x00):
        data = bytes((0, 0, 0, 0, byte_5 & 0x3F | factory, 0xFF, 0xFF, 0xFF))
        assert HD.decode_feedback(data).flags == {flag}


@pytest.mark.parametrize(
    ("byte_4", "flag"),
    [(0x10, "voltage_low"), (0x20, "voltage_high"), (0x40, "temperature_low"), (0x80, "temperature_high")],
)
def test_supply_and_temperature_have_two_bits_each(byte_4: int, flag: str) -> None:
    assert HD.decode_feedback(bytes((0, 0, 0, byte_4, 0, 0, 0, 0))).flags == {flag}


@given(st.binary(min_size=8, max_size=8))
def test_decoding_agrees_with_cantools_on_every_word(data: bytes) -> None:
    for layout, codec in (("electrak_hd", HD), ("electrak_md", MD)):
        oracle: Any = load_database(layout).decode_message("AFM", data, decode_choices=False)
        if oracle["position_mm"] > 1000:
            with pytest.raises(ValueError, match="beyond 1000 mm"):
                codec.decode_feedback(data)
            continue
        ours = codec.decode_feedback(data)
        assert ours.position_mm == pytest.approx(oracle["position_mm"])
        assert ours.current_a == pytest.approx(oracle["current_a"])
        assert ours.duty_percent == oracle["speed_percent"]
        assert ours.moving == bool(oracle["moving"])
        for flag in ("overload", "backdrive", "parameter", "saturation", "fatal"):
            assert (flag in ours.flags) == bool(oracle[flag])
        assert ("voltage_low" in ours.flags) == (oracle["voltage_error"] == 1)
        assert ("temperature_high" in ours.flags) == (oracle["temperature_error"] == 2)


@given(st.integers(0, 10000), st.integers(0, 250), st.integers(0, 20), st.booleans())
def test_encoding_agrees_with_cantools(position: int, limit: int, speed: int, enable: bool) -> None:
    values = {
        "target_position_mm": position / 10,
        "current_limit_a": limit / 10,
        "speed_percent": speed * 5,
        "motion_enable": int(enable),
        "factory_use": 0,
    }
    oracle = load_database("electrak_hd").encode_message("ACM", values)
    control = Control(position / 10, limit / 10, speed * 5, motion_enable=enable)
    assert HD.encode_control(control) == oracle
    assert HD.decode_control(oracle) == control


@pytest.mark.parametrize("data", [b"", bytes(7), bytes(9), b"\xff\x3f" + bytes(6)])
def test_what_is_no_feedback_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        HD.decode_feedback(data)


@pytest.mark.parametrize(
    ("position_mm", "limit_a", "speed_percent"), [(-0.1, 1, 20), (1700, 1, 20), (1, 52, 20), (1, 1, 160)]
)
def test_what_does_not_fit_its_field_is_not_encoded(position_mm: float, limit_a: float, speed_percent: float) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        HD.encode_control(Control(position_mm, limit_a, speed_percent, motion_enable=True))


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_satisfy_their_schema_and_every_figure_has_a_source(name: str) -> None:
    schema = json.loads((resources.files(firmware_profiles) / "electrak.schema.json").read_text())
    raw = firmware_profiles.load(name)
    jsonschema.Draft202012Validator(schema).validate(raw)
    assert raw["name"] == name
    profile = load_profile(name)
    assert all(profile.sources.values())
    load_database(profile.layout)


def test_what_is_not_known_of_the_md_is_marked_so() -> None:
    unknown = load_profile("electrak_md_a050").unknown
    assert {"speed_no_load_mm_per_s", "current_limit_max_a", "dead_zone_mm"} <= unknown
    assert "speed_no_load_mm_per_s" not in load_profile("electrak_hd_b017").unknown


def test_an_unknown_profile_names_the_nearest() -> None:
    with pytest.raises(WrongDeviceError, match="electrak_hd_b017"):
        load_profile("electrak_hd_b071")


@pytest.mark.parametrize("layout", ["electrak_hd", "electrak_md"])
def test_the_dbc_is_usable_by_other_tools(layout: str) -> None:
    text = (resources.files(firmware_profiles) / f"{layout}.dbc").read_text()
    database = cantools.database.load_string(text, strict=True)
    again = cantools.database.load_string(database.as_dbc_string(), strict=True)
    assert [m.name for m in again.messages] == ["ACM", "AFM"]
    assert all(m.protocol == "j1939" and m.is_extended_frame for m in again.messages)


def test_measured_figures_replace_the_profiles_and_are_known_from_then_on() -> None:
    profile = load_profile("electrak_md_a050").with_figures({"speed_no_load_mm_per_s": 24.5})
    assert profile.figures.speed_no_load_mm_per_s == 24.5
    assert "speed_no_load_mm_per_s" not in profile.unknown
    with pytest.raises(WrongDeviceError, match="Did you mean dead_zone_mm"):
        profile.with_figures({"dead_zome_mm": 1.0})
