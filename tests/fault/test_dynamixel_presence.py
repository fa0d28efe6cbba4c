"""A servo that goes, comes back, or is another one: found again, named, and never armed unasked."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.drivers.dynamixel import Ph54Rotator, servo_task
from graderd.drivers.dynamixel.connection import ServoLink
from graderd.drivers.dynamixel.servo_task import ServoTask
from graderd.hal.device import Lifecycle
from graderd.hal.errors import (
    DeviceError,
    DeviceMissingError,
    DeviceRefusedError,
    DeviceTimeoutError,
    LifecycleError,
    WrongDeviceError,
)
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo import VirtualServo, VirtualServoBus
from tests.dynamixel_sim import Bench, bench, standing, until, works_again


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Bench]:
    async with bench(tmp_path) as made:
        yield made


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
    settings = Ph54Settings(port="/dev/null/nothing", usb_serial_number="FT4THV9P")
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
    nowhere = Ph54Rotator(Ph54Settings(port=str(tmp_path / "none")))
    with pytest.raises(DeviceMissingError, match="no such serial port"):
        await nowhere.open()
    assert nowhere.lifecycle is Lifecycle.CLOSED
    assert [f.condition for f in nowhere.faults()] == ["unplugged"]
    absent = Ph54Rotator(Ph54Settings(usb_serial_number="X1"), list_ports=lambda: [Adapter("/dev/ttyUSB7", "Y2")])
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
        patch.setattr(ServoTask, "_cycle", lambda *_, **__: 1 / 0)
        await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
    await works_again(rig)


async def test_the_pause_between_two_looks_for_a_lost_servo_is_bounded(
    rig: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long it was away, it is found soon after it is back: twenty doublings would be days."""
    looks: list[float] = []

    async def absent(_: ServoLink) -> None:
        looks.append(rig.clock.now_s())
        raise DeviceMissingError("/dev/servo", "no such serial port")

    monkeypatch.setattr(servo_task, "_RECONNECT_FIRST_S", 0.001)
    monkeypatch.setattr(servo_task, "_RECONNECT_MOST_S", 0.01)
    with monkeypatch.context() as patch:
        patch.setattr(ServoLink, "connect", absent)
        await rig.bus.unplug()
        await rig.until(lambda: len(looks) > 20, "no more looks for the servo")
    await rig.bus.replug()
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY, "not found again")


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


@pytest.mark.parametrize("after_s", [0.0, 0.01, 0.03, 0.06, 0.09])
@pytest.mark.parametrize("what", ["cancelled", "closed", "unplugged"])
async def test_arming_that_is_broken_off_leaves_no_torque(rig: Bench, what: str, after_s: float) -> None:
    """A stop cancels an arming at whatever point it is: nothing is powered, nothing moves, and it arms again."""
    arming = asyncio.create_task(rig.rotator.arm())
    await asyncio.sleep(after_s)
    rig.rotator.hold()
    match what:
        case "cancelled":
            arming.cancel()
        case "closed":
            await rig.rotator.close()
        case "unplugged":
            await rig.bus.unplug()
    await asyncio.gather(arming, return_exceptions=True)
    if what == "unplugged":
        await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
        await rig.bus.replug()
    if what == "closed":
        await rig.rotator.open()
    elif rig.rotator.lifecycle is Lifecycle.ACTIVE:  # it was armed already
        await rig.rotator.disarm()
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY and not rig.servo.torque_enabled)
    assert rig.servo.shaft_deg == pytest.approx(0.0, abs=0.3)
    await works_again(rig, 3.0)


async def test_closing_an_arming_that_has_just_switched_torque_on_switches_it_off(rig: Bench) -> None:
    rig.bus.inject("delay", seconds=0.03)  # it is on before the driver hears of it
    arming = asyncio.create_task(rig.rotator.arm())
    await rig.until(lambda: rig.servo.torque_enabled)
    await rig.rotator.close()
    assert not rig.servo.torque_enabled
    with pytest.raises(LifecycleError, match="while it was being armed"):
        await arming


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


async def test_a_servo_refused_for_its_settings_can_still_be_verified(tmp_path: Path) -> None:
    servo = VirtualServo()
    async with bench(tmp_path, servo) as rig:
        await rig.bus.unplug()
        await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.FAILED)
        servo.memory["drive_mode"] = 1
        await rig.bus.replug()
        await rig.until(lambda: "wrong_device" in rig.conditions())
        found = await rig.rotator.verify_profile()
        assert [d.register for d in found if d.kind != "default"] == ["drive_mode"]
        servo.memory["drive_mode"] = 0
        await works_again(rig)


async def test_what_arming_wrote_is_no_difference(rig: Bench) -> None:
    await rig.rotator.arm()
    await rig.rotator.disarm()
    assert rig.servo.memory["current_limit"] == 9300  # not the factory's
    assert await rig.rotator.verify_profile() == []
    rig.servo.memory["current_limit"] = 5000
    assert [d.kind for d in await rig.rotator.verify_profile()] == ["default"]


@pytest.mark.timeout(90)
async def test_a_scan_finds_ids_and_baud_rates_and_the_servo_comes_back(tmp_path: Path) -> None:
    servo, other = VirtualServo(), VirtualServo(17)
    wire = VirtualServoBus([servo, other], tmp_path / "servo", strict_baud=True)
    await wire.start()
    rotator = Ph54Rotator(Ph54Settings(port=str(wire.link)))
    try:
        await rotator.open()
        await rotator.arm()
        with pytest.raises(LifecycleError, match="armed"):
            await rotator.scan()
        await rotator.disarm()
        arming = asyncio.create_task(rotator.arm())
        await asyncio.sleep(0)  # it has the wire, and is not armed yet
        with pytest.raises(LifecycleError, match="armed"):
            await rotator.scan()
        await arming
        assert rotator.lifecycle is Lifecycle.ACTIVE
        await rotator.disarm()
        found = await rotator.scan()
        assert [(f.baud_n, f.servo_id_n, f.model_n) for f in found] == [(57_600, 1, 2020), (57_600, 17, 2020)]
        await until(lambda: rotator.lifecycle is Lifecycle.STANDBY, "not found again")
        await rotator.arm()
    finally:
        await rotator.close()
        await wire.close()
