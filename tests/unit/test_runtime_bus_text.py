"""The CAN bus as the daemon hands it on: bundled, nothing kept for a slow reader, let go when nobody looks."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from graderd.api.port import ServiceError
from graderd.config import Config
from graderd.runtime.port import BUS_LINES_N, Port


class Bus:
    """What is in ``Devices.buses``."""

    def __init__(self) -> None:
        self.listeners: list[Callable[[str], None]] = []

    def watch(self, listener: Callable[[str], None]) -> Callable[[], None]:
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def say(self, *lines: str) -> None:
        for line in lines:
            for listener in self.listeners:
                listener(line)


async def test_a_wire_that_nobody_has_is_refused_at_once() -> None:
    devices = SimpleNamespace(buses={"servo": Bus().watch, "can": Bus().watch})
    port = Port(Config(), cast("Any", None), cast("Any", devices), cast("Any", None), {})
    with pytest.raises(ServiceError, match="there is no bus 'lin'") as refused:
        port.bus_text("lin")
    assert refused.value.remedy == "there are: can, servo"


async def test_lines_come_bundled_and_a_slow_reader_is_told_what_it_lost() -> None:
    bus = Bus()
    devices = SimpleNamespace(buses={"can": bus.watch})
    texts = Port(Config(), cast("Any", None), cast("Any", devices), cast("Any", None), {}).bus_text("can")

    first = asyncio.create_task(anext(texts), name="first")
    await asyncio.sleep(0)
    bus.say("a", "b")
    assert await first == "a\nb\n"
    bus.say("c")
    assert await anext(texts) == "c\n"
    bus.say(*(f"{n}" for n in range(BUS_LINES_N + 7)))
    late = await anext(texts)
    assert late.startswith("# 7 lines lost")
    assert late.count("\n") == BUS_LINES_N + 1
    await texts.aclose()
    assert bus.listeners == []
