"""The daemon as the interface sees it: status out, commands in, a few services. ``graderd.runtime`` implements it."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping
from typing import Any, Protocol

from graderd.core.commands import Command, Reply, Stop
from graderd.core.status import Status
from graderd.hal.device import DeviceService


class ServiceError(Exception):
    """A service refused or failed; ``remedy`` says what to do."""

    def __init__(self, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy


class DaemonPort(Protocol):
    """What the HTTP interface may do with the daemon."""

    def status(self) -> Status:
        """The state at the last control tick."""
        ...

    async def next_status(self, after_s: float) -> Status:
        """Wait for a status newer than ``after_s`` (monotonic) and return it."""
        ...

    async def command(self, command: Command, waited_s: float = 0.0) -> Reply:
        """Hand a command to the next tick and wait for its reply. ``waited_s``: since it was heard."""
        ...

    def stop(self, command: Stop) -> Reply:
        """Stop: every wire is told before this returns, and nothing is waited for."""
        ...

    def config(self) -> dict[str, Any]:
        """The resolved configuration."""
        ...

    async def preview_jpeg(self, *, labels: bool = True, width_px: int | None = None) -> tuple[bytes, float]:
        """The newest annotated picture, and its age in seconds. ``labels``: with names and numbers in it; ``width_px``:
        no wider than that.

        Raises:
            ServiceError: there is none.
        """
        ...

    def bus_text(self, name: str) -> AsyncGenerator[str, None]:
        """What is on a wire (``can``, ``servo``) from now on, some lines at a time; ends when it is closed.

        Raises:
            ServiceError: there is no such wire.
        """
        ...

    def services(self) -> Mapping[str, DeviceService]:
        """The device services outside the control loop, by name; they stay the same."""
        ...

    async def service(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Run one of them. Those that move or unpower want ``consent`` to be True, and end when this is cancelled.

        Raises:
            ServiceError: unknown, refused in this mode, or failed.
        """
        ...
