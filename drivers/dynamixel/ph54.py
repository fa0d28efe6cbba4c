"""The blade servo: PH54-200-S500-R as a :class:`graderd.hal.rotator.Rotator`.

One task owns the wire. Every poll period it sends what was commanded since (a hold first), reads the telemetry block
and, less often, torque, hardware error and watchdog. It survives whatever the wire does: a lost servo makes the
rotator FAILED, and it goes on looking for it until it stands in STANDBY again. Nothing but :meth:`Ph54Rotator.arm`
ever makes it ACTIVE.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Coroutine
from dataclasses import replace

from drivers.dynamixel import arming
from drivers.dynamixel.bus import BusLog, ServoRefusedError
from drivers.dynamixel.calibration import Calibration
from drivers.dynamixel.codec import StatusError
from drivers.dynamixel.command import CommandSlot
from drivers.dynamixel.device import EXTENDED_MODE, PATIENT_N, POSITION_MODE, Difference, Ph54Device
from drivers.dynamixel.link import ServoLink, condition_of
from drivers.dynamixel.observer import MOTION_FAULTS, ServoObserver
from drivers.dynamixel.ports import ListPorts, system_ports
from drivers.dynamixel.table import ControlTable
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceLostError,
    DeviceRefusedError,
    DeviceTimeoutError,
    LifecycleError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.lifecycle import Lifecycle
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.settings import RotatorSettings

log = logging.getLogger(__name__)

DEVICE = "rotation"
_HEALTH_EVERY_S = 0.1
_GOALS_EVERY_S = 0.5
_RECONNECT_FIRST_S = 0.1
_RECONNECT_MOST_S = 1.0
_RUNAWAY_DEG = 8.0
"""Braking from the fastest permitted turn takes 5.2 degrees. A blade that goes further under a hold is not braking: its
servo runs the wrong way, and a goal, even that of staying, only drives it on."""
_STOP_S = 0.5
"""A disarm gives the blade so long to come to rest before torque goes off."""
_STILL_READS_N = 5
"""So many reads in a row without movement are rest; one alone may be a turning point."""
_CLOSE_S = 1.5
_UNANSWERED_N = 3
"""A lost servo left at least so many requests unanswered: a program that stood still asked none."""
_LINK_FAULTS = ("no_reply", "corrupt_replies", "unplugged", "wrong_device")


class Ph54Rotator:
    """Blade rotation axis on a PH54. All methods belong to one event loop.

    Args:
        settings: port, calibration, limits, timeouts.
        clock: monotonic seconds for readings and goal timeouts.
        bus_log: called with all bytes on the wire, for the recorder.
        list_ports: lists serial ports; for finding the adapter by USB serial number.
    """

    def __init__(
        self,
        settings: RotatorSettings,
        clock: Clock | None = None,
        bus_log: BusLog | None = None,
        *,
        list_ports: ListPorts = system_ports,
    ) -> None:
        self.settings = settings
        self.table = ControlTable.load(settings.profile)
        self.calibration = Calibration.of(settings, self.table)
        self._mode = EXTENDED_MODE if self.calibration.needs_turns else POSITION_MODE
        self._clock: Clock = clock or SystemClock()
        self._link = ServoLink(settings, self.table, self._mode, self._clock, bus_log, list_ports)
        self._lifecycle = Lifecycle.CLOSED
        self._observer = ServoObserver(DEVICE, settings, self.table, self.calibration, self._clock)
        self._command = CommandSlot(settings, self.calibration)
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()
        self._wake = asyncio.Event()
        self._readers: list[asyncio.Future[None]] = []
        self._torque_is_ours = False
        self._powering_down = False

    # -- what it is -------------------------------------------------------------------------------------------

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        return self._lifecycle

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
        return self._observer.faults.present(self._clock.now_s())

    async def wait_telemetry(self) -> RotatorTelemetry:
        """The next telemetry, as soon as it was read (or the connection's state changed)."""
        reader: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._readers.append(reader)
        await reader
        return self._observer.telemetry

    # -- lifecycle --------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """closed -> standby. See :meth:`graderd.hal.rotator.Rotator.open`; on an error it is closed again."""
        self._require(Lifecycle.CLOSED)
        self._observer.faults.clear(*_LINK_FAULTS)
        self._torque_is_ours = False
        self._command.forget()
        try:
            await self._connect()
        except BaseException as e:
            self._link.disconnect()
            if isinstance(e, DeviceError):
                self._observer.faults.set(condition_of(e), e.cause, self._clock.now_s())
            raise
        self._lifecycle = Lifecycle.STANDBY
        self._start()

    async def arm(self) -> None:
        """standby -> active. See :meth:`graderd.hal.rotator.Rotator.arm`."""
        self._require(Lifecycle.STANDBY)
        if self._observer.turns_unknown:
            raise DeviceRefusedError(
                DEVICE, "whole turns were lost, the angle is ambiguous", "Check the blade, then confirm the turns"
            )
        async with self._turn:
            self._require(Lifecycle.STANDBY)
            device = self._link.device
            self._torque_is_ours = True
            counts = await arming.power_up(device, self.settings, self.calibration)
            if self._lifecycle is not Lifecycle.STANDBY:  # closed in the meantime
                await device.torque(False)
                raise LifecycleError(DEVICE, f"became {self._lifecycle} while it was being armed")
            self._command.forget(counts)
            self._observer.note_sent(counts)
            self._observer.restart()
            self._observer.set_torque(True)
            self._observer.tripped = False
            self._lifecycle = Lifecycle.ACTIVE

    def set_goal_deg(self, goal_deg: float) -> None:
        """Take a new goal; sent at once by the driver's own task. See :meth:`graderd.hal.rotator.Rotator`."""
        if self._lifecycle is not Lifecycle.ACTIVE:
            raise LifecycleError(DEVICE, f"a goal needs the state active, it is {self._lifecycle}", "Arm first")
        if not self.calibration.within_limits(goal_deg):
            raise CommandRangeError(
                DEVICE,
                f"goal {goal_deg}° is outside the limits {self.settings.min_deg:g}…{self.settings.max_deg:g}°",
                "Choose an angle inside them",
            )
        self._command.goal(goal_deg, self._clock.now_s())
        self._wake.set()

    def hold(self) -> None:
        """Stop where the blade is: goal := measured with the next packet. Allowed in every state, idempotent."""
        self._command.hold()
        self._wake.set()

    async def disarm(self) -> None:
        """active -> standby: hold, come to rest, then torque as ``torque_at_disarm`` says. Elsewhere: nothing to do."""
        if self._lifecycle is not Lifecycle.ACTIVE:
            return
        self._lifecycle = Lifecycle.STANDBY
        await self._power_down(off=self.settings.torque_at_disarm == "off")

    async def close(self) -> None:
        """Any state -> closed: torque as ``torque_at_exit`` says where it was switched on by us, then let go."""
        if self._lifecycle is Lifecycle.CLOSED:
            return
        was, self._lifecycle = self._lifecycle, Lifecycle.CLOSED
        if was is not Lifecycle.FAILED and self._torque_is_ours and self._observer.torque_on:
            try:
                async with asyncio.timeout(_CLOSE_S):
                    await self._power_down(off=self.settings.torque_at_exit == "off", leaving=True)
            except (DeviceError, TimeoutError) as e:
                log.error("%s: could not be made safe at exit (%s); its bus watchdog stops it", DEVICE, e)
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        self._link.disconnect()
        self._command.forget()
        self._tell_readers()

    async def _power_down(self, *, off: bool, leaving: bool = False) -> None:
        """Hold, wait for rest, then torque off where asked; leaving with torque on, the watchdog is taken off duty."""
        self._powering_down = True
        try:
            await self._power_down_in_turn(off=off, leaving=leaving)
        finally:
            self._powering_down = False

    async def _power_down_in_turn(self, *, off: bool, leaving: bool) -> None:
        async with self._turn:
            device = self._link.device
            self._command.hold()
            loop = asyncio.get_running_loop()
            until_s, still_n = loop.time() + _STOP_S, 0
            began = None  # where the blade was when the servo had taken the hold, which a bad line may delay
            while loop.time() < until_s and still_n < _STILL_READS_N:
                await self._tolerant(self._send_command(device))
                await self._tolerant(self._observer.read_telemetry(device, None))
                speed, angle = self._observer.telemetry.velocity_deg_per_s, self._observer.telemetry.angle_deg
                still_n = still_n + 1 if speed is not None and abs(speed.value) < 1.0 else 0
                if began is None and not self._command.hold_wanted:
                    began = angle
                if off and began is not None and angle is not None and abs(angle.value - began.value) > _RUNAWAY_DEG:
                    log.warning("%s: does not obey the hold: torque off without waiting for rest", DEVICE)
                    break
            if off:
                await self._torque_off(device)
                self._torque_is_ours = False
            elif leaving:
                await device.write("bus_watchdog", 0)

    async def reboot(self) -> None:
        """Reboot the servo (clears a latched hardware error) and bring it back to standby. The caller has consent.

        Raises:
            LifecycleError: active, closed, or the wire is lost.
            DeviceTimeoutError: it did not come back within 5 s; the driver goes on looking for it.
            WrongDeviceError: it came back with settings that do not fit.
        """
        self._require(Lifecycle.STANDBY)
        async with self._turn:
            self._require(Lifecycle.STANDBY)
            self._lifecycle = Lifecycle.FAILED
            self._torque_is_ours = False
            try:
                await self._link.reboot()
                await self._look_around(self._link.device)
            except DeviceError as e:
                self._observer.faults.set(condition_of(e), e.cause, self._clock.now_s())
                if self._link.bus is not None:
                    self._link.bus.close()  # the servo task finds the line closed and starts anew
                raise
            if self._lifecycle is Lifecycle.FAILED:
                self._lifecycle = Lifecycle.STANDBY

    async def verify_profile(self) -> list[Difference]:
        """Read every register and compare it with the firmware profile; reads only, in every open state.

        Raises:
            LifecycleError: closed or lost.
            DeviceTimeoutError, DeviceLostError: the servo stopped answering.
        """
        if self._lifecycle not in (Lifecycle.STANDBY, Lifecycle.ACTIVE):
            raise LifecycleError(DEVICE, f"cannot read the servo while {self._lifecycle}", "Check the wire")
        return await self._link.device.verify(self._mode)

    def confirm_turns(self) -> None:
        """The operator says that the angle shown is the blade's: whole turns are known again."""
        self._observer.turns_unknown = False
        self._observer.faults.clear("turns_lost")

    def _require(self, state: Lifecycle) -> None:
        if self._lifecycle is not state:
            raise LifecycleError(DEVICE, f"needs the state {state}, it is {self._lifecycle}")

    # -- connection -------------------------------------------------------------------------------------------

    async def _connect(self) -> None:
        self._observer.new_wire()
        await self._look_around(await self._link.connect())
        self._observer.faults.clear(*_LINK_FAULTS)

    async def _look_around(self, device: Ph54Device) -> None:
        """First readings of a servo just found, and what its registers tell of the time without us."""
        observer = self._observer
        observer.restart(position_known=True)
        goals = await observer.read_goals(device, attempts_n=PATIENT_N)
        await observer.read_health(device, attempts_n=PATIENT_N)
        await observer.read_telemetry(device, None, attempts_n=PATIENT_N)
        if self._torque_is_ours and not observer.torque_on:
            observer.name_torque_loss(goals)
        await self._make_safe(device)

    async def _make_safe(self, device: Ph54Device) -> None:
        """Torque that we had switched on goes where ``torque_at_disarm`` says. A stranger's torque is left alone."""
        observer = self._observer
        self._command.forget()
        if self._torque_is_ours and observer.torque_on and self.settings.torque_at_disarm == "off":
            await self._torque_off(device)
        self._torque_is_ours = self._torque_is_ours and observer.torque_on
        if observer.tripped and not observer.torque_on:  # unpowered, no stale goal can come alive
            await device.write("bus_watchdog", 0)
            observer.tripped = False

    async def _torque_off(self, device: Ph54Device) -> None:
        await device.torque(False)
        self._observer.set_torque(False)

    # -- the servo's own task ---------------------------------------------------------------------------------

    def _start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._run(), name="rotation-servo")
        self._task.add_done_callback(self._on_task_done)

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        """The owner of the wire must not die while the rotator is open: start it again."""
        if task is self._task and self._lifecycle is not Lifecycle.CLOSED:
            cause = "was cancelled" if task.cancelled() else f"failed: {task.exception()!r}"
            log.error("%s: the servo task %s; starting it again", DEVICE, cause)
            self._fail(DeviceLostError(DEVICE, f"the servo task {cause}"))
            self._start()

    async def _run(self) -> None:
        pause_s = _RECONNECT_FIRST_S
        while True:
            try:
                if not self._link.is_up:
                    self._link.disconnect()
                    async with self._turn:
                        await self._connect()
                        self._lifecycle = Lifecycle.STANDBY
                    self._link.happened["reconnects_n"] += 1
                    log.info("%s: servo found at %s", DEVICE, self.port)
                pause_s = _RECONNECT_FIRST_S
                await self._serve()
            except DeviceError as e:
                self._fail(e)
            except Exception as e:  # a bug in here must not end the search for the servo
                log.exception("%s: unexpected error in the servo task", DEVICE)
                self._fail(DeviceLostError(DEVICE, f"internal error {e!r}"))
            await asyncio.sleep(pause_s)
            pause_s = min(_RECONNECT_MOST_S, 2 * pause_s)

    def _fail(self, error: DeviceError) -> None:
        condition, faults = condition_of(error), self._observer.faults
        if condition == "no_reply" and self._observer.damaged_lately():
            condition = "corrupt_replies"
        if faults.set(condition, error.cause, self._clock.now_s()):
            log.warning("%s: %s", condition, error)
        faults.clear(*(c for c in _LINK_FAULTS if c != condition), *MOTION_FAULTS)
        self._lifecycle = Lifecycle.FAILED
        self._command.forget()
        self._link.disconnect()
        self._tell_readers()

    def _tell_readers(self) -> None:
        readers, self._readers = self._readers, []
        for reader in readers:
            if not reader.done():
                reader.set_result(None)

    async def _serve(self) -> None:
        """Poll until the servo is lost."""
        loop = asyncio.get_running_loop()
        period_s = 1.0 / self.settings.poll_hz
        next_s = loop.time()
        while True:
            async with self._turn:
                await self._cycle(self._link.device)
            next_s = max(next_s + period_s, loop.time())
            await self._until(next_s)

    async def _until(self, next_s: float) -> None:
        """Sleep until the next poll; a command that comes in between goes out at once."""
        loop = asyncio.get_running_loop()
        while (left_s := next_s - loop.time()) > 0:
            if not self._wake.is_set():
                timer = loop.call_later(left_s, self._wake.set)
                try:
                    await self._wake.wait()
                finally:
                    timer.cancel()
            self._wake.clear()
            async with self._turn:
                await self._tolerant(self._send_command(self._link.device))

    async def _cycle(self, device: Ph54Device) -> None:
        """One poll: command, telemetry, and now and then what changes rarely; a command never waits for two reads."""
        observer, now_s = self._observer, self._clock.now_s()
        self._wake.clear()
        if self._command.expired(now_s):
            self._link.happened["goal_timeouts_n"] += 1
            self._command.hold()
        await self._tolerant(self._send_command(device))
        await self._tolerant(observer.read_telemetry(device, self._standing_goal_deg()))
        self._tell_readers()
        if now_s - observer.health_s >= _HEALTH_EVERY_S:
            await self._tolerant(self._send_command(device))
            await self._tolerant(observer.read_health(device))
        if now_s - observer.goals_s >= _GOALS_EVERY_S:
            await self._tolerant(self._send_command(device))
            await self._tolerant(self._check_goals(device))
        await self._tolerant(self._protect(device))
        if self._link.bus is not None:
            observer.count_damage(self._link.bus)

    def _standing_goal_deg(self) -> float | None:
        """What the servo was last told to do; None while nothing is powered by us."""
        sent = self._observer.telemetry.goal_sent_deg
        return sent.value if self._lifecycle is Lifecycle.ACTIVE and sent is not None else None

    async def _check_goals(self, device: Ph54Device) -> None:
        """Whether the watchdog still stands as it was written."""
        goals = await self._observer.read_goals(device)
        wanted, found = arming.watchdog_counts(self.settings), goals["bus_watchdog"]
        if self._lifecycle is Lifecycle.ACTIVE and not self._observer.tripped and found != wanted:
            detail = f"the bus watchdog reads {found}, not {wanted} as written"
            await self._end_active(device, "ram_reset", detail)

    async def _protect(self, device: Ph54Device) -> None:
        """End ACTIVE where torque is gone, the watchdog has tripped or turns were lost. Only arm() brings it back.

        In STANDBY finish what an interrupted disarm left: torque of ours that should be off, a trip to be cleared.
        """
        observer = self._observer
        if self._lifecycle is Lifecycle.ACTIVE:
            if not observer.torque_on:
                await self._end_active(device)
                observer.name_torque_loss(await observer.read_goals(device, attempts_n=PATIENT_N))
            elif observer.tripped or observer.turns_jumped:
                await self._end_active(device)
        elif not self._powering_down and (
            (self._torque_is_ours and observer.torque_on and self.settings.torque_at_disarm == "off")
            or (observer.tripped and not observer.torque_on)
        ):
            await self._make_safe(device)

    async def _end_active(self, device: Ph54Device, condition: str = "", detail: str = "") -> None:
        self._lifecycle = Lifecycle.STANDBY
        if condition:
            self._observer.faults.event(condition, detail, self._clock.now_s())
        await self._make_safe(device)

    async def _tolerant(self, step: Coroutine[None, None, None]) -> None:
        """Carry out one exchange; a lost packet is nothing, no valid one for ``reply_timeout_s`` is a lost servo."""
        try:
            await step
        except DeviceTimeoutError as e:
            silent_s, unanswered_n = self._link.silence()
            if silent_s > self.settings.reply_timeout_s and unanswered_n >= _UNANSWERED_N:
                c = self._link.counters()
                seen = f"{c.get('requests_n', 0)} requests, {c.get('foreign_n', 0)} replies with another id"
                cause = f"no valid status packet for {silent_s:.2f} s ({seen})"
                raise DeviceTimeoutError(e.where, cause, e.remedy) from e

    async def _send_command(self, device: Ph54Device) -> None:
        """Send what was commanded last: a hold, or a goal that is not on the servo yet."""
        command, observer, sent = self._command, self._observer, None
        try:
            if command.hold_wanted:
                angle = observer.telemetry.angle_deg
                if not observer.torque_on or angle is None:
                    command.forget()  # nothing is powered: nothing to hold
                    return
                if not angle.is_fresh(self._clock.now_s(), self.settings.reply_timeout_s):
                    await observer.read_telemetry(device, None)
                    angle = observer.telemetry.angle_deg or angle
                sent = await command.send_hold(device, angle.value)
            elif self._lifecycle is Lifecycle.ACTIVE:
                sent = await command.send_goal(device)
        except ServoRefusedError as e:
            await self._on_refusal(device, e)
        if sent is not None:
            observer.note_sent(sent)

    async def _on_refusal(self, device: Ph54Device, error: ServoRefusedError) -> None:
        """A goal was refused: the watchdog has tripped, or the servo is not as we left it. Never go on blindly."""
        log.warning("%s: %s", DEVICE, error)
        was_active = self._lifecycle is Lifecycle.ACTIVE
        if was_active:
            self._lifecycle = Lifecycle.STANDBY
        if error.error == StatusError.DATA_RANGE:
            await self._observer.read_goals(device, attempts_n=PATIENT_N)
        elif was_active:
            detail = f"a goal was refused: {error.cause}"
            self._observer.faults.event("ram_reset", detail, self._clock.now_s())
        await self._make_safe(device)
