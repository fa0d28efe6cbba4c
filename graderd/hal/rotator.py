"""Contract of the axis that turns the blade about its vertical axis.

Angles are degrees at the blade, counter-clockwise positive seen from above, 0 = square to the direction of travel.
Zero, sign, gear ratio and soft limits belong to the implementation's settings; callers never see servo counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.reading import Reading


@dataclass(frozen=True, slots=True)
class RotatorTelemetry:
    """The newest readings; a field is None until the device gave it once. All from one telemetry block.

    ``goal_deg`` is where the device is driving the blade to now; None while it lets it stay (held, not powered). With
    the angle it tells plausible motion from implausible, so every driver gives it.
    """

    angle_deg: Reading[float] | None = None
    velocity_deg_per_s: Reading[float] | None = None
    current_a: Reading[float] | None = None
    torque_nm: Reading[float] | None = None
    voltage_v: Reading[float] | None = None
    temperature_c: Reading[float] | None = None
    moving: Reading[bool] | None = None
    in_position: Reading[bool] | None = None
    goal_sent_deg: Reading[float] | None = None
    goal_deg: float | None = None
    torque_on: Reading[bool] | None = None
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def position(self) -> Reading[float] | None:
        """The angle, by the name that every axis has for it."""
        return self.angle_deg

    @property
    def velocity(self) -> Reading[float] | None:
        """Its speed, likewise."""
        return self.velocity_deg_per_s

    @property
    def goal(self) -> float | None:
        """Its goal, likewise."""
        return self.goal_deg


class Rotator(Protocol):
    """A blade rotation axis. All methods belong to one event loop; the sync ones never wait."""

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        ...

    def telemetry(self) -> RotatorTelemetry:
        """Newest readings, each with its time."""
        ...

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions present now (not a history)."""
        ...

    async def open(self) -> None:
        """closed -> standby: open the wire, identify and judge the device, start reading telemetry.

        Nothing begins to move and torque is left as it is; a device found on its way somewhere holds first. After a
        successful open the implementation keeps the connection by itself: a lost device makes it FAILED and it retries
        until it is in STANDBY again.

        Raises:
            DeviceMissingError: no such port.
            WrongDeviceError: not the device or settings expected; the message lists every mismatch.
            DeviceTimeoutError: nothing answers.
        """
        ...

    async def arm(self) -> None:
        """standby -> active: write and read back limits, profile and watchdog, set goal := measured, torque on.

        Everything that a stop will write is written, or tried, first: a stop is never the first time.

        Raises:
            LifecycleError: not in standby.
            DeviceError: anything did not read back as written; torque stays off.
        """
        ...

    def set_goal_deg(self, goal_deg: float) -> None:
        """Take a new goal; sent by the driver's own loop, the newest wins.

        The caller renews it every control tick: a goal not renewed for the settings' ``goal_timeout_s``
        makes the driver hold the measured angle.

        Raises:
            LifecycleError: not active.
            CommandRangeError: not finite or outside the soft limits; the former goal stays.
        """
        ...

    def hold(self) -> None:
        """Stop with the next packet, as soon as the blade can without turning back. Allowed always, idempotent."""
        ...

    async def disarm(self) -> None:
        """active -> standby: hold, then torque as the settings' ``torque_at_disarm`` says."""
        ...

    async def close(self) -> None:
        """Any state -> closed: hold if active, torque as ``torque_at_exit`` says, then let go of the wire."""
        ...
