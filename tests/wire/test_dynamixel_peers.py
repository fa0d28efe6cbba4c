"""Three clients that nobody here wrote, unmodified, against the virtual servo in a process of its own.

dynamixel-sdk (with its easy layer), dynamixel-python and rustypot: every instruction each of them offers. Where a
client itself is wrong, the test says so and shows that the servo answers as the protocol asks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
from dxl2.v2 import BulkParams, HardwareError, MotorBus, SyncParams
from dynamixel_easy_sdk import Connector
from dynamixel_easy_sdk.data_types import Direction, OperatingMode, ProfileConfiguration
from dynamixel_easy_sdk.dynamixel_error import DxlError, DxlRuntimeError
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)
from rustypot import Xl430PyController

from tests.dynamixel_sim import TIMEOUT_S, ServoProcess, servo_process

# The SDK gives up after 34 ms, and is asked again.
pytestmark = [pytest.mark.whole_machine, pytest.mark.xdist_group("a line")]
IDS = (1, 3, 7)
STUFFED = -131073  # FF FF FD FF on the wire: the payload that must be stuffed
T = TypeVar("T")


@pytest.fixture
def servos(tmp_path: Path) -> Iterator[ServoProcess]:
    with servo_process(tmp_path / "servo", *(a for i in IDS for a in ("--id", str(i)))) as process:
        yield process


def patiently(call: Callable[[], T], good: Callable[[T], object], what: str) -> T:
    """Call again while a client with a short built-in timeout gives up on a busy machine."""
    until_s = time.monotonic() + TIMEOUT_S
    while True:
        result = call()
        if good(result):
            return result
        assert time.monotonic() < until_s, f"{what}: {result}"
        time.sleep(0.05)  # a reply that was only late must not answer the next call


# -- dynamixel-sdk ------------------------------------------------------------------------------------------------


@pytest.fixture
def sdk(servos: ServoProcess) -> Iterator[tuple[Any, Any]]:
    port, packets = PortHandler(str(servos.link)), PacketHandler(2.0)
    assert port.openPort()
    assert port.setBaudRate(57_600)
    yield port, packets
    port.closePort()


def comm_ok(result: Any) -> bool:
    """The SDK's last-but-one element is its communication result (or the only one)."""
    return bool((result[-2] if isinstance(result, tuple) and len(result) > 1 else result) == COMM_SUCCESS)


def test_sdk_ping_read_write(sdk: tuple[Any, Any]) -> None:
    port, packets = sdk
    assert patiently(lambda: packets.ping(port, 1), comm_ok, "ping") == (2020, 0, 0)
    found, _ = patiently(lambda: packets.broadcastPing(port), lambda r: len(r[0]) == 3, "broadcast ping")
    assert found == {i: [2020, 12] for i in IDS}
    for size, address, value in ((1, 513, 77), (2, 532, 400), (4, 560, 1234)):
        write, read = getattr(packets, f"write{size}ByteTxRx"), getattr(packets, f"read{size}ByteTxRx")
        assert patiently(lambda w=write, a=address, v=value: w(port, 1, a, v), comm_ok, "write")[-1] == 0  # type: ignore[misc]
        assert patiently(lambda r=read, a=address: r(port, 1, a), comm_ok, "read")[0] == value  # type: ignore[misc]
        only = getattr(packets, f"write{size}ByteTxOnly")
        assert only(port, 3, address, value) == COMM_SUCCESS
        time.sleep(0.05)
        port.clearPort()  # the status of a write nobody waited for
        assert patiently(lambda r=read, a=address: r(port, 3, a), comm_ok, "read")[0] == value  # type: ignore[misc]
    data, _, error = patiently(lambda: packets.readTxRx(port, 1, 570, 25), comm_ok, "block read")
    assert (len(data), error) == (25, 0)
    assert data[22] | data[23] << 8 == 240  # 24.0 V
    assert patiently(lambda: packets.writeTxRx(port, 1, 513, 3, [1, 2, 3]), comm_ok, "write of several")[-1] == 0
    assert patiently(lambda: packets.readTxRx(port, 1, 512, 5), comm_ok, "read")[0][1:4] == [1, 2, 3]


def test_sdk_registered_write_and_action(sdk: tuple[Any, Any]) -> None:
    port, packets = sdk
    assert patiently(lambda: packets.regWriteTxRx(port, 1, 513, 1, [9]), comm_ok, "reg write")[-1] == 0
    assert patiently(lambda: packets.read1ByteTxRx(port, 1, 517), comm_ok, "registered")[0] == 1
    assert patiently(lambda: packets.read1ByteTxRx(port, 1, 513), comm_ok, "led")[0] == 0
    assert packets.action(port, 1) in (COMM_SUCCESS, COMM_RX_TIMEOUT)
    time.sleep(0.1)
    assert patiently(lambda: packets.read1ByteTxRx(port, 1, 513), comm_ok, "led")[0] == 9
    assert packets.regWriteTxOnly(port, 3, 513, 1, [8]) == COMM_SUCCESS
    time.sleep(0.05)
    port.clearPort()
    packets.action(port, 254)
    time.sleep(0.1)
    assert patiently(lambda: packets.read1ByteTxRx(port, 3, 513), comm_ok, "led")[0] == 8


@pytest.mark.parametrize("fast", [False, True])
def test_sdk_sync_and_bulk(sdk: tuple[Any, Any], fast: bool) -> None:
    port, packets = sdk
    write = GroupSyncWrite(port, packets, 560, 4)
    bulk_write = GroupBulkWrite(port, packets)
    for i in IDS:
        assert write.addParam(i, [i, 1, 0, 0])
        assert bulk_write.addParam(i, 513, 1, [i + 100])
    assert write.txPacket() == COMM_SUCCESS
    assert bulk_write.txPacket() == COMM_SUCCESS
    read = GroupSyncRead(port, packets, 560, 4)
    bulk = GroupBulkRead(port, packets)
    for i in IDS:
        assert read.addParam(i)
        assert bulk.addParam(i, 513 if i != 3 else 592, 1 if i != 3 else 2)
    patiently(read.fastSyncRead if fast else read.txRxPacket, lambda r: r == COMM_SUCCESS, "sync read")
    assert [read.getData(i, 560, 4) for i in IDS] == [i + 256 for i in IDS]
    patiently(bulk.fastBulkRead if fast else bulk.txRxPacket, lambda r: r == COMM_SUCCESS, "bulk read")
    assert bulk.getData(1, 513, 1) == 101
    assert bulk.getData(3, 592, 2) == 240
    assert bulk.getData(7, 513, 1) == 107


def test_sdk_reboot_clear_and_factory_reset(sdk: tuple[Any, Any], servos: ServoProcess) -> None:
    port, packets = sdk
    patiently(lambda: packets.write1ByteTxRx(port, 7, 513, 5), comm_ok, "led")
    assert patiently(lambda: packets.clearMultiTurn(port, 7), comm_ok, "clear")[-1] == 0
    patiently(lambda: packets.reboot(port, 7), comm_ok, "reboot")
    patiently(
        lambda: packets.read1ByteTxRx(port, 7, 513), lambda r: r[1] == COMM_SUCCESS and r[0] == 0, "back, RAM reset"
    )
    patiently(lambda: packets.write1ByteTxRx(port, 7, 31, 70), comm_ok, "temperature limit")
    patiently(lambda: packets.factoryReset(port, 7, 0x02), comm_ok, "factory reset but id and baud")
    patiently(lambda: packets.read1ByteTxRx(port, 7, 31), lambda r: r[1] == COMM_SUCCESS and r[0] == 80, "limit reset")
    assert {s["id"] for s in servos.tell("status")["servos"]} == set(IDS)


def test_sdk_stuffing_lost_in_sending_is_still_understood_and_stuffed_replies_are_right(sdk: tuple[Any, Any]) -> None:
    port, packets = sdk
    # The SDK (4.1.0) sends FF FF FD FF without stuffing; a slave that counts lengths takes it, and so does ours.
    assert patiently(lambda: packets.write4ByteTxRx(port, 1, 20, STUFFED & 0xFFFFFFFF), comm_ok, "write")[-1] == 0
    assert patiently(lambda: packets.read4ByteTxRx(port, 1, 20), comm_ok, "read")[0] == STUFFED & 0xFFFFFFFF


def test_sdk_sees_errors_and_alerts_with_valid_data(sdk: tuple[Any, Any], servos: ServoProcess) -> None:
    port, packets = sdk
    for address, size, value, error in (
        (0, 2, 1, 7),
        (512, 1, 2, 4),
        (564, 4, 501_434, 6),
        (564, 2, 5, 5),
        (700, 1, 0, 0),
    ):
        write = getattr(packets, f"write{size}ByteTxRx")
        assert patiently(lambda w=write, a=address, v=value: w(port, 1, a, v), comm_ok, "write")[-1] == error  # type: ignore[misc]
    servos.tell("alert_overload")
    value, _, error = patiently(lambda: packets.read1ByteTxRx(port, 1, 518), comm_ok, "error register")
    assert (value, error) == (0x20, 0x80)


# -- the SDK's easy layer -------------------------------------------------------------------------------------------


class Patient:
    """The same object, its calls repeated where it gave up after its fixed 34 ms on a busy machine."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any) -> Any:
            until_s = time.monotonic() + TIMEOUT_S
            while True:
                try:
                    result = getattr(self._inner, name)(*arguments)
                    return Patient(result) if name.startswith("create") else result
                except DxlRuntimeError as e:
                    if time.monotonic() > until_s or e.dxl_error not in (DxlError.SDK_COMM_RX_TIMEOUT,):
                        raise

        return call


def test_easy_sdk_drives_the_servo(servos: ServoProcess) -> None:
    connector = Patient(Connector(str(servos.link), 57_600))
    try:
        assert sorted(patiently(connector.broadcastPing, lambda r: len(list(r)) == 3, "broadcast ping")) == list(IDS)
        motor = connector.createMotor(1)
        assert motor.ping() == 2020
        assert motor.getOperatingMode() == OperatingMode.POSITION
        motor.setOperatingMode(OperatingMode.POSITION)
        motor.setProfileConfiguration(ProfileConfiguration.VELOCITY_BASED)
        motor.setDirection(Direction.NORMAL)
        motor.setPositionPGain(314)
        motor.setPositionIGain(0)
        motor.setPositionDGain(0)
        motor.setVelocityPGain(6153)
        motor.setVelocityIGain(2209)
        motor.setHomingOffset(0)
        motor.setMaxPositionLimit(400_000)
        motor.setMinPositionLimit(-400_000)
        motor.setVelocityLimit(2000)
        motor.setCurrentLimit(9300)
        motor.setPWMLimit(2009)
        assert motor.getMaxPositionLimit() == 400_000
        assert motor.getMinPositionLimit() == (-400_000) & 0xFFFFFFFF  # its defect: read as unsigned
        assert (motor.getVelocityLimit(), motor.getCurrentLimit(), motor.getPWMLimit()) == (2000, 9300, 2009)
        connector.write4ByteData(1, 560, 1500)
        motor.enableTorque()
        assert motor.isTorqueOn() == 1
        motor.setGoalPosition(50_000)
        patiently(motor.getPresentPosition, lambda p: abs(p - 50_000) < 500, "arrival")
        assert abs(motor.getPresentVelocity()) < 2000
        assert abs(motor.getPresentCurrent()) < 9300
        assert abs(motor.getPresentPWM()) <= 2009
        executor = connector.createGroupExecutor()
        other = connector.createMotor(3)
        executor.addCmd(motor.stageGetPresentPosition())
        executor.addCmd(other.stageGetPresentPosition())
        patiently(executor.executeRead, lambda r: abs(r[0] - 50_000) < 500 and r[1] == 0, "group read")
        executor.addCmd(motor.stageSetGoalPosition(20_000))
        executor.addCmd(other.stageDisableTorque())
        executor.executeWrite()
        patiently(motor.getPresentPosition, lambda p: abs(p - 20_000) < 500, "arrival after a group write")
        motor.disableTorque()
        motor.changeID(9)
        assert connector.ping(9) == 2020
        motor = connector.createMotor(9)
        motor.reboot()
    finally:
        connector.closePort()


# -- dynamixel-python -------------------------------------------------------------------------------------------------


@pytest.fixture
def dxl2(servos: ServoProcess) -> Iterator[Any]:
    bus = MotorBus(str(servos.link), 57_600, timeout=0.4)
    bus.connect()
    yield bus
    bus.disconnect()


def test_dynamixel_python_every_instruction(dxl2: Any) -> None:
    model = {"model_number": 2020, "firmware_version": 12}
    assert dxl2.ping(1).data == model
    assert dxl2.broadcast_ping().data == dict.fromkeys(IDS, model)
    assert dxl2.write(1, 564, 4, -1000, signed=True).ok
    assert dxl2.read(1, 564, 4, signed=True).data == -1000
    assert dxl2.reg_write(1, 513, 1, 9).ok
    assert dxl2.read(1, 513, 1).data == 0
    assert dxl2.action(1).ok
    assert dxl2.read(1, 513, 1).data == 9

    sync_write = SyncParams(560, 4)
    sync, bulk, bulk_write = SyncParams(560, 4), BulkParams(), BulkParams()
    for i in IDS:
        sync_write.add_value(i, 1000 + i)
        sync.add_motor(i)
        bulk_write.add_value(i, 514, 1, i)
    bulk.add_address(1, 514, 1)
    bulk.add_address(3, 592, 2)
    bulk.add_address(7, 580, 4, signed=True)
    dxl2.sync_write(sync_write)
    dxl2.bulk_write(bulk_write)
    for response in (dxl2.sync_read(sync), dxl2.fast_sync_read(sync)):
        assert response.data == [1001, 1003, 1007]
    for response in (dxl2.bulk_read(bulk), dxl2.fast_bulk_read(bulk)):
        assert response.data == [1, 240, 0]

    assert dxl2.clear_position(1).ok
    assert dxl2.clear_errors(1).error == 1  # "reserved" in the e-manual of this model: refused, in good form
    assert dxl2.control_table_backup(1).ok
    assert dxl2.read(1, 878, 1).data == 1
    assert dxl2.write(1, 31, 1, 66).ok
    assert dxl2.control_table_restore(1).ok
    patiently(lambda: dxl2.read(1, 31, 1), lambda r: r.data == 80, "restored after its reboot")
    assert dxl2.reboot(1).ok
    patiently(lambda: dxl2.ping(1), lambda r: r.ok, "back")


def test_dynamixel_python_factory_resets(dxl2: Any) -> None:
    assert dxl2.write(7, 31, 1, 66).ok
    assert dxl2.factory_reset_except_id_baudrate(7).ok
    patiently(lambda: dxl2.read(7, 31, 1), lambda r: r.data == 80, "reset")
    assert dxl2.factory_reset_except_id(7).ok
    patiently(lambda: dxl2.ping(7), lambda r: r.ok, "same id")
    assert dxl2.write(1, 7, 1, 20).ok
    assert dxl2.factory_reset(20).ok
    patiently(lambda: dxl2.ping(1), lambda r: r.ok, "id 1 again")


def test_dynamixel_python_stuffing_and_alert(dxl2: Any, servos: ServoProcess) -> None:
    # Its own defect: what needs stuffing goes out unstuffed with the checksum of the stuffed bytes.
    assert dxl2.write(1, 20, 4, STUFFED, signed=True).timeout
    patiently(lambda: dxl2.write(1, 20, 2, 0xFFFF), lambda r: r.error == 5, "part of a register is refused")
    servos.tell("alert_overload")
    with pytest.raises(HardwareError):
        dxl2.ping(1)


# -- rustypot ----------------------------------------------------------------------------------------------------


def test_rustypot_every_instruction_it_offers_below_address_256(servos: ServoProcess) -> None:
    # Its addresses are one byte wide: of a PH54 it sees the EEPROM half, whose first registers an XL430 has too.
    bus = Xl430PyController(str(servos.link), 57_600, 2.0)
    try:
        assert bus.ping(1)
        assert bus.scan(list(IDS)) == dict.fromkeys(IDS, 2020)
        assert bus.broadcast_scan(list(IDS)) == dict.fromkeys(IDS, 2020)
        assert bus.read_model_number(1) in (2020, [2020])
        assert bus.read_raw_data(1, 0, 2) == list((2020).to_bytes(2, "little"))
        # Payloads that need stuffing, written and read back by a client that does it right.
        for value in (STUFFED, -131072 - 65536 * 2 - 1, 0x7DFDFFFF - 0xFDFFFF):
            raw = list((value & 0xFFFFFFFF).to_bytes(4, "little"))
            bus.write_raw_data(1, 20, raw)
            assert bus.read_raw_data(1, 20, 4) == raw
        bus.sync_write_raw_data([1, 3], 31, [[70], [71]])
        assert bus.sync_read_raw_data([1, 3], 31, 1) == [b"F", b"G"]
        bus.set_fast_sync_read(True)
        assert bus.sync_read_raw_data([1, 3, 7], 31, 1) == [b"F", b"G", b"P"]
        bus.write_raw_data(3, 20, [255, 255, 253, 255])
        fast = bus.sync_read_raw_data([1, 3], 20, 4)
        assert fast[1] == b"\xff\xff\xfd\xff"  # fast replies are not stuffed
        assert bus.read_raw_data_with_error(1, 31, 1) == ([70], 0)
        assert bus.write_raw_data_with_error(1, 0, [1, 2]) == 7
        servos.tell("alert_overload")
        assert bus.read_raw_data_with_error(1, 31, 1) == ([70], 0x80)
        assert bus.reboot(1)
        patiently(lambda: bus.scan([1]), lambda r: r == {1: 2020}, "back")
    finally:
        bus.close()


def test_rustypot_factory_reset(servos: ServoProcess) -> None:
    bus = Xl430PyController(str(servos.link), 57_600, 2.0)
    try:
        bus.write_raw_data(7, 31, [70])
        bus.factory_reset(7, True, True)
        patiently(lambda: bus.scan([7]), lambda r: r == {7: 2020}, "back")
        assert bus.read_raw_data(7, 31, 1) == [80]
    finally:
        bus.close()
