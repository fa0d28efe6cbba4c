"""29-bit identifiers and NAMEs: the standard's rules, and python-can-j1939 as an oracle."""

from __future__ import annotations

import j1939
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.j1939.ids import (
    GLOBAL,
    Pgn,
    destination_of,
    is_pdu1,
    make_id,
    pgn_name,
    pgn_of,
    priority_of,
    source_of,
)
from graderd.drivers.j1939.name import Name


@pytest.mark.parametrize(
    ("can_id", "priority", "pgn", "destination", "source"),
    [
        (0x18EF13FE, 6, 0xEF00, 0x13, 0xFE),
        (0x19EFFF13, 6, 0x1EF00, GLOBAL, 0x13),
        (0x18EEFF13, 6, 0xEE00, GLOBAL, 0x13),
        (0x18FECAE7, 6, 0xFECA, GLOBAL, 0xE7),
        (0x0CF00400, 3, 0xF004, GLOBAL, 0x00),
        (0x1CEC13E7, 7, 0xEC00, 0x13, 0xE7),
    ],
)
def test_known_identifiers_both_ways(can_id: int, priority: int, pgn: int, destination: int, source: int) -> None:
    assert (priority_of(can_id), pgn_of(can_id), destination_of(can_id), source_of(can_id)) == (
        priority,
        pgn,
        destination,
        source,
    )
    assert make_id(priority, pgn, source, destination) == can_id


@given(st.integers(0, 0x1FFFFFFF))
def test_every_identifier_survives_the_round_trip(can_id: int) -> None:
    if can_id & 1 << 25:  # extended data page: not J1939 of today
        return
    assert make_id(priority_of(can_id), pgn_of(can_id), source_of(can_id), destination_of(can_id)) == can_id


@given(st.integers(0, 0x1FFFFFFF))
def test_identifiers_agree_with_python_can_j1939(can_id: int) -> None:
    oracle = j1939.MessageId(can_id=can_id)
    pgn = j1939.ParameterGroupNumber()
    pgn.from_message_id(oracle)
    assert source_of(can_id) == oracle.source_address
    assert priority_of(can_id) == oracle.priority
    assert is_pdu1(pgn_of(can_id)) == pgn.is_pdu1_format
    if pgn.is_pdu1_format:
        assert destination_of(can_id) == pgn.pdu_specific


@pytest.mark.parametrize(
    ("priority", "pgn", "source"), [(8, 0xEF00, 0), (6, 0x40000, 0), (6, 0xEF01, 0), (6, 0xEF00, 256)]
)
def test_identifiers_that_cannot_be_are_refused(priority: int, pgn: int, source: int) -> None:
    with pytest.raises(ValueError):
        make_id(priority, pgn, source)


def test_groups_have_readable_names() -> None:
    assert pgn_name(Pgn.DM1) == "dm1"
    assert pgn_name(0xF004) == "PGN 61444"


def test_the_captured_claim_of_a_real_electrak_reads_as_its_manual_says() -> None:
    name = Name.from_bytes(bytes.fromhex("0100604400FF0080"))
    assert name.value == 0x8000FF0044600001
    assert (name.manufacturer, name.function, name.industry_group, name.identity) == (547, 255, 0, 1)
    assert name.arbitrary_address_capable == 1


names = st.builds(
    Name,
    identity=st.integers(0, 0x1FFFFF),
    manufacturer=st.integers(0, 0x7FF),
    ecu_instance=st.integers(0, 7),
    function_instance=st.integers(0, 31),
    function=st.integers(0, 255),
    vehicle_system=st.integers(0, 127),
    vehicle_system_instance=st.integers(0, 15),
    industry_group=st.integers(0, 7),
    arbitrary_address_capable=st.integers(0, 1),
)


@given(names)
def test_names_survive_the_round_trip_and_agree_with_python_can_j1939(name: Name) -> None:
    assert Name.from_bytes(name.to_bytes()) == name
    oracle = j1939.Name(
        identity_number=name.identity,
        manufacturer_code=name.manufacturer,
        ecu_instance=name.ecu_instance,
        function_instance=name.function_instance,
        function=name.function,
        vehicle_system=name.vehicle_system,
        vehicle_system_instance=name.vehicle_system_instance,
        industry_group=name.industry_group,
        arbitrary_address_capable=name.arbitrary_address_capable,
    )
    assert bytes(oracle.bytes) == name.to_bytes()


@pytest.mark.parametrize("field", ["identity", "manufacturer", "function", "industry_group"])
def test_a_field_too_wide_for_its_bits_is_refused(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        Name(**{field: 1 << 21})
