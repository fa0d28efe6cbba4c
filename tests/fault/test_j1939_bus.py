"""The bus in trouble: every condition told apart, politeness under attack, recovery without a restart."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import itertools
import socket
import struct
from pathlib import Path

import can
import pytest

from drivers.electrak import CanLink, ElectrakActuator, dump
from drivers.electrak.bus_events import BusEvent, event_of
from drivers.electrak.j1939.ids import Frame, Pgn, make_id, pgn_of, source_of
from drivers.electrak.ports import PortLostError, SlcanPort, SocketCanPort, lost_from
from drivers.electrak.slcan_bus import QuietSlcanBus
from drivers.electrak.virtual import VirtualActuatorBus, VirtualElectrak
from graderd.hal.lifecycle import Lifecycle
from graderd.hal.settings import ActuatorSettings, CanSettings
from tests.electrak_sim import Machine, SimulatedLoop, run_simulated, until

OURS = 231


def conditions(link: CanLink) -> set[str]:
    return {fault.condition for fault in link.faults()}


def state(axis: ElectrakActuator) -> Lifecycle:
    """A call, so that the type checker does not take the state for a constant."""
    return axis.lifecycle


def our_claims(machine: Machine, since_s: float) -> int:
    """Claims that our node sent: those the machine's wire carried from us, told by our NAME."""
    name = machine.link.node.claimer.name.to_bytes()
    return sum(t >= since_s and pgn_of(f.can_id) == Pgn.ADDRESS_CLAIMED and f.data == name for t, f in machine.frames)


@pytest.mark.parametrize("state", ["bus_off", "error_passive", "overrun"])
def test_controller_states_are_told_apart_and_go_away(state: str) -> None:
    async def main(_: SimulatedLoop) -> None:
        async with _machine(_) as machine:
            machine.bus.inject(state)
            await asyncio.sleep(0.05)
            expected = "queue_overrun" if state == "overrun" else state
            assert conditions(machine.link) == {expected}
            machine.bus.clear_faults()
            await asyncio.sleep(2.2)
            assert conditions(machine.link) == set()

    run_simulated(main)


def _machine(loop: SimulatedLoop) -> Machine:
    return Machine(loop, names=("lift_left",))


@pytest.mark.parametrize("how", ["interface_down", "unplugged"])
def test_a_lost_bus_is_named_closed_at_once_and_opened_again(how: str) -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            axis = machine.axes["lift_left"]
            await axis.arm()
            await machine.drive({"lift_left": 250.0}, 0.8)
            machine.bus.interface_down() if how == "interface_down" else machine.bus.unplug()
            await asyncio.sleep(0.001)
            assert conditions(machine.link) == {how}
            assert not machine.link.is_open
            assert state(axis) is Lifecycle.FAILED
            await asyncio.sleep(1.5)
            assert conditions(machine.link) == set()
            assert machine.link.counters.reopened_n == 1
            assert state(axis) is Lifecycle.STANDBY, "back, and never active by itself"
            await axis.arm()
            await machine.drive({"lift_left": 120.0}, 5.0)
            assert machine.units["lift_left"].position_mm == pytest.approx(120.0, abs=1.2)

    run_simulated(main)


def test_opening_again_waits_longer_and_longer_and_never_gives_up() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            tries_s: list[float] = []
            factory = machine.link._factory
            assert factory is not None

            def failing() -> object:
                tries_s.append(loop.now_s())
                if len(tries_s) == 4:
                    raise RuntimeError("a defect in the opening itself")
                if len(tries_s) < 10:
                    raise OSError(errno.ENODEV, "No such device")
                return factory()

            machine.link._factory = failing  # type: ignore[assignment]
            machine.bus.unplug()
            await asyncio.sleep(30.0)
            gaps = [b - a for a, b in itertools.pairwise(tries_s)]
            assert gaps == sorted(gaps)
            assert gaps[-1] == pytest.approx(2.0, abs=0.01)
            assert machine.link.is_open

    run_simulated(main)


def test_a_flood_is_reported_and_control_messages_keep_their_time() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            machine.bus.inject("flood", rate_hz=3000)
            await asyncio.sleep(3.0)
            assert conditions(machine.link) == {"flood"}
            times = [t for t, f in machine.frames if f.can_id == make_id(6, Pgn.PROPRIETARY_A, OURS, 19)]
            gaps = [b - a for a, b in itertools.pairwise(times)]
            assert max(gaps) == pytest.approx(0.1, abs=0.001)
            machine.bus.clear_faults()
            await asyncio.sleep(1.5)
            assert conditions(machine.link) == set()

    run_simulated(main)


def test_two_controllers_with_equal_names_are_reported_and_do_not_storm() -> None:
    """can-j1939 2.0.12 made 3,433 claims in 1.5 s in this situation."""

    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            start_s = loop.now_s()
            machine.bus.inject("address_conflict")
            machine.bus.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, OURS), machine.link.node.claimer.name.to_bytes()))
            await asyncio.sleep(1.5)
            assert "address_conflict" in conditions(machine.link)
            assert our_claims(machine, start_s) <= 8  # half of them the rival's: it copies our NAME
            assert machine.link.node.claimer.sent_n <= 4

    run_simulated(main)


def test_a_claim_storm_takes_our_address_but_not_our_manners() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            start_s = loop.now_s()
            machine.bus.inject("claim_storm", rate_hz=2000)
            await asyncio.sleep(1.5)
            assert our_claims(machine, start_s) <= 9
            assert machine.link.address == 128, "the rival's NAME wins: we work on from another address"
            assert state(machine.axes["lift_left"]) is Lifecycle.STANDBY

    run_simulated(main)


def test_a_storm_that_loses_every_arbitration_is_reported() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            start_s = loop.now_s()
            for _ in range(300):
                machine.bus.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, OURS), b"\xff" * 8))
                await asyncio.sleep(0.005)
            assert conditions(machine.link) >= {"claim_storm"}
            assert our_claims(machine, start_s) <= 9
            assert machine.link.address == OURS

    run_simulated(main)


def test_without_an_address_nothing_is_sent_and_that_is_said() -> None:
    async def main(loop: SimulatedLoop) -> None:
        can_settings = CanSettings(interface="virtual", name_arbitrary_address=False)
        async with Machine(loop, names=("lift_left",), can=can_settings) as machine:
            machine.bus.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, OURS), bytes(8)))
            await asyncio.sleep(0.01)
            start_s = loop.now_s()
            await asyncio.sleep(2.0)
            assert "cannot_claim" in conditions(machine.link)
            sent = {source_of(f.can_id) for t, f in machine.frames if t > start_s and source_of(f.can_id) != 19}
            assert sent == {0xFE}
            await asyncio.sleep(10.0)
            assert machine.link.address == OURS, "the other one is gone: a new try succeeds"
            assert "cannot_claim" not in conditions(machine.link)

    run_simulated(main)


def test_somebody_elses_traffic_from_our_address_is_a_conflict() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with _machine(loop) as machine:
            machine.bus.send(Frame(make_id(6, Pgn.PROPRIETARY_A, OURS, 19), bytes(8)))
            await asyncio.sleep(0.01)
            assert conditions(machine.link) == {"address_conflict"}

    run_simulated(main)


STOP = bytes((255, 255, 255, 255, 255, 255, 1, 0xFC))
PERMIT = bytes((255, 255, 255, 255, 255, 255, 1, 0xFD))


@pytest.mark.parametrize(
    ("pgn", "data", "stops_n"),
    [
        (Pgn.STOP_ALL_IMPLEMENTS, [STOP], 1),
        (Pgn.STOP_ALL_IMPLEMENTS, [STOP, STOP, STOP], 1),
        (Pgn.STOP_ALL_IMPLEMENTS, [PERMIT, PERMIT], 0),
        (Pgn.STOP_ALL_IMPLEMENTS, [STOP, PERMIT, STOP], 2),
        (Pgn.STOP_ALL_IMPLEMENTS, [PERMIT, PERMIT[:6] + bytes((5, 0xFD))], 1),
        (Pgn.STOP_ALL_IMPLEMENTS, [STOP[:7]], 0),
        (0xFF42, [bytes(8)], 1),
        (0xFF43, [bytes(8)], 0),
    ],
)
def test_stop_messages_call_on_stop(pgn: int, data: list[bytes], stops_n: int) -> None:
    async def main(loop: SimulatedLoop) -> None:
        can_settings = CanSettings(interface="virtual", stop_pgn_n=0xFF42)
        async with Machine(loop, names=("lift_left",), can=can_settings) as machine:
            for content in data:
                machine.bus.send(Frame(make_id(3, pgn, 38), content))
                await asyncio.sleep(0.01)
            assert len(machine.stops) == stops_n
            assert all("address 38" in reason for reason in machine.stops)

    run_simulated(main)


def test_a_switch_that_goes_on_saying_stop_stops_again() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=("lift_left",)) as machine:
            for _ in range(5):
                machine.bus.send(Frame(make_id(3, Pgn.STOP_ALL_IMPLEMENTS, 38), STOP))
                await asyncio.sleep(0.11)
            assert len(machine.stops) == 5

    run_simulated(main)


def test_stop_messages_may_be_switched_off() -> None:
    async def main(loop: SimulatedLoop) -> None:
        can_settings = CanSettings(interface="virtual", stop_on_iso11783_all_stop=False)
        async with Machine(loop, names=("lift_left",), can=can_settings) as machine:
            machine.bus.send(Frame(make_id(3, Pgn.STOP_ALL_IMPLEMENTS, 38), STOP))
            await asyncio.sleep(0.01)
            assert machine.stops == []

    run_simulated(main)


# -- the slcan adapter, in real time ----------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def slcan_machine(tmp_path: Path):  # type: ignore[no-untyped-def]
    unit = VirtualElectrak(position_mm=100.0, seed=2)
    bus = VirtualActuatorBus([unit], link=tmp_path / "can")
    await bus.start()
    link = CanLink(CanSettings(interface="slcan", channel=str(tmp_path / "can")))
    axis = ElectrakActuator("lift_left", ActuatorSettings(), link)
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
        assert loop.time() - start_s < 5.0
        assert "queue_overrun" in conditions(link)
        bus.clear_faults()
        await asyncio.sleep(0.3)
        assert link.is_open


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
