"""Contract of one linear actuator (blade lift left or right, tilt). Positions are millimetres of extension."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.reading import Reading


@dataclass(frozen=True, slots=True)
class ActuatorTelemetry:
    """The newest readings; a field is None until the device gave it once.

    ``flags`` names the device's own flags that are set (``overload``, ``backdrive``, ``parameter``, ``saturation``,
    ``fatal``, ``voltage_low``, ``voltage_high``, ``temperature_low``, ``temperature_high``).
    ``goal_mm`` is where the device is driving the axis to now; None while it lets it stay (held, arrived, resting by
    itself). With the position it tells plausible motion from implausible, so every driver gives it.
    ``thermal_load`` is the share of the allowed I²t budget in use (1.0 = limit).
    """

    position_mm: Reading[float] | None = None
    velocity_mm_per_s: Reading[float] | None = None
    current_a: Reading[float] | None = None
    duty_percent: Reading[float] | None = None
    moving: Reading[bool] | None = None
    flags: Reading[frozenset[str]] | None = None
    target_sent_mm: Reading[float] | None = None
    goal_mm: float | None = None
    thermal_load: float = 0.0
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def position(self) -> Reading[float] | None:
        """The extension, by the name that every axis has for it."""
        return self.position_mm

    @property
    def velocity(self) -> Reading[float] | None:
        """Its speed, likewise."""
        return self.velocity_mm_per_s

    @property
    def goal(self) -> float | None:
        """Its goal, likewise."""
        return self.goal_mm


class LinearActuator(Protocol):
    """One linear axis. All methods belong to one event loop; the sync ones never wait."""

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        ...

    def telemetry(self) -> ActuatorTelemetry:
        """Newest readings, each with its time."""
        ...

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions present now (not a history)."""
        ...

    async def open(self) -> None:
        """closed -> standby: wake the device with motion disabled and wait for its first feedback.

        Raises:
            DeviceMissingError: the channel does not exist.
            DeviceTimeoutError: no feedback.
        """
        ...

    async def arm(self) -> None:
        """standby -> active: motion may be enabled from now on; nothing moves until a target is set.

        Everything that a stop will write is written, or tried, first: a stop is never the first time.

        Raises:
            LifecycleError: not in standby.
            DeviceError: feedback is stale, a fault is present, or a stop could not be sent now.
        """
        ...

    def set_target_mm(self, target_mm: float, speed_share: float = 1.0) -> None:
        """Take a new target; the driver's own loop walks there with short look-ahead targets.

        ``speed_share`` (0 exclusive to 1) scales the settings' speed. The caller renews the target every control
        tick; one not renewed for the settings' ``target_timeout_s`` makes the driver hold.

        Raises:
            LifecycleError: not active.
            CommandRangeError: not finite or outside the soft limits; the former target stays.
        """
        ...

    def hold(self) -> None:
        """Motion disabled with the next control message, sent at once. Allowed in every state, idempotent."""
        ...

    async def disarm(self) -> None:
        """active -> standby: motion disabled, keep-alive and feedback go on."""
        ...

    async def close(self) -> None:
        """Any state -> closed: motion disabled several times, then silent."""
        ...
