"""The stop path of the servo under what goes wrong beside it: standstill in time, and no way back.

Every case turns the blade at its full speed, makes something fail, holds, and watches the true shaft.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from graderd.drivers.dynamixel import bus as servo_bus
from graderd.drivers.dynamixel.servo_task import Event
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceRefusedError, DeviceTimeoutError, LifecycleError
from graderd.simulator.servo import VirtualServo
from tests.dynamixel_sim import Bench, bench, standing

SPEED_DEG_PER_S, ACCELERATION_DEG_PER_S2 = 30.0, 60.0
REVERSAL_DEG = 0.2
"""So far a stopping blade may come back: the gear's play and the loop's overshoot."""
STANDSTILL_S = 0.4


@dataclass(frozen=True)
class Stopped:
    """What the shaft did after a hold: the way to rest, the way back, the time until it stood."""

    way_deg: float
    reversal_deg: float
    took_s: float


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Bench]:
    async with bench(
        tmp_path,
        wire={"seed": 7},
        speed_deg_per_s=SPEED_DEG_PER_S,
        acceleration_deg_per_s2=ACCELERATION_DEG_PER_S2,
        max_deg=120.0,
        poll_hz=50.0,
    ) as made:
        yield made


async def under_way(rig: Bench) -> None:
    """Armed and turning at full speed."""
    await rig.rotator.arm()
    await rig.drive(100.0, rig.past(12.0))


async def stopped(rig: Bench, what: str) -> Stopped:
    """Hold, and watch the true shaft until it has stood for 0.3 s."""
    began_s, from_deg = rig.clock.now_s(), rig.servo.shaft_deg
    rig.rotator.hold()
    ahead = math.copysign(1.0, rig.servo.shaft_velocity_deg_per_s)
    farthest_deg, back_deg, stood_s = 0.0, 0.0, began_s
    while rig.clock.now_s() - max(stood_s, began_s) < 0.3 and rig.clock.now_s() - began_s < 3.0:
        await asyncio.sleep(0.002)
        at_deg = ahead * (rig.servo.shaft_deg - from_deg)
        farthest_deg = max(farthest_deg, at_deg)
        back_deg = max(back_deg, farthest_deg - at_deg)
        if abs(rig.servo.shaft_velocity_deg_per_s) > 0.5:
            stood_s = rig.clock.now_s()
    found = Stopped(farthest_deg, back_deg, stood_s - began_s)
    sys.stdout.write(
        f"{what}: standstill {found.took_s:.2f} s after the hold, {found.way_deg:.1f}° on, "
        f"{found.reversal_deg:.2f}° back\n"
    )
    return found


class ReluctantAdapter:
    """``os`` as the bus sees it, where the kernel's buffer is full at first and then takes a few bytes at a time."""

    read = staticmethod(os.read)

    def __init__(self) -> None:
        self.calls_n = 0

    def write(self, fd: int, data: bytes) -> int:
        self.calls_n += 1
        if self.calls_n % 3 == 1:
            raise BlockingIOError
        return os.write(fd, data[:5] if self.calls_n % 3 == 2 else data)


def good(found: Stopped, took_s: float = STANDSTILL_S) -> bool:
    return found.reversal_deg <= REVERSAL_DEG and found.took_s < took_s


async def test_on_a_clean_line(rig: Bench) -> None:
    await under_way(rig)
    assert good(await stopped(rig, "clean line"))
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE


LOSSY_STOPS_N = 12
AGAIN_MOST_N = 3


async def lose_some(rig: Bench) -> None:
    """Arm on a clean line, then lose 15 % of the exchanges."""
    rig.bus.clear_faults()
    async with asyncio.timeout(20.0):
        while rig.rotator.lifecycle is not Lifecycle.STANDBY:
            await asyncio.sleep(0.01)
    await rig.rotator.arm()
    rig.bus.inject("drop", rate=0.08)
    rig.bus.inject("drop_requests", rate=0.08)


@pytest.mark.whole_machine
@pytest.mark.xdist_group("a line")
async def test_with_15_percent_of_the_exchanges_lost(rig: Bench) -> None:
    """Of twelve stops, some lose the hold, some the reading before it, some both. Who withholds the processor for a
    moment adds to what the line loses, until the servo counts as gone: then the blade stands, and is armed again."""
    again_n = stops_n = 0
    await lose_some(rig)
    while stops_n < LOSSY_STOPS_N:
        goal_deg = 100.0 if stops_n % 2 == 0 else -50.0
        from_deg = rig.servo.shaft_deg
        try:
            await rig.drive(goal_deg, lambda from_deg=from_deg: abs(rig.servo.shaft_deg - from_deg) > 12.0)  # type: ignore[misc]
        except LifecycleError:
            again_n += 1
            assert again_n <= AGAIN_MOST_N
            await lose_some(rig)
            continue
        assert good(await stopped(rig, "15 % loss"))
        stops_n += 1
    if not again_n:
        assert not rig.conditions() & {"no_reply", "ram_reset", "torque_off", "wrong_device"}


@pytest.mark.parametrize("lost_s", [0.02, 0.05, 0.08])
async def test_a_hold_that_is_lost_with_what_is_asked_after_it(rig: Bench, lost_s: float) -> None:
    """The servo turned on meanwhile: the hold that it takes at last is not the one it was to take at first."""
    await under_way(rig)
    rig.bus.inject("drop_requests")
    asyncio.get_running_loop().call_later(lost_s, rig.bus.clear_faults)
    assert good(await stopped(rig, f"nothing heard for {lost_s:g} s"), STANDSTILL_S + lost_s)


async def test_a_hold_whose_answer_is_lost_with_those_after_it(rig: Bench) -> None:
    """The servo took it and stands: what is sent again does not move it on."""
    await under_way(rig)
    from_deg = rig.servo.shaft_deg
    rig.bus.inject("drop")
    asyncio.get_running_loop().call_later(0.08, rig.bus.clear_faults)
    assert good(await stopped(rig, "no answer for 0.08 s"))
    assert rig.servo.shaft_deg - from_deg < 3.0


async def test_a_hold_that_went_unanswered_is_not_forgotten_with_the_disarming_it_was_for(rig: Bench) -> None:
    """Whoever arms again at once ends the disarming; what makes the servo safe then has no newer reading than from
    before the hold, and by that one it would turn the blade on, up to its old goal."""
    await under_way(rig)
    task, device = rig.rotator._task, rig.rotator._link.device
    async with task.wire_lock:
        rig.bus.inject("drop")
        task.note(Event.DISARMED)
        rig.rotator.hold()
        with contextlib.suppress(DeviceTimeoutError):
            await task._hold(device)
        held = rig.servo.memory["goal_position"]
        with pytest.raises(DeviceTimeoutError):
            await task._make_safe(device)
        assert rig.servo.memory["goal_position"] == held
        rig.bus.clear_faults()
    await rig.until(lambda: not rig.servo.torque_enabled)


async def test_holds_that_arrive_damaged_again_and_again(rig: Bench) -> None:
    """Answered CRC Error each time: known not to have been taken, however often."""
    await under_way(rig)
    rig.bus.inject("damage_requests")
    asyncio.get_running_loop().call_later(0.06, rig.bus.clear_faults)
    assert good(await stopped(rig, "damaged for 0.06 s"), 0.5)


@pytest.mark.parametrize("deg", [-15.0, 15.0, 40.0])
async def test_one_wrong_position_with_a_right_crc(rig: Bench, deg: float) -> None:
    await under_way(rig)
    rig.bus.inject("wrong_position", deg=deg)
    await rig.rotator.wait_telemetry()
    assert good(await stopped(rig, f"one reading {deg:+.0f}° off"))
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE


async def test_a_wrong_position_in_the_very_reading_that_the_hold_asks_for(rig: Bench) -> None:
    await under_way(rig)
    rig.bus.inject("delay", seconds=0.05)
    await rig.rotator.wait_telemetry()
    rig.bus.inject("wrong_position", deg=-15.0)
    assert good(await stopped(rig, "50 ms late and one reading off"), 0.6)


@pytest.mark.parametrize("held", [False, True], ids=["under way", "and a hold"])
async def test_one_reading_that_says_torque_off(rig: Bench, monkeypatch: pytest.MonkeyPatch, held: bool) -> None:
    """Believed, it would leave a blade that turns to itself: no hold is owed to what is not powered."""
    await under_way(rig)
    read, address, misread_n = rig.servo.read, rig.servo.table["torque_enable"].address, 0

    def misread(first: int, size: int) -> tuple[int, bytes]:
        nonlocal misread_n
        error, data = read(first, size)
        if misread_n or not first <= address < first + size:
            return error, data
        misread_n += 1
        if held:
            rig.rotator.hold()
        return error, data[: address - first] + b"\0" + data[address - first + 1 :]

    monkeypatch.setattr(rig.servo, "read", misread)
    if held:
        await rig.until(lambda: misread_n)
        assert good(await stopped(rig, "one reading says torque off"))
    else:
        await rig.drive(100.0, rig.past(40.0))
    assert misread_n
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE
    assert not rig.conditions() & {"ram_reset", "torque_off"}


async def test_a_hold_that_is_refused(rig: Bench) -> None:
    await under_way(rig)
    rig.bus.inject("refuse", address=556, error=6)  # the block of profile and goal
    assert good(await stopped(rig, "hold refused"), 0.8)
    assert rig.servo.torque_enabled
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE


async def test_an_adapter_that_takes_no_bytes_for_a_while(rig: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    await under_way(rig)
    adapter = ReluctantAdapter()
    timeouts_n = rig.rotator.telemetry().counters.get("timeouts_n", 0)
    with monkeypatch.context() as patch:
        patch.setattr(servo_bus, "os", adapter)
        assert good(await stopped(rig, "EAGAIN and partial writes"))
    assert rig.rotator.telemetry().counters.get("timeouts_n", 0) - timeouts_n <= 1


async def test_damaged_instructions_answered_crc_error_are_lost_packets(rig: Bench) -> None:
    await under_way(rig)
    rig.bus.inject("damage_requests", rate=0.3)
    assert good(await stopped(rig, "30 % of the instructions damaged"))
    await rig.drive(60.0, rig.past(30.0))
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE
    assert not rig.conditions() & {"no_reply", "ram_reset", "torque_off", "wrong_device"}


async def test_a_servo_whose_acceleration_limit_is_low_brakes_with_what_it_has(tmp_path: Path) -> None:
    servo = VirtualServo()
    servo.memory["acceleration_limit"] = 9982  # a factory value; 998 °/s²
    async with bench(tmp_path, servo) as rig:  # 240 °/s² in its moves, so that ten times as much is too much
        await rig.rotator.arm()
        await rig.drive(50.0, rig.past(25.0))
        assert good(await stopped(rig, "acceleration limit 9982"))
        assert servo.torque_enabled
        assert rig.rotator.lifecycle is Lifecycle.ACTIVE


async def test_what_the_stop_writes_is_written_at_arm_already(rig: Bench) -> None:
    """A servo that refuses the hold's profile is not armed: the stop is not the first time it is tried."""
    rig.bus.inject("refuse", address=556, error=6)
    with pytest.raises(DeviceRefusedError, match="hold"):
        await rig.rotator.arm()
    assert not rig.servo.torque_enabled


async def test_a_servo_found_powered_and_on_its_way_holds_first(tmp_path: Path) -> None:
    """A short unplug: our polling would feed the watchdog while the blade runs on to its last goal."""
    async with bench(tmp_path, torque_at_disarm="on", watchdog_s=2.0, max_deg=120.0, speed_deg_per_s=30.0) as rig:
        await rig.rotator.arm()
        await rig.drive(100.0, rig.past(12.0))
        await rig.bus.unplug()
        await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
        await rig.bus.replug()
        await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY)
        found_deg = rig.servo.shaft_deg
        await rig.until(lambda: standing(rig))
        assert rig.servo.shaft_deg - found_deg < 3.0
        assert rig.servo.torque_enabled


async def test_a_servo_of_somebody_else_on_its_way_holds_when_found(tmp_path: Path) -> None:
    servo = VirtualServo()
    async with bench(tmp_path, servo, opened=False) as rig:
        for name, value in (
            ("profile_velocity", 500), ("profile_acceleration", 600), ("torque_enable", 1), ("goal_position", 250_000),
        ):  # fmt: skip
            register = servo.table[name]
            assert servo.write(register.address, register.encode(value)) == 0
        await rig.until(lambda: servo.shaft_deg > 5.0)
        await rig.rotator.open()
        found_deg = servo.shaft_deg
        await rig.until(lambda: standing(rig))
        assert servo.shaft_deg - found_deg < 8.0
        assert servo.torque_enabled  # not ours: left as it is


async def test_a_servo_one_turn_off_in_position_mode_does_not_move(tmp_path: Path) -> None:
    servo = VirtualServo()
    servo.lose_turns(-1)  # its count reads one turn too much
    async with bench(tmp_path, servo) as rig:
        rig.bus.inject("keeps_turns")
        with pytest.raises(DeviceRefusedError, match="turn"):
            await rig.rotator.arm()
        assert not servo.torque_enabled
        await rig.until(lambda: standing(rig))
        assert abs(servo.shaft_deg) < 0.5


@pytest.fixture
def geared() -> VirtualServo:
    """In extended position mode, 10 turns for one of the blade."""
    servo = VirtualServo()
    servo.memory["operating_mode"] = 4
    servo.shaft_deg = 400.0
    return servo


GEAR: dict[str, Any] = {"gear_ratio": 10.0, "speed_deg_per_s": 8.3}


async def test_where_turns_matter_they_are_unknown_after_a_restart_without_the_daemon(
    tmp_path: Path, geared: VirtualServo
) -> None:
    async with bench(tmp_path, geared, **GEAR) as rig:
        rig.rotator.confirm_turns()
        await rig.until(lambda: rig.at(40.0)() and not rig.conditions())
        await rig.rotator.close()
        geared.power(False)
        geared.power(True)
        await rig.rotator.open()
        angle = rig.rotator.telemetry().angle_deg
        assert angle is not None
        assert not angle.valid
        assert "turns_lost" in rig.conditions()
        with pytest.raises(DeviceRefusedError, match="turns"):
            await rig.rotator.arm()


async def test_where_turns_matter_a_witness_in_ram_proves_that_there_was_no_restart(
    tmp_path: Path, geared: VirtualServo
) -> None:
    async with bench(tmp_path, geared, **GEAR) as rig:
        assert "turns_lost" in rig.conditions()  # nobody has ever said so
        rig.rotator.confirm_turns()
        await rig.until(lambda: not rig.conditions())
        await rig.rotator.arm()
        await rig.rotator.close()
        await rig.rotator.open()
        angle = rig.rotator.telemetry().angle_deg
        assert angle is not None
        assert angle.valid
        await rig.rotator.arm()
        await rig.drive(45.0, rig.at(45.0))


async def test_where_turns_matter_a_restart_within_the_same_turn_is_noticed_too(
    tmp_path: Path, geared: VirtualServo
) -> None:
    geared.shaft_deg = 100.0  # the count is the same after a restart: no jump would tell
    async with bench(tmp_path, geared, **GEAR) as rig:
        rig.rotator.confirm_turns()
        await rig.until(lambda: geared.memory["led_green"])
        rig.bus.inject("ram_reset")
        await rig.until(lambda: "turns_lost" in rig.conditions())
