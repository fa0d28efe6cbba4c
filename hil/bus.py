"""CAN interfaces, raw and J1939 sockets of the running kernel, as the tests use them."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

MODULES: Final = ("can", "can-raw", "can-j1939", "can-gw", "vcan", "slcan")
EXTENDED: Final = 0x8000_0000
ERROR: Final = 0x2000_0000
ADDRESS_CLAIMED: Final = 0xEE00
REQUEST: Final = 0xEA00
GLOBAL: Final = 0xFF
IDLE: Final = 0xFE
_FRAME: Final = struct.Struct("=IB3x8s")
# <linux/can/raw.h> and <linux/can/j1939.h>; Python's socket module does not name them.
CAN_RAW_ERR_FILTER: Final = 2
SO_J1939_PROMISC: Final = 2


class Frame(NamedTuple):
    """One frame: identifier without flags, data, and whether it is an error frame."""

    can_id: int
    data: bytes
    is_error: bool = False

    @property
    def source(self) -> int:
        """J1939 source address."""
        return self.can_id & 0xFF

    @property
    def pgn(self) -> int:
        """J1939 parameter group; the destination byte of PDU1 is masked."""
        number = (self.can_id >> 8) & 0x3FFFF
        return number & 0x3FF00 if (number >> 8) & 0xFF < 240 else number


def ip(*arguments: str) -> str:
    """Run ``ip``; its output.

    Raises:
        RuntimeError: it failed, with what it said.
    """
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


def load_modules() -> None:
    """Load the kernel's CAN modules where they are not built in; harmless where they are there."""
    subprocess.run(["modprobe", "-a", *MODULES], capture_output=True, check=False)


def can_make_vcan() -> bool:
    """Whether the running kernel gives us a virtual CAN interface (needs root and the module)."""
    load_modules()
    try:
        ip("link", "add", "hil-probe", "type", "vcan")
        ip("link", "del", "hil-probe")
    except (RuntimeError, FileNotFoundError):
        return False
    return True


def interface_exists(name: str) -> bool:
    """Whether there is a network interface of that name."""
    return Path("/sys/class/net", name).exists()


def details(name: str) -> dict[str, object]:
    """State, bit rate and error counters of a CAN interface, as the kernel tells them."""
    found: dict[str, object] = json.loads(ip("-json", "-details", "-statistics", "link", "show", name))[0]["linkinfo"]
    return found


class RawBus:
    """A raw CAN socket on one interface (empty name: on all), with error frames."""

    def __init__(self, interface: str, *, only_errors: bool = False) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, struct.pack("=I", 0x1FFFFFFF))
        if only_errors:
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.bind((interface,))

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()

    def send(self, can_id: int, data: bytes = b"") -> None:
        """Send one extended frame."""
        self._socket.send(_FRAME.pack(can_id | EXTENDED, len(data), data))

    def receive(self, timeout_s: float) -> Frame | None:
        """The next frame, or None after ``timeout_s``."""
        self._socket.settimeout(max(timeout_s, 1e-3))
        try:
            can_id, length, data = _FRAME.unpack(self._socket.recv(_FRAME.size))
        except TimeoutError:
            return None
        return Frame(can_id & 0x1FFFFFFF, data[:length], bool(can_id & ERROR))

    def frames(self, seconds: float) -> Iterator[Frame]:
        """All frames that come within ``seconds``."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            frame = self.receive(left_s)
            if frame is not None:
                yield frame

    def drain(self) -> list[Frame]:
        """What has come already."""
        found = []
        while (frame := self.receive(0.0)) is not None:
            found.append(frame)
        return found


@dataclass(frozen=True, slots=True)
class Received:
    """A J1939 message the kernel has put together."""

    data: bytes
    pgn: int
    source: int
    name: int


class KernelNode:
    """A node on the kernel's own J1939 stack: with ``name``, one that claims its address; else at a fixed address."""

    def __init__(self, interface: str, address: int, *, name: int = 0, promiscuous: bool = False) -> None:
        self.interface = interface
        self.address = address
        self.name = name
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        if promiscuous:
            self._socket.setsockopt(socket.SOL_CAN_BASE + socket.CAN_J1939, SO_J1939_PROMISC, 1)
        self._socket.bind((interface, name or socket.J1939_NO_NAME, socket.J1939_NO_PGN, address))

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()

    def claim(self) -> None:
        """Put our claim on the bus; J1939-81 gives others 250 ms to object."""
        self.send(ADDRESS_CLAIMED, self.name.to_bytes(8, "little"))

    def send(self, pgn: int, data: bytes, destination: int = GLOBAL, timeout_s: float = 5.0) -> None:
        """Send a message of any length; the kernel chooses transport protocol above 8 bytes.

        Raises:
            OSError: EADDRNOTAVAIL while the address is not ours; others as the kernel says.
        """
        self._socket.settimeout(timeout_s)
        self._socket.sendto(data, (self.interface, socket.J1939_NO_NAME, pgn, destination))

    def request(self, pgn: int, destination: int = GLOBAL) -> None:
        """Ask for a parameter group."""
        self.send(REQUEST, pgn.to_bytes(3, "little"), destination)

    def receive(self, timeout_s: float, *, pgn: int | None = None, source: int | None = None) -> Received | None:
        """The next message (of that group, from that address), or None after ``timeout_s``."""
        until_s = time.monotonic() + timeout_s
        while (left_s := until_s - time.monotonic()) > 0:
            self._socket.settimeout(left_s)
            try:
                data, _, _, address = self._socket.recvmsg(4096)
            except TimeoutError:
                return None
            _, name, got_pgn, got_source = address
            if pgn in (None, got_pgn) and source in (None, got_source):
                return Received(data, got_pgn, got_source, name)
        return None


def daemons_claim(listener: RawBus, timeout_s: float = 3.0) -> tuple[int, int]:
    """Address and NAME of the next claim that is the daemon's (industry group 3: construction).

    Raises:
        AssertionError: none came in time.
    """
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        frame = listener.receive(0.2)
        if frame is not None and frame.pgn == ADDRESS_CLAIMED and len(frame.data) == 8:
            name = int.from_bytes(frame.data, "little")
            if (name >> 60) & 7 == 3:
                return frame.source, name
    raise AssertionError(f"no claim of the daemon within {timeout_s:g} s")


def couple(one: str, other: str) -> None:
    """Let every frame of one interface appear on the other, by the kernel's CAN gateway; ends with either of them."""
    for source, destination in ((one, other), (other, one)):
        subprocess.run(["cangw", "-A", "-s", source, "-d", destination, "-e"], check=True)


def add_vcan(name: str, *, fd: bool = False) -> None:
    """Make a virtual CAN interface, or take the one of that name, and set it up. ``fd``: it carries CAN FD frames."""
    if not interface_exists(name):
        ip("link", "add", "dev", name, "type", "vcan")
    if fd:
        ip("link", "set", name, "mtu", "72")
    ip("link", "set", name, "txqueuelen", "1000", "up")


def remove_vcan(name: str) -> None:
    """Take a virtual CAN interface away; none is fine."""
    if interface_exists(name):
        # Linux before 6.1.192 waits here for as long as somebody has a J1939 socket open on it, and cannot be killed.
        # The thread waits on where we do not, so that the process is reaped whenever the kernel lets it go.
        command = ["ip", "link", "del", name]
        remove = threading.Thread(target=subprocess.run, args=(command,), name=f"remove {name}", daemon=True)
        remove.start()
        remove.join(5.0)
