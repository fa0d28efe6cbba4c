"""What a driver tells the wiring: the model of its settings, how it is built, and what it offers besides its contract.

A room of ``drivers`` has these in its ``backend.py``; a driver from elsewhere has one in a module of its own, and the
configuration names it (docs/developers/add-a-device.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from graderd.drivers.j1939.link import CanLink
from graderd.hal.camera import Camera
from graderd.hal.clock import Clock
from graderd.hal.device import DeviceService, WatchBus
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.rotator import Rotator
from graderd.hal.settings import ActuatorSettings, CameraSettings, CanSettings, RotatorSettings, StopInputSettings
from graderd.hal.stop_input import StopInput

RotatorS = TypeVar("RotatorS", bound=RotatorSettings)
RotatorD = TypeVar("RotatorD", bound=Rotator)
ActuatorS = TypeVar("ActuatorS", bound=ActuatorSettings)
ActuatorD = TypeVar("ActuatorD", bound=LinearActuator)
CameraS = TypeVar("CameraS", bound=CameraSettings)
StopInputS = TypeVar("StopInputS", bound=StopInputSettings)


@dataclass(frozen=True, slots=True)
class Parts:
    """What the daemon has for its drivers. ``can`` is there whether anything uses it or not; it is not open yet."""

    clock: Clock
    can: CanLink


def _no_services(_: Any) -> Mapping[str, DeviceService]:
    return {}


def _no_buses(_: Any) -> Mapping[str, WatchBus]:
    return {}


@dataclass(frozen=True, slots=True)
class RotatorBackend(Generic[RotatorS, RotatorD]):
    """A driver of the blade's rotation.

    ``build`` returns it closed. ``safe_off`` ends motion without a daemon and without the driver: a synchronous
    function that opens the wire anew, returns a line for the log and raises ``DeviceError`` where it could not reach
    the device. It runs in a thread beside the other drivers', has told the device within a second, and stays longer
    only where an adapter boots when it is opened. ``services``: by name, without the axis. ``buses``: wires of its own
    that can be watched, by the name that they have for clients.
    """

    settings: type[RotatorS]
    build: Callable[[RotatorS, Parts], RotatorD]
    safe_off: Callable[[RotatorS, CanSettings], str]
    services: Callable[[RotatorD], Mapping[str, DeviceService]] = _no_services
    buses: Callable[[RotatorD], Mapping[str, WatchBus]] = _no_buses


@dataclass(frozen=True, slots=True)
class LinearActuatorBackend(Generic[ActuatorS, ActuatorD]):
    """A driver of a linear actuator.

    As for the rotation; ``build`` is told which axis it is, and ``safe_off`` gets all axes of this driver at once,
    because they may share a wire.
    """

    settings: type[ActuatorS]
    build: Callable[[str, ActuatorS, Parts], ActuatorD]
    safe_off: Callable[[Mapping[str, ActuatorS], CanSettings], str]
    services: Callable[[ActuatorD], Mapping[str, DeviceService]] = _no_services


@dataclass(frozen=True, slots=True)
class CameraBackend(Generic[CameraS]):
    """A camera. ``build`` gets the settings and whether frames come in real time (False: as fast as they are read)."""

    settings: type[CameraS]
    build: Callable[[CameraS, bool], Camera]


@dataclass(frozen=True, slots=True)
class StopInputBackend(Generic[StopInputS]):
    """A stop input."""

    settings: type[StopInputS]
    build: Callable[[StopInputS], StopInput]
