"""The four states every device goes through, the same for camera, rotator and actuators."""

from __future__ import annotations

from enum import StrEnum


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
