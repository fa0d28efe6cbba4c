"""The servo's lifecycle as a table: every state it may be in, everything that happens to it. Pure."""

from __future__ import annotations

from enum import StrEnum
from types import MappingProxyType
from typing import Final

from graderd.hal.lifecycle import Lifecycle


class Event(StrEnum):
    """What happens to a servo. ``DISARMED``: asked for, or it is not as arming left it. ``LOST``: silent or gone."""

    OPENED = "opened"
    ARMED = "armed"
    DISARMED = "disarmed"
    LOST = "lost"
    FOUND = "found"
    CLOSED = "closed"


_NEXT: Final = MappingProxyType(
    {
        (Lifecycle.CLOSED, Event.OPENED): Lifecycle.STANDBY,
        (Lifecycle.STANDBY, Event.ARMED): Lifecycle.ACTIVE,
        (Lifecycle.ACTIVE, Event.DISARMED): Lifecycle.STANDBY,
        (Lifecycle.STANDBY, Event.LOST): Lifecycle.FAILED,
        (Lifecycle.ACTIVE, Event.LOST): Lifecycle.FAILED,
        (Lifecycle.FAILED, Event.FOUND): Lifecycle.STANDBY,
        **{(state, Event.CLOSED): Lifecycle.CLOSED for state in Lifecycle},
    }
)


def after(state: Lifecycle, event: Event) -> Lifecycle:
    """The state that ``event`` leads to; where the table has none, nothing changes."""
    return _NEXT.get((state, event), state)
