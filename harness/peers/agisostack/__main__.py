"""AgIsoStack++ beside graderd on one bus: ``python -m harness.peers.agisostack [--source FOLDER] [--build FOLDER]``.

Fetches its pinned commit (git holds the content against the commit's id), compiles ``peer.cpp`` with it, and lets it
claim, ask, send and contend against :class:`CanLink` and two virtual Electraks, each with an slcan adapter of its own
on one wire. By hand, not in CI: it compiles for some minutes. Needs git, cmake and a C++17 compiler.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

from graderd.drivers.electrak import CanLink, ElectrakActuator
from graderd.drivers.j1939.ids import Pgn
from graderd.drivers.j1939.transport import Message
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.settings import CanSettings, ElectrakSettings
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from graderd.simulator.actuators.slcan import SlcanAdapter

HERE = Path(__file__).parent
REPOSITORY = "https://github.com/Open-Agriculture/AgIsoStack-plus-plus.git"
COMMIT = "509a920cadff634612e8972158e1c293c9f372c7"
TIMEOUT_S = 10.0
OURS, PEERS = 231, 38
LONG_N = 100
Event = dict[str, Any]


def fetched(folder: Path) -> Path:
    """The library's source at the pinned commit."""
    if not (folder / "CMakeLists.txt").exists():
        folder.mkdir(parents=True, exist_ok=True)
        for command in (
            ("init", "--quiet"),
            ("fetch", "--quiet", "--depth", "1", REPOSITORY, COMMIT),
            ("checkout", "--quiet", "FETCH_HEAD"),
        ):
            subprocess.run(["git", *command], cwd=folder, check=True)
    return folder


def compiled(source: Path, build: Path) -> Path:
    """The peer's program."""
    configure = ["cmake", "-S", str(HERE), "-B", str(build), "-DCMAKE_BUILD_TYPE=Release"]
    subprocess.run([*configure, f"-DAGISOSTACK_SOURCE={source.resolve()}"], check=True)
    subprocess.run(["cmake", "--build", str(build), "--target", "peer"], check=True)
    return build / "peer"


class Peer:
    """The running program: what it said, and a way to tell it what to do."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.said: list[Event] = []
        self._process = process
        self._news = asyncio.Event()
        self._reader = asyncio.create_task(self._read())

    async def _read(self) -> None:
        assert self._process.stdout is not None
        while line := await self._process.stdout.readline():
            if line.startswith(b"{"):
                self.said.append(json.loads(line))
                self._news.set()

    async def seen(self, what: str, met: Callable[[Event], bool], since_n: int = 0) -> Event:
        """The first thing it said since that meets ``met``."""
        async with asyncio.timeout(TIMEOUT_S):
            while True:
                for event in self.said[since_n:]:
                    if met(event):
                        sys.stdout.write(f"seen: {what}: {json.dumps(event)}\n")
                        return event
                self._news.clear()
                await self._news.wait()

    async def tell(self, command: str) -> int:
        """Have it do something; returns how much it had said before."""
        assert self._process.stdin is not None
        before_n = len(self.said)
        self._process.stdin.write(command.encode() + b"\n")
        await self.seen(command, lambda e: e.get("command") == command and e["ok"], before_n)
        return before_n

    async def end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        await self._process.wait()
        await self._reader


def message(pgn: int, source: int, text: bytes = b"") -> Callable[[Event], bool]:
    """Whether an event is that message from that address, with that in it."""
    wanted = text.hex().upper()
    return lambda e: (e["event"], e.get("pgn"), e.get("from")) == ("message", pgn, source) and wanted in e["data"]


async def until(what: str, met: Callable[[], object]) -> None:
    async with asyncio.timeout(TIMEOUT_S):
        while not met():
            await asyncio.sleep(0.01)
    sys.stdout.write(f"seen: {what}\n")


async def beside(program: Path, folder: Path) -> None:
    """Everything that the two show each other; a ``TimeoutError`` where one of it does not come."""
    units = [VirtualElectrak(seed=1), VirtualElectrak(address=20, seed=2, identity=2)]
    bus = VirtualActuatorBus(units, link=folder / "ours")
    adapter = SlcanAdapter(bus.wire, folder / "theirs")
    async with AsyncExitStack() as stack:
        await bus.start()
        stack.push_async_callback(bus.close)
        adapter.plug()
        stack.callback(adapter.unplug)
        link = CanLink(CanSettings(interface="slcan", channel=str(folder / "ours")), software="graderd peer test")
        long_ones: list[Message] = []
        link.tap_messages(lambda m, _: long_ones.append(m) if len(m.data) == LONG_N else None)
        axis = ElectrakActuator("lift_left", ElectrakSettings(), link)
        await axis.open()
        stack.push_async_callback(link.close)
        stack.push_async_callback(axis.close)

        pipes: dict[str, Any] = {"stdin": asyncio.subprocess.PIPE, "stdout": asyncio.subprocess.PIPE}
        process = await asyncio.create_subprocess_exec(str(program), str(folder / "theirs"), str(PEERS), **pipes)
        peer = Peer(process)
        stack.push_async_callback(peer.end)
        addresses = {"own": PEERS, "graderd": OURS}
        await peer.seen("both addresses claimed", lambda e: addresses.items() <= e.items())

        since_n = await peer.tell(f"request {Pgn.SOFTWARE_ID}")
        await peer.seen("software id, in a transport session", message(Pgn.SOFTWARE_ID, OURS, b"graderd"), since_n)
        since_n = await peer.tell(f"request {Pgn.DM1}")
        await peer.seen("an answer to a request for DM1", message(Pgn.DM1, OURS), since_n)
        since_n = await peer.tell("request 61000")
        await peer.seen("not acknowledged: what graderd has not", message(Pgn.ACKNOWLEDGEMENT, OURS), since_n)
        await peer.tell(f"send {LONG_N}")
        await until(f"{LONG_N} bytes whole here", lambda: long_ones)
        assert long_ones[0].data == bytes(range(LONG_N))
        since_n = len(peer.said)
        link.publish_faults([DeviceFault("rotation", c, "", 0.0) for c in ("no_reply", "turns_lost")])
        dm1 = message(Pgn.DM1, OURS)
        await peer.seen("two codes as DM1, broadcast", lambda e: dm1(e) and len(e["data"]) == 2 * (2 + 2 * 4), since_n)

        await axis.arm()
        since_n = len(peer.said)
        moves = asyncio.create_task(drive(axis))
        control = {"event": "control", "from": OURS, "to": 19}
        await peer.seen("an actuator enabled", lambda e: {**control, "enable": 1}.items() <= e.items(), since_n)
        since_n = await peer.tell(f"rival {OURS}")
        disabled = {**control, "enable": 0}
        await peer.seen("disabled when the address is lost", lambda e: disabled.items() <= e.items(), since_n)
        moves.cancel()
        await asyncio.gather(moves, return_exceptions=True)
        await until("it stands", lambda: units[0].velocity_mm_per_s == 0)
        await until("graderd claims another address", lambda: link.address not in (None, OURS))
        claim = {"event": "claim", "from": link.address}
        await peer.seen("and its claim is heard", lambda e: claim.items() <= e.items(), since_n)


async def drive(axis: ElectrakActuator) -> None:
    """As the control tick does."""
    while axis.lifecycle is Lifecycle.ACTIVE:
        axis.set_target_mm(180.0)
        await asyncio.sleep(0.02)


def main() -> int:
    parser = argparse.ArgumentParser(prog="harness.peers.agisostack", description=__doc__)
    parser.add_argument("--source", type=Path, help="AgIsoStack++ that is here already")
    parser.add_argument("--build", type=Path, default=Path("var/peers/agisostack"), help="what is fetched and compiled")
    options = parser.parse_args()
    source = options.source or fetched(options.build / "source")
    program = compiled(source, options.build / "program")
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(beside(program, Path(folder)))
    sys.stdout.write(f"AgIsoStack++ {COMMIT[:8]} and graderd understand each other\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
