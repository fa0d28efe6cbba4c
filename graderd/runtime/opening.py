"""Opens each device until it is open; afterwards the drivers keep their connections themselves."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from graderd.hal.errors import DeviceError
from graderd.runtime.control import ControlLoop

RETRY_S = 1.0

log = logging.getLogger(__name__)


async def open_devices(loop: ControlLoop) -> None:
    """Open the bus, then all axes side by side; every failure is told once per cause and tried again."""
    devices = loop.devices
    async with asyncio.TaskGroup() as group:
        group.create_task(_keep_trying(loop, "rotation", devices.rotation.open), name="open-rotation")
        group.create_task(_open_bus(loop), name="open-can")


async def _open_bus(loop: ControlLoop) -> None:
    await _keep_trying(loop, "can", loop.devices.link.open)
    async with asyncio.TaskGroup() as group:
        for name, actuator in loop.devices.actuators.items():
            group.create_task(_keep_trying(loop, name, actuator.open), name=f"open-{name}")


async def _keep_trying(loop: ControlLoop, name: str, open_device: Callable[[], Awaitable[None]]) -> None:
    while True:
        try:
            await open_device()
        except DeviceError as error:
            if loop.connection_problems.get(name) != str(error):
                log.warning("%s: cannot be opened: %s", name, error)
                loop.connection_problems[name] = str(error)
            await asyncio.sleep(RETRY_S)
        else:
            loop.connection_problems.pop(name, None)
            log.info("%s: open", name)
            return
