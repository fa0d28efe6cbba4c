"""Builds the devices from the configuration. Here, and in this package only, drivers are imported."""

from __future__ import annotations

from collections.abc import Callable

from graderd.config import Config
from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.drivers.electrak.actuator import ElectrakActuator
from graderd.drivers.electrak.dump import candump_line
from graderd.drivers.j1939.link import CanLink
from graderd.drivers.stop_input import make_stop_input
from graderd.hal.clock import Clock
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import LinearActuator
from graderd.runtime.devices import Devices
from graderd.runtime.stop_input import StopInputWatch


def build_devices(config: Config, clock: Clock, on_bus_stop: Callable[[str], None]) -> Devices:
    """All devices, closed. ``on_bus_stop`` is called for a stop message on the CAN bus."""
    rotator = Ph54Rotator(config.rotation, clock)
    link = CanLink(config.can, clock, on_stop=on_bus_stop)
    actuators: dict[str, LinearActuator] = {
        name: ElectrakActuator(name, section, link, clock) for name, section in config.actuators().items()
    }

    def publish(faults: tuple[DeviceFault, ...], stopped: bool) -> None:
        link.publish_faults(faults, stopped=stopped)

    def watch_bus(listener: Callable[[str], None]) -> Callable[[], None]:
        return link.tap(lambda frame, now_s: listener(candump_line(frame, now_s)))

    return Devices(
        rotation=rotator,
        link=link,
        actuators=actuators,
        publish_faults=publish,
        watch_bus=watch_bus,
    )


def build_stop_input(config: Config, clock: Clock, on_stop: Callable[[str], None]) -> StopInputWatch | None:
    """The watch over the stop input, or None where the configuration names none."""
    source = make_stop_input(config.stop_input)
    return None if source is None else StopInputWatch(config.stop_input, source, clock, on_stop)
