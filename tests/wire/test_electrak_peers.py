"""Both sides of the CAN wire against what we did not write: python-can, cantools, python-can-j1939, the kernel."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cantools.database
import j1939
import pytest

import graderd.firmware_profiles
from graderd.drivers.electrak import CanLink, ElectrakActuator, safe_off
from graderd.drivers.j1939.ids import Pgn
from graderd.drivers.j1939.python_can import can
from graderd.drivers.j1939.transport import Message
from graderd.hal.errors import DeviceMissingError
from graderd.hal.settings import CanSettings, ElectrakSettings
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from harness.electrak_sim import until

DBC = Path(next(iter(graderd.firmware_profiles.__path__))) / "electrak_hd.dbc"


@pytest.fixture
async def machine(tmp_path: Path) -> AsyncIterator[VirtualActuatorBus]:
    bus = VirtualActuatorBus([VirtualElectrak(seed=4), VirtualElectrak(address=20, seed=4)], link=tmp_path / "can")
    await bus.start()
    yield bus
    await bus.close()


async def in_thread(call: Any, *arguments: Any) -> Any:
    return await asyncio.to_thread(call, *arguments)


async def test_python_cans_own_slcan_and_cantools_with_our_dbc_read_the_virtual_actuator(
    machine: VirtualActuatorBus, tmp_path: Path
) -> None:
    database = cantools.database.load_file(DBC)

    def peer() -> list[dict[str, Any]]:
        seen: list[dict[str, Any]] = []
        with can.Bus(
            interface="slcan", channel=str(tmp_path / "can"), bitrate=250000, sleep_after_open=0.0
        ) as bus, can.Logger(str(tmp_path / "log.asc")) as logger:  # fmt: skip
            for _ in range(20):
                acm = bytes.fromhex("00800C0200000000")
                bus.send(can.Message(arbitration_id=0x18EF1300, data=acm, is_extended_id=True))
                message = bus.recv(0.1)
                if message is not None:
                    logger.on_message_received(message)
                    if message.arbitration_id == 0x19EFFF13:
                        seen.append(database.decode_message("AFM", message.data))
        return seen

    seen = await in_thread(peer)
    assert len(seen) >= 5
    assert all(abs(float(s["position_mm"]) - 100.0) < 0.2 for s in seen)
    assert str(seen[0]["voltage_error"]) == "in_range"
    logged = [m for m in can.LogReader(tmp_path / "log.asc") if m.arbitration_id == 0x19EFFF13]
    assert len(logged) == len(seen)


async def test_our_driver_drives_an_actuator_and_cantools_reads_what_we_send(
    machine: VirtualActuatorBus, tmp_path: Path
) -> None:
    database = cantools.database.load_file(DBC)
    heard: list[dict[str, Any]] = []
    machine.listen(lambda f: heard.append(database.decode_message("ACM", f.data)) if f.can_id == 0x18EF13E7 else None)
    link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
    axis = ElectrakActuator("lift_left", ElectrakSettings(), link)
    await axis.open()
    await axis.arm()
    for _ in range(25):
        axis.set_target_mm(112.0)
        await asyncio.sleep(0.02)
    await axis.close()
    await link.close()
    async with asyncio.timeout(5.0):  # what was sent last is on its way through the pseudo-terminal
        while heard[-1]["motion_enable"]:
            await asyncio.sleep(0.005)
    moving = [h for h in heard if h["motion_enable"]]
    assert len(moving) >= 3
    assert all(h["speed_percent"] == 80 and h["current_limit_a"] == 18.0 for h in moving)
    assert moving[-1]["target_position_mm"] == pytest.approx(113.1, abs=0.1), "target plus approach bias"


async def test_safe_off_stops_a_moving_actuator_from_another_process(
    machine: VirtualActuatorBus, tmp_path: Path
) -> None:
    settings = CanSettings(interface="slcan", channel=str(tmp_path / "can"))
    unit = machine.actuators[0]
    start = can.Message(arbitration_id=0x18EF1300, data=bytes.fromhex("B80B2D1A00000000"), is_extended_id=True)

    def peer() -> None:
        with can.Bus(interface="slcan", channel=settings.channel, bitrate=250000, sleep_after_open=0.0) as bus:
            for _ in range(10):
                bus.send(start)
                bus.recv(0.1)

    await in_thread(peer)
    assert unit.velocity_mm_per_s > 10
    assert await in_thread(safe_off, settings, (19, 20)) == 8
    await until(lambda: unit.velocity_mm_per_s == 0)
    assert not unit.received_control[-1].motion_enable


def test_safe_off_on_a_missing_bus_says_so(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissingError):
        safe_off(CanSettings(interface="slcan", channel=str(tmp_path / "none")), (19,))


async def test_python_can_j1939_claims_requests_and_sends_long_messages_beside_us(tmp_path: Path) -> None:
    """python-can-j1939 as a neighbour: it sees our claim, we keep our address, transport protocol works both ways."""
    channel = f"neighbour-{os.getpid()}-{tmp_path.name}"
    link = CanLink(CanSettings(interface="virtual", channel=channel), software="graderd test")
    long_messages: list[Message] = []
    link.tap_messages(lambda m, _: long_messages.append(m) if len(m.data) > 8 else None)
    received: list[tuple[int, bytes]] = []

    def on_message(priority: int, pgn: int, sa: int, timestamp: float, data: bytes) -> None:
        received.append((pgn, bytes(data)))

    ecu = j1939.ElectronicControlUnit()
    ecu.connect(interface="virtual", channel=channel)
    name = j1939.Name(arbitrary_address_capable=0, industry_group=3, function=130, identity_number=9)
    neighbour = j1939.ControllerApplication(name, 0xE9)
    ecu.add_ca(controller_application=neighbour)
    neighbour.subscribe(on_message)
    neighbour.start()
    try:
        await link.open()
        async with asyncio.timeout(5):
            while link.address is None or neighbour.state != j1939.ControllerApplication.State.NORMAL:
                await asyncio.sleep(0.05)
        assert link.address == 231
        await in_thread(neighbour.send_request, 0, Pgn.COMPONENT_ID, 231)  # destination-specific: RTS/CTS from us
        async with asyncio.timeout(5):
            while not received:
                await asyncio.sleep(0.05)
        assert received[0][0] == Pgn.COMPONENT_ID
        assert received[0][1].startswith(b"graderd*blade controller*")
        data = list(range(100))
        await in_thread(neighbour.send_pgn, 0, 0xFE, 0xEB, 6, data)  # BAM to all
        await in_thread(neighbour.send_pgn, 0, 0xEF, 231, 6, data)  # RTS/CTS to us
        async with asyncio.timeout(10):
            while len(long_messages) < 2:
                await asyncio.sleep(0.05)
        assert {m.pgn for m in long_messages} == {0xFEEB, 0xEF00}
        assert all(m.data == bytes(data) and m.source == 0xE9 for m in long_messages)
        assert link.node.claimer.seen[0xE9] == int.from_bytes(bytes(name.bytes), "little")
    finally:
        neighbour.stop()
        await in_thread(ecu.disconnect)
        await in_thread(ecu.stop)
        await link.close()


async def read_line(stream: asyncio.StreamReader) -> dict[str, Any]:
    async with asyncio.timeout(10):
        return json.loads(await stream.readline())  # type: ignore[no-any-return]


@pytest.mark.whole_machine
@pytest.mark.xdist_group("a line")
async def test_the_virtual_actuators_run_alone_and_take_faults_on_standard_input(tmp_path: Path) -> None:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "graderd.simulator.actuators", "--link", str(tmp_path / "can"),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdin is not None
        assert (await read_line(process.stdout))["event"] == "ready"
        link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
        tilt = ElectrakSettings(address_n=27, profile="electrak_md_a050", max_mm=95.0, current_limit_a=5.0)
        axes = [
            ElectrakActuator("lift_left", ElectrakSettings(address_n=19), link),
            ElectrakActuator("lift_right", ElectrakSettings(address_n=20), link),
            ElectrakActuator("tilt", tilt, link),
        ]
        await asyncio.gather(*(axis.open() for axis in axes))
        process.stdin.write(b'{"inject": "fatal", "address": 20}\n')
        await process.stdin.drain()
        await until(lambda: bool(axes[1].faults()))
        assert [[f.name for f in axis.faults()] for axis in axes] == [[], ["lift_right.fatal"], []]
        process.kill()
        await until(lambda: {f.condition for f in link.faults()} == {"unplugged"})
        assert all(f.condition in ("no_feedback", "fatal") for axis in axes for f in axis.faults())
        for axis in axes:
            await axis.close()
        await link.close()
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
        await process.wait()
        process._transport.close()  # type: ignore[attr-defined]


def _kernel_j1939(channel: str) -> bool:
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as probe:
            probe.bind((channel, socket.J1939_NO_NAME, socket.J1939_NO_PGN, 0x55))
    except OSError:
        return False
    return True


_VCAN = next((path.name for path in sorted(Path("/sys/class/net").glob("vcan*"))), "")

if _VCAN and _kernel_j1939(_VCAN):  # not collected where the kernel has no vcan or no J1939 stack

    async def test_the_kernels_j1939_stack_hears_us_and_we_hear_it() -> None:
        link = CanLink(CanSettings(interface="socketcan", channel=_VCAN))
        messages: list[Message] = []
        link.tap_messages(lambda m, _: messages.append(m))
        with socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as peer:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            peer.bind((_VCAN, socket.J1939_NO_NAME, socket.J1939_NO_PGN, 0x55))
            peer.settimeout(3.0)
            await link.open()
            await asyncio.sleep(0.4)
            assert link.address == 231
            ask = Pgn.COMPONENT_ID.to_bytes(3, "little")
            peer.sendto(ask, (_VCAN, socket.J1939_NO_NAME, Pgn.REQUEST, 231))

            def answer() -> bytes:
                while True:
                    data, (_, _, pgn, source) = peer.recvfrom(2000)
                    if pgn == Pgn.COMPONENT_ID and source == 231:
                        return data

            assert (await in_thread(answer)).startswith(b"graderd*")
            await in_thread(peer.sendto, bytes(range(200)), (_VCAN, socket.J1939_NO_NAME, 0xEF00, 231))
            await asyncio.sleep(1.0)
            assert any(m.pgn == 0xEF00 and m.data == bytes(range(200)) for m in messages)
        await link.close()
