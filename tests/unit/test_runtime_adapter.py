"""A slow USB adapter is told; a pty or an adapter without a timer is not."""

from __future__ import annotations

import pytest

from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.hal.settings import RotatorSettings
from graderd.runtime.app import adapter_watch


@pytest.mark.parametrize(("timer_ms", "told"), [(16, True), (2, True), (1, False), (None, False)])
def test_the_latency_timer(monkeypatch: pytest.MonkeyPatch, timer_ms: int | None, told: bool) -> None:
    rotator = Ph54Rotator(RotatorSettings())
    monkeypatch.setattr(Ph54Rotator, "port", property(lambda _: "/dev/ttyUSB7"))
    monkeypatch.setattr(adapter_watch, "latency_timer_ms", lambda _: timer_ms)
    watch = adapter_watch.AdapterWatch(rotator)
    for _ in range(2):
        assert bool(watch.faults(1.0)) is told
    if told:
        assert watch.faults(1.0)[0].name == "servo_bus.adapter_latency"
        assert str(timer_ms) in watch.faults(1.0)[0].detail
