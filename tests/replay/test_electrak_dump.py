"""The bus in words: every log format, live, long messages, bad input; by the module's own command line."""

from __future__ import annotations

import io
import itertools
import json
import socket
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.electrak import dump as electrak_dump
from graderd.drivers.electrak.dump import DecodedFrame, FrameDecoder, dump, main, read_live, text_of
from graderd.drivers.j1939 import can_port
from graderd.drivers.j1939.bus_health import BusEvent
from graderd.drivers.j1939.can_logs import candump_line, parse_candump_line, read_file
from graderd.drivers.j1939.can_port import BusPort, open_port
from graderd.drivers.j1939.dm1 import dtc_of, encode
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.drivers.j1939.python_can import SocketcanBus, can, load_mf4
from graderd.drivers.j1939.transport import Transport
from graderd.hal.errors import ProtocolError
from graderd.hal.settings import CanSettings

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


def message(frame: Frame, t_s: float, **more: Any) -> can.Message:
    return can.Message(t_s, frame.can_id, frame.extended, data=frame.data, **more)


def decoded(frame: Frame, t_s: float = 0.0, decoder: FrameDecoder | None = None) -> DecodedFrame:
    return (decoder or FrameDecoder()).decode(message(frame, t_s))


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


@pytest.fixture(params=["log", "txt", "asc", "blf", "mf4", "trc", "csv"])
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"trip.{request.param}"
    if request.param == "log":
        path.write_text(candump_compact(1622749162.0))
    elif request.param == "txt":
        path.write_text(candump_columns())
    else:
        load_mf4()
        with can.Logger(path) as writer:
            for t_s, frame in FRAMES:
                writer.on_message_received(
                    can.Message(
                        timestamp=1622749162.0 + t_s,
                        arbitration_id=frame.can_id,
                        data=frame.data,
                        is_extended_id=frame.extended,
                        channel=1,
                        is_rx=True,
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
    assert (timed.arbitration_id, bytes(timed.data)) == FRAMES[1][1][:2]
    assert timed.timestamp == (1622749162.1 if "(1" in line else timed.timestamp)


@given(st.text(max_size=60))
def test_other_lines_are_passed_over(line: str) -> None:
    parse_candump_line(line)


def test_network_management_and_diagnostics_have_names() -> None:
    decode = decoded
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
    told = [decoded(frame, index * 0.05, decoder) for index, frame in enumerate(frames)]
    assert told[0]["signals"] == {"control": "bam", "about_pgn": 65259, "about": "component_id"}
    assert told[-1]["signals"]["text"] == "graderd*blade controller*7**"


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.booleans())
def test_no_frame_can_make_it_fail_and_every_object_is_json(can_id: int, data: bytes, extended: bool) -> None:
    told = decoded(Frame(can_id if extended else can_id & 0x7FF, data, extended), 1.0)
    keys = {"t_s", "kind", "can_id", "pgn", "source", "destination", "name", "signals"}
    assert set(json.loads(json.dumps(told))) >= keys
    text_of(told)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("absent.log", None, "no such file"),
        ("letter.log", "Dear reader\n", "holds no CAN frame"),
        ("empty.log", "", "is empty"),
        ("empty.trc", "", "is empty"),
        ("empty.asc", "", "is empty"),
        ("empty.csv", "", "is empty"),
        ("empty.blf", "", "is empty"),
        ("headed.asc", "date Wed Jun 03 19:39:22 2021\nbase hex  timestamps absolute\n", "holds no CAN frame"),
        ("damaged.log.gz", "not packed at all", "cannot be read"),
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


SPECIAL = [
    ("(1.000000) can0 20000040#0000000000000000", "error", 0x40, ""),
    ("(1.000000) can0 20000004#0030000000000000", "error", 0x04, "0030000000000000"),
    ("(1.000000) can0 200000A8#0000080000000000", "error", 0xA8, ""),
    ("(1.000000) can0 18EA13E7#R", "remote", 0x18EA13E7, ""),
    ("(1.000000) can0 123#R8", "remote", 0x123, ""),
    ("(1.000000) can0 18EF13E7##1DC0519150000000000000000", "fd", 0x18EF13E7, "DC0519150000000000000000"),
    (" (1.0)  can0  18EF13E7  [12]  DC 05 19 15 00 00 00 00 00 00 00 00", "fd", 0x18EF13E7, "DC0519150000000000000000"),
    (" (1.0)  can0  20000004   [8]  00 30 00 00 00 00 00 00   ERRORFRAME", "error", 0x04, "0030000000000000"),
    ("  can0  18EA13E7   [8]  remote request", "remote", 0x18EA13E7, ""),
]


@pytest.mark.parametrize(("line", "kind", "can_id", "data"), SPECIAL)
def test_error_remote_and_fd_frames_are_told_as_what_they_are(line: str, kind: str, can_id: int, data: str) -> None:
    frame = parse_candump_line(line)
    assert frame is not None
    told = FrameDecoder().decode(frame)
    assert (told["kind"], told["can_id"]) == (kind, can_id)
    assert told["data"] == data or not data
    assert told["name"] not in ("ACM", "AFM")
    assert {"error": "error", "remote": "remote", "fd": "CAN FD"}[kind] in text_of(told)


# -- live: a reader of python-can's messages, and the kernel's own structures


def kinds_of_a_live_bus(monkeypatch: pytest.MonkeyPatch, port: BusPort, frames_n: int) -> list[dict[str, Any]]:
    """What ``graderd can dump CHANNEL`` prints of the next frames."""
    monkeypatch.setattr(electrak_dump, "open_port", lambda *_, **__: port)
    live = read_live("can0")
    out = io.StringIO()
    dump(itertools.islice(live, frames_n), out, as_json=True)
    live.close()  # type: ignore[attr-defined]
    return [json.loads(line) for line in out.getvalue().splitlines()]


def test_live_remote_error_and_fd_frames_are_told_as_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = can.Bus(interface="virtual", channel="live")
    port = BusPort(can.Bus(interface="virtual", channel="live"))
    try:
        bus.send(message(FRAMES[0][1], 0.0))
        bus.send(can.Message(arbitration_id=0x18EA13E7, is_remote_frame=True, dlc=3))
        bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)))
        bus.send(can.Message(arbitration_id=0x18EF13E7, is_fd=True, data=bytes(range(12))))
        told = kinds_of_a_live_bus(monkeypatch, port, 4)
    finally:
        bus.shutdown()
    assert [each["kind"] for each in told] == ["data", "remote", "error", "fd"]
    assert told[0]["signals"] == ACM
    assert told[1]["name"] == "remote request for request"
    assert told[2]["signals"]["state"] == "bus_off"
    assert told[3]["data"] == bytes(range(12)).hex().upper()


def test_the_kernels_frames_are_told_as_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """``struct can_frame`` and ``canfd_frame`` as SocketCAN hands them out, through python-can's own reader of them."""
    ours, kernel = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS, as python-can asks for
    bus = SocketcanBus.__new__(SocketcanBus)
    bus.__dict__.update(socket=ours, channel="can0", _is_filtered=False, _filters=None, _is_shutdown=False)
    bus.__dict__.update(_bcm_sockets={}, _periodic_tasks=[], _task_id=0)
    monkeypatch.setattr(can_port, "_check_interface", lambda *_: None)
    monkeypatch.setattr(can_port, "SocketcanBus", lambda **_: bus)
    port = open_port(CanSettings(interface="socketcan", channel="can0"), fd=True)
    assert not ours.getsockopt(socket.SOL_SOCKET, 40), (
        "SO_RXQ_OVFL: python-can's reader takes no second control message"
    )
    classic, flexible = struct.Struct("=IB3x8s"), struct.Struct("=IBB2x64s")
    kernel.send(classic.pack(0x8000_0000 | 0x18EF1300, 8, FRAMES[0][1].data))
    kernel.send(classic.pack(0xC000_0000 | 0x18EA13E7, 3, b""))
    kernel.send(classic.pack(0x2000_0000 | 0x04, 8, bytes((0, 0x30, 0, 0, 0, 0, 128, 128))))
    kernel.send(flexible.pack(0x8000_0000 | 0x18EF13E7, 12, 1, bytes(range(12))))
    told = kinds_of_a_live_bus(monkeypatch, port, 4)
    kernel.close()
    assert [each["kind"] for each in told] == ["data", "remote", "error", "fd"]
    assert told[0]["signals"] == ACM
    assert told[2]["signals"] == {"errors": ["controller"], "state": "error_passive"}
    assert told[3]["data"] == bytes(range(12)).hex().upper()


def test_error_frames_say_what_is_wrong() -> None:
    told = {
        event: FrameDecoder().decode(frame)["signals"]
        for event in BusEvent
        if (frame := parse_candump_line(candump_line(event, 1.0))) is not None
    }
    assert told[BusEvent.BUS_OFF] == {"errors": ["bus_off"], "state": "bus_off"}
    assert told[BusEvent.ERROR_PASSIVE] == {"errors": ["controller"], "state": "error_passive"}
    assert told[BusEvent.REFUSED] == {"errors": ["transmit_timeout"]}
    assert len(told) == len(BusEvent)


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "csv", "log.gz", "asc.gz"])
def test_every_format_keeps_error_and_remote_frames_apart(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"trip.{suffix}"
    with can.Logger(path) as writer:
        writer.on_message_received(message(FRAMES[0][1], 1.0, channel=1, is_rx=True))
        writer.on_message_received(can.Message(1.1, 0x18EA13E7, is_remote_frame=True, channel=1, is_rx=True))
        writer.on_message_received(can.Message(1.2, 0x04, False, is_error_frame=True, channel=1, is_rx=True))
    assert [told["kind"] for told in dumped(path)] == ["data", "remote", "error"]


def test_broken_bytes_and_half_lines_cost_their_line_only(tmp_path: Path) -> None:
    path = tmp_path / "broken.log"
    good = candump_compact(0.0).encode()
    path.write_bytes(good + b"(1.0) can0 18E\xff\xfe#00\n" + b"\x00\x80\n(2.0) can0 18EF1300#DC0\n" + good)
    assert len(dumped(path)) == 2 * len(FRAMES)


# -- long messages that do not end as they should


def bam(source: int, destination: int = 255, control: int = 32) -> Frame:
    body = bytes((control, 20, 0, 3, 255, 0xEB, 0xFE, 0))
    return Frame(make_id(7, Pgn.TP_CONNECTION, source, destination), body)


def packet(n: int, source: int, destination: int = 255) -> Frame:
    return Frame(make_id(7, Pgn.TP_DATA, source, destination), bytes((n,)) + b"abcdefg")


def complete(decoder: FrameDecoder, frames: list[tuple[float, Frame]]) -> bool:
    return any("message" in decoded(frame, t_s, decoder)["signals"] for t_s, frame in frames)


def test_packets_a_minute_apart_are_no_message() -> None:
    frames = [(0.0, bam(40)), (0.1, packet(1, 40)), (60.0, packet(2, 40)), (60.1, packet(3, 40))]
    assert not complete(FrameDecoder(), frames)
    assert complete(FrameDecoder(), [(0.1 * n, frame) for n, (_, frame) in enumerate(frames)])


@pytest.mark.parametrize("by", [(40, 231), (231, 40)])
def test_an_aborted_connection_does_not_go_on(by: tuple[int, int]) -> None:
    abort = Frame(make_id(7, Pgn.TP_CONNECTION, *by), bytes((255, 3, 255, 255, 255, 0xEB, 0xFE, 0)))
    frames = [bam(40, 231, 16), packet(1, 40, 231), packet(2, 40, 231), packet(3, 40, 231)]
    assert complete(FrameDecoder(), [(0.1 * n, frame) for n, frame in enumerate(frames)])
    assert not complete(FrameDecoder(), [(0.1 * n, frame) for n, frame in enumerate([*frames[:2], abort, *frames[2:]])])


def test_packets_that_the_receiver_asks_for_again_are_put_in_their_place() -> None:
    again = Frame(make_id(7, Pgn.TP_CONNECTION, 231, 40), bytes((17, 2, 2, 255, 255, 0xEB, 0xFE, 0)))
    frames = [bam(40, 231, 16), packet(1, 40, 231), packet(2, 40, 231), again, packet(2, 40, 231), packet(3, 40, 231)]
    assert complete(FrameDecoder(), [(0.1 * n, frame) for n, frame in enumerate(frames)])


def test_sessions_left_open_block_nothing() -> None:
    decoder = FrameDecoder()
    for source in range(200):
        decoded(bam(source), 0.001 * source, decoder)
    assert complete(decoder, [(0.3, bam(220)), (0.4, packet(1, 220)), (0.5, packet(2, 220)), (0.6, packet(3, 220))])
    assert len(decoder._listener._sessions) <= 16


def test_the_command_line_writes_json_and_survives_a_closed_pipe(tmp_path: Path) -> None:
    path = tmp_path / "trip.log"
    path.write_text(candump_compact(0.0) * 3000)
    command = f"{sys.executable} -m graderd.drivers.electrak.dump {path} --json | head -n 2"
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["name"] for line in lines] == ["ACM", "AFM"]
    assert done.stderr == ""


def test_candump_text_on_standard_input_is_read_and_what_is_written_is_read_again() -> None:
    text = "# 2 lines lost: the reader is too slow\n" + "".join(f"{candump_line(f, t)}\n" for t, f in FRAMES)
    done = subprocess.run(
        [sys.executable, "-m", "graderd.drivers.electrak.dump", "-", "--json"],
        input=text, capture_output=True, text=True, check=True,
    )  # fmt: skip
    objects = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(o["t_s"], o["can_id"], o["data"]) for o in objects] == [
        (t, f.can_id, f.data.hex().upper()) for t, f in FRAMES
    ]
