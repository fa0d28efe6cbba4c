"""The servo's wire in words: what was asked and answered, what is damaged, and the way through text and back."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.dynamixel.codec import ALERT, Instruction, StatusError, encode, encode_status
from graderd.drivers.dynamixel.dump import WireDecoder, dump, main, parse_wire_line, text_of, wire_line
from graderd.drivers.dynamixel.table import ControlTable

TABLE = ControlTable.load("ph54_200_s500")
VELOCITY, POSITION = TABLE["present_velocity"], TABLE["present_position"]
ASK = encode(1, Instruction.READ, VELOCITY.address.to_bytes(2, "little") + b"\x08\x00")
ANSWER = encode_status(1, 0, VELOCITY.encode(-250) + POSITION.encode(-125_000))


def decoded(*pieces: tuple[Literal["tx", "rx"], bytes]) -> list[dict[str, Any]]:
    decoder = WireDecoder(TABLE)
    return [cast("dict[str, Any]", p) for n, (d, data) in enumerate(pieces) for p in decoder.feed(float(n), d, data)]


def test_an_answer_is_read_as_what_was_asked_even_in_pieces() -> None:
    asked, answered = decoded(("tx", ASK), ("rx", ANSWER[:9]), ("rx", ANSWER[9:]))
    assert (asked["kind"], asked["direction"], asked["id"]) == ("read", "tx", 1)
    assert (asked["address"], asked["size"]) == (576, 8)
    assert (answered["kind"], answered["t_s"], answered["address"]) == ("status", 2.0, 576)
    assert answered["registers"] == {
        "present_velocity": {"value": -2.5, "unit": "rev/min"},
        "present_position": {"value": -125_000, "unit": "pulse"},
    }
    assert text_of(cast("Any", answered)).split() == [
        "2.000000", "rx", "1", "status", "576+8", "present_velocity=-2.5rev/min", "present_position=-125000pulse",
    ]  # fmt: skip


def test_an_answer_to_nothing_or_to_another_servo_is_no_register() -> None:
    _, foreign, answered, late = decoded(("tx", ASK), ("rx", encode_status(2, 0, bytes(8)) + ANSWER + ANSWER))
    assert (foreign["registers"], len(answered["registers"])) == ({}, 2)
    assert (late["registers"], late["address"], late["data"]) == ({}, None, ANSWER[9:-2].hex().upper())
    assert decoded(("tx", ASK), ("rx", encode_status(2, 0, bytes(8))))[1]["registers"] == {}
    assert decoded(("tx", ASK), ("rx", encode_status(1, 0, b"\xe4\x07\x0c")))[1]["registers"] == {}


def test_a_write_names_what_it_writes_and_a_refusal_its_reason_and_the_alert() -> None:
    goal = TABLE["goal_position"]
    write = encode(1, Instruction.WRITE, goal.address.to_bytes(2, "little") + goal.encode(4711))
    refusal = encode_status(1, StatusError.DATA_RANGE | ALERT)
    written, refused = decoded(("tx", write), ("rx", refusal))
    assert written["registers"] == {"goal_position": {"value": 4711, "unit": "pulse"}}
    assert (refused["error"], refused["alert"]) == ("data_range", True)
    assert text_of(cast("Any", refused)).endswith("ALERT data_range")
    assert decoded(("rx", encode_status(1, 0x7F)))[0]["error"] == "error 127"


def test_only_whole_registers_are_named() -> None:
    part = encode(1, Instruction.WRITE, (POSITION.address + 1).to_bytes(2, "little") + bytes(3))
    assert decoded(("tx", part))[0]["registers"] == {}


def test_damage_is_told_beside_what_is_whole() -> None:
    broken = bytearray(ANSWER)
    broken[12] ^= 1
    *_, damaged, whole = decoded(("tx", ASK), ("rx", bytes(broken) + ANSWER))
    assert (damaged["kind"], damaged["direction"], damaged["id"]) == ("damaged", "rx", None)
    assert damaged["error"] == f"wrong CRC; {len(ANSWER)} bytes belong to no packet"
    assert whole["registers"]
    _, cut, again = decoded(("tx", ASK), ("rx", ANSWER[:-3]), ("tx", ASK))
    assert (cut["kind"], cut["direction"], cut["error"]) == (
        "damaged", "rx", f"{len(ANSWER) - 3} bytes belong to no packet",
    )  # fmt: skip
    assert again["kind"] == "read"


@given(st.lists(st.tuples(st.sampled_from(["tx", "rx"]), st.binary(min_size=1, max_size=40)), max_size=8))
def test_no_bytes_make_it_fail_and_the_text_is_read_back(pieces: list[tuple[Literal["tx", "rx"], bytes]]) -> None:
    for direction, data in pieces:
        assert parse_wire_line(wire_line(3.25, direction, data) + "\n") == (3.25, direction, data)
    for packet in decoded(*pieces):
        assert json.loads(json.dumps(packet)) == packet
        assert "\n" not in text_of(cast("Any", packet))


@pytest.mark.parametrize(
    "line", ["", "# 3 lines lost: the reader is too slow", "(1.0) can0 18EF1300#DC", "(1.0) servo rx F"]
)
def test_other_lines_are_passed_over(line: str) -> None:
    out = io.StringIO()
    assert dump([line, wire_line(1.0, "tx", ASK)], TABLE, out, as_json=True) == 1
    assert json.loads(out.getvalue())["kind"] == "read"


@pytest.mark.live
def test_a_file_and_standard_input_are_read_alike(tmp_path: Path) -> None:
    log = tmp_path / "servo.log"
    log.write_text(wire_line(1.0, "tx", ASK) + "\n# 1 lines lost\n" + wire_line(1.01, "rx", ANSWER) + "\n")
    command = [sys.executable, "-m", "graderd.drivers.dynamixel.dump", "--json"]
    out = {
        subprocess.run([*command, source], input=log.read_text(), capture_output=True, text=True, check=True).stdout
        for source in ("-", str(log))
    }
    assert [json.loads(line)["kind"] for line in out.pop().splitlines()] == ["read", "status"]
    assert out == set()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.log"], "No such file"),
        (["letter.log"], "holds no line of the servo's wire"),
        (["-", "--profile", "electrak_hd_b017"], "no control table of a servo"),
        (["-", "--profile", "ph54_200_s50"], "ph54_200_s500"),
    ],
)
def test_bad_input_gives_one_clear_line_and_a_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("letter.log").write_text("Dear reader\n")
    assert main(arguments) == 1
    told = capsys.readouterr()
    assert said in told.err
    assert (told.err.count("\n"), told.out) == (1, "")
