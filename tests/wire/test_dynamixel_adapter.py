"""A slow USB adapter is told, for as long as it is connected; a pty or an adapter without a timer is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from graderd.drivers.dynamixel import serial_port
from tests.dynamixel_sim import bench


@pytest.mark.parametrize(("timer_ms", "told"), [(16, True), (2, True), (1, False), (None, False)])
async def test_the_latency_timer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timer_ms: int | None, told: bool
) -> None:
    monkeypatch.setattr(serial_port, "latency_timer_ms", lambda _: timer_ms)
    async with bench(tmp_path) as rig:
        found = [fault for fault in rig.rotator.faults() if fault.name == "servo_bus.adapter_latency"]
        assert bool(found) is told
        assert all(str(timer_ms) in fault.detail for fault in found)
        await rig.rotator.close()
        assert not rig.rotator.faults()
