"""Make the servo safe when the daemon is dead: the driver's own client, for as long as one or two exchanges take."""

from __future__ import annotations

import asyncio

from graderd.drivers.dynamixel.bus import ServoBus
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.device import Ph54Device
from graderd.drivers.dynamixel.observer import ServoObserver
from graderd.drivers.dynamixel.serial_port import ListPorts, find_port, system_ports
from graderd.drivers.dynamixel.servo_task import DEVICE, CommandSlot
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.clock import SystemClock
from graderd.hal.errors import DeviceTimeoutError
from graderd.hal.settings import Ph54Settings

_ATTEMPTS_N = 5


def safe_off(settings: Ph54Settings, *, list_ports: ListPorts = system_ports) -> str:
    """Bring the blade servo into the state ``torque_at_exit`` asks for, and leave. Blocks for a second at most.

    ``off``: torque off. ``on``: hold with torque left as it is, bus watchdog off duty, so that the servo holds without
    anybody. Returns one line that says what was done, for the log. Not from within an event loop.

    Raises:
        DeviceMissingError: no such port, or somebody else (a living daemon) holds it.
        DeviceTimeoutError: the servo does not answer; the write was sent several times nevertheless.
        DeviceRefusedError: it answers and refuses.
    """
    return asyncio.run(_safe_off(settings, list_ports))


async def _safe_off(settings: Ph54Settings, list_ports: ListPorts) -> str:
    table = ControlTable.load(settings.profile)
    bus = ServoBus(find_port(settings.port, settings.usb_serial_number, list_ports), settings.baud_n)
    bus.open()
    device = Ph54Device(bus, table, settings.servo_id_n)
    try:
        if settings.torque_at_exit == "on":
            await _hold(device, settings)
            return f"{DEVICE}: holding where it stands, torque left as it was"
        await device.write("torque_enable", 0, attempts_n=_ATTEMPTS_N, urgent=True)
    except DeviceTimeoutError as e:
        raise DeviceTimeoutError(device.where, "no answer to the safe-off write", "Cut the 24 V supply") from e
    finally:
        bus.close()
    return f"{DEVICE}: torque switched off"


async def _hold(device: Ph54Device, settings: Ph54Settings) -> None:
    """A tripped watchdog holds already, refuses goals, and stays as it is."""
    calibration, clock = Calibration.of(settings, device.table), SystemClock()
    observer, command = (
        ServoObserver(DEVICE, settings, device.table, calibration, clock),
        CommandSlot(settings, calibration),
    )
    goals = await observer.read_goals(device, attempts_n=_ATTEMPTS_N)
    if observer.tripped:
        return
    await observer.read_telemetry(device, None, attempts_n=_ATTEMPTS_N)
    if observer.motion is None:
        raise DeviceTimeoutError(device.where, "no two readings of the angle agree", "Cut the 24 V supply")
    command.forget(goals["goal_position"])
    await command.send_hold(device, observer.motion, clock.now_s(), attempts_n=_ATTEMPTS_N)
    await device.write("bus_watchdog", 0, attempts_n=_ATTEMPTS_N)
