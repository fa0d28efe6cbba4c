"""The PH54 profile: its schema, an independent oracle, and what is built from it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.resources import files
from itertools import pairwise

import jsonschema
import pytest

from graderd import firmware_profiles
from graderd.drivers.dynamixel.table import ControlTable

TABLES = [n for n in firmware_profiles.names() if firmware_profiles.load(n).get("kind") == "control_table"]


@pytest.fixture(scope="module")
def table() -> ControlTable:
    return ControlTable.load("ph54_200_s500")


def _model_rows(name: str) -> Iterator[tuple[int, int, str]]:
    text = (files("dynamixel_easy_sdk") / "control_table" / f"{name}.model").read_text(encoding="utf-8")
    for line in text.partition("[control table]")[2].strip().splitlines()[1:]:
        address, size, label = line.split("\t")
        yield int(address), int(size), label


@pytest.mark.parametrize("name", TABLES)
def test_profile_fits_its_schema(name: str) -> None:
    schema = json.loads((files(firmware_profiles) / "control_table.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(firmware_profiles.load(name), schema)
    assert firmware_profiles.load(name)["name"] == name


@pytest.mark.parametrize("name", TABLES)
def test_addresses_sizes_and_names_equal_the_table_in_the_sdk_wheel(name: str) -> None:
    table = ControlTable.load(name)
    ours = {r.label: (r.address, r.size) for r in table.registers}
    aliases = {"Indirect Address Write", "Indirect Data Write", "Indirect Address Read", "Indirect Data Read"}
    rows = [row for row in _model_rows(name) if row[2] not in aliases]
    assert len(rows) > 40
    for address, size, label in rows:
        assert ours.get(label) == (address, size), label
    known = {label for _, _, label in rows}
    extra = {r.label for r in table.registers} - known
    assert all(label.startswith(("Indirect ", "External Port Data")) for label in extra), extra


def test_nothing_overlaps_and_everything_lies_in_memory(table: ControlTable) -> None:
    for before, after in pairwise(table.registers):
        assert before.end <= after.address
    assert table.registers[-1].end <= table.memory_bytes


def test_defaults_are_legal_and_fit(table: ControlTable) -> None:
    for register in table.registers:
        register.encode(register.default)
        if register.writable:
            assert register.allows(register.default), register.name


def test_disagreements_name_registers(table: ControlTable) -> None:
    rows = table.profile["disagreement"]
    assert len(rows) >= 10
    assert all(row["register"] in table for row in rows)


def test_telemetry_is_one_block_of_25_bytes(table: ControlTable) -> None:
    block = table.block("moving", "present_temperature")
    assert (block.address, block.size) == (570, 25)
    values = {r.name: -5 if r.signed else 7 for r in block.registers}
    assert block.decode(block.encode(values)) == values
    with pytest.raises(ValueError, match="25 bytes"):
        block.decode(bytes(24))
    with pytest.raises(ValueError, match="cannot write"):
        block.encode({**values, "present_temperature": 300})
    with pytest.raises(ValueError, match="cannot write"):
        block.encode({"moving": 1})


def test_a_block_leaves_gaps_out(table: ControlTable) -> None:
    block = table.block("bus_watchdog", "goal_position")
    data = bytearray(b"\xee" * block.size)
    data[0] = 0xFF
    assert block.decode(bytes(data))["bus_watchdog"] == -1
    assert block.encode({r.name: 0 for r in block.registers})[1] == 0


def test_registers_know_their_values(table: ControlTable) -> None:
    goal = table["goal_position"]
    assert goal.decode(goal.encode(-131073)) == -131073
    with pytest.raises(ValueError, match="does not fit"):
        table["torque_enable"].encode(256)
    with pytest.raises(ValueError, match="bytes"):
        goal.decode(b"\x00")
    assert table["operating_mode"].allows(4)
    assert not table["operating_mode"].allows(5)
    assert not table["drive_mode"].allows(2)
    at = table.at(583)
    assert at is not None
    assert at.name == "present_position"
    assert table.at(900) is None


def test_an_unknown_profile_names_the_nearest() -> None:
    with pytest.raises(firmware_profiles.UnknownProfileError, match="did you mean 'ph54_200_s500'"):
        firmware_profiles.load("ph54_200_s5000")


def test_a_loaded_profile_is_a_copy() -> None:
    firmware_profiles.load("ph54_200_s500")["table"].clear()
    assert firmware_profiles.load("ph54_200_s500")["table"]["register"]
