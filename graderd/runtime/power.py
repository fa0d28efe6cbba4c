"""Brings the devices to ACTIVE and back as the state machine wants, in a task of its own beside the tick."""

from __future__ import annotations

import asyncio
import logging

from graderd.hal.errors import DeviceError
from graderd.hal.lifecycle import Lifecycle
from graderd.runtime.devices import Devices

log = logging.getLogger(__name__)


class PowerKeeper:
    """``want(True)`` arms all devices once, ``want(False)`` disarms those that are active. Nothing is retried here:
    a failed arming is reported once through :meth:`take_error` and the machine goes back to disarmed."""

    def __init__(self, devices: Devices) -> None:
        self._devices = devices
        self._wanted = False
        self._task: asyncio.Task[None] | None = None
        self._error = ""

    @property
    def all_active(self) -> bool:
        """Whether every device is ACTIVE and none is being armed or disarmed."""
        busy = self._task is not None and not self._task.done()
        return not busy and all(d.lifecycle is Lifecycle.ACTIVE for d in self._devices.all().values())

    def take_error(self) -> str:
        """Why arming failed, once."""
        error, self._error = self._error, ""
        return error

    def want(self, power: bool) -> None:
        """Called every tick; starts a task only on a change, or where an active device should not be."""
        busy = self._task is not None and not self._task.done()
        stray = not power and any(d.lifecycle is Lifecycle.ACTIVE for d in self._devices.all().values())
        if power == self._wanted and not (stray and not busy):
            return
        if busy and self._task is not None:
            if power == self._wanted:
                return
            self._task.cancel()
        self._wanted = power
        work = self._arm_all(self._task) if power else self._disarm_all(self._task)
        self._task = asyncio.get_running_loop().create_task(work, name=f"power-{'on' if power else 'off'}")

    async def _arm_all(self, former: asyncio.Task[None] | None) -> None:
        await _finished(former)
        for name, device in self._devices.all().items():
            try:
                if device.lifecycle is Lifecycle.ACTIVE:
                    await device.disarm()  # left over from before: arming anew writes and verifies everything
                await device.arm()
            except DeviceError as error:
                log.warning("arming %s failed: %s", name, error)
                self._error = str(error)
                return

    async def _disarm_all(self, former: asyncio.Task[None] | None) -> None:
        await _finished(former)
        self._error = ""
        for name, device in self._devices.all().items():
            try:
                if device.lifecycle is Lifecycle.ACTIVE:
                    await device.disarm()
            except DeviceError as error:
                # The device keeps its own dead man; the fault it reports says the rest.
                log.warning("disarming %s failed: %s", name, error)

    async def close(self) -> None:
        """End the task under way."""
        if self._task is not None:
            self._task.cancel()
            await _finished(self._task)


async def _finished(task: asyncio.Task[None] | None) -> None:
    """Wait for a cancelled or ending task, whatever became of it."""
    if task is not None:
        await asyncio.gather(task, return_exceptions=True)
