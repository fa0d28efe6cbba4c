"""``python -m drivers.electrak.dump``: the bus in words, live or from a log, one line or one JSON object a frame.

A serial adapter has one reader: while the daemon has it, the frames come from the daemon (``graderd can dump``).
"""

from __future__ import annotations

import argparse
import json
import select
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, TextIO

import can

from drivers.electrak.bus_events import BusEvent
from drivers.electrak.candump import Timed, parse_candump
from drivers.electrak.decode import DecodedFrame, FrameDecoder
from drivers.electrak.j1939.ids import Frame
from drivers.electrak.ports import PortLostError, open_port
from graderd.hal.clock import SystemClock
from graderd.hal.errors import DeviceError, DeviceLostError, ProtocolError
from graderd.hal.settings import CanSettings

_READERS: Final[dict[str, tuple[Callable[[Any], Iterable[can.Message]], str]]] = {
    ".asc": (can.ASCReader, "r"),
    ".blf": (can.BLFReader, "rb"),
    ".mf4": (can.MF4Reader, "rb"),
    ".trc": (can.TRCReader, "r"),
    ".csv": (can.CSVReader, "r"),
}
"""Log formats read by python-can, by file name; every other file is taken for candump text."""


def read_file(path: Path) -> Iterator[Timed]:
    """Frames of a candump, ASC, BLF or MF4 log with their times in seconds.

    Raises:
        ProtocolError: the file cannot be read as such a log.
    """
    if path.suffix.lower() not in _READERS:
        yield from _read_candump(path)
        return
    make_reader, mode = _READERS[path.suffix.lower()]
    try:
        with path.open(mode) as file:  # opened here, because some readers leave a damaged file open
            for message in make_reader(file):
                if not (message.is_error_frame or message.is_remote_frame):
                    yield message.timestamp, Frame(message.arbitration_id, bytes(message.data), message.is_extended_id)
    except OSError:
        raise
    except Exception as error:  # each format's reader has its own ways to fail on a damaged file
        raise ProtocolError(
            str(path), f"cannot be read: {error}", "Is it a log of this format, and complete?"
        ) from error


def _read_candump(path: Path) -> Iterator[Timed]:
    found = False
    with path.open(encoding="ascii", errors="replace") as lines:
        for timed in parse_candump(lines):
            found = True
            yield timed
    if not found:
        formats = "candump text, or .asc, .blf, .mf4"
        raise ProtocolError(str(path), "holds no CAN frame in candump's form", f"Known formats: {formats}")


def read_live(channel: str) -> Iterator[Timed]:
    """Frames of a live bus for ever: a serial port or link is opened as slcan, anything else as SocketCAN.

    Raises:
        DeviceMissingError: it cannot be opened.
        DeviceLostError: it was lost.
    """
    is_port = "/" in channel
    settings = CanSettings(interface="slcan" if is_port else "socketcan", channel=channel)
    clock = SystemClock()
    port = open_port(settings)
    try:
        while True:
            if not port.pending:
                select.select([port.fileno()], [], [])
            for item in port.read():
                if not isinstance(item, BusEvent):
                    yield clock.now_s(), item
    except PortLostError as error:
        raise DeviceLostError(f"CAN {channel}", f"{error.condition}: {error.detail}") from error
    finally:
        port.close()


def text_of(decoded: DecodedFrame) -> str:
    """One line for people."""
    head = f"{decoded['t_s']:17.6f}  {decoded['can_id']:08X}"
    if decoded["pgn"] is None:
        return f"{head}  {decoded['data']}"
    route = f"{decoded['source']:3d} > {decoded['destination']:3d}"
    signals = " ".join(f"{key}={value}" for key, value in decoded["signals"].items())
    return f"{head}  {route}  {decoded['name']:<18} {signals or decoded['data']}"


def dump(frames: Iterator[Timed], out: TextIO, *, as_json: bool) -> None:
    """Write every frame, decoded."""
    decoder = FrameDecoder()
    for t_s, frame in frames:
        decoded = decoder.decode(frame, t_s)
        out.write((json.dumps(decoded) if as_json else text_of(decoded)) + "\n")
        out.flush()


def main(argv: list[str] | None = None) -> int:
    """Exit status 1 where the source cannot be read."""
    parser = argparse.ArgumentParser(
        prog="python -m drivers.electrak.dump",
        description="Print a CAN bus decoded, live or from a candump, ASC, BLF or MF4 file.",
        epilog="examples: dump can0 | dump /dev/graderd/can | dump trip.log --json | candump -L can0 | dump -",
    )
    parser.add_argument(
        "source", nargs="?", default="can0", help="CAN interface, slcan port, log file, or - for candump text"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a frame")
    arguments = parser.parse_args(argv)
    path = Path(arguments.source)
    try:
        is_file = path.is_file()
        if not is_file and path.suffix and not path.exists():
            raise ProtocolError(str(path), "no such file")
        if arguments.source == "-":
            frames = parse_candump(sys.stdin)
        else:
            frames = read_file(path) if is_file else read_live(arguments.source)
        dump(frames, sys.stdout, as_json=arguments.json)
    except (BrokenPipeError, KeyboardInterrupt):
        sys.stderr.close()  # the reader is gone, and Python would complain about it at exit
    except (DeviceError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
