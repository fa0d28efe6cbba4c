"""Make the servo safe when the daemon is dead: one synchronous function, no event loop, no state."""

from __future__ import annotations

import contextlib
import os
import select
import time

import serial

from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.codec import Instruction, Packet, StreamDecoder, encode
from graderd.drivers.dynamixel.serial_port import ListPorts, find_port, open_port, system_ports
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.errors import DeviceTimeoutError
from graderd.hal.settings import Ph54Settings

_REPLY_S = 0.1
_ATTEMPTS_N = 3


def safe_off(settings: Ph54Settings, *, list_ports: ListPorts = system_ports) -> str:
    """Bring the blade servo into the state ``torque_at_exit`` asks for, and leave. Blocks for a second at most.

    ``off``: torque off. ``on``: goal := measured with torque left as it is, bus watchdog off duty, so that the servo
    holds without anybody. Returns one line that says what was done, for the log.

    Raises:
        DeviceMissingError: no such port, or somebody else (a living daemon) holds it.
        DeviceTimeoutError: the servo does not answer; the write was sent three times nevertheless.
    """
    table = ControlTable.load(settings.profile)
    port = find_port(settings.port, settings.usb_serial_number, list_ports)
    opened = open_port(port, settings.baud_n)
    try:
        wire = _Wire(opened, settings.servo_id_n)
        if settings.torque_at_exit == "off":
            done = wire.write(table, "torque_enable", 0)
            text = "torque switched off"
        else:
            done = wire.hold(table, Calibration.of(settings, table))
            text = "holding where it stands, torque left as it was"
    finally:
        with contextlib.suppress(OSError, serial.SerialException):
            opened.close()
    if not done:
        raise DeviceTimeoutError(
            f"servo {settings.servo_id_n} at {port}", "no answer to the safe-off write", "Cut the 24 V supply"
        )
    return f"rotation: {text}"


class _Wire:
    """Blocking request and reply on an open port."""

    def __init__(self, opened: serial.Serial, servo_id: int) -> None:
        self._fd = opened.fileno()
        self._servo_id = servo_id
        os.set_blocking(self._fd, False)

    def write(self, table: ControlTable, name: str, value: int) -> bool:
        """Write a register until the servo says yes; whether it did."""
        register = table[name]
        params = register.address.to_bytes(2, "little") + register.encode(value)
        return self._ask(Instruction.WRITE, params, 0) is not None

    def read(self, table: ControlTable, name: str) -> int | None:
        """Read a register; None without a valid answer."""
        register = table[name]
        params = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        packet = self._ask(Instruction.READ, params, register.size)
        return register.decode(packet.data) if packet is not None else None

    def hold(self, table: ControlTable, calibration: Calibration) -> bool:
        """Goal := measured. A tripped watchdog holds already and refuses goals: then only that is left to be."""
        measured = self.read(table, "present_position")
        if measured is None:
            return False
        low, high = calibration.servo_limits()
        held = self.write(table, "goal_position", max(low, min(high, measured)))
        return self.write(table, "bus_watchdog", 0) if held else self.read(table, "bus_watchdog") == -1

    def _ask(self, instruction: int, params: bytes, data_n: int) -> Packet | None:
        request = encode(self._servo_id, instruction, params)
        for _ in range(_ATTEMPTS_N):
            decoder = StreamDecoder()
            with contextlib.suppress(BlockingIOError):
                os.read(self._fd, 4096)
            try:
                os.write(self._fd, request)
            except OSError:
                return None
            until_s = time.monotonic() + _REPLY_S
            while (left_s := until_s - time.monotonic()) > 0:
                if not select.select([self._fd], [], [], left_s)[0]:
                    break
                try:
                    data = os.read(self._fd, 4096)
                except OSError:
                    return None
                if not data:
                    return None
                for packet in decoder.feed(data):
                    fits = packet.is_status and packet.packet_id == self._servo_id and not packet.error
                    if fits and len(packet.data) == data_n:
                        return packet
        return None
