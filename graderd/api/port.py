"""The daemon as the interface sees it: status out, commands in, a few services. ``graderd.runtime`` implements it."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any, Protocol

from graderd.core.commands import Command, Reply
from graderd.core.status import Status


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

    async def command(self, command: Command) -> Reply:
        """Hand a command to the next tick and wait for its reply. Stop is taken ahead of all others."""
        ...

    def config(self) -> dict[str, Any]:
        """The resolved configuration."""
        ...

    async def preview_jpeg(self) -> bytes:
        """The newest annotated picture.

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

    async def service(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """A device service outside the control loop: ``rotation.verify_profile``, ``rotation.reboot``,
        ``rotation.step_response``, ``camera.calibrate``, ``camera.calibration_file``.
        Those that move or unpower want ``consent: true``.

        Raises:
            ServiceError: unknown, refused in this mode, or failed.
        """
        ...
