"""Contract of the vehicle: how fast it drives and how far it has come. It is only listened to, never told anything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from graderd.hal.reading import Reading


@dataclass(frozen=True, slots=True)
class VehicleTelemetry:
    """The newest readings; None: never told.

    ``speed_m_per_s``: forward is positive; a source that cannot tell reverse gives it as positive too.
    ``travelled_m``: distance along the travel, backwards counted off where the source can tell; it counts from
    anywhere and starts again with its source, so only a difference between two fresh readings means something.

    A reading may be wrong, and readings may come and go. So one reading ends nothing (what ends a pass has to be said
    for ``rule.standing_s``), and what is not known lengthens nothing: while no fresh reading is there, ``rule`` counts
    ``pass_m`` in ``pass_s``, or the last known speed where that was faster.
    """

    speed_m_per_s: Reading[float] | None = None
    travelled_m: Reading[float] | None = None


class Vehicle(Protocol):
    """One source of speed. It is never required: without it a time rule stands in for the travel."""

    @property
    def where(self) -> str:
        """What is listened to, for people."""
        ...

    async def open(self) -> None:
        """Begin to listen; returns at once, and goes on listening whatever becomes of the source. Idempotent."""
        ...

    def telemetry(self) -> VehicleTelemetry:
        """The newest readings; never waits."""
        ...

    async def close(self) -> None:
        """Listen no more; idempotent."""
        ...
