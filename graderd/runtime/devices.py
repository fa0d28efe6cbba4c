"""The devices the control loop works with, as contracts: opened, powered and held together.

Built by ``graderd.runtime.app.devices``.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from graderd.hal.device import DeviceService, Lifecycle, WatchBus
from graderd.hal.errors import DeviceError
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.rotator import Rotator
from graderd.hal.vehicle import Vehicle

RETRY_S = 1.0

log = logging.getLogger(__name__)


class Link(Protocol):
    """The CAN bus: it is opened whether a device is on it or not (it brings stop messages, and takes diagnostic ones),
    by whoever comes first, and closed after all of them."""

    async def open(self) -> None:
        """Open the channel and claim our address, or do nothing where that is done; afterwards it keeps itself open.

        Raises:
            DeviceMissingError: the channel does not exist.
        """
        ...

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions of the bus present now."""
        ...

    async def close(self) -> None:
        """Let go of the channel."""
        ...


def _publish_nowhere(faults: tuple[DeviceFault, ...], stopped: bool) -> None:
    """Where there is no bus to tell."""


@dataclass(frozen=True, slots=True)
class Devices:
    """Everything that can move, the bus under it, and the vehicle that carries it."""

    rotation: Rotator
    link: Link
    actuators: dict[str, LinearActuator]
    services: Mapping[str, DeviceService] = field(default_factory=dict)
    """What the drivers offer besides, as ``device.name``; what a driver has not is absent."""
    publish_faults: Callable[[tuple[DeviceFault, ...], bool], None] = _publish_nowhere
    """Puts the active faults, and whether the machine is stopped, on the bus as diagnostic messages (DM1)."""
    buses: Mapping[str, WatchBus] = field(default_factory=dict)
    """The wires that can be watched: ``can``, and what the rotation's driver has of its own."""
    vehicle: Vehicle | None = None
    problems: dict[str, str] = field(default_factory=dict)
    """Why a device, or the bus (``can``), is not open yet; kept by :func:`open_devices`."""

    def all(self) -> dict[str, Rotator | LinearActuator]:
        """The axes by device name."""
        return {"rotation": self.rotation, **self.actuators}

    def problem_of(self, axis: str) -> str:
        """Why the axis's device is not open, empty where nothing is known."""
        return self.problems.get(axis, "")

    def hold_all(self) -> tuple[str, ...]:
        """Ask every axis to stop where it is, each in its own try; returns the axes whose driver raised."""
        failed = []
        for name, device in self.all().items():
            try:
                device.hold()
            except Exception:  # the stop path goes on to the next device whatever this one raised
                failed.append(name)
        return tuple(failed)


class PowerSequencer:
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
                log.warning("arming %s failed: %s", name, error, extra={"event": True, "device": name})
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
                log.warning("disarming %s failed: %s", name, error, extra={"event": True, "device": name})

    async def close(self) -> None:
        """End the task under way."""
        if self._task is not None:
            self._task.cancel()
            await _finished(self._task)


async def _finished(task: asyncio.Task[None] | None) -> None:
    """Wait for a cancelled or ending task, whatever became of it."""
    if task is not None:
        await asyncio.gather(task, return_exceptions=True)


async def open_devices(devices: Devices) -> None:
    """Open the bus and all axes side by side: an axis with a wire of its own does not wait for a bus that is not there,
    and one that is on the bus opens it itself. What fails is told and tried again; the log repeats it more rarely."""
    openings: dict[str, Callable[[], Awaitable[None]]] = {"can": devices.link.open}
    openings |= {name: device.open for name, device in devices.all().items()}
    async with asyncio.TaskGroup() as group:
        for name, open_device in openings.items():
            group.create_task(_keep_trying(name, open_device, devices.problems), name=f"open-{name}")
        if devices.vehicle is not None:
            group.create_task(devices.vehicle.open(), name="open-vehicle")


async def _keep_trying(name: str, open_device: Callable[[], Awaitable[None]], problems: dict[str, str]) -> None:
    while True:
        try:
            await open_device()
        except DeviceError as error:
            problem = str(error)
            # A bus that is not there is told once, not by each device on it.
            told = any(theirs == problem for other, theirs in problems.items() if other != name)
            if not told:
                log.warning("%s: cannot be opened: %s", name, error, extra={"device": name})
            problems[name] = problem
            await asyncio.sleep(RETRY_S)
        else:
            problems.pop(name, None)
            log.info("%s: open", name, extra={"device": name})
            return
