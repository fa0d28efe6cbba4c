"""A service of a device outside the control loop: something a person asks for, such as a reboot or a comparison."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class DeviceService:
    """``run`` takes the request's arguments, returns a JSON object, and raises ``DeviceError`` where it cannot.

    ``only_reads``: it may be asked for in every mode and without consent. All others may move or unpower something:
    they need a disarmed machine and somebody who has looked.
    """

    run: Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]
    only_reads: bool = False


WatchBus = Callable[[Callable[[str], None]], Callable[[], None]]
"""Calls a listener with everything on a wire from now on, received or sent, each a line of text; returns the call that
ends it. Nobody listening costs nothing."""
