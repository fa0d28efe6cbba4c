"""The bus in trouble: every condition told apart, politeness under attack, recovery without a restart."""

from __future__ import annotations

import asyncio
import errno
import itertools

import pytest

from graderd.drivers.j1939.ids import Frame, Pgn, make_id, pgn_of, source_of
from graderd.hal.device import Lifecycle
from graderd.hal.settings import CanSettings
from harness.electrak_sim import Machine, SimulatedLoop, conditions, run_simulated, state

OURS = 231


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
