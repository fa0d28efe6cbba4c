"""Which driver a section of the configuration names: graderd's own from a table, another's from its module.

graderd's own are imported plainly, here and in :mod:`graderd.runtime.app.frame_sources`. A driver from elsewhere is
found at run time, by the name that the configuration gives it; nothing of graderd is ever reached that way (see
docs/adr/0004-drivers-from-elsewhere.md).
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, TypeVar

from graderd.config import Config, ConfigError, parse_section
from graderd.drivers.backend import CameraBackend, LinearActuatorBackend, RotatorBackend, StopInputBackend
from graderd.drivers.dynamixel.backend import PH54
from graderd.drivers.electrak.backend import ELECTRAK
from graderd.drivers.simulated.stop_input import SimulatedStopInput
from graderd.drivers.stop_input import GpioStopInput, SerialStopInput
from graderd.hal.settings import (
    ActuatorSettings,
    CameraSettings,
    PluginCameraSettings,
    RotatorSettings,
    Settings,
    StopInputSettings,
    is_plugin,
)

ROTATORS: Final[Mapping[str, RotatorBackend[Any, Any]]] = {"ph54": PH54}
ACTUATORS: Final[Mapping[str, LinearActuatorBackend[Any, Any]]] = {"electrak": ELECTRAK}
STOP_INPUTS: Final[Mapping[str, StopInputBackend[Any]]] = {
    "serial": StopInputBackend(StopInputSettings, SerialStopInput),
    "gpio": StopInputBackend(StopInputSettings, GpioStopInput),
    "simulated": StopInputBackend(StopInputSettings, lambda settings: SimulatedStopInput(settings.port)),
}
_OURS: Final = "graderd"

Backend = RotatorBackend[Any, Any] | LinearActuatorBackend[Any, Any] | CameraBackend[Any] | StopInputBackend[Any]
B = TypeVar("B", bound=Backend)


def rotator_of(settings: RotatorSettings) -> tuple[RotatorBackend[Any, Any], Any]:
    """The driver of ``[rotation]``, and the section as it takes it.

    Raises:
        ConfigError: a driver from elsewhere that is not there, is no such driver, or does not take its settings.
    """
    if not is_plugin(settings.backend):
        return ROTATORS[settings.backend], settings
    return _plugin("rotation", "backend", settings.backend, settings, RotatorBackend)


def actuator_of(name: str, settings: ActuatorSettings) -> tuple[LinearActuatorBackend[Any, Any], Any]:
    """The same of ``[lift_left]``, ``[lift_right]`` or ``[tilt]``."""
    if not is_plugin(settings.backend):
        return ACTUATORS[settings.backend], settings
    return _plugin(name, "backend", settings.backend, settings, LinearActuatorBackend)


def stop_input_of(settings: StopInputSettings) -> tuple[StopInputBackend[Any], Any] | None:
    """The same of ``[stop_input]``; None where there is none."""
    if settings.backend == "none":
        return None
    if not is_plugin(settings.backend):
        return STOP_INPUTS[settings.backend], settings
    return _plugin("stop_input", "backend", settings.backend, settings, StopInputBackend)


def plugin_camera_of(settings: CameraSettings) -> tuple[CameraBackend[Any], Any]:
    """The same of ``[camera]``, whose source is a driver from elsewhere."""
    # The configuration's section has the calibration too, which is perception's.
    of_camera = settings.model_dump(include=set(PluginCameraSettings.model_fields))
    section = PluginCameraSettings.model_validate(of_camera)
    return _plugin("camera", "source", settings.source, section, CameraBackend)


def check_plugins(config: Config) -> None:
    """Whether every driver from elsewhere is there and takes its settings.

    Raises:
        ConfigError: one line per mistake.
    """
    checks: list[Callable[[], object]] = [
        partial(rotator_of, config.rotation),
        *(partial(actuator_of, name, section) for name, section in config.actuators().items()),
        partial(stop_input_of, config.stop_input),
    ]
    if is_plugin(config.camera.source):
        checks.append(partial(plugin_camera_of, config.camera))
    problems: list[str] = []
    for check in checks:
        try:
            check()
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(None, problems)


def _plugin(section: str, key: str, name: str, settings: Settings, kind: type[B]) -> tuple[B, Any]:
    where = f"configuration: {section}.{key}"
    if name.split(":")[0].split(".")[0] == _OURS:
        raise ConfigError(None, [f"{where}: {name} is graderd's own. Name it by its word, without a colon"])
    try:
        found = pkgutil.resolve_name(name)
    except Exception as error:  # whatever another's module raises when it is imported
        remedy = "Install its package beside graderd, or correct the name"
        raise ConfigError(None, [f"{where}: {name} cannot be loaded ({error}). {remedy}"]) from error
    if not isinstance(found, kind):
        given = type(found).__name__
        raise ConfigError(None, [f"{where}: {name} is a {given}, not a {kind.__name__}. Correct the name"])
    return found, parse_section(section, settings, found.settings)
