"""Every fault of the servo: named, safe, and recoverable without a new rotator (issue: the PH54 driver, item 4)."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceError, DeviceRefusedError
from graderd.simulator.servo import FAULTS, VirtualServo
from tests.dynamixel_sim import LOST_S, Bench, armed_at, bench, standing, works_again

ALERTS = sorted(name for name in FAULTS if name.startswith("alert_"))


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Bench]:
    async with bench(tmp_path, reply_timeout_s=LOST_S) as made:
        yield made


async def test_no_reply_fails_the_rotator_stops_the_blade_and_heals(rig: Bench) -> None:
    await rig.rotator.arm()
    await rig.drive(50.0, rig.past(13.0))
    rig.bus.inject("drop_requests")
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    assert "no_reply" in rig.conditions()
    await rig.until(lambda: standing(rig))  # the servo's own watchdog
    assert rig.servo.shaft_deg < 45.0
    rig.bus.clear_faults()
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY)
    assert not rig.servo.torque_enabled
    await works_again(rig)


async def test_an_answer_that_takes_long_is_told_within_the_configured_time(rig: Bench) -> None:
    rig.bus.inject("drop")
    began_s = rig.clock.now_s()
    await rig.until(lambda: "no_reply" in rig.conditions())
    assert 0.1 < rig.clock.now_s() - began_s < 1.0  # reply_timeout_s is 0.25


async def test_a_hold_that_goes_unanswered_puts_off_nothing(rig: Bench) -> None:
    """Whether it was taken is asked for, but no longer than until the servo counts as lost: seven requests."""
    await rig.rotator.arm()
    await rig.drive(50.0, rig.past(13.0))
    rig.bus.inject("delay", seconds=0.4)
    before_n = rig.rotator.telemetry().counters["timeouts_n"]
    await rig.until(lambda: rig.rotator.telemetry().counters["timeouts_n"] - before_n >= 2)
    rig.rotator.hold()
    await rig.until(lambda: "no_reply" in rig.conditions())
    assert rig.rotator.telemetry().counters["timeouts_n"] - before_n <= 8


async def test_corrupt_replies_are_named_and_never_believed(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.bus.inject("flip", rate=0.3)
    for _ in range(100):
        rig.rotator.set_goal_deg(5.0)
        angle = (await rig.rotator.wait_telemetry()).angle_deg
        assert angle is not None
        assert angle.value == pytest.approx(5.0, abs=0.6)
        if "corrupt_replies" in rig.conditions():
            break
    assert "corrupt_replies" in rig.conditions()
    rig.bus.clear_faults()
    await rig.rotator.disarm()
    await works_again(rig)


async def test_nothing_but_corrupt_replies_is_a_lost_servo(rig: Bench) -> None:
    rig.bus.inject("flip")
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    assert "corrupt_replies" in rig.conditions()
    rig.bus.clear_faults()
    await works_again(rig)


async def test_replies_with_another_id_are_not_believed(rig: Bench) -> None:
    rig.bus.inject("foreign_id")
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    assert rig.rotator.telemetry().counters["foreign_n"] > 0
    assert "no_reply" in rig.conditions()
    rig.bus.clear_faults()
    await works_again(rig)


async def test_another_model_after_a_replug_is_named_and_not_armed(rig: Bench) -> None:
    await rig.bus.unplug()
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    rig.bus.inject("wrong_model")
    await rig.bus.replug()
    await rig.until(lambda: "wrong_device" in rig.conditions())
    with pytest.raises(DeviceError):
        await rig.rotator.arm()
    rig.bus.clear_faults()
    await works_again(rig)


@pytest.mark.parametrize("alert", ALERTS)
async def test_each_hardware_error_bit_is_named_and_cleared_by_a_reboot(rig: Bench, alert: str) -> None:
    await armed_at(rig, 5.0)
    rig.servo.memory["shutdown"] = 0x3F  # this one lets every error cut the torque
    rig.bus.inject(alert)
    await rig.until(lambda: alert in rig.conditions())
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY)
    assert not rig.servo.torque_enabled
    # Readable under alert:
    angle = (await rig.rotator.wait_telemetry()).angle_deg
    assert angle is not None
    assert angle.value == pytest.approx(5.0, abs=1.0)
    with pytest.raises(DeviceRefusedError, match="hardware error"):
        await rig.rotator.arm()
    await rig.rotator.reboot()
    await works_again(rig)


async def test_an_alert_that_cuts_no_torque_leaves_the_rotator_active(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.servo.memory["shutdown"] = 0x30
    rig.bus.inject("alert_voltage")
    await rig.until(lambda: "alert_voltage" in rig.conditions())
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE


async def test_a_tripped_watchdog_is_named_and_arming_clears_it(rig: Bench) -> None:
    await rig.rotator.arm()
    await rig.drive(50.0, rig.past(13.0))
    # What a daemon that stood still for a while finds: the servo stopped by itself.
    rig.servo.memory["bus_watchdog"] = -1
    rig.servo.tripped = True
    await rig.until(lambda: "watchdog_tripped" in rig.conditions())
    assert rig.rotator.lifecycle is Lifecycle.STANDBY
    await rig.until(lambda: standing(rig))
    assert rig.servo.shaft_deg < 45.0
    await works_again(rig)
    assert not rig.servo.tripped


async def test_a_refused_goal_finds_the_tripped_watchdog_at_once(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.servo.memory["bus_watchdog"] = -1
    rig.servo.tripped = True
    rig.rotator.set_goal_deg(20.0)
    await rig.until(lambda: "watchdog_tripped" in rig.conditions(), timeout_s=2.0)
    assert rig.rotator.lifecycle is Lifecycle.STANDBY


async def test_ram_reset_by_a_supply_dip_never_leaves_the_rotator_active(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.bus.inject("ram_reset")
    await rig.until(lambda: "ram_reset" in rig.conditions())
    assert rig.rotator.lifecycle is Lifecycle.STANDBY
    await works_again(rig)


async def test_a_power_cut_is_lost_and_then_named_as_ram_reset(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.bus.inject("power_cut")
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    rig.bus.clear_faults()
    await rig.until(lambda: "ram_reset" in rig.conditions())
    assert rig.rotator.lifecycle is Lifecycle.STANDBY
    assert not rig.servo.torque_enabled
    await works_again(rig)


async def test_torque_switched_off_by_others_is_named_and_ends_active(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.bus.inject("torque_off")
    await rig.until(lambda: "torque_off" in rig.conditions())
    assert rig.rotator.lifecycle is Lifecycle.STANDBY
    await works_again(rig)


async def test_lost_turns_in_position_mode_are_named_and_the_angle_stays_right(rig: Bench) -> None:
    await armed_at(rig, 5.0)
    rig.bus.inject("turns_lost", turns_n=1)
    await rig.until(lambda: "turns_lost" in rig.conditions())
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY and not rig.servo.torque_enabled)
    angle = (await rig.rotator.wait_telemetry()).angle_deg
    assert angle is not None
    assert angle.value == pytest.approx(5.0, abs=1.0)
    await works_again(rig)


async def test_lost_turns_behind_a_gear_need_a_person(tmp_path: Path) -> None:
    servo = VirtualServo()
    servo.memory["operating_mode"] = 4
    servo.shaft_deg = 400.0
    async with bench(tmp_path, servo, gear_ratio=10.0, speed_deg_per_s=8.3) as rig:
        assert rig.at(40.0)()
        rig.rotator.confirm_turns()
        await rig.rotator.arm()
        await rig.drive(45.0, rig.at(45.0))
        await rig.rotator.disarm()
        await rig.rotator.reboot()
        assert "turns_lost" in rig.conditions()
        angle = rig.rotator.telemetry().angle_deg
        assert angle is not None
        assert not angle.valid
        with pytest.raises(DeviceRefusedError, match="turns"):
            await rig.rotator.arm()
        rig.rotator.confirm_turns()
        await works_again(rig)


async def test_commanded_but_not_moving(rig: Bench) -> None:
    await armed_at(rig, 0.0)
    rig.bus.inject("jam")
    await rig.drive(20.0, lambda: "not_moving" in rig.conditions())
    rig.rotator.hold()
    rig.bus.clear_faults()
    await rig.until(lambda: not rig.conditions())
    await rig.drive(10.0, rig.at(10.0))
    assert not rig.conditions()


async def test_moving_uncommanded_while_armed(rig: Bench) -> None:
    await armed_at(rig, 0.0)
    rig.rotator.hold()
    held_s = rig.clock.now_s()
    await rig.until(lambda: not rig.conditions() and rig.clock.now_s() > held_s + 1.0)
    rig.bus.inject("push", torque_nm=55.0)  # more than the current limit holds
    await rig.until(lambda: "moving_uncommanded" in rig.conditions())
    rig.bus.clear_faults()
    await rig.rotator.disarm()
    rig.servo.shaft_deg = 0.0
    await works_again(rig)


async def test_a_blade_without_torque_may_be_turned_by_hand(rig: Bench) -> None:
    """As bring-up and calibration ask; while it has torque the same push is told (above)."""
    begun_s = rig.clock.now_s()
    await rig.until(lambda: not rig.conditions() and rig.clock.now_s() > begun_s + 0.5)
    from_deg = rig.servo.shaft_deg
    rig.bus.inject("push", torque_nm=10.0)
    await rig.until(lambda: abs(rig.servo.shaft_deg - from_deg) > 10.0)
    turned_s = rig.clock.now_s()
    await rig.until(lambda: rig.conditions() or rig.clock.now_s() > turned_s + 0.5)
    assert "moving_uncommanded" not in rig.conditions()
    rig.bus.clear_faults()
    rig.servo.shaft_deg = 0.0
    await works_again(rig)


async def test_moving_the_wrong_way(rig: Bench) -> None:
    await armed_at(rig, 0.0)
    rig.bus.inject("wrong_way")
    await rig.drive(20.0, lambda: "wrong_way" in rig.conditions())
    assert rig.servo.shaft_deg < 0.0
    await rig.rotator.disarm()
    rig.bus.clear_faults()
    await rig.until(lambda: standing(rig))
    rig.servo.shaft_deg = 0.0
    await works_again(rig)


async def test_reversing_and_holding_raise_nothing(rig: Bench) -> None:
    await rig.rotator.arm()
    for goal_deg in (50.0, -50.0, 50.0):
        begun_s = rig.clock.now_s()
        await rig.drive(goal_deg, lambda s=begun_s: rig.conditions() or rig.clock.now_s() - s > 0.8)  # type: ignore[misc]
        assert not rig.conditions()
    rig.rotator.hold()
    for _ in range(60):
        await rig.rotator.wait_telemetry()
        assert not rig.conditions()


@pytest.mark.parametrize(
    ("fault", "params", "condition"),
    [
        ("voltage", {"volts": 19.0}, "voltage_near_limit"),
        ("voltage", {"volts": 30.5}, "voltage_near_limit"),
        ("temperature", {"celsius": 75.0}, "temperature_near_limit"),
    ],
)
async def test_near_limits_warn_and_keep_working(
    rig: Bench, fault: str, params: dict[str, float], condition: str
) -> None:
    await armed_at(rig, 5.0)
    rig.bus.inject(fault, **params)
    await rig.until(lambda: condition in rig.conditions())
    assert rig.rotator.lifecycle is Lifecycle.ACTIVE
    rig.bus.clear_faults()
    await rig.until(lambda: not rig.conditions())
