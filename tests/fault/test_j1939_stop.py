"""A stop while the bus or our address on it is in trouble: never mute. In simulated time; safety.md tells the times."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Coroutine
from functools import update_wrapper
from typing import Any, Literal

import pytest

from graderd.drivers.j1939.bus_health import BusEvent
from graderd.drivers.j1939.can_port import PortFullError
from graderd.drivers.j1939.ids import Frame, Pgn, make_id, pgn_of, source_of
from graderd.hal.errors import DeviceRefusedError
from harness.electrak_sim import Machine, SimulatedLoop, conditions, run_simulated

OURS = 231
WINNER = bytes(8)
"""The lowest NAME there is: it wins every arbitration."""
ENABLE = 1 << 28


def enabled(frame: Frame) -> bool:
    return bool(int.from_bytes(frame.data, "little") & ENABLE)


def commands(machine: Machine, since_s: float, address: int = 19) -> list[tuple[float, Frame]]:
    """Control messages to an actuator that the wire carried."""
    to = make_id(6, Pgn.PROPRIETARY_A, 0, address) & 0x3FFFF00
    return [(t, f) for t, f in machine.frames if t >= since_s and f.can_id & 0x3FFFF00 == to]


def claim(address: int) -> Frame:
    return Frame(make_id(6, Pgn.ADDRESS_CLAIMED, address), WINNER)


async def standstill(machine: Machine, since_s: float) -> float:
    """Seconds until the left lift stands."""
    while machine.units["lift_left"].velocity_mm_per_s:
        await asyncio.sleep(0.002)
        assert machine.clock.now_s() - since_s < 3.0, "it never stood still"
    return machine.clock.now_s() - since_s


async def lifting(machine: Machine) -> None:
    """Arm and drive until the left lift is in mid-move."""
    await machine.axes["lift_left"].arm()
    await machine.drive({"lift_left": 280.0}, 0.83)
    assert machine.units["lift_left"].velocity_mm_per_s > 20.0


def in_mid_lift(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test in simulated time with the left lift in mid-move; it is handed loop and machine."""

    async def main(loop: SimulatedLoop, arguments: dict[str, Any]) -> None:
        async with Machine(loop, names=("lift_left",)) as machine:
            await lifting(machine)
            await test(loop, machine, **arguments)

    def run(**arguments: Any) -> None:
        run_simulated(lambda loop: main(loop, arguments))

    update_wrapper(run, test)
    signature = inspect.signature(test)  # pytest shall see what is parametrized, and nothing else
    run.__signature__ = signature.replace(parameters=[*signature.parameters.values()][2:])  # type: ignore[attr-defined]
    return run


def out_claim_everything(machine: Machine) -> Callable[[], None]:
    """A node that takes every address that we claim; the call ends it."""
    ours = machine.link.node.claimer.name.to_bytes()
    active = True

    def hear(frame: Frame) -> None:
        if active and pgn_of(frame.can_id) == Pgn.ADDRESS_CLAIMED and frame.data == ours:
            machine.bus.send(claim(source_of(frame.can_id)))

    def end() -> None:
        nonlocal active
        active = False

    machine.bus.listen(hear)
    machine.bus.send(claim(OURS))
    return end


@in_mid_lift
async def test_a_contention_in_mid_lift_stops_at_once_and_a_stop_during_the_new_claim_finds_it_stopped(
    loop: SimulatedLoop, machine: Machine
) -> None:
    lost_s = loop.now_s()
    machine.bus.send(claim(OURS))
    await asyncio.sleep(0.005)
    without: int | None = machine.link.address
    assert without is None
    machine.axes["lift_left"].hold()
    first_s, first = commands(machine, lost_s)[0]
    assert not enabled(first)
    assert source_of(first.can_id) == OURS, "from the old address: there is no other"
    assert first_s - lost_s <= 0.001
    assert await standstill(machine, lost_s) <= 0.25
    await asyncio.sleep(0.5)
    assert machine.link.address == 128
    assert not any(enabled(f) for _, f in commands(machine, lost_s))


@pytest.mark.parametrize("stop_after_s", [0.0, 0.1, 0.24, 1.0])
@in_mid_lift
async def test_a_stop_gets_through_against_a_node_that_takes_every_address(
    loop: SimulatedLoop, machine: Machine, stop_after_s: float
) -> None:
    lost_s = loop.now_s()
    out_claim_everything(machine)
    await machine.drive({"lift_left": 280.0}, stop_after_s)
    stop_s = loop.now_s()
    machine.axes["lift_left"].hold()
    assert await standstill(machine, lost_s) <= max(0.25, stop_after_s + 0.001), "it stands when the stop comes"
    await asyncio.sleep(1.0)
    told = commands(machine, lost_s)
    assert told
    assert told[0][0] - lost_s <= 0.021
    assert not any(enabled(f) for _, f in told)
    assert machine.link.address is None
    assert not [f for t, f in commands(machine, stop_s + 0.5)], "at rest: no word from somebody else's address"


@in_mid_lift
async def test_a_disable_that_was_lost_is_said_again_until_the_actuator_stands(
    loop: SimulatedLoop, machine: Machine
) -> None:
    unit = machine.units["lift_left"]
    hear, deaf_until_s = unit.on_frame, loop.now_s() + 0.15
    unit.on_frame = (  # type: ignore[method-assign]
        lambda frame, now_s: hear(frame, now_s) if now_s > deaf_until_s else None
    )
    lost_s = loop.now_s()
    end = out_claim_everything(machine)
    assert await standstill(machine, lost_s) <= 0.45
    # It would stand by then without a further word, at the short target that it has.
    said_again_s, said_again = commands(machine, deaf_until_s)[0]
    assert said_again_s - deaf_until_s <= 0.11
    assert not enabled(said_again)
    end()


def test_no_address_is_a_fault_within_three_tenths_of_a_second_and_arming_is_refused() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=("lift_left",)) as machine:
            await machine.axes["lift_left"].arm()
            end = out_claim_everything(machine)
            lost_s = loop.now_s()
            while "cannot_claim" not in conditions(machine.link):
                await asyncio.sleep(0.02)
                assert loop.now_s() - lost_s <= 0.3
            await machine.axes["lift_left"].disarm()
            with pytest.raises(DeviceRefusedError):
                await machine.axes["lift_left"].arm()
            end()
            await asyncio.sleep(12.0)
            assert "cannot_claim" not in conditions(machine.link)

    run_simulated(main)


def test_a_contention_that_ends_as_the_standard_says_is_no_fault() -> None:
    async def main(loop: SimulatedLoop) -> None:
        async with Machine(loop, names=("lift_left",)) as machine:
            machine.bus.send(claim(OURS))
            for _ in range(50):
                await asyncio.sleep(0.02)
                assert "cannot_claim" not in conditions(machine.link)
            assert machine.link.address == 128

    run_simulated(main)


def test_a_claim_that_succeeded_is_followed_at_once_by_what_is_owed() -> None:
    async def main(loop: SimulatedLoop) -> None:
        for phase in range(10):  # wherever on the grid of the control messages the claim ends
            async with Machine(loop, names=("lift_left",)) as machine:
                await asyncio.sleep(0.01 * phase)
                lost_s = loop.now_s()
                machine.bus.send(claim(OURS))
                await asyncio.sleep(0.5)
                first_s = next(t for t, f in commands(machine, lost_s) if source_of(f.can_id) == 128)
                assert first_s - lost_s <= 0.25 + 0.021

    run_simulated(main)


@in_mid_lift
async def test_a_stop_while_the_bus_was_lost_goes_out_first_when_it_is_back(
    loop: SimulatedLoop, machine: Machine
) -> None:
    machine.units["lift_left"].behaviour.speed_factor = 0.1  # slow, so that it is still on its way
    machine.bus.interface_down()
    await asyncio.sleep(0.05)
    machine.axes["lift_left"].hold()
    while not machine.link.is_open:
        await asyncio.sleep(0.001)
    back_s = loop.now_s()
    await asyncio.sleep(0.005)
    (first_s, first), *_ = commands(machine, back_s - 0.002)
    assert first_s - back_s <= 0.002, "not after the 250 ms of the claim"
    assert not enabled(first)
    assert await standstill(machine, back_s) <= 0.25


@in_mid_lift
async def test_a_stop_during_bus_off_goes_out_as_soon_as_the_controller_is_back(
    loop: SimulatedLoop, machine: Machine
) -> None:
    port = machine.link._port
    assert port is not None
    send, read = port.send, port.read

    def refuse(frame: Frame) -> None:
        raise PortFullError(f"no buffer space for {frame.can_id:X}")

    port.send = refuse  # type: ignore[method-assign]
    machine.bus.inject("bus_off")
    await asyncio.sleep(0.03)
    machine.axes["lift_left"].hold()
    await asyncio.sleep(0.043)
    assert "bus_off" in conditions(machine.link)
    port.send = send  # type: ignore[method-assign]
    back_s = loop.now_s()
    machine.bus.report_state("error_active")
    await asyncio.sleep(0.002)
    (first_s, first), *_ = commands(machine, back_s)
    assert first_s - back_s <= 0.001
    assert not enabled(first)
    assert await standstill(machine, back_s) <= 0.25
    assert BusEvent.BUS_OFF not in read()


@pytest.mark.parametrize("back", ["error_active", "error_passive"])
@in_mid_lift
async def test_a_bus_off_that_is_over_before_anybody_looks_ends_motion_and_is_told(
    loop: SimulatedLoop, machine: Machine, back: Literal["error_active", "error_passive"]
) -> None:
    """Both came in one read: the first word afterwards let the actuator move on, and no tick ever saw the fault."""
    off_s = loop.now_s()
    machine.bus.inject("bus_off")
    machine.bus.report_state(back)
    await asyncio.sleep(0.002)
    (first_s, first), *_ = commands(machine, off_s)
    assert first_s - off_s <= 0.001
    assert not enabled(first)
    assert "bus_off" in conditions(machine.link)
    assert await standstill(machine, off_s) <= 0.25
    await asyncio.sleep(off_s + 0.9 - loop.now_s())
    assert "bus_off" in conditions(machine.link)
    await asyncio.sleep(0.2)
    assert "bus_off" not in conditions(machine.link)
    assert not any(enabled(f) for _, f in commands(machine, off_s))


@in_mid_lift
async def test_a_bus_off_that_was_there_to_be_seen_is_over_when_it_is(loop: SimulatedLoop, machine: Machine) -> None:
    machine.bus.inject("bus_off")
    await asyncio.sleep(1.1)
    assert "bus_off" in conditions(machine.link)
    machine.bus.report_state("error_active")
    await asyncio.sleep(0.002)
    assert "bus_off" not in conditions(machine.link)
