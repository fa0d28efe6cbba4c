"""The devices the control loop works with, as contracts; built by ``graderd.runtime.app.devices``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.rotator import Rotator

ACTUATOR_NAMES = ("lift_left", "lift_right", "tilt")


class Link(Protocol):
    """The CAN bus under the actuators: opened before them, closed after them."""

    async def open(self) -> None:
        """Open the channel and claim our address; afterwards it keeps itself open.

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


def _watch_nothing(listener: Callable[[str], None]) -> Callable[[], None]:  # noqa: ARG001
    """Where there is no bus to watch."""
    return lambda: None


@dataclass(frozen=True, slots=True)
class Devices:
    """Everything that can move, and the bus under it."""

    rotation: Rotator
    link: Link
    actuators: dict[str, LinearActuator]
    publish_faults: Callable[[tuple[DeviceFault, ...], bool], None] = _publish_nowhere
    """Puts the active faults, and whether the machine is stopped, on the bus as diagnostic messages (DM1)."""
    watch_bus: Callable[[Callable[[str], None]], Callable[[], None]] = _watch_nothing
    """Calls a listener with every frame on the bus, received or sent, as a line of candump text; returns the call that
    ends it."""

    def all(self) -> dict[str, Rotator | LinearActuator]:
        """The axes by device name."""
        return {"rotation": self.rotation, **self.actuators}

    def hold_all(self) -> tuple[str, ...]:
        """Ask every axis to stop where it is, each in its own try; returns the axes whose driver raised."""
        failed = []
        for name, device in self.all().items():
            try:
                device.hold()
            except Exception:  # the stop path goes on to the next device whatever this one raised
                failed.append(name)
        return tuple(failed)
