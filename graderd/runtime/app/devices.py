"""Builds the devices that the configuration names, and says what of it this installation cannot do."""

from __future__ import annotations

import grp
import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from graderd.api.server import MAX_PATH_BYTES, tls_context
from graderd.config import Config, ConfigError
from graderd.drivers.backend import Parts
from graderd.drivers.j1939.bus_health import BusEvent
from graderd.drivers.j1939.can_logs import candump_line
from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.link import CanLink
from graderd.drivers.j1939.vehicle import J1939Vehicle
from graderd.drivers.simulated.vehicle import SimulatedVehicle
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.device import DeviceService
from graderd.hal.errors import DeviceError
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.vehicle import Vehicle
from graderd.runtime.app.backends import actuator_of, check_plugins, rotator_of, stop_input_of
from graderd.runtime.devices import Devices
from graderd.runtime.stop_input import StopInputWatch
from graderd.tokens import read_tokens


def build_devices(config: Config, clock: Clock, on_bus_stop: Callable[[str], None]) -> Devices:
    """All devices, closed. ``on_bus_stop`` is called for a stop message on the CAN bus.

    Raises:
        ConfigError: a driver from elsewhere cannot be had, or does not take its settings.
    """
    link = CanLink(config.can, clock, on_stop=on_bus_stop)
    parts = Parts(clock, link)
    services: dict[str, DeviceService] = {}

    backend, settings = rotator_of(config.rotation)
    rotator = backend.build(settings, parts)
    services.update({f"rotation.{name}": service for name, service in backend.services(rotator).items()})

    actuators: dict[str, LinearActuator] = {}
    for axis, section in config.actuators().items():
        of_axis, its_settings = actuator_of(axis, section)
        actuators[axis] = of_axis.build(axis, its_settings, parts)
        services.update({f"{axis}.{name}": service for name, service in of_axis.services(actuators[axis]).items()})

    def publish(faults: tuple[DeviceFault, ...], stopped: bool) -> None:
        link.publish_faults(faults, stopped=stopped)

    def watch_can(listener: Callable[[str], None]) -> Callable[[], None]:
        def write(item: Frame | BusEvent, now_s: float) -> None:
            listener(candump_line(item, now_s))

        end_frames, end_events = link.tap(write), link.tap_events(write)

        def end() -> None:
            end_frames()
            end_events()

        return end

    return Devices(
        rotation=rotator,
        link=link,
        actuators=actuators,
        services=services,
        publish_faults=publish,
        buses={"can": watch_can, **backend.buses(rotator)},
        vehicle=_vehicle(config, link, clock),
    )


def _vehicle(config: Config, link: CanLink, clock: Clock) -> Vehicle | None:
    """What tells the machine's speed, or None where the configuration names nothing."""
    match config.vehicle.source:
        case "j1939":
            return J1939Vehicle(config.vehicle, link)
        case "simulated":
            return SimulatedVehicle(config.vehicle.path, clock)
        case "none":
            return None


def build_stop_input(config: Config, clock: Clock, on_stop: Callable[[str], None]) -> StopInputWatch | None:
    """The watch over the stop input, or None where the configuration names none.

    Raises:
        ConfigError: as :func:`build_devices`.
    """
    named = stop_input_of(config.stop_input)
    if named is None:
        return None
    backend, settings = named
    return StopInputWatch(settings, backend.build(settings), clock, on_stop)


def problems(config: Config) -> list[str]:
    """What a valid configuration may ask that this installation cannot do: `run` and `config check` refuse the same.

    A line each with place, cause and remedy; nothing is opened, whatever is or is not plugged in.
    """
    found = []
    clock = SystemClock()
    try:
        check_plugins(config)
        build_devices(config, clock, on_bus_stop=lambda _: None)
        build_stop_input(config, clock, on_stop=lambda _: None)
    except ConfigError as error:
        found += error.problems
    except (DeviceError, LookupError) as error:
        found.append(" ".join(str(error).split()))
    api = config.api
    if not Path(api.socket).name or len(os.fsencode(api.socket)) > MAX_PATH_BYTES:
        found.append(f"api.socket: {api.socket!r} is no path of 1 to {MAX_PATH_BYTES} bytes. Choose a shorter one")
    if api.tcp is not None:
        try:
            tls_context(api.tcp)
            read_tokens(api.tcp.token_file)
        except DeviceError as error:
            found.append(" ".join(str(error).split()))
    if config.foxglove.port_n is not None and find_spec("foxglove") is None:
        found.append("foxglove.port_n: the live view's library is not installed. pip install 'graderd[foxglove]'")
    if api.socket_group:
        try:
            grp.getgrnam(api.socket_group)
        except KeyError:
            found.append(f"api.socket_group: there is no group {api.socket_group}. Create it, or name another")
    return found
