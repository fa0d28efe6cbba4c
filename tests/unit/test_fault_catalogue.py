"""The fault catalogue: complete, in plain words, consistent, and the same in the pages made from it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from graderd.cli.app import run_app
from graderd.cli.docs import pages
from graderd.core.axes import ACTUATORS
from graderd.core.faults.catalogue import CATALOGUE, find_rows
from graderd.core.faults.monitor import (
    ALL_AXES,
    Clear,
    FaultRow,
    FaultState,
    Reaction,
    catalogue_key,
    clear_faults,
    held_axes,
    row_for,
    update_faults,
)
from graderd.hal.fault import DeviceFault

ROOT = Path(__file__).resolve().parents[2]
CONDITIONS = {
    "rotation": (
        "no_reply corrupt_replies wrong_device alert_voltage alert_hall_sensor alert_overheating alert_encoder "
        "alert_electrical_shock alert_overload watchdog_tripped ram_reset turns_lost torque_off not_moving "
        "not_arriving overspeed moving_uncommanded wrong_way voltage_near_limit temperature_near_limit unplugged"
    ),
    "servo_bus": "adapter_latency lossy",
    "actuator": (
        "no_feedback implausible_feedback feedback_flood overload parameter saturation backdrive fatal voltage "
        "temperature uncommanded_motion not_moving not_arriving overspeed restarted wrong_address thermal_derating "
        "thermal_limit sides_apart"
    ),
    "can": (
        "interface_down bus_off error_passive unplugged adapter_refuses queue_overrun address_conflict cannot_claim "
        "claim_storm flood"
    ),
    "camera": (
        "missing stale black blown_out blocked frozen blurred torn wrong_resolution knocked depth_missing "
        "blade_elsewhere obstructed "
        "worker_restarted worker_hung settings_not_kept"
    ),
    "daemon": (
        "tick_overrun loop_blocked suspended disk_full clock_stepped state_file_corrupt recorder_failed memory_high "
        "perception_nonsense lease_lapsed"
    ),
    "stop_input": "open lost stale stuck",
}
ROWS = list(CATALOGUE.values())


def test_every_condition_has_a_row_and_no_row_is_idle() -> None:
    expected = {f"{part}.{condition}" for part, names in CONDITIONS.items() for condition in names.split()}
    assert set(CATALOGUE) == expected


def test_a_row_is_found_under_its_own_key_only_once() -> None:
    assert all(key == row.key for key, row in CATALOGUE.items())


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_a_row_speaks_plainly(row: FaultRow) -> None:
    for text in (row.reads, row.cause, row.remedy):
        assert 8 <= len(text) <= 140
        assert text == text.strip()
        assert not text.endswith(".")
        assert not re.search(r"\b(crc|eeprom|ram|afm|acm|exception|nack|timeout)\b", text, re.IGNORECASE)
    # What the operator reads says what is, not what code it has.
    assert "_" not in row.reads
    assert row.key not in row.reads
    assert 0.0 <= row.debounce_s <= 5.0


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_a_row_names_axes_that_exist(row: FaultRow) -> None:
    assert row.axes <= ALL_AXES or row.axes == frozenset({"own"})
    assert row.axes != frozenset({"own"}) or row.key.startswith("actuator.")
    if row.reaction is Reaction.HOLD:
        assert row.axes, "a hold of no axis is no reaction"


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_what_ends_a_fault_fits_its_reaction(row: FaultRow) -> None:
    assert row.clear is not Clear.NEVER
    if row.reaction is Reaction.STOP:
        assert row.clear is Clear.ON_RESET
    else:
        assert row.clear is not Clear.ON_RESET
    if row.reaction <= Reaction.WARN:
        assert row.clear is Clear.WHEN_GONE


@pytest.mark.parametrize("row", [row for row in ROWS if row.clear is not Clear.WHEN_GONE], ids=lambda row: row.key)
def test_the_remedy_says_how_a_latched_fault_ends(row: FaultRow) -> None:
    assert re.search(r"\barm\b", row.remedy)
    if row.reaction is Reaction.STOP:
        assert "reset" in row.remedy


HANDS = re.compile(
    r"\b(free|lift the|load off|lens|mount|linkage|cables?|connectors?|shield|terminat\w+|wires|wiring|label|brake|"
    r"measure|plug|exchange|coupling|port|give one)\b"
)
"""What somebody does, or goes to, at the blade, its devices or their cables."""


@pytest.mark.parametrize("row", [r for r in ROWS if r.reaction < Reaction.RETREAT], ids=lambda row: row.key)
def test_whoever_is_sent_to_the_machine_finds_automatic_operation_ended(row: FaultRow) -> None:
    if HANDS.search(row.remedy):
        assert "disarm" in row.remedy, "make it a retreat, or say that the machine is disarmed first"
    if row.reaction is Reaction.HOLD:
        assert row.clear is Clear.WHEN_GONE, "a latch waits for a person, and automatic operation ends for him"


@pytest.mark.parametrize("row", [r for r in ROWS if r.reaction is Reaction.RETREAT], ids=lambda row: row.key)
def test_a_remedy_after_a_retreat_says_how_to_go_on(row: FaultRow) -> None:
    assert re.search(r"\barm\b|'graderd (auto|calibrate|jog)", row.remedy)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_commands_named_in_a_remedy_exist(row: FaultRow, capsys: pytest.CaptureFixture[str]) -> None:
    for text in re.findall(r"'graderd ([a-z ]+)", row.remedy):
        words = text.split()
        assert any(run_app([*words[:n], "--help"]) == 0 for n in (len(words), len(words) - 1) if n), text
    capsys.readouterr()


def test_the_dangerous_ones_stop_and_the_lost_ones_disarm() -> None:
    stops = {row.key for row in ROWS if row.reaction is Reaction.STOP}
    assert {key for key in stops if not key.startswith("stop_input.")} == {
        "rotation.moving_uncommanded",
        "rotation.wrong_way",
        "rotation.overspeed",
    }
    for key in (
        "rotation.no_reply",
        "rotation.unplugged",
        "rotation.ram_reset",
        "rotation.turns_lost",
        "rotation.torque_off",
        "actuator.no_feedback",
        "actuator.restarted",
        "can.interface_down",
        "can.unplugged",
        "can.bus_off",
    ):
        assert CATALOGUE[key].reaction is Reaction.DISARM
    assert all(row.reaction is Reaction.DISARM for row in ROWS if row.key.startswith("rotation.alert_"))


def test_a_stale_picture_holds_the_rotation_at_once() -> None:
    state = update_faults(FaultState(), [DeviceFault("camera", "stale", "no frame", 0.0)], 0.0, CATALOGUE)
    assert held_axes(state.active).keys() == frozenset({"rotation"})


@pytest.mark.parametrize(
    ("device", "axes"), [("lift_left", {"lift"}), ("lift_right", {"lift"}), ("tilt", {"tilt"})], ids=str
)
def test_an_actuator_holds_its_own_axis(device: str, axes: set[str]) -> None:
    state = update_faults(FaultState(), [DeviceFault(device, "overload", "", 0.0)], 1.0, CATALOGUE)
    assert held_axes(state.active).keys() == axes


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_a_fault_counts_after_its_debounce_and_ends_as_the_row_says(row: FaultRow) -> None:
    part, _, condition = row.key.partition(".")
    fault = DeviceFault("tilt" if part == "actuator" else part, condition, "detail", 0.0)
    assert row_for(fault, CATALOGUE).key == row.key
    state = update_faults(FaultState(), [fault], 0.0, CATALOGUE)
    assert bool(state.active) == (row.debounce_s == 0)
    state = update_faults(state, [fault], row.debounce_s, CATALOGUE)
    assert [f.name for f in state.active] == [fault.name]
    gone = update_faults(state, [], 1.0 + row.debounce_s, CATALOGUE)
    assert bool(gone.active) == (row.clear is not Clear.WHEN_GONE)
    assert bool(clear_faults(gone, Clear.ON_REARM).active) == (row.clear is Clear.ON_RESET)
    assert clear_faults(gone, Clear.ON_RESET).active == ()


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("rotation.no_reply", {"rotation.no_reply"}),
        ("lift_left.overload", {"actuator.overload"}),
        ("actuator.overload", {"actuator.overload"}),
        ("not_moving", {"rotation.not_moving", "actuator.not_moving"}),
        ("servo_bus", {"servo_bus.adapter_latency", "servo_bus.lossy"}),
        ("tilt", {key for key in CATALOGUE if key.startswith("actuator.")}),
        ("tilt.stale", set()),
        ("nonsense", set()),
        ("", set()),
    ],
)
def test_rows_are_found_by_what_a_person_types(name: str, keys: set[str]) -> None:
    assert {row.key for row in find_rows(name)} == keys


def test_the_three_actuators_share_their_rows() -> None:
    assert {catalogue_key(device, "overload") for device in ACTUATORS} == {"actuator.overload"}


@pytest.mark.parametrize("name", ["faults.md", "cli.md"])
def test_the_pages_are_up_to_date(name: str) -> None:
    page = ROOT / "docs" / "operators" / name
    assert page.read_text("utf-8") == pages()[name], "write it again: python -m graderd.cli.docs"


def _told_after_s(there_s: float, gone_s: float, row: FaultRow, tick_s: float = 0.02, most_s: float = 30.0) -> float:
    """When a fault that is there and gone in turn is told first; infinite: not within ``most_s``."""
    state, fault = FaultState(), DeviceFault("can", "bus", "", 0.0)
    there_n, gone_n = round(there_s / tick_s), round(gone_s / tick_s)
    for n in range(round(most_s / tick_s)):
        now_s = n * tick_s
        present = [fault] if n % (there_n + gone_n) < there_n else []
        state = update_faults(state, present, now_s, {"can.bus": row})
        if state.active:
            return now_s
    return float("inf")


@pytest.mark.parametrize("debounce_s", [0.1, 0.3, 1.0])
def test_a_fault_that_flaps_faster_than_its_debounce_is_told(debounce_s: float) -> None:
    row = FaultRow("can.bus", "reads so", "for a cause", "with a remedy", Reaction.HOLD, debounce_s=debounce_s)
    assert _told_after_s(60.0, 1.0, row) == pytest.approx(debounce_s, abs=0.02)
    assert _told_after_s(0.02, 0.02, row) <= 3 * debounce_s + 0.1
    assert _told_after_s(debounce_s * 0.8, debounce_s * 0.8, row) <= 5 * debounce_s
    assert _told_after_s(debounce_s * 0.4, debounce_s * 0.8, row) <= 10 * debounce_s


@pytest.mark.parametrize("debounce_s", [0.1, 0.3, 1.0])
def test_what_is_there_for_a_moment_now_and_then_is_not_told(debounce_s: float) -> None:
    row = FaultRow("can.bus", "reads so", "for a cause", "with a remedy", Reaction.HOLD, debounce_s=debounce_s)
    assert _told_after_s(0.02, 0.2, row) == float("inf")
    assert _told_after_s(debounce_s * 0.5, debounce_s * 2.0, row) == float("inf")
