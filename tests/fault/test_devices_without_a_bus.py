"""A machine whose CAN bus is not there: real link, real drivers, and an actuator that has a wire of its own."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from graderd.config import parse
from graderd.hal.clock import SystemClock
from graderd.hal.device import Lifecycle
from graderd.runtime.app.devices import build_devices
from graderd.runtime.devices import open_devices
from harness.electrak_sim import until
from harness.fakes import FakeActuator


async def test_what_is_not_on_the_bus_opens_and_what_is_says_why_it_does_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    here = {"backend": "tests.unit.test_backends:ACTUATOR", "driver": {"name_n": 7}, "min_mm": 1.0, "max_mm": 9.0}
    config = parse({"can": {"channel": "nowhere0"}, "rotation": {"port": str(tmp_path / "none")}, "tilt": here})
    devices = build_devices(config, SystemClock(), on_bus_stop=lambda _: None)
    tilt = devices.actuators["tilt"]
    assert isinstance(tilt, FakeActuator)
    tilt.lifecycle = Lifecycle.CLOSED
    opening = asyncio.create_task(open_devices(devices))
    try:
        await until(lambda: {"can", "rotation", "lift_left", "lift_right"} <= set(devices.problems))
        assert (tilt.lifecycle, devices.problem_of("tilt")) == (Lifecycle.STANDBY, "")
        assert "nowhere0" in devices.problem_of("lift_left")
        assert devices.problem_of("lift_left") == devices.problem_of("lift_right") == devices.problems["can"]
        told = [each.getMessage() for each in caplog.records if "nowhere0" in each.getMessage()]
        assert len(told) == 1, "once for the bus and all on it"
    finally:
        opening.cancel()
        await asyncio.gather(opening, return_exceptions=True)
