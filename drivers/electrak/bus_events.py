"""What a CAN controller, its driver or its adapter says about the bus itself."""

from __future__ import annotations

from enum import StrEnum


class BusEvent(StrEnum):
    """What the controller or the kernel says about the bus itself."""

    ERROR_ACTIVE = "error_active"
    ERROR_PASSIVE = "error_passive"
    BUS_OFF = "bus_off"
    QUEUE_OVERRUN = "queue_overrun"


def event_of(class_bits: int, data: bytes) -> BusEvent | None:
    """Read an error frame of the Linux kernel (linux/can/error.h)."""
    if class_bits & 0x40:
        return BusEvent.BUS_OFF
    if class_bits & 0x100:  # the controller was restarted after bus-off
        return BusEvent.ERROR_ACTIVE
    if class_bits & 0x04 and len(data) > 1:
        if data[1] & 0x03:
            return BusEvent.QUEUE_OVERRUN
        if data[1] & 0x30:
            return BusEvent.ERROR_PASSIVE
        if data[1] & 0x40:
            return BusEvent.ERROR_ACTIVE
    return None
