"""The blade servo: PH54-200-S500-R, or another of its family by its profile, as a :class:`graderd.hal.rotator.Rotator`.

One task owns the wire. Every poll period it sends what was commanded since (a hold first), reads the telemetry block
and, less often, torque, hardware error and watchdog. It survives whatever the wire does: a lost servo makes the
rotator FAILED, and it goes on looking for it until it stands in STANDBY again. Nothing but :meth:`Ph54Rotator.arm`
ever makes it ACTIVE.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import replace

from graderd.drivers.dynamixel import arming
from graderd.drivers.dynamixel.bus import BusTap
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.connection import Found, ServoLink
from graderd.drivers.dynamixel.device import EXTENDED_MODE, POSITION_MODE, Difference
from graderd.drivers.dynamixel.observer import ServoObserver
from graderd.drivers.dynamixel.serial_port import ListPorts, system_ports
from graderd.drivers.dynamixel.servo_task import DEVICE, FIELDS, LINK_FAULTS, CommandSlot, Event, ServoTask
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceRefusedError,
    LifecycleError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.settings import Ph54Settings

log = logging.getLogger(__name__)

_CLOSE_S = 1.5


class Ph54Rotator:
    """Blade rotation axis on a PH54. All methods belong to one event loop.

    Args:
        settings: port, calibration, limits, timeouts.
        clock: monotonic seconds for readings and goal timeouts.
        list_ports: lists serial ports; for finding the adapter by USB serial number.

    Raises:
        CommandRangeError: the settings ask more than the servo of that profile can.
        firmware_profiles.UnknownProfileError, WrongDeviceError: there is no such profile, or it is no servo's.
    """

    def __init__(
        self,
        settings: Ph54Settings,
        clock: Clock | None = None,
        *,
        list_ports: ListPorts = system_ports,
    ) -> None:
        self.settings = settings
        self.table = ControlTable.load(settings.profile)
        self.calibration = Calibration.of(settings, self.table)
        self._check_settings()
        self._mode = EXTENDED_MODE if self.calibration.needs_turns else POSITION_MODE
        self._clock: Clock = clock or SystemClock()
        self._link = ServoLink(settings, self.table, self._mode, self._clock, list_ports)
        self._observer = ServoObserver(DEVICE, settings, self.table, self.calibration, self._clock)
        self._command = CommandSlot(settings, self.calibration)
        self._task = ServoTask(settings, self._link, self._observer, self._command, self._clock)

    # -- what it is -------------------------------------------------------------------------------------------

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        return self._task.lifecycle

    @property
    def port(self) -> str | None:
        """The port in use; None while the wire is not open."""
        return self._link.bus.port if self._link.bus is not None else None

    @property
    def firmware_version(self) -> int | None:
        """Of the servo last identified."""
        return self._link.firmware_version

    def telemetry(self) -> RotatorTelemetry:
        """Newest readings, each with its time; ``counters`` tell the wire's history."""
        counters = {**self._link.counters(), "implausible_n": self._observer.implausible_n}
        return replace(self._observer.telemetry, counters=counters)

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions present now. Events (trips, lost turns) stay visible for a second after they happened."""
        present = self._observer.faults.present(self._clock.now_s())
        return (*present, *(fault for fault in (self._link.slow_adapter, self._link.lossy) if fault is not None))

    def tap(self, listener: BusTap) -> Callable[[], None]:
        """Call ``listener`` with all bytes on the wire, whoever sent them; returns the call that ends it."""
        return self._link.tap(listener)

    async def wait_telemetry(self) -> RotatorTelemetry:
        """The next telemetry, as soon as it was read (or the connection's state changed)."""
        await self._task.next_poll()
        return self._observer.telemetry

    # -- lifecycle --------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """closed -> standby. See :meth:`graderd.hal.rotator.Rotator.open`; on an error it is closed again."""
        self._require(Lifecycle.CLOSED)
        self._observer.faults.clear(*LINK_FAULTS)
        self._task.torque_is_ours = False
        self._command.forget()
        try:
            async with self._task.wire_lock:
                await self._task.connect()
        except BaseException as e:
            if isinstance(e, DeviceError):
                self._observer.faults.set(self._task.condition_of(e), e.cause, self._clock.now_s())
            self._link.disconnect()
            raise
        self._task.note(Event.OPENED)
        self._task.start()

    async def arm(self) -> None:
        """standby -> active. See :meth:`graderd.hal.rotator.Rotator.arm`."""
        self._require(Lifecycle.STANDBY)
        if self._observer.turns_unknown:
            raise DeviceRefusedError(
                DEVICE, "whole turns were lost, the angle is ambiguous", "Check the blade, then confirm the turns"
            )
        for fault in self._observer.faults.present(self._clock.now_s()):
            if fault.condition in LINK_FAULTS:  # a stop would have to pass that line
                raise DeviceRefusedError(DEVICE, f"{fault.condition}: {fault.detail}", "Mend the line, then arm")
        async with self._task.wire_lock:
            self._require(Lifecycle.STANDBY)
            device = self._link.device
            self._task.torque_is_ours = True
            armed = await arming.power_up(device, self.settings, self.calibration)
            if self._task.lifecycle is not Lifecycle.STANDBY:  # closed in the meantime
                await device.torque(False)
                raise LifecycleError(DEVICE, f"became {self._task.lifecycle} while it was being armed")
            self._command.armed(armed)
            self._observer.note_sent(armed.goal_counts)
            self._observer.restart()
            self._observer.set_torque(True)
            self._observer.tripped = False
            self._task.note(Event.ARMED)

    def set_goal_deg(self, goal_deg: float) -> None:
        """Take a new goal; sent at once by the driver's own task. See :meth:`graderd.hal.rotator.Rotator`."""
        if self._task.lifecycle is not Lifecycle.ACTIVE:
            raise LifecycleError(DEVICE, f"a goal needs the state active, it is {self._task.lifecycle}", "Arm first")
        if not self.calibration.within_limits(goal_deg):
            raise CommandRangeError(
                DEVICE,
                f"goal {goal_deg}° is outside the limits {self.settings.min_deg:g}…{self.settings.max_deg:g}°",
                "Choose an angle inside them",
            )
        self._command.goal(goal_deg, self._clock.now_s())
        self._task.wake()

    def hold(self) -> None:
        """Stop with the next packet, as soon as the blade can without turning back. Allowed always, idempotent."""
        self._command.hold()
        self._task.wake()

    async def disarm(self) -> None:
        """active -> standby: hold, come to rest, then torque as ``torque_at_disarm`` says. Elsewhere: nothing to do."""
        if self._task.lifecycle is not Lifecycle.ACTIVE:
            return
        self._task.note(Event.DISARMED)
        await self._task.power_down(off=self.settings.torque_at_disarm == "off")

    async def close(self) -> None:
        """Any state -> closed: torque as ``torque_at_exit`` says where it was switched on by us, then let go."""
        if self._task.lifecycle is Lifecycle.CLOSED:
            return
        was = self._task.lifecycle
        self._task.note(Event.CLOSED)
        if was is not Lifecycle.FAILED and self._task.torque_is_ours:
            try:
                async with asyncio.timeout(_CLOSE_S):
                    if self._observer.torque_on:
                        await self._task.power_down(off=self.settings.torque_at_exit == "off", leaving=True)
                    else:  # an arming under way sees that it is closed, and switches torque off again
                        async with self._task.wire_lock:
                            pass
            except (DeviceError, TimeoutError) as e:
                log.error("%s: could not be made safe at exit (%s); its bus watchdog stops it", DEVICE, e, extra=FIELDS)
        await self._task.stop()

    async def reboot(self) -> None:
        """Reboot the servo (clears a latched hardware error) and bring it back to standby. The caller has consent.

        Raises:
            LifecycleError: active, closed, or the wire is lost.
            DeviceTimeoutError: it did not come back within 5 s; the driver goes on looking for it.
            WrongDeviceError: it came back with settings that do not fit.
        """
        self._require(Lifecycle.STANDBY)
        async with self._task.wire_lock:
            self._require(Lifecycle.STANDBY)
            self._task.note(Event.LOST)
            self._task.torque_is_ours = False
            try:
                await self._link.reboot()
                await self._task.first_readings(self._link.device)
            except DeviceError as e:
                self._observer.faults.set(self._task.condition_of(e), e.cause, self._clock.now_s())
                if self._link.bus is not None:
                    self._link.bus.close()  # the servo task finds the line closed and starts anew
                raise
            self._task.note(Event.FOUND)

    async def verify_profile(self) -> list[Difference]:
        """Read every register and compare it with the firmware profile and what arming writes; reads only.

        In every state: a servo that was refused for its settings is the one that has to be looked at.

        Raises:
            DeviceMissingError, DeviceTimeoutError, DeviceLostError: the servo cannot be reached.
        """
        written = arming.eeprom_counts(self.calibration)
        if self._link.is_up:  # polling goes on between the reads
            return await self._link.device.verify(self._mode, written)
        async with self._task.wire_lock, self._link.visit() as device:
            return await device.verify(self._mode, written)

    async def scan(self) -> list[Found]:
        """Every servo on the wire, at every baud rate; the servo in use is lost for that long and found again.

        Raises:
            LifecycleError: active.
            DeviceMissingError: there is no port.
        """
        self._require_not_active()
        async with self._task.wire_lock:
            self._require_not_active()  # it may have been armed while this waited for the wire
            self._task.note(Event.LOST)
            return await self._link.scan()

    def confirm_turns(self) -> None:
        """The operator says that the angle shown is the blade's: whole turns are known again."""
        self._observer.confirm_turns()

    def _check_settings(self) -> None:
        most_a = (self.table["current_limit"].max or 0) / 1000.0
        if self.calibration.current_limit_a > most_a:
            cause = f"current_limit_a {self.calibration.current_limit_a:g} is above {most_a:g} A"
            raise CommandRangeError(f"settings of {DEVICE}", cause, f"Profile: {self.table.name}")

    def _require_not_active(self) -> None:
        if self._task.lifecycle is Lifecycle.ACTIVE:
            raise LifecycleError(DEVICE, "cannot look for others while it is armed", "Disarm first")

    def _require(self, state: Lifecycle) -> None:
        if self._task.lifecycle is not state:
            raise LifecycleError(DEVICE, f"needs the state {state}, it is {self._task.lifecycle}")
