"""Every fault of the servo: named, safe, and recoverable without a new rotator (issue: the PH54 driver, item 4)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from drivers.dynamixel import Ph54Rotator
from drivers.dynamixel.keeper import ServoKeeper
from drivers.dynamixel.virtual import FAULTS, VirtualServo, VirtualServoBus
from graderd.hal.errors import DeviceError, DeviceMissingError, DeviceRefusedError, DeviceTimeoutError, WrongDeviceError
from graderd.hal.lifecycle import Lifecycle
from graderd.hal.settings import RotatorSettings
from tests.dynamixel_sim import Bench, bench, until

ALERTS = sorted(name for name in FAULTS if name.startswith("alert_"))


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Bench]:
    async with bench(tmp_path) as made:
        yield made


async def armed_at(rig: Bench, goal_deg: float) -> None:
    """Arm and drive somewhere, so that there is something to lose."""
    await rig.rotator.arm()
    await rig.drive(goal_deg, rig.at(goal_deg))


async def works_again(rig: Bench, goal_deg: float = 10.0) -> None:
    """Faults gone, arm, and the blade goes where it is told: without a jump on the way."""
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY, "not in standby")
    await rig.until(lambda: not rig.conditions(), "faults did not clear")
    before_deg = rig.servo.shaft_deg
    await rig.rotator.arm()
    await asyncio.sleep(0.1)
    assert rig.servo.shaft_deg == pytest.approx(before_deg, abs=0.3)
    await rig.drive(goal_deg, rig.at(goal_deg))
    assert not rig.conditions()


def standing(rig: Bench) -> bool:
    return abs(rig.servo.shaft_velocity_deg_per_s) < 0.5


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
    async with bench(tmp_path, servo, gear_ratio=10.0, velocity_deg_per_s=10.0) as rig:
        assert rig.at(40.0)()
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
    await asyncio.sleep(1.5)
    rig.bus.inject("push", torque_nm=55.0)  # more than the current limit holds
    await rig.until(lambda: "moving_uncommanded" in rig.conditions())
    rig.bus.clear_faults()
    await rig.rotator.disarm()
    rig.servo.shaft_deg = 0.0
    await works_again(rig)


async def test_moving_uncommanded_while_unpowered(rig: Bench) -> None:
    await asyncio.sleep(0.5)
    rig.bus.inject("push", torque_nm=10.0)
    await rig.until(lambda: "moving_uncommanded" in rig.conditions())
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
        begun_s = asyncio.get_running_loop().time()
        await rig.drive(goal_deg, lambda s=begun_s: asyncio.get_running_loop().time() - s > 0.8)  # type: ignore[misc]
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


async def test_unplug_in_mid_turn_and_replug_under_the_same_name(rig: Bench) -> None:
    await rig.rotator.arm()
    await rig.drive(50.0, rig.past(13.0))
    began_s = rig.clock.now_s()
    await rig.bus.unplug()
    await rig.until(lambda: "unplugged" in rig.conditions())
    assert rig.clock.now_s() - began_s < 0.5
    assert rig.rotator.lifecycle is Lifecycle.FAILED
    await rig.until(lambda: standing(rig))
    assert rig.servo.shaft_deg < 45.0
    await rig.bus.replug()
    await rig.until(lambda: "watchdog_tripped" in rig.conditions())
    await works_again(rig)


class Adapter:
    """A serial port as pyserial lists it."""

    def __init__(self, device: str, serial_number: str | None) -> None:
        self.device = device
        self.serial_number = serial_number


async def test_replug_under_another_name_is_found_by_usb_serial_number(tmp_path: Path) -> None:
    servo = VirtualServo()
    wire = VirtualServoBus([servo], tmp_path / "ttyUSB0")
    adapters = [Adapter("/dev/ttyS0", None), Adapter(str(tmp_path / "ttyUSB0"), "FT4THV9P")]
    settings = RotatorSettings(port="/dev/null/nothing", usb_serial_number="FT4THV9P")
    rotator = Ph54Rotator(settings, list_ports=lambda: list(adapters))
    await wire.start()
    try:
        await rotator.open()
        await rotator.arm()
        await wire.unplug()
        adapters.pop()
        await until(lambda: rotator.lifecycle is Lifecycle.FAILED, "not lost")
        await asyncio.sleep(0.2)
        assert any(f.condition == "unplugged" for f in rotator.faults())
        await wire.replug(tmp_path / "ttyUSB3")
        adapters.append(Adapter(str(tmp_path / "ttyUSB3"), "FT4THV9P"))
        await until(lambda: rotator.lifecycle is Lifecycle.STANDBY, "not found again")
        assert rotator.port == str(tmp_path / "ttyUSB3")
        await rotator.arm()
    finally:
        await rotator.close()
        await wire.close()


async def test_opening_without_port_or_servo_says_what_to_do(tmp_path: Path) -> None:
    nowhere = Ph54Rotator(RotatorSettings(port=str(tmp_path / "none")))
    with pytest.raises(DeviceMissingError, match="no such serial port"):
        await nowhere.open()
    assert nowhere.lifecycle is Lifecycle.CLOSED
    assert [f.condition for f in nowhere.faults()] == ["unplugged"]
    absent = Ph54Rotator(RotatorSettings(usb_serial_number="X1"), list_ports=lambda: [Adapter("/dev/ttyUSB7", "Y2")])
    with pytest.raises(DeviceMissingError, match=r"X1.*Y2 at /dev/ttyUSB7"):
        await absent.open()
    async with bench(tmp_path, opened=False, servo_id_n=5) as rig:
        with pytest.raises(DeviceTimeoutError, match="nothing answers"):
            await rig.rotator.open()
        assert rig.conditions() == {"no_reply"}
    async with bench(tmp_path, opened=False, baud_n=12_345) as rig:
        with pytest.raises(DeviceRefusedError, match="cannot run at 12345"):
            await rig.rotator.open()


async def test_all_mismatches_stand_in_one_error_and_nothing_is_written(tmp_path: Path) -> None:
    servo = VirtualServo()
    servo.memory["drive_mode"] = 9
    servo.memory["operating_mode"] = 1
    servo.memory["homing_offset"] = 77
    servo.memory["startup_configuration"] = 1
    servo.memory["shutdown"] = 4
    servo.memory["secondary_id"] = 9
    servo.memory["firmware_version"] = 5
    before = [servo.memory[r.name] for r in servo.table.registers if r.eeprom]
    async with bench(tmp_path, servo, opened=False) as rig:
        with pytest.raises(WrongDeviceError) as caught:
            await rig.rotator.open()
        for word in (
            "Drive Mode",
            "Operating Mode",
            "Homing Offset",
            "Startup",
            "Shutdown",
            "Secondary ID",
            "Firmware",
        ):
            assert word in str(caught.value)
        assert rig.conditions() == {"wrong_device"}
    assert before == [servo.memory[r.name] for r in servo.table.registers if r.eeprom]
    assert not servo.torque_enabled


async def test_a_wrong_model_is_refused_at_open(tmp_path: Path) -> None:
    async with bench(tmp_path, opened=False) as rig:
        rig.bus.inject("wrong_model")
        with pytest.raises(WrongDeviceError, match="model number 2010"):
            await rig.rotator.open()


async def test_a_low_status_return_level_is_put_right(tmp_path: Path) -> None:
    servo = VirtualServo()
    servo.memory["status_return_level"] = 0
    async with bench(tmp_path, servo) as rig:
        assert rig.rotator.lifecycle is Lifecycle.STANDBY


async def test_the_servo_task_comes_back_when_it_is_killed(rig: Bench) -> None:
    def reconnects_n() -> int:
        return rig.rotator.telemetry().counters.get("reconnects_n", 0)

    before_n = reconnects_n()
    for task in asyncio.all_tasks():
        if task.get_name() == "rotation-servo":
            task.cancel()
    await rig.until(lambda: reconnects_n() > before_n)  # that it failed between may be too short to be seen
    await works_again(rig)


async def test_an_unexpected_exception_does_not_end_the_search(rig: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ServoKeeper, "_cycle", lambda *_, **__: 1 / 0)
        await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    await works_again(rig)


async def test_a_reboot_needs_standby(rig: Bench) -> None:
    await rig.rotator.arm()
    with pytest.raises(DeviceError, match="standby"):
        await rig.rotator.reboot()


async def test_a_servo_that_does_not_come_back_from_a_reboot_is_looked_for(rig: Bench) -> None:
    rig.servo.reboot_s = 7.0  # two seconds more than it is waited for
    with pytest.raises(DeviceTimeoutError):
        await rig.rotator.reboot()
    await works_again(rig)


async def test_power_lost_during_arming_leaves_no_torque(rig: Bench) -> None:
    arming = asyncio.create_task(rig.rotator.arm(), name="arm")
    await asyncio.sleep(0.002)
    rig.bus.inject("ram_reset")
    try:
        await arming
    except DeviceError:
        assert not rig.servo.torque_enabled
        assert rig.rotator.lifecycle is not Lifecycle.ACTIVE
    await rig.rotator.disarm()


async def test_arming_is_refused_outside_the_limits_and_in_motion(rig: Bench) -> None:
    rig.servo.shaft_deg = 80.0
    await rig.rotator.wait_telemetry()
    with pytest.raises(DeviceRefusedError, match=r"outside its limits"):
        await rig.rotator.arm()
    assert not rig.servo.torque_enabled
    rig.servo.shaft_deg = 0.0
    rig.servo.plant.settings.friction_nm = 0.0
    rig.servo.plant.velocity_deg_per_s = 20.0
    with pytest.raises(DeviceRefusedError, match=r"turns at"):
        await rig.rotator.arm()
    assert not rig.servo.torque_enabled
