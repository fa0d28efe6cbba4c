"""The servo bus against a wire that misbehaves, and against the measured defects of dynamixel-sdk 4.1.0."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import serial

from graderd.drivers.dynamixel import serial_port
from graderd.drivers.dynamixel.bus import ServoBus, ServoRefusedError
from graderd.drivers.dynamixel.codec import Instruction, StatusError, StreamDecoder, encode, encode_status
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.errors import DeviceLostError, DeviceMissingError, DeviceTimeoutError
from graderd.simulator.servo import VirtualServo, VirtualServoBus
from harness.awake_clock import AwakeClock

TABLE = ControlTable.load("ph54_200_s500")
GOAL = TABLE["goal_position"]
STUFFED = -131073  # FF FF FD FF


@pytest.fixture
async def servos(tmp_path: Path) -> AsyncIterator[VirtualServoBus]:
    wire = VirtualServoBus([VirtualServo(1), VirtualServo(2)], tmp_path / "servo", seed=7)
    await wire.start()
    yield wire
    await wire.close()


@pytest.fixture
async def bus(servos: VirtualServoBus) -> AsyncIterator[ServoBus]:
    made = ServoBus(str(servos.link), 57_600)
    made.open()
    yield made
    made.close()


async def test_ping_read_write(bus: ServoBus) -> None:
    assert await bus.ping(1) == (2020, 12)
    await bus.write(1, GOAL.address, GOAL.encode(-1000))
    packet = await bus.read(1, GOAL.address, 4)
    assert GOAL.decode(packet.data) == -1000
    assert not packet.alert


async def test_payloads_that_need_stuffing_survive_both_ways(bus: ServoBus) -> None:
    # Defect 1 of the SDK: stuffing is lost in sending.
    await bus.write(1, GOAL.address, GOAL.encode(STUFFED))
    assert GOAL.decode((await bus.read(1, GOAL.address, 4)).data) == STUFFED


@pytest.mark.parametrize(
    ("address", "data", "error"),
    [
        (0, b"\x01\x00", StatusError.ACCESS),
        (512, b"\x02", StatusError.DATA_RANGE),
        (564, (501_434).to_bytes(4, "little"), StatusError.DATA_LIMIT),
        (564, b"\x00\x00", StatusError.DATA_LENGTH),
    ],
)
async def test_a_refusal_is_an_error_with_its_number(
    bus: ServoBus, address: int, data: bytes, error: StatusError
) -> None:
    with pytest.raises(ServoRefusedError, match=error.name.lower()) as caught:
        await bus.write(1, address, data)
    assert caught.value.error == error


@pytest.mark.parametrize("size", [1, 2, 4, 25])
async def test_a_status_with_an_error_is_never_read_as_data(bus: ServoBus, size: int) -> None:
    # Defect 2 of the SDK: it slices the checksum out as data, or dies with IndexError.
    with pytest.raises(ServoRefusedError, match="access"):
        await bus.read(1, 900, size)


async def test_alert_is_data_beside_a_valid_answer(bus: ServoBus, servos: VirtualServoBus) -> None:
    # Defect 4: its easy layer cannot even switch torque off while a hardware error is set.
    servos.inject("alert_overload")
    packet = await bus.read(1, 518, 1)
    assert (packet.alert, packet.data) == (True, b"\x20")
    assert (await bus.write(1, 512, b"\x00")).alert


async def test_the_port_is_usable_again_after_an_unplug(bus: ServoBus, servos: VirtualServoBus) -> None:
    # Defect 3: after an exception the SDK's port stays busy for ever.
    await servos.unplug()
    with pytest.raises(DeviceLostError):
        await bus.ping(1)
    with pytest.raises(DeviceLostError):
        await bus.ping(1)
    await servos.replug()
    bus.close()
    bus.open()
    assert await bus.ping(1) == (2020, 12)


async def test_waiting_costs_no_processor_time(bus: ServoBus, servos: VirtualServoBus) -> None:
    # Defect 7: the SDK spins while it waits.
    servos.inject("drop")
    before_s = os.times()
    with pytest.raises(DeviceTimeoutError):
        await bus.request(1, Instruction.PING, b"", 3, attempts_n=12)
    after_s = os.times()
    assert after_s.user + after_s.system - before_s.user - before_s.system < 0.25 * (after_s.elapsed - before_s.elapsed)


async def test_a_silent_servo_times_out_and_is_counted(bus: ServoBus) -> None:
    with pytest.raises(DeviceTimeoutError, match="no valid status packet to read at address 580 in 3"):
        await bus.read(9, 580, 4, attempts_n=3)
    counters = bus.counters()
    assert counters["timeouts_n"] == 3
    assert counters["retries_n"] == 2


async def test_a_late_reply_is_never_taken_for_anothers(bus: ServoBus, servos: VirtualServoBus) -> None:
    for _ in range(10):
        await bus.ping(1)  # the line is known to be quick
    servos.inject("delay", seconds=0.05)
    servos.servos[0].memory["profile_velocity"] = 111
    servos.servos[0].memory["profile_acceleration"] = 222
    with pytest.raises(DeviceTimeoutError):
        await bus.read(1, TABLE["profile_velocity"].address, 4, attempts_n=1)
    # The reply with 111 is still under way and as long as the one asked for now.
    packet = await bus.read(1, TABLE["profile_acceleration"].address, 4, attempts_n=10)
    assert int.from_bytes(packet.data, "little") == 222
    assert bus.counters()["late_n"] >= 1


@pytest.mark.parametrize("delay_s", [0.04, 0.07])
async def test_a_line_that_grows_late_gives_no_older_answer_and_is_used_again_at_once(
    tmp_path: Path, delay_s: float
) -> None:
    """Also where the question whether the line is clear is itself answered late: whose answer that is must be known."""
    clock, servo = AwakeClock(), VirtualServo()
    wire = VirtualServoBus([servo], tmp_path / "servo", clock=clock)
    await wire.start()
    bus = ServoBus(str(wire.link), 57_600, clock=clock)
    bus.open()
    try:
        for _ in range(4):
            for _ in range(10):
                await bus.read(1, 568, 2)  # the line is known to be quick
            wire.inject("delay", seconds=delay_s)
            lost_n, answers_n = bus.counters()["timeouts_n"], 0
            while answers_n < 5:
                with contextlib.suppress(DeviceTimeoutError):
                    tick = int.from_bytes((await bus.read(1, 568, 2, attempts_n=1)).data, "little")
                    older_s = (bus.heard_s - tick / 1000.0) % 32.768  # the servo's clock is the test's
                    assert older_s < 0.015 or older_s > 32.7, "the answer to an older question"
                    answers_n += 1
            assert bus.counters()["timeouts_n"] - lost_n <= 3
            wire.clear_faults()
        assert bus.damaged_n == 0, "late is not damaged"
    finally:
        bus.close()
        await wire.close()


@pytest.mark.parametrize("fault", ["echo", "noise", "trickle"])
async def test_stray_bytes_do_no_harm(bus: ServoBus, servos: VirtualServoBus, fault: str) -> None:
    servos.inject(fault)
    for i in range(20):
        await bus.write(1, GOAL.address, GOAL.encode(i), attempts_n=4)
        assert GOAL.decode((await bus.read(1, GOAL.address, 4, attempts_n=4)).data) == i
    if fault == "echo":
        assert bus.counters()["echo_n"] >= 40
    if fault == "noise":
        assert bus.counters()["stray_bytes_n"] >= 40


@pytest.mark.parametrize("fault", ["flip", "truncate", "drop"])
async def test_damage_is_retried_and_never_believed(bus: ServoBus, servos: VirtualServoBus, fault: str) -> None:
    servos.inject(fault, rate=0.3)
    for i in range(25):
        await bus.write(2, GOAL.address, GOAL.encode(i * 1001), attempts_n=30)
        assert GOAL.decode((await bus.read(2, GOAL.address, 4, attempts_n=30)).data) == i * 1001
    assert bus.counters()["retries_n"] > 0


async def test_another_servos_reply_is_not_ours(bus: ServoBus, servos: VirtualServoBus) -> None:
    servos.inject("foreign_id")
    with pytest.raises(DeviceTimeoutError):
        await bus.read(1, 580, 4, attempts_n=1)
    assert bus.counters()["foreign_n"] == 1


async def test_many_tasks_share_the_wire_one_request_at_a_time(bus: ServoBus, servos: VirtualServoBus) -> None:
    in_flight: list[int] = []
    transmit = bus._transmit

    async def watched(packet: bytes) -> bool:
        in_flight.append(servos.requests_n - servos.replies_n)
        return await transmit(packet)

    bus._transmit = watched  # type: ignore[method-assign]
    for servo in servos.servos:
        servo.shaft_deg = servo.servo_id * 10.0
    await asyncio.gather(*(bus.read(1 + i % 2, 580, 4, attempts_n=5) for i in range(60)))
    assert set(in_flight) == {0}


async def test_an_urgent_request_overtakes_those_that_wait(bus: ServoBus, servos: VirtualServoBus) -> None:
    servos.inject("delay", seconds=0.01)
    order: list[str] = []

    async def ask(name: str, *, urgent: bool) -> None:
        await bus.write(1, GOAL.address, GOAL.encode(0), attempts_n=5, urgent=urgent)
        order.append(name)

    async with asyncio.TaskGroup() as group:
        for i in range(4):
            group.create_task(ask(f"normal {i}", urgent=False), name=f"normal-{i}")
        await asyncio.sleep(0)
        group.create_task(ask("urgent", urgent=True), name="urgent")
    assert order.index("urgent") <= 1


async def test_a_cancelled_request_leaves_the_wire_usable(bus: ServoBus, servos: VirtualServoBus) -> None:
    servos.inject("delay", seconds=0.02)
    tasks = [asyncio.create_task(bus.read(1, 580, 4), name=f"read-{i}") for i in range(5)]
    await asyncio.sleep(0.005)
    for task in tasks[:4]:
        task.cancel()
    for task in tasks[:4]:
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert len((await tasks[4]).data) == 4
    assert await bus.ping(1, attempts_n=4) == (2020, 12)


async def test_every_byte_is_logged(servos: VirtualServoBus) -> None:
    log: list[tuple[float, str, bytes]] = []
    bus = ServoBus(str(servos.link), 57_600, taps=[lambda t, d, b: log.append((t, d, b))])
    bus.open()
    await bus.ping(1)
    bus.close()
    assert (log[0][1], log[0][2]) == ("tx", encode(1, Instruction.PING))
    assert b"".join(b for _, d, b in log if d == "rx") == encode_status(1, 0, b"\xe4\x07\x0c")


async def test_a_second_owner_is_refused(servos: VirtualServoBus, bus: ServoBus) -> None:
    # Defect 11: the SDK opens a port that another program is using.
    second = ServoBus(str(servos.link), 57_600)
    with pytest.raises(DeviceMissingError, match="another program"):
        second.open()
    assert bus.is_open


@pytest.mark.parametrize("code", range(10))
async def test_all_baud_codes_of_the_ph54(tmp_path: Path, code: int) -> None:
    # Defect 10: the SDK refuses 4.5M, 6M and 10.5M. The servo here hears only the right speed.
    baud_n = TABLE.profile["bus"]["baud_n"][code]
    servo = VirtualServo()
    servo.memory["baud_rate"] = code
    wire = VirtualServoBus([servo], tmp_path / "servo", strict_baud=True)
    await wire.start()
    try:
        for asked_n, heard in ((baud_n, True), (baud_n * 2, False)):
            bus = ServoBus(str(wire.link), asked_n)
            bus.open()
            try:
                if heard:
                    assert await bus.ping(1, attempts_n=5) == (2020, 12)
                else:
                    with pytest.raises(DeviceTimeoutError):
                        await bus.ping(1, attempts_n=1)
            finally:
                bus.close()
    finally:
        await wire.close()


async def test_low_latency_is_asked_for_and_its_absence_reported(
    servos: VirtualServoBus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[bool] = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda _, on: asked.append(on))
    bus = ServoBus(str(servos.link), 57_600)
    bus.open()
    assert asked == [True]
    assert bus.counters()["low_latency_n"] == 1
    bus.close()
    monkeypatch.undo()
    monkeypatch.setattr(serial_port, "latency_timer_ms", lambda _: 16)
    bus.open()
    assert bus.counters()["low_latency_n"] == 0
    assert "16 ms" in caplog.text
    bus.close()


def test_the_latency_timer_is_read_where_there_is_one(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB0").mkdir()
    (tmp_path / "ttyUSB0" / "latency_timer").write_text("16\n", encoding="ascii")
    assert serial_port.latency_timer_ms("/dev/ttyUSB0", tmp_path) == 16
    assert serial_port.latency_timer_ms("/dev/ttyUSB1", tmp_path) is None


def test_a_port_that_is_no_port(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissingError, match="no such serial port"):
        serial_port.open_port(str(tmp_path / "none"), 57_600)
    file = tmp_path / "file"
    file.write_text("x", encoding="ascii")
    with pytest.raises(DeviceMissingError, match="cannot be opened"):
        serial_port.open_port(str(file), 57_600)


class Slave:
    """A bare pty whose other end is scripted: what a request is answered with."""

    def __init__(self, answer: Callable[[int, bytes], bytes]) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._answer = answer
        self._decoder = StreamDecoder()
        asyncio.get_running_loop().add_reader(self._master, self._on_readable)

    def _on_readable(self) -> None:
        for packet in self._decoder.feed(os.read(self._master, 4096)):
            os.write(self._master, self._answer(packet.instruction, packet.params))

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)


async def ask(answer: Callable[[int, bytes], bytes], size: int = 4) -> bytes:
    slave = Slave(answer)
    bus = ServoBus(slave.port, 1_000_000)
    bus.open()
    try:
        return (await bus.read(1, 580, size, attempts_n=1)).data
    finally:
        bus.close()
        slave.close()


@pytest.mark.parametrize("size", [0, 1, 2, 3, 5, 8])
async def test_a_reply_of_another_length_is_not_taken(size: int) -> None:
    with pytest.raises(DeviceTimeoutError):
        await ask(lambda *_: encode_status(1, 0, bytes(size)))


async def test_a_servo_that_found_our_request_damaged_is_asked_again() -> None:
    replies = iter((encode_status(1, StatusError.CRC), encode_status(1, 0, b"\x01\x02\x03\x04")))
    slave = Slave(lambda *_: next(replies))
    bus = ServoBus(slave.port, 1_000_000)
    bus.open()
    assert (await bus.read(1, 580, 4, attempts_n=2)).data == b"\x01\x02\x03\x04"
    bus.close()
    slave.close()


async def test_reads_as_long_as_a_pings_reply_are_not_made(bus: ServoBus) -> None:
    with pytest.raises(ValueError, match="3 bytes"):
        await bus.read(1, 513, 3)


async def test_deadlines_follow_the_line(bus: ServoBus, servos: VirtualServoBus) -> None:
    servos.inject("delay", seconds=0.04)
    for _ in range(5):
        await bus.ping(1, attempts_n=6)
    before_n = bus.counters()["timeouts_n"]
    for _ in range(10):
        await bus.ping(1, attempts_n=6)
    assert bus.counters()["timeouts_n"] - before_n <= 2
    servos.clear_faults()
    for _ in range(40):
        await bus.ping(1, attempts_n=6)
    assert bus.allowance_s < 0.05
