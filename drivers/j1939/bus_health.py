"""What is wrong with the bus, as fault conditions: each with its own cause, none mistaken for another."""

from __future__ import annotations

import collections
from enum import StrEnum
from typing import Final

from graderd.drivers.j1939.claim import AddressClaimer, ClaimState
from graderd.hal.errors import DeviceError
from graderd.hal.fault import EVENT_SHOWN_S, DeviceFault, PresentFaults


class BusEvent(StrEnum):
    """What the controller or the kernel says about the bus itself."""

    ERROR_ACTIVE = "error_active"
    ERROR_PASSIVE = "error_passive"
    BUS_OFF = "bus_off"
    QUEUE_OVERRUN = "queue_overrun"
    REFUSED = "refused"
    """The adapter answered NACK to what it was given: a frame that did not leave, mostly."""


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


ERROR_FRAMES: Final[dict[BusEvent, tuple[int, bytes]]] = {
    BusEvent.BUS_OFF: (0x40, bytes(8)),
    BusEvent.ERROR_PASSIVE: (0x04, bytes((0, 0x30, 0, 0, 0, 0, 128, 128))),
    BusEvent.ERROR_ACTIVE: (0x04, bytes((0, 0x40, 0, 0, 0, 0, 0, 0))),
    BusEvent.QUEUE_OVERRUN: (0x04, bytes((0, 0x01, 0, 0, 0, 0, 0, 0))),
    BusEvent.REFUSED: (0x01, bytes(8)),
}
"""Events as error frames of the Linux kernel: class bits and data. One that was refused is a transmit timeout."""

ERROR_CLASSES: Final = (
    "transmit_timeout",
    "arbitration_lost",
    "controller",
    "protocol_violation",
    "transceiver",
    "no_acknowledgement",
    "bus_off",
    "bus_error",
    "restarted",
    "error_counters",
)
"""What the bits of an error frame's identifier say, from the lowest on."""

FLOOD_HZ: Final = 1200.0
"""Frames a second beyond which the bus counts as flooded: about 75 % of what 250 kbit/s can carry."""
REFUSED_N: Final = 5
"""NACKs of the adapter within a second that are a fault. A single one is a lost frame, and is counted."""
_REFUSED_WINDOW_S: Final = 1.0
ADDRESS_LOST_S: Final = 0.28
"""An address that was lost and not replaced for longer is a fault. A new claim takes 0.25 s and a poll of 0.02 s."""
_OVERRUN_SHOWN_S: Final = 2.0
_WINDOW_S: Final = 0.5
_LOST: Final = ("interface_down", "unplugged")


class BusHealth:
    """Collects events and tells the faults of device ``can``."""

    def __init__(self) -> None:
        self._faults = PresentFaults("can")
        self._window_start_s = 0.0
        self._window_n = 0
        self._refused_s: collections.deque[float] = collections.deque(maxlen=REFUSED_N)
        self._off_since_s: float | None = None

    @property
    def is_off(self) -> bool:
        """Whether the controller has left the bus, and is not back."""
        return self._off_since_s is not None

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """Conditions present now."""
        if now_s - self._window_start_s > 2 * _WINDOW_S:
            self._faults.clear("flood")
        return self._faults.present(now_s)

    def on_open(self) -> None:
        """The bus is open (again): a new start."""
        self._off_since_s = None
        self._faults.clear(*_LOST, "bus_off", "error_passive", "queue_overrun")

    def on_lost(self, condition: str, detail: str, now_s: float) -> None:
        """The bus is gone."""
        self._off_since_s = None
        self._faults.clear("bus_off", "error_passive", "queue_overrun", "flood")
        self._faults.set(condition, detail, now_s)

    def on_open_failed(self, error: DeviceError, now_s: float) -> None:
        """Opening again failed: an interface that exists and is down is not the same as one that is gone."""
        is_down = "interface is down" in error.cause
        self._faults.clear(_LOST[is_down])
        self._faults.set(_LOST[not is_down], error.cause, now_s)

    def on_event(self, event: BusEvent, now_s: float) -> None:
        """An error frame or an adapter's state line."""
        match event:
            case BusEvent.BUS_OFF:
                self._off_since_s = now_s
                self._faults.clear("error_passive", "queue_overrun")
                self._faults.set("bus_off", "the controller left the bus after too many transmit errors", now_s)
            case BusEvent.ERROR_PASSIVE:
                self._back_on_the_bus(now_s)
                self._faults.set("error_passive", "the controller counts 128 errors or more", now_s)
            case BusEvent.ERROR_ACTIVE:
                self._back_on_the_bus(now_s)
                self._faults.clear("error_passive")
            case BusEvent.QUEUE_OVERRUN:
                self._faults.tell("queue_overrun", "received frames were lost", now_s, _OVERRUN_SHOWN_S)
            case BusEvent.REFUSED:
                self._refused_s.append(now_s)
                if len(self._refused_s) == REFUSED_N and now_s - self._refused_s[0] < _REFUSED_WINDOW_S:
                    detail = f"it answered NACK {REFUSED_N} times within a second"
                    self._faults.tell("adapter_refuses", detail, now_s, _REFUSED_WINDOW_S)

    def _back_on_the_bus(self, now_s: float) -> None:
        """It left and came back, maybe before anybody looked: told all the same, for as long as any event is."""
        off_since_s, self._off_since_s = self._off_since_s, None
        if off_since_s is None:
            return
        self._faults.clear("bus_off")
        left_s = off_since_s + EVENT_SHOWN_S - now_s
        if left_s > 0.0:
            self._faults.tell("bus_off", "the controller left the bus, and is back on it", now_s, left_s)

    def on_transmit_full(self, detail: str, now_s: float) -> None:
        """The transmit queue was full; after a bus-off that is only its consequence."""
        if not self.is_off:
            self._faults.tell("queue_overrun", f"transmit queue full: {detail}", now_s, _OVERRUN_SHOWN_S)

    def on_traffic(self, frames_n: int, now_s: float) -> None:
        """Count received frames."""
        self._window_n += frames_n
        elapsed_s = now_s - self._window_start_s
        if elapsed_s < _WINDOW_S:
            return
        rate_hz = self._window_n / elapsed_s
        self._faults.keep("flood", rate_hz > FLOOD_HZ, f"{rate_hz:.0f} frames a second", now_s)
        self._window_start_s, self._window_n = now_s, 0

    def watch_claim(self, claimer: AddressClaimer, lost_for_s: float, now_s: float) -> None:
        """Turn the state of the address claim into conditions; ``lost_for_s``: an address lost and not replaced yet."""
        address = claimer.wanted
        none_free = claimer.state is ClaimState.CANNOT_CLAIM
        for condition, is_present, detail in (
            (
                "cannot_claim",
                none_free or lost_for_s > ADDRESS_LOST_S,
                f"address {address} is taken" + (" and no other is free" if none_free else " and so is the next"),
            ),
            ("claim_storm", claimer.storming(now_s), f"another node claims address {address} without end"),
            (
                "address_conflict",
                claimer.equal_name_seen(now_s) or claimer.violated(now_s),
                f"another node uses our address {address}"
                + (" and our NAME" if claimer.equal_name_seen(now_s) else ""),
            ),
        ):
            self._faults.keep(condition, is_present, detail, now_s)
