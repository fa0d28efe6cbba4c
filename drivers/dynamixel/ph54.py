"""The blade servo: PH54-200-S500-R as a :class:`graderd.hal.rotator.Rotator`.

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
from graderd.drivers.dynamixel.connection import ServoLink, condition_of
from graderd.drivers.dynamixel.device import EXTENDED_MODE, POSITION_MODE, Difference
from graderd.drivers.dynamixel.observer import ServoObserver
from graderd.drivers.dynamixel.serial_port import ListPorts, system_ports
from graderd.drivers.dynamixel.servo_task import DEVICE, FIELDS, LINK_FAULTS, CommandSlot, ServoTask
from graderd.drivers.dynamixel.table import ControlTable
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceRefusedError,
    LifecycleError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.lifecycle import Lifecycle
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
        self._mode = EXTENDED_MODE if self.calibration.needs_turns else POSITION_MODE
        self._clock: Clock = clock or SystemClock()
        self._link = ServoLink(settings, self.table, self._mode, self._clock, list_ports)
        self._observer = ServoObserver(DEVICE, settings, self.table, self.calibration, self._clock)
        self._command = CommandSlot(settings, self.calibration)
        self._keeper = ServoTask(settings, self._link, self._observer, self._command, self._clock)

    # -- what it is -------------------------------------------------------------------------------------------

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        return self._keeper.lifecycle

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
        return replace(self._observer.telemetry, counters=self._link.counters())

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions present now. Events (trips, lost turns) stay visible for a second after they happened."""
        present, slow = self._observer.faults.present(self._clock.now_s()), self._link.slow_adapter
        return present if slow is None else (*present, slow)

    def tap(self, listener: BusTap) -> Callable[[], None]:
        """Call ``listener`` with all bytes on the wire, whoever sent them; returns the call that ends it."""
        return self._link.tap(listener)

    async def wait_telemetry(self) -> RotatorTelemetry:
        """The next telemetry, as soon as it was read (or the connection's state changed)."""
        await self._keeper.next_poll()
        return self._observer.telemetry

    # -- lifecycle --------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """closed -> standby. See :meth:`graderd.hal.rotator.Rotator.open`; on an error it is closed again."""
        self._require(Lifecycle.CLOSED)
        self._observer.faults.clear(*LINK_FAULTS)
        self._keeper.torque_is_ours = False
        self._command.forget()
        try:
            await self._keeper.connect()
        except BaseException as e:
            self._link.disconnect()
            if isinstance(e, DeviceError):
                self._observer.faults.set(condition_of(e), e.cause, self._clock.now_s())
            raise
        self._keeper.lifecycle = Lifecycle.STANDBY
        self._keeper.start()

    async def arm(self) -> None:
        """standby -> active. See :meth:`graderd.hal.rotator.Rotator.arm`."""
        self._require(Lifecycle.STANDBY)
        if self._observer.turns_unknown:
            raise DeviceRefusedError(
                DEVICE, "whole turns were lost, the angle is ambiguous", "Check the blade, then confirm the turns"
            )
        async with self._keeper.turn:
            self._require(Lifecycle.STANDBY)
            device = self._link.device
            self._keeper.torque_is_ours = True
            counts = await arming.power_up(device, self.settings, self.calibration)
            if self._keeper.lifecycle is not Lifecycle.STANDBY:  # closed in the meantime
                await device.torque(False)
                raise LifecycleError(DEVICE, f"became {self._keeper.lifecycle} while it was being armed")
            self._command.forget(counts)
            self._observer.note_sent(counts)
            self._observer.restart()
            self._observer.set_torque(True)
            self._observer.tripped = False
            self._keeper.lifecycle = Lifecycle.ACTIVE

    def set_goal_deg(self, goal_deg: float) -> None:
        """Take a new goal; sent at once by the driver's own task. See :meth:`graderd.hal.rotator.Rotator`."""
        if self._keeper.lifecycle is not Lifecycle.ACTIVE:
            raise LifecycleError(DEVICE, f"a goal needs the state active, it is {self._keeper.lifecycle}", "Arm first")
        if not self.calibration.within_limits(goal_deg):
            raise CommandRangeError(
                DEVICE,
                f"goal {goal_deg}° is outside the limits {self.settings.min_deg:g}…{self.settings.max_deg:g}°",
                "Choose an angle inside them",
            )
        self._command.goal(goal_deg, self._clock.now_s())
        self._keeper.wake()

    def hold(self) -> None:
        """Stop where the blade is: goal := measured with the next packet. Allowed in every state, idempotent."""
        self._command.hold()
        self._keeper.wake()

    async def disarm(self) -> None:
        """active -> standby: hold, come to rest, then torque as ``torque_at_disarm`` says. Elsewhere: nothing to do."""
        if self._keeper.lifecycle is not Lifecycle.ACTIVE:
            return
        self._keeper.lifecycle = Lifecycle.STANDBY
        await self._keeper.power_down(off=self.settings.torque_at_disarm == "off")

    async def close(self) -> None:
        """Any state -> closed: torque as ``torque_at_exit`` says where it was switched on by us, then let go."""
        if self._keeper.lifecycle is Lifecycle.CLOSED:
            return
        was, self._keeper.lifecycle = self._keeper.lifecycle, Lifecycle.CLOSED
        if was is not Lifecycle.FAILED and self._keeper.torque_is_ours and self._observer.torque_on:
            try:
                async with asyncio.timeout(_CLOSE_S):
                    await self._keeper.power_down(off=self.settings.torque_at_exit == "off", leaving=True)
            except (DeviceError, TimeoutError) as e:
                log.error("%s: could not be made safe at exit (%s); its bus watchdog stops it", DEVICE, e, extra=FIELDS)
        await self._keeper.stop()

    async def reboot(self) -> None:
        """Reboot the servo (clears a latched hardware error) and bring it back to standby. The caller has consent.

        Raises:
            LifecycleError: active, closed, or the wire is lost.
            DeviceTimeoutError: it did not come back within 5 s; the driver goes on looking for it.
            WrongDeviceError: it came back with settings that do not fit.
        """
        self._require(Lifecycle.STANDBY)
        async with self._keeper.turn:
            self._require(Lifecycle.STANDBY)
            self._keeper.lifecycle = Lifecycle.FAILED
            self._keeper.torque_is_ours = False
            try:
                await self._link.reboot()
                await self._keeper.look_around(self._link.device)
            except DeviceError as e:
                self._observer.faults.set(condition_of(e), e.cause, self._clock.now_s())
                if self._link.bus is not None:
                    self._link.bus.close()  # the servo task finds the line closed and starts anew
                raise
            if self._keeper.lifecycle is Lifecycle.FAILED:
                self._keeper.lifecycle = Lifecycle.STANDBY

    async def verify_profile(self) -> list[Difference]:
        """Read every register and compare it with the firmware profile; reads only, in every open state.

        Raises:
            LifecycleError: closed or lost.
            DeviceTimeoutError, DeviceLostError: the servo stopped answering.
        """
        if self._keeper.lifecycle not in (Lifecycle.STANDBY, Lifecycle.ACTIVE):
            raise LifecycleError(DEVICE, f"cannot read the servo while {self._keeper.lifecycle}", "Check the wire")
        return await self._link.device.verify(self._mode)

    def confirm_turns(self) -> None:
        """The operator says that the angle shown is the blade's: whole turns are known again."""
        self._observer.turns_unknown = False
        self._observer.faults.clear("turns_lost")

    def _require(self, state: Lifecycle) -> None:
        if self._keeper.lifecycle is not state:
            raise LifecycleError(DEVICE, f"needs the state {state}, it is {self._keeper.lifecycle}")
