"""The virtual servo as a Protocol 2.0 slave: registers, addressing, motion."""

from __future__ import annotations

import pytest

from graderd.drivers.dynamixel.codec import (
    BROADCAST_ID,
    Instruction,
    StatusError,
    split_fast_status,
)
from graderd.simulator.servo import VirtualServo
from tests.servo_line import Line, moving


@pytest.fixture
def line() -> Line:
    return Line(VirtualServo(1))


# -- access -----------------------------------------------------------------------------------------------------


def test_every_register_reads_its_default_and_every_writable_one_takes_its_limits(line: Line) -> None:
    own = {"present_input_voltage", "present_temperature", "model_number", "id"}
    for register in line.servos[0].table.registers:
        if register.name in own or register.name.startswith("present_"):
            continue
        assert line.read(register.name) == register.default, register.name
    for register in line.servos[0].table.registers:
        if not register.writable or register.name.startswith("indirect_") or register.name == "id":
            continue
        if register.limit or register.min is None or register.max is None:
            continue
        for value in (register.min, register.max):
            wanted = StatusError.NONE if register.allows(value) else StatusError.DATA_RANGE
            fresh = Line(VirtualServo(1))
            assert fresh.write(register.name, value) in (wanted, None), (register.name, value)


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("present_position", 0, StatusError.ACCESS),
        ("torque_enable", 2, StatusError.DATA_RANGE),
        ("operating_mode", 5, StatusError.DATA_RANGE),
        ("drive_mode", 2, StatusError.DATA_RANGE),
        ("bus_watchdog", -2, StatusError.DATA_RANGE),
        ("max_voltage_limit", 351, StatusError.DATA_LIMIT),
        ("goal_position", 501_434, StatusError.DATA_LIMIT),
        ("goal_current", -22_741, StatusError.DATA_LIMIT),
        ("profile_velocity", 2_901, StatusError.DATA_LIMIT),
        ("goal_velocity", 2_901, StatusError.DATA_LIMIT),
        ("goal_pwm", -2_010, StatusError.DATA_LIMIT),
    ],
)
def test_illegal_writes_are_refused_with_the_right_number_and_change_nothing(
    line: Line, name: str, value: int, error: StatusError
) -> None:
    before = line.read(name)
    assert line.write(name, value) == error
    assert line.read(name) == before


def test_lengths_and_addresses(line: Line) -> None:
    def error(instruction: int, params: bytes) -> int:
        (reply,) = line.ask(1, instruction, params)
        return reply.error

    assert error(Instruction.WRITE, b"\x34\x02\x00\x00") == StatusError.DATA_LENGTH  # half a goal position
    assert error(Instruction.WRITE, b"\x36\x02\x00\x00") == StatusError.ACCESS  # from its middle
    assert error(Instruction.WRITE, b"\x34\x02") == StatusError.DATA_LENGTH
    assert error(Instruction.READ, b"\x34\x02\x00\x00") == StatusError.DATA_LENGTH
    assert error(Instruction.READ, b"\x34\x02\x04") == StatusError.DATA_LENGTH
    assert error(Instruction.READ, b"\xff\x03\x04\x00") == StatusError.ACCESS
    assert error(Instruction.READ, b"\x0e\x00\x01\x00") == StatusError.ACCESS  # a gap
    assert error(0x42, b"") == StatusError.INSTRUCTION
    (reply,) = line.ask(1, Instruction.READ, b"\x00\x00\x40\x00")  # a block over gaps
    assert reply.error == 0
    assert len(reply.data) == 64


def test_a_write_of_several_registers_takes_effect_as_a_whole_or_not_at_all(line: Line) -> None:
    good = bytes((1, 2, 3))
    assert line.ask(1, Instruction.WRITE, b"\x01\x02" + good)[0].error == 0
    assert [line.read(f"led_{c}") for c in ("red", "green", "blue")] == [1, 2, 3]
    assert line.ask(1, Instruction.WRITE, b"\x01\x02" + bytes((9, 9, 9, 3)))[0].error == StatusError.DATA_RANGE
    assert line.read("led_red") == 1


def test_eeprom_is_locked_while_torque_is_on(line: Line) -> None:
    assert line.write("torque_enable", 1) == 0
    assert line.write("temperature_limit", 70) == StatusError.ACCESS
    assert line.write("led_red", 5) == 0
    assert line.write("torque_enable", 0) == 0
    assert line.write("temperature_limit", 70) == 0


def test_limits_written_by_the_same_packet_count(line: Line) -> None:
    table = line.servos[0].table
    limits = table["max_position_limit"].encode(1000) + table["min_position_limit"].encode(-1000)
    assert line.ask(1, Instruction.WRITE, b"\x30\x00" + limits)[0].error == 0
    assert line.write("goal_position", 1001) == StatusError.DATA_LIMIT
    assert line.write("operating_mode", 4) == 0
    assert line.write("goal_position", 2_000_000) == 0  # the extended mode knows no position limits


def test_indirect_addressing_inherits_size_access_and_limits(line: Line) -> None:
    goal = line.servos[0].table["goal_position"].address
    for i in range(4):
        assert line.write(f"indirect_address_{i + 1}", goal + i) == 0
    assert line.write("indirect_address_5", line.servos[0].table["led_red"].address) == 0
    data = (12_345).to_bytes(4, "little") + b"\x07"
    at = line.servos[0].table["indirect_data_1"].address.to_bytes(2, "little")
    assert line.ask(1, Instruction.WRITE, at + data)[0].error == 0
    assert (line.read("goal_position"), line.read("led_red")) == (12_345, 7)
    assert line.ask(1, Instruction.READ, at + b"\x05\x00")[0].data == data
    assert line.ask(1, Instruction.WRITE, at + b"\x01\x02")[0].error == StatusError.DATA_LENGTH
    assert line.write("indirect_address_6", line.servos[0].table["present_position"].address) == 0
    assert line.write("indirect_data_6", 1) == StatusError.ACCESS
    assert line.write("indirect_address_7", 511) == StatusError.DATA_RANGE
    assert line.write("indirect_data_9", 200) == 0  # not mapped: plain memory
    assert line.read("indirect_data_9") == 200


# -- addressing -------------------------------------------------------------------------------------------------


def test_status_return_level(line: Line) -> None:
    assert line.write("status_return_level", 1) == 0  # answered at the level it was
    assert line.write("led_red", 5) is None
    assert line.read("led_red") == 5
    line.write("status_return_level", 0)
    assert line.ask(1, Instruction.READ, b"\x01\x02\x01\x00") == []
    assert len(line.ask(1, Instruction.PING)) == 1
    assert line.ask(BROADCAST_ID, Instruction.SYNC_READ, b"\x01\x02\x01\x00\x01") == []


def test_several_ids_answer_in_order_and_others_are_silent() -> None:
    line = Line(VirtualServo(9), VirtualServo(2), VirtualServo(5))
    assert [p.packet_id for p in line.ask(BROADCAST_ID, Instruction.PING)] == [2, 5, 9]
    assert line.ask(7, Instruction.PING) == []
    assert line.ask(BROADCAST_ID, Instruction.READ, b"\x01\x02\x01\x00") == []
    assert line.write("led_red", 3, servo_id=BROADCAST_ID) is None
    assert [line.read("led_red", i) for i in (2, 5, 9)] == [3, 3, 3]
    sync = line.ask(BROADCAST_ID, Instruction.SYNC_READ, b"\x01\x02\x01\x00" + bytes((9, 4, 2)))
    assert [p.packet_id for p in sync] == [9, 2]
    fast = line.ask(BROADCAST_ID, Instruction.FAST_SYNC_READ, b"\x01\x02\x01\x00" + bytes((9, 2)))
    assert [r.data for r in split_fast_status(fast[0], [(9, 1), (2, 1)])] == [b"\x03", b"\x03"]
    assert line.ask(BROADCAST_ID, Instruction.FAST_SYNC_READ, b"\x01\x02\x01\x00" + bytes((9, 4))) == []
    bulk = bytes((9, 1, 2, 1, 0, 2, 0, 0, 2, 0))
    assert [p.data for p in line.ask(BROADCAST_ID, Instruction.BULK_READ, bulk)] == [b"\x03", b"\xe4\x07"]
    fast = line.ask(BROADCAST_ID, Instruction.FAST_BULK_READ, bulk)
    assert [r.data for r in split_fast_status(fast[0], [(9, 1), (2, 2)])] == [b"\x03", b"\xe4\x07"]


def test_group_writes_answer_nothing_and_malformed_ones_do_nothing() -> None:
    line = Line(VirtualServo(1), VirtualServo(2))
    assert line.ask(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x01\x02\x01\x00" + bytes((1, 7, 2, 8))) == []
    assert line.ask(BROADCAST_ID, Instruction.BULK_WRITE, bytes((1, 2, 2, 1, 0, 50, 2, 3, 2, 1, 0, 60))) == []
    assert [line.read("led_red", i) for i in (1, 2)] == [7, 8]
    assert (line.read("led_green", 1), line.read("led_blue", 2)) == (50, 60)
    for params in (b"", b"\x01", b"\x01\x02\x01\x00\x01", b"\x01\x02\x00\x00\x01\x02"):
        line.ask(BROADCAST_ID, Instruction.SYNC_WRITE, params)
        line.ask(BROADCAST_ID, Instruction.BULK_WRITE, params)
        line.ask(BROADCAST_ID, Instruction.SYNC_READ, params[:4])
        line.ask(BROADCAST_ID, Instruction.BULK_READ, params)
    assert line.ask(1, Instruction.SYNC_READ, b"\x01\x02\x01\x00\x01") == []
    assert line.read("led_red", 1) == 7


def test_the_secondary_id_is_obeyed_in_ram_and_never_answers(line: Line) -> None:
    assert line.write("secondary_id", 77) == 0
    assert line.write("led_red", 5, servo_id=77) is None
    assert line.write("temperature_limit", 60, servo_id=77) is None
    assert (line.read("led_red"), line.read("temperature_limit")) == (5, 80)
    assert line.ask(77, Instruction.PING) == []


def test_registered_writes_wait_for_action(line: Line) -> None:
    assert line.write("led_red", 5, instruction=Instruction.REG_WRITE) == 0
    assert (line.read("led_red"), line.read("registered_instruction")) == (0, 1)
    assert line.write("torque_enable", 9, instruction=Instruction.REG_WRITE) == StatusError.DATA_RANGE
    assert line.ask(BROADCAST_ID, Instruction.ACTION) == []
    assert (line.read("led_red"), line.read("registered_instruction")) == (5, 0)
    assert line.ask(1, Instruction.ACTION)[0].error == 0


# -- motion -----------------------------------------------------------------------------------------------------


def test_a_trapezoid_keeps_velocity_and_acceleration_and_arrives(line: Line) -> None:
    moving(line)
    fastest, last = 0.0, 0.0
    for _ in range(450):
        line.run(0.01, fed=True)
        v = line.servos[0].shaft_velocity_deg_per_s
        assert abs(v - last) <= 60.0 * 0.01 * 2.5 + 0.05
        fastest, last = max(fastest, v), v
    assert fastest == pytest.approx(30.0, abs=1.0)
    assert line.read("present_position") == pytest.approx(250_000, abs=100)
    assert line.read("moving_status") == 0x31
    assert line.read("moving") == 0


def test_a_new_goal_in_mid_move_keeps_velocity_continuous(line: Line) -> None:
    moving(line)
    line.run(1.5, fed=True)
    line.write("goal_position", -250_000)
    last = line.servos[0].shaft_velocity_deg_per_s
    for _ in range(100):
        line.run(0.01, fed=True)
        v = line.servos[0].shaft_velocity_deg_per_s
        assert abs(v - last) < 2.0
        last = v
    assert last < -20


def test_torque_on_with_a_stale_goal_jumps_and_with_a_fresh_one_does_not(line: Line) -> None:
    assert line.write("goal_position", 100_000) == 0
    assert line.write("torque_enable", 1) == 0
    line.run(2.0, fed=True)
    assert line.servos[0].shaft_deg == pytest.approx(100_000 * 360 / 1_003_846, abs=0.2)


def test_the_loads_torque_shows_in_the_current_and_in_the_play(line: Line) -> None:
    servo = line.servos[0]
    line.write("torque_enable", 1)
    line.run(0.5, fed=True)
    servo.load_torque_nm = 20.0
    line.run(2.0, fed=True)
    assert abs(line.read("present_current")) == pytest.approx((20.0 - 3.0) / 4.806 * 1000, rel=0.4)
    assert servo.shaft_deg - servo.plant.motor_deg == pytest.approx(0.05, abs=1e-6)
    servo.load_torque_nm = -20.0
    line.run(2.0, fed=True)
    assert servo.shaft_deg - servo.plant.motor_deg == pytest.approx(-0.05, abs=1e-6)
    assert abs(servo.shaft_deg) < 0.5


def test_velocity_current_and_pwm_modes(line: Line) -> None:
    for mode, name, value in ((1, "goal_velocity", 1000), (0, "goal_current", 2000), (16, "goal_pwm", 600)):
        fresh = Line(VirtualServo(1))
        assert fresh.write("operating_mode", mode) == 0
        fresh.write("torque_enable", 1)
        fresh.write(name, value)
        fresh.run(0.5, fed=True)
        speed = fresh.servos[0].shaft_velocity_deg_per_s
        assert 20.0 < speed < 1200.0, (mode, speed)
        if mode == 1:
            assert speed == pytest.approx(60.0, abs=2.0)


def test_reverse_and_time_based_drive_modes() -> None:
    line = Line(VirtualServo(1))
    line.write("drive_mode", 5)
    line.write("profile_velocity", 1000)  # one second for the whole way
    line.write("profile_acceleration", 300)
    line.write("torque_enable", 1)
    line.write("goal_position", 100_000)
    line.run(0.5, fed=True)
    assert line.servos[0].shaft_deg == pytest.approx(-50_000 * 360 / 1_003_846, abs=1.5)
    line.run(0.7, fed=True)
    assert line.read("present_position") == pytest.approx(100_000, abs=600)


def test_torque_by_goal_update_needs_its_bit(line: Line) -> None:
    line.write("goal_position", 1000)
    assert line.read("torque_enable") == 0
    line.write("drive_mode", 8)
    line.write("goal_position", 2000)
    assert line.read("torque_enable") == 1


def test_homing_offset_shifts_but_not_beyond_a_quarter_in_position_mode(line: Line) -> None:
    line.write("homing_offset", 5_000)
    assert line.read("present_position") == 5_000
    line.write("homing_offset", 300_000)
    assert line.read("present_position") == 0
