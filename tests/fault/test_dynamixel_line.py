"""What the servo's line does to everything else: losses, babble, lateness, twins, and a plug pulled while closing."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.drivers.dynamixel.bus import ServoBus
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceRefusedError, DeviceTimeoutError, LifecycleError, WrongDeviceError
from tests.contract.conformance import all_known, state
from tests.dynamixel_sim import LOST_S, Bench, bench


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Bench]:
    async with bench(tmp_path, wire={"seed": 5}, reply_timeout_s=LOST_S) as made:
        yield made


@pytest.fixture
async def bus(rig: Bench) -> AsyncIterator[ServoBus]:
    """A bus of the test's own, on the rig's wire."""
    await rig.rotator.close()
    made = ServoBus(str(rig.bus.link), 57_600, clock=rig.clock)
    made.open()
    yield made
    made.close()


@pytest.mark.whole_machine
@pytest.mark.xdist_group("a line")
@pytest.mark.timeout(60)
async def test_15_percent_loss_is_told_and_nothing_else_happens(tmp_path: Path) -> None:
    """As many exchanges as in a minute at the default poll rate, on three lines side by side."""
    folders = [tmp_path / str(number) for number in range(3)]
    for folder in folders:
        folder.mkdir()
    async with asyncio.TaskGroup() as lines:
        for seed, folder in enumerate(folders, 11):
            lines.create_task(_loses(folder, seed, 1667))


async def _loses(folder: Path, seed: int, exchanges_n: int) -> None:
    """A line of its own that loses 15 % of so many exchanges: told, and the servo is driven on."""
    async with bench(folder, wire={"seed": seed}, poll_hz=200.0, reply_timeout_s=LOST_S) as rig:
        await rig.rotator.arm()
        rig.bus.inject("drop", rate=0.08)
        rig.bus.inject("drop_requests", rate=0.08)
        from_n, told = rig.bus.requests_n, set[str]()
        while rig.bus.requests_n - from_n < exchanges_n:
            rig.rotator.set_goal_deg(5.0)
            await asyncio.sleep(0.02)
            told |= rig.conditions()
            assert rig.rotator.lifecycle is Lifecycle.ACTIVE, rig.rotator.faults()
        assert told == {"lossy"}
        assert all_known(rig.rotator.faults())
        rig.bus.clear_faults()
        await rig.until(lambda: not rig.conditions())


async def test_a_lost_servo_is_told_in_time(rig: Bench) -> None:
    rig.bus.inject("drop")
    began_s = rig.clock.now_s()
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    assert 0.2 < rig.clock.now_s() - began_s < 0.6


async def test_a_damaged_instruction_answered_crc_error_is_unanswered(rig: Bench, bus: ServoBus) -> None:
    rig.bus.inject("damage_requests")
    with pytest.raises(DeviceTimeoutError):
        await bus.read(1, 580, 4, attempts_n=2)
    assert bus.counters()["damaged_requests_n"] == 2


async def test_a_header_that_claims_a_long_packet_swallows_no_reply(rig: Bench, bus: ServoBus) -> None:
    rig.bus.inject("babble", length=1000)
    for _ in range(5):
        await bus.read(1, 580, 4, attempts_n=1)


async def test_readings_carry_the_time_at_which_the_servo_measured(rig: Bench) -> None:
    rig.bus.inject("delay", seconds=0.04)
    for _ in range(8):  # until the line's lateness is known
        await rig.rotator.wait_telemetry()
    angle = (await rig.rotator.wait_telemetry()).angle_deg
    assert angle is not None
    assert angle.age_s(rig.clock.now_s()) > 0.035


async def test_two_servos_with_one_id_are_told_as_such(tmp_path: Path) -> None:
    async with bench(tmp_path, opened=False) as rig:
        rig.bus.inject("twin")
        with pytest.raises(WrongDeviceError, match="two servos answer to id 1"):
            await rig.rotator.open()
        assert "wrong_device" in rig.conditions()


async def test_a_second_servo_with_the_id_is_told_at_work_and_nothing_arms_on_it(rig: Bench) -> None:
    await rig.rotator.arm()
    rig.bus.inject("drop", rate=0.15)  # answers that came late or never before are no second servo's
    await rig.until(lambda: rig.rotator.telemetry().counters["timeouts_n"] > 5)
    rig.bus.clear_faults()
    await rig.until(lambda: not rig.conditions())
    rig.bus.inject("twin")
    await rig.until(lambda: "wrong_device" in rig.conditions())
    assert [f.detail for f in rig.rotator.faults() if f.condition == "wrong_device"] == [
        "two servos answer to id 1: give one of them another id"
    ]
    await rig.rotator.disarm()
    with pytest.raises(DeviceRefusedError, match="two servos answer to id 1"):
        await rig.rotator.arm()
    rig.bus.clear_faults()
    await rig.until(lambda: not rig.conditions())
    await rig.rotator.arm()


async def test_nothing_arms_on_a_line_that_damages_what_is_said(rig: Bench) -> None:
    rig.bus.inject("flip", rate=0.3)
    await rig.until(lambda: "corrupt_replies" in rig.conditions())
    with pytest.raises(DeviceRefusedError, match="corrupt_replies"):
        await rig.rotator.arm()
    rig.bus.clear_faults()
    await rig.until(lambda: not rig.conditions())
    await rig.rotator.arm()


async def test_late_answers_are_no_second_servo(rig: Bench) -> None:
    told = set[str]()
    for delay_s in (0.0, 0.08, 0.0, 0.03, 0.0):
        rig.bus.inject("delay", seconds=delay_s)
        for _ in range(10):
            await rig.rotator.wait_telemetry()
            told |= rig.conditions()
    assert "wrong_device" not in told


async def test_answers_that_lie_on_each_other_are_told_as_damage_not_as_silence(tmp_path: Path) -> None:
    async with bench(tmp_path, opened=False) as rig:
        rig.bus.inject("collide")
        with pytest.raises(DeviceTimeoutError):
            await rig.rotator.open()
        assert rig.conditions() == {"corrupt_replies"}
        rig.bus.clear_faults()
        rig.bus.inject("flip")
        with pytest.raises(DeviceTimeoutError, match=r"every answer at 57600 bit/s is damaged.*second servo with id 1"):
            await rig.rotator.open()
        rig.bus.clear_faults()
        await rig.rotator.open()
        rig.bus.inject("collide")
        await rig.until(lambda: "corrupt_replies" in rig.conditions())


@pytest.mark.parametrize("after_s", [0.0, 0.005, 0.02, 0.05])
async def test_closed_is_closed_though_the_plug_is_pulled_meanwhile(rig: Bench, after_s: float) -> None:
    await rig.rotator.arm()
    await rig.drive(50.0, rig.past(10.0))
    closing = asyncio.create_task(rig.rotator.close())
    await asyncio.sleep(after_s)
    await rig.bus.unplug()
    async with asyncio.timeout(3.0):
        await closing
    assert state(rig.rotator) is Lifecycle.CLOSED
    await rig.bus.replug()
    await asyncio.sleep(0.3)
    assert state(rig.rotator) is Lifecycle.CLOSED
    await rig.rotator.open()
    assert state(rig.rotator) is Lifecycle.STANDBY


async def test_nobody_waits_for_the_telemetry_of_a_closed_servo(rig: Bench) -> None:
    await rig.rotator.close()
    async with asyncio.timeout(10.0):
        with pytest.raises(LifecycleError, match="closed"):
            await rig.rotator.wait_telemetry()
