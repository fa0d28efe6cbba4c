"""The PH54 profile: its schema, an independent oracle, and what is built from it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import jsonschema
import pytest

from graderd import firmware_profiles
from graderd.drivers.dynamixel import model_file
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.errors import DeviceError, WrongDeviceError

TABLES = [n for n in firmware_profiles.names() if firmware_profiles.load(n).get("kind") == "control_table"]


@pytest.fixture(scope="module")
def table() -> ControlTable:
    return ControlTable.load("ph54_200_s500")


def _model_text(name: str) -> str:
    return (files("dynamixel_easy_sdk") / "control_table" / f"{name}.model").read_text(encoding="utf-8")


def _model_rows(name: str) -> Iterator[tuple[int, int, str]]:
    text = _model_text(name)
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


def test_the_family_fits_its_schema() -> None:
    schema = json.loads((files(firmware_profiles) / "servo_family.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(firmware_profiles.load("p_series"), schema)


# -- other servos of the family, from the SDK's tables ----------------------------------------------------------------


def test_importing_the_ph54_gives_our_own_profile() -> None:
    """Addresses, sizes, units, signs and counts of a turn in the SDK's table are ours, or it would be refused."""
    assert model_file.profile_of(model_file.find("PH54-200-S500-R")) == firmware_profiles.load("ph54_200_s500")


@pytest.mark.parametrize("name", model_file.models())
def test_an_imported_profile_is_whole_and_reads_back(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert model_file.main([name, "--to", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"written": str(tmp_path / f"{name}.toml"), "model": name}
    profile = firmware_profiles.load(str(tmp_path / f"{name}.toml"))
    assert profile == model_file.profile_of(model_file.find(name))
    schema = json.loads((files(firmware_profiles) / "control_table.schema.json").read_text(encoding="utf-8"))
    jsonschema.validate(profile, schema)
    table = ControlTable(profile)
    test_defaults_are_legal_and_fit(table)
    test_disagreements_name_registers(table)
    rating, top = profile["rating"], table["current_limit"].max
    assert rating["torque_nm_per_a"] * rating["current_continuous_a"] == pytest.approx(
        rating["torque_continuous_nm"], rel=1e-3
    )
    assert top is not None
    assert rating["current_continuous_a"] * 1000 < top
    assert table["goal_current"].max == -(table["goal_current"].min or 0) == top
    assert table["max_position_limit"].max == profile["motion"]["pulses_per_turn"] // 2
    # The data sheets give gear and counts apart: 2,000 counts for a turn of the motor, 2,048 of the smallest one.
    counts_n = profile["motion"]["pulses_per_turn"] / profile["motion"]["gear_ratio"]
    assert counts_n == pytest.approx(2048 if name == "pm42_010_s260" else 2000, rel=1e-5)
    registry = _model_text("dynamixel").splitlines()
    assert f"{profile['model_number']}\t{name}.model" in registry


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Present Velocity\t0.0010471976\trad/s", "Present Velocity\t0.0239691227\trad/s", "counts 0.02"),
        ("Present Velocity\t0.0010471976\trad/s", "Present Velocity\t0.0010471976\tdeg/s", "counts 0.001"),
        ("Present Current\t1.0\traw\tsigned", "Present Current\t1.0\traw\tunsigned", "unsigned there"),
        ("564\t4\tGoal Position", "596\t4\tGoal Position", "Goal Position is at 596"),
        ("564\t4\tGoal Position\n", "", "Goal Position is missing"),
        ("564\t4\tGoal Position", "564\tfour\tGoal Position", "line 6"),
        ("position\t303750", "position\t2048", "half a turn"),
        ("[control table]", "[tables]", "none of a .model file"),
    ],
)
def test_a_table_that_is_not_the_familys_is_refused(old: str, new: str, said: str) -> None:
    text = _model_text("ph42_020_s300")
    assert old in text
    with pytest.raises(DeviceError, match=said.replace(".", r"\.")):
        model_file.profile_of(model_file.ModelFile.parse("ph42_020_s300", text.replace(old, new)))


@pytest.mark.parametrize("name", ["xm430_w350", "h54_200_s500_ra", "xl320", "rh_p12_rn"])
def test_a_servo_of_another_family_is_refused(name: str) -> None:
    with pytest.raises(WrongDeviceError, match=r"not the P series'.*graderd drives ph42_020_s300"):
        model_file.profile_of(model_file.find(name))


def test_an_import_says_what_is_wrong_and_overwrites_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "ph42_020_s300.toml"
    there.write_text("mine")
    not_utf8 = tmp_path / "x.model"
    not_utf8.write_bytes(b"\xff\xfe")
    for arguments, said in (
        (["ph42_020_s300", "--to", str(tmp_path)], "is there already"),
        (["ph42_020_s300", "--to", str(tmp_path / "nowhere" / "a.toml")], "cannot be written"),
        (["ph42_020_s300", "--to", str(tmp_path / "nowhere")], "is no folder"),
        (["ph43", "--to", str(tmp_path)], "There are ph42_020_s300, ph54_100"),
        ([str(not_utf8), "--to", str(tmp_path)], "is no text"),
    ):
        assert model_file.main(arguments) == 1
        told = capsys.readouterr().err
        assert told.startswith("graderd: ")
        assert told.count("\n") == 1
        assert said in told
    assert there.read_text() == "mine"


def test_a_profile_that_is_no_servos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WrongDeviceError, match="no control table"):
        ControlTable.load("electrak_hd_b017")
    broken = tmp_path / "broken.toml"
    with pytest.raises(firmware_profiles.UnknownProfileError, match="No such file"):
        ControlTable.load(str(broken))
    broken.write_text("x = ")
    with pytest.raises(firmware_profiles.UnknownProfileError, match="graderd profile import"):
        ControlTable.load(str(broken))
    model_file.main(["ph42_020_s300", "--to", str(tmp_path)])
    broken.write_text((tmp_path / "ph42_020_s300.toml").read_text().replace("address = 564", "address = 'here'"))
    with pytest.raises(WrongDeviceError, match=f"{broken}: is no control table"):
        ControlTable.load(str(broken))
