"""What a driver reports when something is wrong: a name and its detail, no judgement.

How bad it is, what the operator reads and what clears it stands in the fault catalogue (``graderd.core.faults``).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DeviceFault:
    """One present fault of one device.

    ``device``: ``camera``, ``rotation``, ``lift_left``, ``lift_right``, ``tilt``, ``can``, ``servo_bus``,
    ``stop_input`` or ``daemon``.
    ``condition``: the catalogue's name of the condition, for example ``no_reply``.
    ``detail``: one line with the numbers, for example ``no status packet for 0.21 s (7 requests)``.
    ``since_s``: monotonic time at which it was first seen.
    ``latched``: the cause is gone, the driver keeps the condition until it is armed again. The fault catalogue has
    latches of its own; a driver's latch must not keep the machine from the very arm that ends it.
    """

    device: str
    condition: str
    detail: str
    since_s: float
    latched: bool = False

    @property
    def name(self) -> str:
        """``device.condition``, the name used in status, records and ``graderd explain``."""
        return f"{self.device}.{self.condition}"
