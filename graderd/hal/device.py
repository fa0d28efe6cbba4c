"""What all devices share: the states they go through, and services that a person asks for beside the control loop."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from graderd.hal.settings import Settings


class Lifecycle(StrEnum):
    """``closed -> standby -> active``, and ``failed`` from any of them.

    * CLOSED: the wire is not open.
    * STANDBY: open, identified and readable; unpowered, or powered and forbidden to move.
    * ACTIVE: may move when commanded.
    * FAILED: the wire or the device is lost or refuses; the driver keeps trying to get back to STANDBY
      (never to ACTIVE: that takes an arm).
    """

    CLOSED = "closed"
    STANDBY = "standby"
    ACTIVE = "active"
    FAILED = "failed"


class NoArguments(Settings):
    """Of a service that takes none."""


@dataclass(frozen=True, slots=True)
class DeviceService:
    """``run`` takes the request's arguments as ``arguments`` describes them, returns a JSON object, and raises
    ``DeviceError`` where it cannot.

    ``only_reads``: it may be asked for in every mode and without consent. All others may move or unpower something:
    they need a disarmed machine and somebody who has looked, and run one at a time. ``moves``: it moves the machine for
    as long as it runs, and is cancelled when the client that asked for it goes.
    """

    run: Callable[[Any], Awaitable[dict[str, Any]]]
    only_reads: bool = False
    moves: bool = False
    arguments: type[Settings] = NoArguments
    summary: str = "A device service outside the control loop"


WatchBus = Callable[[Callable[[str], None]], Callable[[], None]]
"""Calls a listener with everything on a wire from now on, received or sent, each a line of text; returns the call that
ends it. Nobody listening costs nothing."""
