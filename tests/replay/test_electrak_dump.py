"""The bus in words: every log format, live, long messages, bad input; by the module's own command line."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.electrak.dump import FrameDecoder, candump_line, dump, main, parse_candump_line, read_file, text_of
from graderd.drivers.j1939.dm1 import dtc_of, encode
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.drivers.j1939.transport import Transport
from graderd.hal.errors import ProtocolError

FRAMES = [
    (0.0, Frame(0x18EF1300, bytes.fromhex("DC05191500000000"))),
    (0.105, Frame(0x19EFFF13, bytes.fromhex("1F870705C9FFFFFF"))),
    (0.2, Frame(0x18EEFF13, bytes.fromhex("0100604400FF0080"))),
    (0.3, Frame(0x123, b"\x01\x02", extended=False)),
]
ACM = {"target_position_mm": 150.0, "current_limit_a": 10.0, "speed_percent": 50, "motion_enable": 1}
AFM = {
    "position_mm": 182.3,
    "current_a": 3.0,
    "speed_percent": 50,
    "voltage_error": "in_range",
    "temperature_error": "in_range",
    "moving": 1,
    "overload": 0,
    "backdrive": 0,
    "parameter": 1,
    "saturation": 0,
    "fatal": 0,
}


def candump_compact(start_s: float) -> str:
    return "".join(
        f"({start_s + t:.6f}) can0 {f.can_id:0{8 if f.extended else 3}X}#{f.data.hex().upper()}\n" for t, f in FRAMES
    )


def candump_columns() -> str:
    return "".join(
        f" ({t:010.6f})  can0  RX - -  {f.can_id:0{8 if f.extended else 3}X}   [{len(f.data)}]  {f.data.hex(' ')}\n"
        for t, f in FRAMES
    )


def dumped(path: Path) -> list[dict[str, Any]]:
    out = io.StringIO()
    dump(read_file(path), out, as_json=True)
    return [json.loads(line) for line in out.getvalue().splitlines()]


@pytest.fixture(params=["log", "txt", "asc", "blf", "mf4"])
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"trip.{request.param}"
    if request.param == "log":
        path.write_text(candump_compact(1622749162.0))
    elif request.param == "txt":
        path.write_text(candump_columns())
    else:
        with can.Logger(path) as writer:
            for t_s, frame in FRAMES:
                writer.on_message_received(
                    can.Message(
                        timestamp=1622749162.0 + t_s,
                        arbitration_id=frame.can_id,
                        data=frame.data,
                        is_extended_id=frame.extended,
                        channel=0,
                    )
                )
    return path


@pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning", "default::FutureWarning")
def test_every_log_format_gives_the_same_frames(log: Path) -> None:
    """(The MF4 reader is asammdf; what it warns about is not ours.)"""
    objects = dumped(log)
    assert [o["name"] for o in objects] == ["ACM", "AFM", "address_claimed", ""]
    assert [o["can_id"] for o in objects] == [0x18EF1300, 0x19EFFF13, 0x18EEFF13, 0x123]
    assert (objects[0]["pgn"], objects[0]["source"], objects[0]["destination"]) == (61184, 0, 19)
    assert (objects[1]["pgn"], objects[1]["source"], objects[1]["destination"]) == (126720, 19, 255)
    assert objects[0]["signals"] == ACM
    assert objects[1]["signals"] == AFM
    assert objects[2]["signals"]["manufacturer"] == 547
    assert objects[3]["pgn"] is None
    assert objects[1]["t_s"] - objects[0]["t_s"] == pytest.approx(0.105, abs=1e-3)


@pytest.mark.parametrize(
    "line",
    [
        "(1622749162.100000) can0 19EFFF13#1F870705C9FFFFFF",
        "(1622749162.100000) vcan0 19EFFF13#1F870705C9FFFFFF R",
        "  can0  19EFFF13   [8]  1F 87 07 05 C9 FF FF FF",
        " (1622749162.100000)  can0  19EFFF13   [8]  1F 87 07 05 C9 FF FF FF   '........'",
        " (2021-06-03 19:39:22.100000)  can0  TX - -  19EFFF13   [8]  1F 87 07 05 C9 FF FF FF",
    ],
)
def test_every_form_of_candump_line_is_read(line: str) -> None:
    timed = parse_candump_line(line)
    assert timed is not None
    assert timed[1] == FRAMES[1][1]


@given(st.text(max_size=60))
def test_other_lines_are_passed_over(line: str) -> None:
    parse_candump_line(line)


def test_network_management_and_diagnostics_have_names() -> None:
    decode = FrameDecoder().decode
    ask = decode(Frame(make_id(6, Pgn.REQUEST, 40, 231), bytes.fromhex("EBFE00")), 0.0)
    assert ask["signals"] == {"requested_pgn": 65259, "requested": "component_id"}
    nack = decode(Frame(make_id(6, Pgn.ACKNOWLEDGEMENT, 231), bytes.fromhex("01FFFFFF2804F000")), 0.0)
    assert nack["signals"] == {"control": "negative", "about_pgn": 61444, "address": 40}
    cannot = decode(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, 254), bytes(8)), 0.0)
    assert cannot["name"] == "cannot_claim"
    stop = decode(Frame(make_id(3, Pgn.STOP_ALL_IMPLEMENTS, 38), b"\xff" * 6 + b"\x03\xfc"), 0.0)
    assert stop["signals"] == {"transitions": 3, "state": "stop"}
    dm1 = decode(Frame(make_id(6, Pgn.DM1, 231), encode([dtc_of("tilt", "overload")], amber=True)), 0.0)
    assert dm1["signals"]["lamps"] == ["amber_warning"]
    assert dm1["signals"]["dtcs"][0]["fmi"] == 7
    assert decode(Frame(make_id(3, 0xF004, 0), bytes(8)), 0.0)["name"] == "PGN 61444"
    assert "PGN 61444" in text_of(decode(Frame(make_id(3, 0xF004, 0), bytes(8)), 0.0))


def test_a_long_message_is_put_together_in_its_last_frame() -> None:
    sender = Transport()
    sender.address = 231
    frames = sender.send(Pgn.COMPONENT_ID, b"graderd*blade controller*7**", 255, 0.0)
    for step in range(60):
        frames += sender.poll(step * 0.01)
    decoder = FrameDecoder()
    decoded = [decoder.decode(frame, index * 0.05) for index, frame in enumerate(frames)]
    assert decoded[0]["signals"] == {"control": "bam", "about_pgn": 65259, "about": "component_id"}
    assert decoded[-1]["signals"]["text"] == "graderd*blade controller*7**"


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.booleans())
def test_no_frame_can_make_it_fail_and_every_object_is_json(can_id: int, data: bytes, extended: bool) -> None:
    decoded = FrameDecoder().decode(Frame(can_id if extended else can_id & 0x7FF, data, extended), 1.0)
    assert set(json.loads(json.dumps(decoded))) >= {"t_s", "can_id", "pgn", "source", "destination", "name", "signals"}
    text_of(decoded)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("absent.log", None, "no such file"),
        ("letter.log", "Dear reader\n", "no CAN frame in candump's form"),
        ("damaged.blf", "not a BLF file at all", "cannot be read"),
    ],
)
def test_bad_input_gives_one_clear_line_and_a_status(
    name: str, content: str | None, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    assert main([str(path)]) == 1
    error = capsys.readouterr().err.strip()
    assert why in error
    assert "\n" not in error


def test_a_missing_interface_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["can_absent"]) == 1
    assert "no such network interface" in capsys.readouterr().err


def test_a_truncated_log_gives_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "cut.log"
    path.write_text(candump_compact(0.0)[:-12])
    with_cut = list(read_file(path))
    assert len(with_cut) >= 3
    empty = tmp_path / "empty.log"
    empty.write_text("")
    with pytest.raises(ProtocolError):
        list(read_file(empty))


def test_the_command_line_writes_json_and_survives_a_closed_pipe(tmp_path: Path) -> None:
    path = tmp_path / "trip.log"
    path.write_text(candump_compact(0.0) * 3000)
    command = f"{sys.executable} -m graderd.drivers.electrak.dump {path} --json | head -n 2"
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["name"] for line in lines] == ["ACM", "AFM"]
    assert done.stderr == ""


def test_candump_text_on_standard_input_is_read_and_what_is_written_is_read_again() -> None:
    text = "# 2 frames lost: the reader is too slow\n" + "".join(f"{candump_line(f, t)}\n" for t, f in FRAMES)
    done = subprocess.run(
        [sys.executable, "-m", "graderd.drivers.electrak.dump", "-", "--json"],
        input=text, capture_output=True, text=True, check=True,
    )  # fmt: skip
    objects = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(o["t_s"], o["can_id"], o["data"]) for o in objects] == [
        (t, f.can_id, f.data.hex().upper()) for t, f in FRAMES
    ]
