"""The virtual servo's own protection: watchdog, hardware errors, reboot, what survives a power cut."""

from __future__ import annotations

import pytest

from graderd.drivers.dynamixel.codec import (
    BROADCAST_ID,
    Instruction,
    StatusError,
)
from graderd.simulator.servo import VirtualServo
from tests.servo_line import Line, moving

KEY = bytes((0x43, 0x54, 0x52, 0x4C))


@pytest.fixture
def line() -> Line:
    return Line(VirtualServo(1))


def test_the_watchdog_stops_locks_goals_and_is_cleared_by_zero(line: Line) -> None:
    moving(line)
    assert line.write("bus_watchdog", 10) == 0
    line.run(1.0, fed=True)
    line.run(0.19)
    assert line.servos[0].shaft_velocity_deg_per_s > 25.0
    line.run(0.05)
    assert line.servos[0].shaft_velocity_deg_per_s < 1.0
    assert line.read("bus_watchdog") == -1
    assert line.write("goal_position", 0) == StatusError.DATA_RANGE
    assert line.write("bus_watchdog", 10) == StatusError.DATA_RANGE
    assert line.write("bus_watchdog", 0) == 0
    where = line.servos[0].shaft_deg
    line.run(1.0)
    assert line.servos[0].shaft_deg == pytest.approx(where, abs=0.5)  # the stale goal does not come alive
    assert line.write("goal_position", 0) == 0


def test_the_watchdog_sleeps_without_torque_and_any_packet_feeds_it() -> None:
    line = Line(VirtualServo(1), VirtualServo(2))
    line.write("bus_watchdog", 5)
    line.run(1.0)
    assert line.read("bus_watchdog") == 5
    line.write("torque_enable", 1)
    for _ in range(20):
        line.run(0.05)
        line.ask(2, Instruction.PING)
    assert line.read("bus_watchdog") == 5
    line.run(0.15)
    assert line.read("bus_watchdog") == -1


def test_a_hardware_error_cuts_torque_as_the_mask_says_and_only_a_reboot_gives_it_back(line: Line) -> None:
    servo = line.servos[0]
    line.write("torque_enable", 1)
    servo.raise_hardware_error(0x01)  # voltage: not in the default mask of 52
    assert line.read("torque_enable") == 1
    assert line.ask(1, Instruction.PING)[0].alert
    servo.raise_hardware_error(0x20)
    assert line.read("torque_enable") == 0
    assert line.read("hardware_error_status") == 0x21
    assert line.write("torque_enable", 1) == StatusError.RESULT_FAIL
    assert line.ask(1, Instruction.REBOOT)[0].error == 0
    assert line.ask(1, Instruction.PING) == []
    line.run(0.45)
    assert not line.ask(1, Instruction.PING)[0].alert
    assert line.write("torque_enable", 1) == 0


def test_overload_heat_and_voltage_raise_their_bits(line: Line) -> None:
    servo = line.servos[0]
    moving(line)
    servo.plant.jammed = True
    line.run(8.0, fed=True)
    assert line.read("hardware_error_status") & 0x20
    for attribute, value, bit in (("forced_temperature_c", 81.0, 0x04), ("forced_voltage_v", 14.0, 0x01)):
        fresh = Line(VirtualServo(1))
        setattr(fresh.servos[0], attribute, value)
        fresh.run(0.05)
        assert fresh.read("hardware_error_status") == bit


def test_a_reboot_resets_ram_keeps_eeprom_and_wraps_the_turns(line: Line) -> None:
    servo = line.servos[0]
    line.write("operating_mode", 4)
    servo.shaft_deg = 800.0
    assert line.read("present_position") == round(800.0 / 360 * 1_003_846)
    line.write("led_red", 5)
    line.write("temperature_limit", 70)
    line.ask(1, Instruction.REBOOT)
    line.run(0.5)
    assert (line.read("led_red"), line.read("temperature_limit")) == (0, 70)
    assert line.read("present_position") == round(80.0 / 360 * 1_003_846)
    assert servo.shaft_deg == pytest.approx(800.0)


def test_position_mode_wraps_at_torque_on(line: Line) -> None:
    line.servos[0].shaft_deg = 370.0
    assert line.read("present_position") == round(370.0 / 360 * 1_003_846)
    line.write("goal_position", round(10.0 / 360 * 1_003_846))
    line.write("torque_enable", 1)
    line.run(0.3, fed=True)
    assert line.read("present_position") == pytest.approx(10.0 / 360 * 1_003_846, abs=300)
    assert line.servos[0].shaft_deg == pytest.approx(370.0, abs=0.1)


def test_clear_works_at_rest_only(line: Line) -> None:
    clear = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))
    line.write("operating_mode", 4)
    line.servos[0].shaft_deg = 730.0
    moving(line, goal=round(740.0 / 360 * 1_003_846))
    line.run(0.3, fed=True)
    assert line.ask(1, Instruction.CLEAR, clear)[0].error == StatusError.RESULT_FAIL
    line.run(3.0, fed=True)
    assert line.ask(1, Instruction.CLEAR, clear)[0].error == 0
    assert line.read("present_position") == pytest.approx(20.0 / 360 * 1_003_846, abs=300)
    line.run(1.0, fed=True)
    assert line.servos[0].shaft_deg == pytest.approx(740.0, abs=0.2)
    assert line.ask(1, Instruction.CLEAR, b"\x02" + clear[1:])[0].error == StatusError.RESULT_FAIL


def test_backup_and_restore(line: Line) -> None:
    assert line.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x02" + KEY)[0].error == StatusError.RESULT_FAIL
    line.write("temperature_limit", 66)
    line.write("position_p_gain", 500)
    line.write("startup_configuration", 2)
    assert line.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x01" + KEY)[0].error == 0
    assert line.read("backup_ready") == 1
    line.write("temperature_limit", 77)
    line.write("torque_enable", 1)
    assert line.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x01" + KEY)[0].error == StatusError.RESULT_FAIL
    line.write("torque_enable", 0)
    assert line.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x02" + KEY)[0].error == 0
    line.run(0.5)
    assert line.read("temperature_limit") == 66
    assert line.read("position_p_gain") == 500  # startup bit 1 restores RAM too
    assert line.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x03" + KEY)[0].error == StatusError.RESULT_FAIL


def test_factory_reset_keeps_what_it_is_told_to(line: Line) -> None:
    for option, servo_id, baud in ((0x02, 8, 3), (0x01, 8, 1), (0xFF, 1, 1)):
        fresh = Line(VirtualServo(8))
        fresh.write("baud_rate", 3, servo_id=8)
        fresh.write("temperature_limit", 60, servo_id=8)
        assert fresh.ask(8, Instruction.FACTORY_RESET, bytes((option,)))[0].error == 0
        fresh.run(0.5)
        assert fresh.servos[0].servo_id == servo_id
        assert (fresh.servos[0].memory["baud_rate"], fresh.servos[0].memory["temperature_limit"]) == (baud, 80)
    assert line.ask(1, Instruction.FACTORY_RESET, b"\x07")[0].error == StatusError.DATA_RANGE
    line.write("temperature_limit", 60)
    line.ask(BROADCAST_ID, Instruction.FACTORY_RESET, b"\xff")  # would leave every servo of a bus with id 1
    assert line.read("temperature_limit") == 60


def test_power_off_is_silent_and_comes_back_with_fresh_ram(line: Line) -> None:
    line.write("led_red", 9)
    line.servos[0].power(False)
    assert line.ask(1, Instruction.PING) == []
    line.run(0.1)
    line.servos[0].power(True)
    assert line.read("led_red") == 0


def test_startup_configuration_can_power_the_motor_at_boot(line: Line) -> None:
    line.write("startup_configuration", 1)
    line.ask(1, Instruction.REBOOT)
    line.run(0.5)
    assert line.read("torque_enable") == 1


def test_the_same_seed_gives_the_same_readings() -> None:
    def run(seed: int) -> list[int]:
        line = Line(VirtualServo(1, seed=seed))
        moving(line)
        readings = []
        for _ in range(50):
            line.run(0.02, fed=True)
            readings.append(line.read("present_current"))
        return readings

    assert run(3) == run(3)
    assert run(3) != run(4)
