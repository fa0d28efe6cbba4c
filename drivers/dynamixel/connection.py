"""The way to the servo: find the port, open the bus, identify the device, and the wire's history across reconnects."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from graderd.drivers.dynamixel.bus import BusTap, ServoBus, ServoRefusedError
from graderd.drivers.dynamixel.device import Ph54Device
from graderd.drivers.dynamixel.serial_port import ListPorts, find_port
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.clock import Clock
from graderd.hal.errors import (
    DeviceError,
    DeviceLostError,
    DeviceMissingError,
    DeviceRefusedError,
    DeviceTimeoutError,
    WrongDeviceError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.settings import Ph54Settings

_REBOOT_S = 5.0
_LOOK_EVERY_S = 0.05
_MANY = 1_000_000
_LATENCY_WANTED_MS = 1
_LOSS_WINDOW_S, _LOSS_REQUESTS_N, _LOSS_SHARE = 2.0, 40, 0.05
_LOSS_COUNTERS = ("requests_n", "timeouts_n")
"""So large a share of at least so many requests without an answer, within the window, is told."""


log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Found:
    """One servo that answered a scan."""

    baud_n: int
    servo_id_n: int
    model_n: int
    firmware_version: int


class ServoLink:
    """One servo's connection; made, lost and made again. ``firmware_version``: of the servo last identified."""

    def __init__(
        self,
        settings: Ph54Settings,
        table: ControlTable,
        expected_mode: int,
        clock: Clock,
        list_ports: ListPorts,
    ) -> None:
        self.firmware_version: int | None = None
        self.happened: Counter[str] = Counter(reconnects_n=0, goal_timeouts_n=0)
        self.bus: ServoBus | None = None
        self.slow_adapter: DeviceFault | None = None
        """The present adapter holds bytes back, which makes every reply late, whatever the baud rate."""
        self.lossy: DeviceFault | None = None
        """The present line loses more than it should."""
        self._told: deque[tuple[float, int, int]] = deque()
        self._settings = settings
        self._table = table
        self._mode = expected_mode
        self._clock = clock
        self._taps: list[BusTap] = []
        self._list_ports = list_ports
        self._device: Ph54Device | None = None

    @property
    def is_up(self) -> bool:
        """Whether a servo was identified and its port has not been lost since."""
        return self._device is not None and self.bus is not None and self.bus.is_open

    def tap(self, listener: BusTap) -> Callable[[], None]:
        """Call ``listener`` with all bytes on the wire, over all connections; returns the call that ends it."""
        self._taps.append(listener)
        return lambda: self._taps.remove(listener)

    @property
    def device(self) -> Ph54Device:
        """The servo.

        Raises:
            DeviceLostError: there is none at present.
        """
        if self._device is None:
            raise DeviceLostError("rotation", "the servo is not connected", "Check the USB cable")
        return self._device

    async def connect(self) -> Ph54Device:
        """Find the port, open it, identify and judge the servo.

        Raises:
            DeviceMissingError, DeviceRefusedError: as for the port.
            WrongDeviceError, DeviceTimeoutError, DeviceLostError: as :meth:`Ph54Device.identify`.
        """
        device = self._open(self._settings.baud_n)
        self.firmware_version = await device.identify(self._mode)
        self._device = device
        return device

    @asynccontextmanager
    async def visit(self) -> AsyncIterator[Ph54Device]:
        """The servo as it is, fit or not; a wire that was not up is let go of again.

        Raises:
            DeviceMissingError, DeviceRefusedError: as for the port.
        """
        if self.is_up:
            yield self.device
            return
        self.disconnect()
        try:
            yield self._open(self._settings.baud_n)
        finally:
            self.disconnect()

    async def scan(self) -> list[Found]:
        """Every servo that answers, at every rate the model knows. Nothing but pings is sent; the wire is let go of.

        Raises:
            DeviceMissingError: as for the port.
        """
        found: list[Found] = []
        for baud_n in sorted(self._table.profile["bus"]["baud_n"]):
            self.disconnect()
            try:
                bus = self._open(baud_n).bus
                found += [Found(baud_n, *answer) for answer in await bus.ping_all()]
            except (DeviceRefusedError, DeviceLostError) as e:  # a rate this adapter cannot do
                log.info("scan: %s", e)
            finally:
                self.disconnect()
        return found

    def _open(self, baud_n: int) -> Ph54Device:
        s, rates = self._settings, self._table.profile["bus"]["baud_n"]
        if baud_n not in rates:
            cause = f"{self._table.title} cannot run at {baud_n} bit/s"
            raise DeviceRefusedError("rotation", cause, f"Choose one of {rates}")
        port = find_port(s.port, s.usb_serial_number, self._list_ports)
        self.bus = ServoBus(port, baud_n, clock=self._clock, taps=self._taps)
        self.bus.open()
        self.slow_adapter = self._judge_adapter(self.bus)
        return Ph54Device(self.bus, self._table, s.servo_id_n)

    def _judge_adapter(self, bus: ServoBus) -> DeviceFault | None:
        """Adapters without a latency timer, and ptys, hold nothing back."""
        timer_ms = bus.latency_timer_ms
        if timer_ms is None or timer_ms <= _LATENCY_WANTED_MS:
            return None
        detail = f"{bus.port}: latency timer {timer_ms} ms, {_LATENCY_WANTED_MS} ms is wanted"
        return DeviceFault("servo_bus", "adapter_latency", detail, self._clock.now_s())

    def judge_loss(self) -> None:
        """Tell a line that loses much, while repeats still make up for it; called with every poll."""
        if self.bus is None:
            return
        now_s, counted = self._clock.now_s(), self.bus.counters()
        self._told.append((now_s, counted["requests_n"], counted["timeouts_n"]))
        while now_s - self._told[0][0] > _LOSS_WINDOW_S:
            self._told.popleft()
        requests_n, lost_n = (
            counted[name] - first for name, first in zip(_LOSS_COUNTERS, self._told[0][1:], strict=True)
        )
        if requests_n < _LOSS_REQUESTS_N:
            return
        if lost_n <= _LOSS_SHARE * requests_n:
            self.lossy = None
        elif self.lossy is None:
            detail = f"{lost_n} of {requests_n} requests within {_LOSS_WINDOW_S:g} s had no answer"
            self.lossy = DeviceFault("servo_bus", "lossy", detail, now_s)

    def disconnect(self) -> None:
        """Let go of the port and remember what was counted. Idempotent."""
        self._device = None
        self.slow_adapter = self.lossy = None
        self._told.clear()
        if self.bus is not None:
            bus, self.bus = self.bus, None
            bus.close()
            counted = bus.counters()
            counted.pop("low_latency_n")
            self.happened.update(counted)

    def counters(self) -> dict[str, int]:
        """Everything since the beginning, over all connections, what never happened too: a rate begins at 0.
        ``low_latency_n`` is of the present one."""
        now = Counter(self.bus.counters()) if self.bus is not None else Counter[str]()
        low_latency_n = now.pop("low_latency_n", 0)
        names = dict.fromkeys((*self.happened, *now))  # a sum of counters would drop what is 0
        return {**{name: self.happened[name] + now[name] for name in names}, "low_latency_n": low_latency_n}

    def silence(self) -> tuple[float, int]:
        """Seconds since the last valid status packet, and requests without an answer since."""
        if self.bus is None:
            return float("inf"), _MANY
        return self._clock.now_s() - self.bus.last_valid_s, self.bus.unanswered_n

    async def reboot(self) -> None:
        """Reboot the servo and wait until it is back and fits.

        Raises:
            DeviceTimeoutError: it did not come back in time.
            WrongDeviceError, DeviceLostError: as :meth:`Ph54Device.identify`.
        """
        loop, device = asyncio.get_running_loop(), self.device
        await device.reboot()
        until_s = loop.time() + _REBOOT_S
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            try:
                self.firmware_version = await device.identify(self._mode)
                self._told.clear()  # what went unanswered meanwhile is no loss
                return
            except DeviceTimeoutError:
                if loop.time() > until_s:
                    raise


def condition_of(error: DeviceError) -> str:
    """The fault's name for an error that ended or prevented a connection."""
    if isinstance(error, WrongDeviceError | ServoRefusedError):  # a read refused: not this control table
        return "wrong_device"
    if isinstance(error, DeviceMissingError | DeviceLostError):
        return "unplugged"
    return "no_reply"
