"""graderd's J1939 beside cantools and python-can-j1939: codec, receive and send path, steadiness of the schedule.

``python benchmarks/j1939.py [--seconds N] [--json]``. The three are measured in one run on one machine; the period
measurement runs graderd and python-can-j1939 at the same time, each in a process and on an slcan adapter of its own,
with the same 800 frames a second coming in (run it on a machine that is otherwise quiet: the tail of the period error
is the machine's where its cores are taken). Exit status 1 where a bar is missed: ahead of python-can-j1939 everywhere,
and no more than a fifth behind bare cantools as a codec.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import itertools
import json
import multiprocessing
import multiprocessing.process
import multiprocessing.queues
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graderd.drivers.electrak.codec import Control, ElectrakCodec, load_database
from graderd.drivers.j1939.can_port import BusPort, SlcanPort
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.drivers.j1939.link import CanLink
from graderd.drivers.j1939.slcan_bus import QuietSlcanBus
from graderd.hal.settings import CanSettings
from graderd.simulator.actuators.slcan import SlcanAdapter
from graderd.simulator.actuators.wire import Wire

# Run as a script, this file's folder leads the search path and this file is called as the peer is.
sys.path[:] = [entry for entry in sys.path if not entry.endswith("benchmarks")]
j1939 = importlib.import_module("j1939")

AFM_ID, ACM_ID = 0x19EFFF13, 0x18EF13E7
AFM = bytes.fromhex("1F870705C9FFFFFF")
LOAD_HZ = 800
"""Frames a second that arrive during the period measurement: half of what 250 kbit/s can carry."""
LOAD_BURST_N = 4
Measured = dict[str, float]


def rate(call: Callable[[], object], seconds: float) -> Measured:
    """Calls a second of wall time and CPU microseconds a call, the best of three rounds."""
    best: Measured = {"per_s": 0.0, "cpu_us": 0.0}
    for _ in range(3):
        calls_n, start_s, cpu_s = 0, time.perf_counter(), time.process_time()
        while time.perf_counter() - start_s < seconds / 3:
            for _ in range(200):
                call()
            calls_n += 200
        per_s = calls_n / (time.perf_counter() - start_s)
        if per_s > best["per_s"]:
            best = {"per_s": per_s, "cpu_us": 1e6 * (time.process_time() - cpu_s) / calls_n}
    return best


class NullPort(BusPort):
    """Takes every frame and sends it nowhere."""

    def __init__(self) -> None:
        self.sent_n = 0

    def send(self, _frame: Frame) -> None:
        self.sent_n += 1


class Axis:
    """What the link wants of an actuator, reduced to the codec."""

    address = 0x13
    feedback_pgn = Pgn.PROPRIETARY_A2

    def __init__(self) -> None:
        self._codec = ElectrakCodec("electrak_hd")
        self._control = Control(150.0, 18.0, 80.0, motion_enable=True)
        self.heard_n = 0

    def control_frame(self, source: int, _now_s: float) -> Frame:
        return Frame(make_id(6, Pgn.PROPRIETARY_A, source, self.address), self._codec.encode_control(self._control))

    def stop_frame(self, source: int, now_s: float) -> Frame | None: ...

    def on_feedback(self, data: bytes, _now_s: float) -> None:
        self._codec.decode_feedback(data)
        self.heard_n += 1

    def on_claim(self, name: int, solicited: bool, now_s: float) -> None: ...

    def on_link_lost(self, now_s: float) -> None: ...

    def hold(self) -> None: ...


def measure_codec(seconds: float) -> dict[str, dict[str, Measured]]:
    """Eight bytes to values and back: ours, cantools, and python-can-j1939 with cantools (it has no codec)."""
    codec, database = ElectrakCodec("electrak_hd"), load_database("electrak_hd")
    afm, acm = database.get_message_by_name("AFM"), database.get_message_by_name("ACM")
    control = Control(150.0, 18.0, 80.0, motion_enable=True)
    values = {
        "target_position_mm": 150.0,
        "current_limit_a": 18.0,
        "speed_percent": 80,
        "motion_enable": 1,
        "factory_use": 0,
    }
    return {
        "decode, codec alone": {
            "graderd": rate(lambda: codec.decode_feedback(AFM), seconds),
            "cantools": rate(lambda: afm.decode(AFM, decode_choices=False), seconds),
        },
        "encode, codec alone": {
            "graderd": rate(lambda: codec.encode_control(control), seconds),
            "cantools": rate(lambda: acm.encode(values, strict=False), seconds),
        },
    }


def measure_path(seconds: float) -> dict[str, dict[str, Measured]]:
    """A frame from the bus to values at the subscriber, and values to a frame handed to the bus."""
    axis = Axis()
    link = CanLink(CanSettings(interface="virtual", source_address_n=0x10))
    link.attach(axis)
    link._port = NullPort()
    link.node.start(0.0)
    link.node.take()
    frame = Frame(AFM_ID, AFM)

    database = load_database("electrak_hd")
    afm, acm = database.get_message_by_name("AFM"), database.get_message_by_name("ACM")
    values = {
        "target_position_mm": 150.0,
        "current_limit_a": 18.0,
        "speed_percent": 80,
        "motion_enable": 1,
        "factory_use": 0,
    }
    ecu = j1939.ElectronicControlUnit(send_message=lambda *_: None)
    peer = j1939.ControllerApplication(j1939.Name(identity_number=1), 0x10, bypass_address_claim=True)
    ecu.add_ca(controller_application=peer)
    peer.start()

    def on_message(_priority: int, _pgn: int, _sa: int, _timestamp: float, data: bytes) -> None:
        afm.decode(bytes(data), decode_choices=False)

    peer.subscribe(on_message)
    try:
        return {
            "receive: frame to values": {
                "graderd": rate(lambda: link._on_frame(frame, 0.0), seconds),
                "python-can-j1939": rate(lambda: ecu.notify(AFM_ID, bytearray(AFM), 0.0), seconds),
            },
            "send: values to frame": {
                "graderd": rate(lambda: link.send_control(axis), seconds),
                "python-can-j1939": rate(
                    lambda: peer.send_pgn(0, 0xEF, 0x13, 6, list(acm.encode(values, strict=False))), seconds
                ),
            },
        }
    finally:
        peer.stop()
        ecu.stop()


class Adapter:
    """An slcan adapter under load."""

    def __init__(self, folder: Path, name: str) -> None:
        self.link = folder / name
        self._wire = Wire()
        self._adapter = SlcanAdapter(self._wire, self.link)

    def plug(self) -> None:
        self._adapter.plug()

    def unplug(self) -> None:
        self._adapter.unplug()

    def load(self, index: int) -> None:
        """One feedback message of one of eight nodes."""
        self._wire.send(Frame(AFM_ID & ~0xFF | 0x13 + index % 8, AFM))


def ours_main(channel: str, seconds: float, out: multiprocessing.queues.Queue[Any]) -> None:
    """One process: graderd's link on the adapter."""

    stamps_s: list[float] = []

    class StampedPort(SlcanPort):
        def send(self, frame: Frame) -> None:
            super().send(frame)
            if frame.can_id & 0x3FFFF00 == 0xEF1300:
                stamps_s.append(time.perf_counter())

    async def run() -> None:
        link = CanLink(
            CanSettings(interface="slcan", channel=channel, source_address_n=0x10),
            bus_factory=lambda: StampedPort(QuietSlcanBus(channel, 250_000)),
        )
        axis = Axis()
        link.attach(axis)
        await link.open()
        await asyncio.sleep(seconds)
        link.detach(axis)  # without the farewell messages
        await link.close()

    cpu_s = time.process_time()
    asyncio.run(run())
    out.put(("graderd", stamps_s, time.process_time() - cpu_s))


def theirs_main(channel: str, seconds: float, out: multiprocessing.queues.Queue[Any]) -> None:
    """One process: python-can-j1939 on python-can's slcan, with its cyclic timer."""
    codec = ElectrakCodec("electrak_hd")
    data = list(codec.encode_control(Control(150.0, 18.0, 80.0, motion_enable=True)))
    cpu_s = time.process_time()
    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface="slcan", channel=channel, bitrate=250000, sleep_after_open=0.0)
    peer = j1939.ControllerApplication(j1939.Name(identity_number=1), 0x10, bypass_address_claim=True)
    ecu.add_ca(controller_application=peer)
    peer.start()
    peer.subscribe(lambda _priority, _pgn, _sa, _time, received: codec.decode_feedback(bytes(received)))

    stamps_s: list[float] = []

    def send(_cookie: object) -> bool:
        peer.send_pgn(0, 0xEF, 0x13, 6, data)
        stamps_s.append(time.perf_counter())
        return True

    peer.add_timer(0.1, send)
    time.sleep(seconds)
    out.put(("python-can-j1939", stamps_s, time.process_time() - cpu_s))
    peer.stop()
    ecu.stop()
    ecu.disconnect()


async def feed(adapters: list[Adapter], processes: list[multiprocessing.process.BaseProcess]) -> None:
    """Load both adapters until both processes ended."""
    loop = asyncio.get_running_loop()
    for adapter in adapters:
        adapter.plug()
    for process in processes:
        process.start()
    index, due_s = 0, loop.time()
    while any(process.is_alive() for process in processes):
        for adapter in adapters:
            for _ in range(LOAD_BURST_N):
                index += 1
                adapter.load(index)
        due_s = max(due_s + LOAD_BURST_N / LOAD_HZ, loop.time() - 0.02)
        await asyncio.sleep(max(0.0, due_s - loop.time()))
    for adapter in adapters:
        adapter.unplug()


def measure_period(seconds: float) -> dict[str, Measured]:
    """Error of the 100 ms control period of both, at the same time, in a process each, on an adapter each."""
    context = multiprocessing.get_context("spawn")
    out: multiprocessing.queues.Queue[Any] = context.Queue()
    with tempfile.TemporaryDirectory() as folder:
        adapters = {name: Adapter(Path(folder), name) for name in ("graderd", "python-can-j1939")}
        mains = {"graderd": ours_main, "python-can-j1939": theirs_main}
        processes: list[multiprocessing.process.BaseProcess] = [
            context.Process(target=mains[name], args=(str(adapter.link), seconds, out))
            for name, adapter in adapters.items()
        ]
        asyncio.run(feed(list(adapters.values()), processes))
    found: dict[str, Measured] = {}
    for _ in processes:
        name, stamps_s, cpu_s = out.get(timeout=10)
        gaps_s = [b - a for a, b in itertools.pairwise(stamps_s[3:])]
        errors_ms = sorted(1e3 * abs(gap - 0.1) for gap in gaps_s)
        found[name] = {
            "mean_period_ms": 1e3 * statistics.fmean(gaps_s),
            "error_p50_ms": errors_ms[len(errors_ms) // 2],
            "error_p99_ms": errors_ms[min(len(errors_ms) - 1, int(0.99 * len(errors_ms)))],
            "error_max_ms": errors_ms[-1],
            "cpu_percent": 100 * cpu_s / seconds,
            "messages_n": float(len(stamps_s)),
        }
    return found


def judge(rates: dict[str, dict[str, Measured]], period: dict[str, Measured]) -> list[str]:
    """The bars that are missed."""
    missed = []
    for name, by_whom in rates.items():
        ours = by_whom["graderd"]
        for other, theirs in by_whom.items():
            share = 0.8 if other == "cantools" else 1.0
            if other != "graderd" and (
                ours["per_s"] < share * theirs["per_s"] or ours["cpu_us"] > theirs["cpu_us"] / share
            ):
                missed.append(f"{name}: behind {other}")
    for figure in ("error_p99_ms", "cpu_percent"):
        if period["graderd"][figure] > period["python-can-j1939"][figure]:
            missed.append(f"period {figure}: behind python-can-j1939")
    return missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the period measurement")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    arguments = parser.parse_args()
    rates = measure_codec(1.5) | measure_path(1.5)
    period = measure_period(arguments.seconds)
    missed = judge(rates, period)
    if arguments.json:
        print(json.dumps({"rates": rates, "period": period, "missed": missed}))
        return 1 if missed else 0
    for name, by_whom in rates.items():
        for who, measured in by_whom.items():
            print(f"{name:<26} {who:<10} {measured['per_s']:>10,.0f} /s {measured['cpu_us']:>8.2f} us CPU each")
    for who, figures in period.items():
        print(f"{'100 ms period, loaded':<26} {who:<10} " + "  ".join(f"{k} {v:.3f}" for k, v in figures.items()))
    print("missed: " + "; ".join(missed) if missed else "every bar is met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
