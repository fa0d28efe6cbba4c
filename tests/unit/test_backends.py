"""The registry of drivers: every name that the settings take has one, and old files mean what they meant."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path

import pytest
from pydantic import ValidationError

from graderd.config import Config, ConfigError, parse
from graderd.drivers.backend import CameraBackend, LinearActuatorBackend, RotatorBackend, StopInputBackend
from graderd.drivers.realsense import FolderCamera
from graderd.drivers.simulated.stop_input import SimulatedStopInput
from graderd.hal.clock import ManualClock
from graderd.hal.device import DeviceService
from graderd.hal.settings import (
    ActuatorSettings,
    CameraSettings,
    CanSettings,
    ElectrakSettings,
    Ph54Settings,
    PluginRotatorSettings,
    RotatorSettings,
    Settings,
    StopInputSettings,
)
from graderd.runtime.app import backends, guard
from graderd.runtime.app.devices import build_devices
from graderd.runtime.app.frame_sources import open_camera
from graderd.runtime.perception_protocol import Start
from harness.fakes import FakeActuator


def test_every_name_that_the_settings_take_has_a_driver() -> None:
    for name in backends.ROTATORS:
        assert RotatorSettings(backend=name).backend == name
    for name in backends.ACTUATORS:
        assert ElectrakSettings(backend=name).backend == name
    for name in backends.STOP_INPUTS:
        assert StopInputSettings(backend=name, port="/dev/x").backend == name
    with pytest.raises(ValidationError) as raised:
        RotatorSettings(backend="-")
    assert f"there is {', '.join(backends.ROTATORS)}." in str(raised.value)
    with pytest.raises(ValidationError) as raised:
        ElectrakSettings(backend="-")
    assert f"there is {', '.join(backends.ACTUATORS)}." in str(raised.value)
    with pytest.raises(ValidationError) as raised:
        StopInputSettings(backend="-")
    assert f"there is {', '.join(('none', *backends.STOP_INPUTS))}." in str(raised.value)


def test_every_source_of_pictures_has_a_driver() -> None:
    with pytest.raises(ValidationError) as raised:
        CameraSettings(source="-")
    names = str(raised.value).split("there is ")[1].split(".")[0].split(", ")
    kinds = {type(open_camera(CameraSettings(source=name, path="x"))) for name in names}
    assert len(kinds) == len(names) == 6


def test_a_file_that_names_no_driver_gets_those_it_always_had() -> None:
    config = parse({"rotation": {"zero_deg": 1.5}, "tilt": {"speed_percent": 60}, "stop_input": {"poll_hz": 50}})
    assert isinstance(config.rotation, Ph54Settings)
    backend, settings = backends.rotator_of(config.rotation)
    assert isinstance(backend, RotatorBackend)
    assert settings is config.rotation
    of_tilt, its_settings = backends.actuator_of("tilt", config.tilt)
    assert isinstance(of_tilt, LinearActuatorBackend)
    assert isinstance(its_settings, ElectrakSettings)
    assert backends.stop_input_of(config.stop_input) is None


def test_the_stop_input_is_the_one_that_is_named() -> None:
    named = backends.stop_input_of(StopInputSettings(backend="simulated", port="x"))
    assert named is not None
    backend, settings = named
    assert isinstance(backend.build(settings), SimulatedStopInput)


def test_the_guard_goes_on_where_one_driver_cannot_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that was uninstalled must not keep the others from their safe-off."""
    told: list[str] = []

    def safe_off(axes: Mapping[str, ElectrakSettings], _: CanSettings) -> str:
        told.extend(axes)
        return "told"

    electrak = LinearActuatorBackend(ElectrakSettings, lambda *_: pytest.fail("built"), safe_off)
    monkeypatch.setattr(backends, "ACTUATORS", {"electrak": electrak})
    config = Config(rotation=PluginRotatorSettings(backend="nowhere.at.all:ROTATOR", driver={}))
    monkeypatch.setattr(guard, "load", lambda _: config)
    assert guard.run_guard(None) == 1
    assert told == ["lift_left", "lift_right", "tilt"]


class Keys(Settings):
    """``driver`` of the sections below."""

    name_n: int


class OwnCameraSettings(CameraSettings):
    driver: Keys


class OwnActuatorSettings(ActuatorSettings):
    driver: Keys


class OwnStopInputSettings(StopInputSettings):
    driver: Keys


class OwnCamera(FolderCamera):
    """A camera from elsewhere, as far as the wiring goes."""

    def __init__(self, settings: OwnCameraSettings, real_time: bool) -> None:
        super().__init__(settings, real_time)
        self.name_n = settings.driver.name_n


CAMERA = CameraBackend(OwnCameraSettings, OwnCamera)
ACTUATOR = LinearActuatorBackend(
    OwnActuatorSettings,
    lambda name, settings, _: FakeActuator(name, ManualClock(), float(settings.driver.name_n), []),
    lambda axes, can: f"{', '.join(axes)} on {can.channel}",
    lambda actuator: {"where": DeviceService(lambda _: asyncio.sleep(0, {"at": actuator.position}), only_reads=True)},
)
STOP_INPUT = StopInputBackend(OwnStopInputSettings, lambda settings: SimulatedStopInput(f"{settings.driver.name_n}"))


def named(what: str) -> dict[str, object]:
    return {"backend": f"{__name__}:{what}", "driver": {"name_n": 7}}


async def test_camera_actuator_and_stop_input_may_come_from_elsewhere_too(tmp_path: Path) -> None:
    camera = {"source": f"{__name__}:CAMERA", "path": str(tmp_path), "driver": {"name_n": 7}}
    tilt = {**named("ACTUATOR"), "min_mm": 1.0, "max_mm": 9.0}
    config = parse({"camera": camera, "tilt": tilt, "stop_input": named("STOP_INPUT")})
    backends.check_plugins(config)
    start = Start(
        camera=config.camera, calibration=config.camera.calibration, perception=config.perception, blade=config.blade
    )
    made = open_camera(Start.model_validate_json(start.model_dump_json()).camera)  # as the perception child gets it
    assert isinstance(made, OwnCamera)
    assert made.name_n == 7
    devices = build_devices(config, ManualClock(), on_bus_stop=lambda _: None)
    assert isinstance(devices.actuators["tilt"], FakeActuator)
    assert await devices.services["tilt.where"].run({}) == {"at": 7.0}
    assert guard._actions(config)["tilt"]() == "tilt on can0"
    stop_input = backends.stop_input_of(config.stop_input)
    assert stop_input is not None
    assert stop_input[0].build(stop_input[1]).where == "simulated loop at 7"


def test_an_actuators_stroke_is_not_guessed() -> None:
    with pytest.raises(ConfigError, match=r"tilt\.min_mm: Field required"):
        parse({"tilt": named("ACTUATOR")})


def test_a_wrong_key_of_each_is_named_with_its_place() -> None:
    wrong = {"driver": {"name": 7}}
    config = parse(
        {
            "camera": {"source": f"{__name__}:CAMERA", **wrong},
            "tilt": {**named("ACTUATOR"), "min_mm": 1.0, "max_mm": 9.0, **wrong},
            "stop_input": {**named("STOP_INPUT"), **wrong},
        }
    )
    with pytest.raises(ConfigError) as raised:
        backends.check_plugins(config)
    for section in ("camera", "tilt", "stop_input"):
        assert f"{section}.driver.name: unknown key. Did you mean {section}.driver.name_n?" in str(raised.value)
