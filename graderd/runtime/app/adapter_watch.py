"""Watches the servo's USB adapter: a latency timer above 1 ms makes every reply late, whatever the baud rate."""

from __future__ import annotations

from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.drivers.dynamixel.serial_port import latency_timer_ms
from graderd.hal.fault import DeviceFault, PresentFaults

WANTED_MS = 1


class AdapterWatch:
    """Looks once per connection; adapters without such a timer, and ptys, are none of its business."""

    def __init__(self, rotator: Ph54Rotator) -> None:
        self._rotator = rotator
        self._port: str | None = None
        self._faults = PresentFaults("servo_bus")

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """``servo_bus.adapter_latency`` while the present adapter holds bytes back."""
        port = self._rotator.port
        if port != self._port:
            self._port = port
            timer_ms = latency_timer_ms(port) if port is not None else None
            detail = f"{port}: latency timer {timer_ms} ms, {WANTED_MS} ms is wanted"
            slow = timer_ms is not None and timer_ms > WANTED_MS
            self._faults.keep("adapter_latency", slow, detail, now_s)
        return self._faults.present(now_s)
