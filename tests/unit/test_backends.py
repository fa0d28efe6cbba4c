"""The registry of drivers: every name that the settings take has one, and old files mean what they meant."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from pydantic import ValidationError

from graderd.config import Config, parse
from graderd.drivers.backend import LinearActuatorBackend, RotatorBackend
from graderd.drivers.simulated.stop_input import SimulatedStopInput
from graderd.hal.settings import (
    CameraSettings,
    CanSettings,
    ElectrakSettings,
    Ph54Settings,
    PluginRotatorSettings,
    RotatorSettings,
    StopInputSettings,
)
from graderd.runtime.app import backends, guard
from graderd.runtime.app.frame_sources import open_camera


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
