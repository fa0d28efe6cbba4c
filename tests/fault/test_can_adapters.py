"""Adapters that hang, go, pile up or lose: by slcan in real time, by SocketCAN's own frames and error numbers."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import socket
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from graderd.drivers.electrak import CanLink, ElectrakActuator, dump, safe_off
from graderd.drivers.j1939 import link as link_module
from graderd.drivers.j1939.bus_health import BusEvent, event_of
from graderd.drivers.j1939.can_port import BusPort, PortLostError, SlcanPort, SocketCanPort, lost_from
from graderd.drivers.j1939.ids import Frame, Pgn, make_id, pgn_of
from graderd.drivers.j1939.python_can import can
from graderd.drivers.j1939.slcan_bus import QuietSlcanBus
from graderd.hal.clock import SystemClock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceLostError, DeviceMissingError
from graderd.hal.settings import CanSettings, ElectrakSettings
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from graderd.simulator.actuators.slcan import SlcanAdapter
from harness.electrak_sim import conditions, state, until

# -- the slcan adapter, in real time ----------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def slcan_machine(tmp_path: Path):  # type: ignore[no-untyped-def]
    unit = VirtualElectrak(position_mm=100.0, seed=2)
    bus = VirtualActuatorBus([unit], link=tmp_path / "can")
    await bus.start()
    link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
    axis = ElectrakActuator("lift_left", ElectrakSettings(), link)
    try:
        await axis.open()
        yield bus, link, axis
    finally:
        await axis.close()
        await link.close()
        await bus.close()


def has(link: CanLink, condition: str) -> bool:
    return condition in conditions(link)


async def test_an_unplugged_adapter_is_noticed_at_once_and_used_again_when_it_is_back(tmp_path: Path) -> None:
    async with slcan_machine(tmp_path) as (bus, link, axis):
        bus.unplug()
        await until(lambda: conditions(link) == {"unplugged"}, 2.0)
        assert state(axis) is Lifecycle.FAILED
        await asyncio.sleep(0.3)
        bus.replug()
        await until(lambda: state(axis) is Lifecycle.STANDBY)
        assert conditions(link) == set()


async def test_a_second_reader_is_refused_before_it_disturbs_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async with slcan_machine(tmp_path) as (_, link, axis):
        assert await asyncio.to_thread(dump.main, [str(tmp_path / "can")]) == 1
        error = capsys.readouterr().err
        assert "another program has it open" in error
        assert "'graderd can dump' without a port" in error
        before_n = link.counters.rx_n
        await until(lambda: link.counters.rx_n > before_n + 5)
        assert conditions(link) == set()
        assert state(axis) is Lifecycle.STANDBY


async def test_what_is_sent_and_what_is_received_can_be_watched(tmp_path: Path) -> None:
    async with slcan_machine(tmp_path) as (_, link, _):
        seen: set[int] = set()
        end = link.tap(lambda frame, _: seen.add(frame.can_id))
        await until(lambda: seen >= {0x18EF1300 | (link.address or 0), 0x19EFFF13})
        end()


async def test_state_lines_of_the_adapter_are_understood(tmp_path: Path) -> None:
    async with slcan_machine(tmp_path) as (bus, link, _):
        for line, expected in ((b"sp130128", "error_passive"), (b"sb000256", "bus_off"), (b"e1o", "queue_overrun")):
            bus.send_adapter_line(line)
            await until(functools.partial(has, link, expected))
            bus.send_adapter_line(b"sa000000")
        bus.send_adapter_line(b"T18FFgarbage")
        bus.send_adapter_line(b"\xff\x00?")
        await asyncio.sleep(0.05)
        assert link.is_open


async def test_a_hung_adapter_fills_the_queue_and_never_blocks_the_loop(tmp_path: Path) -> None:
    async with slcan_machine(tmp_path) as (bus, link, _):
        bus.inject("adapter_hung")
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        for _ in range(3000):
            link.request(Pgn.SOFTWARE_ID)
        assert loop.time() - start_s < 1.0
        assert "queue_overrun" in conditions(link)
        bus.clear_faults()
        await asyncio.sleep(0.3)
        assert link.is_open


async def test_an_adapter_that_refuses_is_told_and_counted_and_one_refusal_is_not(tmp_path: Path) -> None:
    async with slcan_machine(tmp_path) as (bus, link, axis):
        assert link.counters.refused_n == 0, "what is refused while it is opened is no news"
        bus.send_adapter_line(b"\a")
        await until(lambda: link.counters.refused_n == 1)
        assert conditions(link) == set()
        bus.inject("adapter_refuses")
        await until(lambda: "adapter_refuses" in conditions(link))
        assert link.counters.refused_n >= 5
        bus.clear_faults()
        await until(lambda: conditions(link) == set())
        await until(lambda: state(axis) is Lifecycle.STANDBY)


async def test_an_adapter_that_forgot_its_channel_is_opened_again(tmp_path: Path) -> None:
    async with slcan_machine(tmp_path) as (bus, link, axis):
        bus.inject("adapter_resets")
        await until(lambda: "adapter_refuses" in conditions(link))
        await until(lambda: bus.channel_open)
        await until(lambda: conditions(link) == set() and state(axis) is Lifecycle.STANDBY)
        assert link.counters.lost_n == 0


async def test_four_who_open_a_bus_that_is_not_there_try_it_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The daemon and each of three actuators ask for it, all at the same time, and again after the same pause."""
    tried_n = 0

    def absent(settings: CanSettings) -> BusPort:
        nonlocal tried_n
        tried_n += 1
        raise DeviceMissingError(f"CAN {settings.channel}", "no such interface")

    monkeypatch.setattr(link_module, "open_port", absent)
    link = CanLink(CanSettings())
    for asked_n in (1, 2):
        told = await asyncio.gather(*(link.open() for _ in range(4)), return_exceptions=True)
        assert [type(error) for error in told] == [DeviceMissingError] * 4
        assert tried_n == asked_n


async def test_a_board_that_vanishes_while_it_boots_is_left_in_peace_before_it_is_opened_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened_s: list[float] = []

    class Booting(BusPort):
        def __init__(self, settings: CanSettings) -> None:
            super().__init__(can.Bus(interface="virtual", channel=settings.channel))
            opened_s.append(SystemClock().now_s())

        def wait_ready(self, timeout_s: float) -> bool:
            raise PortLostError("unplugged", f"hung up, within {timeout_s:g} s")

    monkeypatch.setattr(link_module, "READY_S", 0.3)
    monkeypatch.setattr(link_module, "open_port", Booting)
    link = CanLink(CanSettings(channel="boots"))
    for _ in range(2):
        with pytest.raises(DeviceLostError):
            await link.open()
    assert opened_s[1] - opened_s[0] >= 0.3


async def test_a_board_that_resets_when_its_port_is_opened_is_waited_for(tmp_path: Path) -> None:
    unit = VirtualElectrak(position_mm=100.0, seed=2)
    bus = VirtualActuatorBus([unit], link=tmp_path / "can")
    await bus.start()
    bus.inject("adapter_resets", boot_s=1.2)
    link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
    await link.open()
    assert bus.channel_open
    claimed_n = link.counters.tx_n
    assert claimed_n == 2, "request and claim, none lost in its boot"
    await link.close()
    bus.unplug()
    bus.replug()
    assert await asyncio.to_thread(safe_off, link.settings, (19,)) == 8, "the guard too: before it booted, and after"
    await bus.close()


async def test_an_adapter_that_never_answers_is_used_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SlcanAdapter, "_answer", _mute(SlcanAdapter._answer))
    monkeypatch.setattr(link_module, "READY_S", 0.2)
    async with slcan_machine(tmp_path) as (_, link, axis):
        assert conditions(link) == set()
        assert state(axis) is Lifecycle.STANDBY


def _mute(answer: Callable[[SlcanAdapter, bytes], bytes]) -> Callable[[SlcanAdapter, bytes], bytes]:
    def without(adapter: SlcanAdapter, line: bytes) -> bytes:
        answer(adapter, line)
        return b""

    return without


async def test_self_reception_is_no_conflict_and_a_stranger_is(tmp_path: Path) -> None:
    unit = VirtualElectrak(position_mm=100.0, seed=2)
    bus = VirtualActuatorBus([unit], link=tmp_path / "can")
    await bus.start()
    bus.inject("self_reception")
    link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
    axis = ElectrakActuator("lift_left", ElectrakSettings(), link)
    await axis.open()
    await until(lambda: link.counters.tx_n > 20)
    assert conditions(link) == set()
    bus.send(Frame(make_id(6, Pgn.PROPRIETARY_A, link.address or 0, 19), bytes(8)))
    await until(lambda: conditions(link) == {"address_conflict"})
    await axis.close()
    await link.close()
    await bus.close()


# -- SocketCAN, by its frames and error numbers -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("class_bits", "data", "event"),
    [
        (0x040, bytes(8), BusEvent.BUS_OFF),
        (0x004, bytes((0, 0x10)), BusEvent.ERROR_PASSIVE),
        (0x004, bytes((0, 0x20)), BusEvent.ERROR_PASSIVE),
        (0x004, bytes((0, 0x01)), BusEvent.QUEUE_OVERRUN),
        (0x004, bytes((0, 0x02)), BusEvent.QUEUE_OVERRUN),
        (0x004, bytes((0, 0x40)), BusEvent.ERROR_ACTIVE),
        (0x100, bytes(8), BusEvent.ERROR_ACTIVE),
        (0x020, bytes(8), None),
    ],
)
def test_error_frames_of_the_kernel(class_bits: int, data: bytes, event: BusEvent | None) -> None:
    assert event_of(class_bits, data) is event


@pytest.mark.parametrize(
    ("number", "condition"),
    [
        (errno.ENETDOWN, "interface_down"),
        (errno.ENODEV, "unplugged"),
        (errno.ENXIO, "unplugged"),
        (errno.EIO, "unplugged"),
    ],
)
def test_error_numbers_tell_down_from_gone(number: int, condition: str) -> None:
    assert lost_from(OSError(number, "x")).condition == condition
    assert lost_from(can.CanOperationError("x", number)).condition == condition


class FakeSocketCan:
    """A socket that hands out raw can_frame structures, as CAN_RAW does."""

    def __init__(self) -> None:
        self.ours, self.socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)

    def fileno(self) -> int:
        return self.socket.fileno()

    def shutdown(self) -> None:
        self.ours.close()
        self.socket.close()


def test_raw_frames_are_read_straight_from_the_socket() -> None:
    fake = FakeSocketCan()
    port = SocketCanPort(fake)  # type: ignore[arg-type]
    frame = struct.Struct("=IB3x8s")
    fake.ours.send(frame.pack(0x19EFFF13 | socket.CAN_EFF_FLAG, 8, bytes.fromhex("1F870705C9FFFFFF")))
    fake.ours.send(frame.pack(0x123, 2, b"ab"))
    fake.ours.send(frame.pack(0x123 | socket.CAN_RTR_FLAG, 0, b""))
    fake.ours.send(frame.pack(0x40 | socket.CAN_ERR_FLAG, 8, bytes(8)))
    fake.ours.send(b"short")
    assert port.read() == [
        Frame(0x19EFFF13, bytes.fromhex("1F870705C9FFFFFF")),
        Frame(0x123, b"ab", extended=False),
        BusEvent.BUS_OFF,
    ]
    assert port.read() == []
    port.close()
    with pytest.raises(PortLostError):
        port.read()


async def test_a_host_that_does_not_read_loses_whole_frames_and_never_half_of_one(tmp_path: Path) -> None:
    bus = VirtualActuatorBus([], link=tmp_path / "can")
    await bus.start()
    host = QuietSlcanBus(str(tmp_path / "can"), 250_000)
    await until(lambda: bus.channel_open)
    for index in range(3000):
        bus.send(Frame(make_id(6, 0xFF00, 0x33), index.to_bytes(8, "little")))
    seen = []
    for _ in range(3000):
        message = host.recv(0)
        if message is not None:
            assert message.dlc == 8
            seen.append(int.from_bytes(message.data, "little"))
    assert len(seen) > 50
    assert seen == sorted(set(seen))
    host.shutdown()
    await bus.close()


async def test_what_piled_up_is_read_in_small_helpings_and_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A backlog must not keep the next control message waiting, and must not wait for another frame to come."""
    bus = VirtualActuatorBus([], link=tmp_path / "can")
    await bus.start()
    link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
    await link.open()
    await until(lambda: bus.channel_open)  # the host has asked for it by now; the adapter may not have read that yet
    seen: list[int] = []
    link.tap(lambda frame, _: seen.append(frame.can_id))
    helpings: list[int] = []
    read = SlcanPort.read

    def counted(port: SlcanPort) -> list[Frame | BusEvent]:
        items = read(port)
        helpings.append(len(items))
        return items

    monkeypatch.setattr(SlcanPort, "read", counted)
    for index in range(60):
        bus.send(Frame(make_id(6, 0xFF00, index), b"12345678"))
    await until(lambda: len([i for i in seen if pgn_of(i) == 0xFF00]) == 60)
    assert max(helpings) <= 8
    await link.close()
    await bus.close()
