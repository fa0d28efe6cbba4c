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
import math
from collections import Counter, deque
from collections.abc import Coroutine
from dataclasses import replace

from drivers.dynamixel import arming
from drivers.dynamixel.bus import BusLog, ServoBus, ServoRefusedError
from drivers.dynamixel.calibration import Calibration
from drivers.dynamixel.codec import StatusError
from drivers.dynamixel.detectors import MotionDetectors, Sample
from drivers.dynamixel.device import EXTENDED_MODE, PATIENT_N, POSITION_MODE, WATCHDOG_TRIPPED, Difference, Ph54Device
from drivers.dynamixel.faultbook import FaultBook
from drivers.dynamixel.ports import ListPorts, find_port, system_ports
from drivers.dynamixel.table import ControlTable
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceLostError,
    DeviceMissingError,
    DeviceRefusedError,
    DeviceTimeoutError,
    LifecycleError,
    WrongDeviceError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.lifecycle import Lifecycle
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.settings import RotatorSettings

log = logging.getLogger(__name__)

DEVICE = "rotation"
_HEALTH_EVERY_S = 0.1
_GOALS_EVERY_S = 0.5
_RECONNECT_FIRST_S = 0.1
_RECONNECT_MOST_S = 1.0
_REBOOT_S = 5.0
_STOP_S = 0.5
"""A disarm gives the blade so long to come to rest before torque goes off."""
_STILL_READS_N = 5
"""So many reads in a row without movement are rest; one alone may be a turning point."""
_CLOSE_S = 1.5
_CORRUPT_N, _CORRUPT_WINDOW_S = 3, 1.0
_LINK_FAULTS = ("no_reply", "corrupt_replies", "unplugged", "wrong_device")
_MOTION_FAULTS = frozenset(
    {"not_moving", "wrong_way", "moving_uncommanded", "voltage_near_limit", "temperature_near_limit"}
)


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
        self.firmware_version: int | None = None
        self._alerts = {int(bit, 16): name for bit, name in self.table.profile["hardware_error"].items()}
        self._mode = EXTENDED_MODE if self.calibration.needs_turns else POSITION_MODE
        self._clock: Clock = clock or SystemClock()
        self._bus_log = bus_log
        self._list_ports = list_ports
        self._lifecycle = Lifecycle.CLOSED
        self._telemetry = RotatorTelemetry()
        self._faults = FaultBook(DEVICE)
        self._detectors = MotionDetectors(settings)
        self._bus: ServoBus | None = None
        self._device: Ph54Device | None = None
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()
        self._wake = asyncio.Event()
        self._readers: list[asyncio.Future[None]] = []
        self._past: Counter[str] = Counter()
        self._goal_deg: float | None = None
        self._goal_s = -math.inf
        self._sent_counts: int | None = None
        self._hold_wanted = False
        self._hold_profile = False
        self._torque_on = False
        self._torque_is_ours = False
        self._tripped = False
        self._raw_counts: int | None = None
        self._turns_unknown = False
        self._health_s = self._goals_s = -math.inf
        self._crc_seen_n = 0
        self._corrupt_s: deque[float] = deque(maxlen=64)

    # -- what it is -------------------------------------------------------------------------------------------

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        return self._lifecycle

    @property
    def port(self) -> str | None:
        """The port in use; None while the wire is not open."""
        return self._bus.port if self._bus is not None else None

    def telemetry(self) -> RotatorTelemetry:
        """Newest readings, each with its time; ``counters`` tell the wire's history."""
        return replace(self._telemetry, counters=self._counters())

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions present now. Events (trips, lost turns) stay visible for a second after they happened."""
        return self._faults.present(self._clock.now_s())

    async def wait_telemetry(self) -> RotatorTelemetry:
        """The next telemetry, as soon as it was read (or the connection's state changed)."""
        reader: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._readers.append(reader)
        await reader
        return self._telemetry

    def _counters(self) -> dict[str, int]:
        now = Counter(self._bus.counters()) if self._bus is not None else Counter[str]()
        low_latency_n = now.pop("low_latency_n", 0)
        return {**(self._past + now), "low_latency_n": low_latency_n}

    # -- lifecycle --------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """closed -> standby. See :meth:`graderd.hal.rotator.Rotator.open`; on an error it is closed again."""
        self._require(Lifecycle.CLOSED)
        self._faults.clear(*_LINK_FAULTS)
        self._torque_is_ours = False
        try:
            await self._connect()
        except BaseException as e:
            self._disconnect()
            if isinstance(e, DeviceError):
                self._faults.set(_condition(e), e.cause, self._clock.now_s())
            raise
        self._lifecycle = Lifecycle.STANDBY
        self._start()

    async def arm(self) -> None:
        """standby -> active. See :meth:`graderd.hal.rotator.Rotator.arm`."""
        self._require(Lifecycle.STANDBY)
        if self._turns_unknown:
            raise DeviceRefusedError(
                DEVICE, "whole turns were lost, the angle is ambiguous", "Check the blade, then confirm the turns"
            )
        async with self._turn:
            self._require(Lifecycle.STANDBY)
            device = self._connected()
            self._torque_is_ours = True
            counts = await arming.power_up(device, self.settings, self.calibration)
            if self._lifecycle is not Lifecycle.STANDBY:  # closed in the meantime
                await device.torque(False)
                raise LifecycleError(DEVICE, f"became {self._lifecycle} while it was being armed")
            self._goal_deg, self._hold_wanted, self._hold_profile = None, False, False
            self._note_sent(counts)
            self._detectors.restart()
            self._raw_counts = None
            self._tripped = False
            self._set_torque(True)
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
        self._goal_deg, self._goal_s = goal_deg, self._clock.now_s()
        self._hold_wanted = False
        self._wake.set()

    def hold(self) -> None:
        """Stop where the blade is: goal := measured with the next packet. Allowed in every state, idempotent."""
        if self._goal_deg is None and self._hold_profile and not self._hold_wanted:
            return  # holding already
        self._goal_deg = None
        self._hold_wanted = True
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
        self._goal_deg = None
        was, self._lifecycle = self._lifecycle, Lifecycle.CLOSED
        if was is not Lifecycle.FAILED and self._torque_is_ours and self._torque_on:
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
        self._disconnect()
        self._tell_readers()

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
            device = self._connected()
            before = self._raw_counts
            self._lifecycle = Lifecycle.FAILED
            self._torque_is_ours = False
            await device.reboot()
            try:
                await self._await_return(device)
                self._raw_counts = before
                await self._look_around(device)
            except DeviceError as e:
                self._faults.set(_condition(e), e.cause, self._clock.now_s())
                if self._bus is not None:
                    self._bus.close()  # the supervisor finds the line closed and starts anew
                raise
            self._lifecycle = Lifecycle.STANDBY

    async def _await_return(self, device: Ph54Device) -> None:
        loop = asyncio.get_running_loop()
        until_s = loop.time() + _REBOOT_S
        while True:
            await asyncio.sleep(0.05)
            try:
                self.firmware_version = await device.identify(self._mode)
                return
            except DeviceTimeoutError:
                if loop.time() > until_s:
                    raise

    async def verify_profile(self) -> list[Difference]:
        """Read every register and compare it with the firmware profile; reads only, in every open state.

        Raises:
            LifecycleError: closed or lost.
            DeviceTimeoutError, DeviceLostError: the servo stopped answering.
        """
        if self._lifecycle not in (Lifecycle.STANDBY, Lifecycle.ACTIVE):
            raise LifecycleError(DEVICE, f"cannot read the servo while {self._lifecycle}", "Check the wire")
        return await self._connected().verify(self._mode)

    def confirm_turns(self) -> None:
        """The operator says that the angle shown is the blade's: whole turns are known again."""
        self._turns_unknown = False
        self._faults.clear("turns_lost")

    # -- connection -------------------------------------------------------------------------------------------

    def _require(self, state: Lifecycle) -> None:
        if self._lifecycle is not state:
            raise LifecycleError(DEVICE, f"needs the state {state}, it is {self._lifecycle}")

    def _connected(self) -> Ph54Device:
        if self._device is None:
            raise DeviceLostError(DEVICE, "the servo is not connected", "Check the USB cable")
        return self._device

    async def _connect(self) -> None:
        rates = self.table.profile["bus"]["baud_n"]
        if self.settings.baud_n not in rates:
            raise DeviceRefusedError(
                DEVICE, f"{self.table.title} cannot run at {self.settings.baud_n} bit/s", f"Choose one of {rates}"
            )
        port = find_port(self.settings.port, self.settings.usb_serial_number, self._list_ports)
        bus = ServoBus(port, self.settings.baud_n, clock=self._clock, bus_log=self._bus_log)
        bus.open()
        self._bus, self._crc_seen_n = bus, 0
        device = Ph54Device(bus, self.table, self.settings.servo_id_n)
        self.firmware_version = await device.identify(self._mode)
        await self._look_around(device)
        self._device = device
        self._faults.clear(*_LINK_FAULTS)

    def _disconnect(self) -> None:
        self._device = None
        if self._bus is not None:
            bus, self._bus = self._bus, None
            bus.close()
            counted = bus.counters()
            counted.pop("low_latency_n")
            self._past.update(counted)

    async def _look_around(self, device: Ph54Device) -> None:
        """First readings of a servo just found, and what its registers tell of the time without us."""
        self._detectors.restart()
        self._corrupt_s.clear()
        goals, _ = await device.read_block(device.goal_block)
        await self._read_health(device, attempts_n=PATIENT_N)
        await self._read_telemetry(device, attempts_n=PATIENT_N)
        now_s = self._clock.now_s()
        self._tripped = False
        if goals["bus_watchdog"] == WATCHDOG_TRIPPED:
            self._note_trip(now_s)
        elif self._torque_is_ours and not self._torque_on and goals["bus_watchdog"] == 0:
            self._faults.event("ram_reset", "power was cut: the servo is back with its RAM registers reset", now_s)
        elif self._torque_is_ours and not self._torque_on:
            self._faults.event("torque_off", "torque was found switched off", now_s)
        await self._make_safe(device)

    async def _make_safe(self, device: Ph54Device) -> None:
        """Torque that we had switched on goes where ``torque_at_disarm`` says. A stranger's torque is left alone."""
        self._goal_deg, self._hold_wanted, self._hold_profile = None, False, False
        if self._torque_is_ours and self._torque_on and self.settings.torque_at_disarm == "off":
            await device.torque(False)
            self._set_torque(False)
        self._torque_is_ours = self._torque_is_ours and self._torque_on
        if self._tripped and not self._torque_on:  # unpowered, no stale goal can come alive
            await device.write("bus_watchdog", 0)
            self._tripped = False

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
                if self._device is None or not self._bus or not self._bus.is_open:
                    self._disconnect()
                    async with self._turn:
                        await self._connect()
                        self._lifecycle = Lifecycle.STANDBY
                    self._past["reconnects_n"] += 1
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
        condition = _condition(error)
        now_s = self._clock.now_s()
        if condition == "no_reply" and self._corrupt_s and now_s - self._corrupt_s[-1] < 2 * _CORRUPT_WINDOW_S:
            condition = "corrupt_replies"
        if self._faults.set(condition, error.cause, now_s):
            log.warning("%s: %s", condition, error)
        self._faults.clear(*(c for c in _LINK_FAULTS if c != condition), *_MOTION_FAULTS)
        self._lifecycle = Lifecycle.FAILED
        self._goal_deg, self._hold_wanted = None, False
        self._disconnect()
        self._tell_readers()

    # -- the loop ---------------------------------------------------------------------------------------------

    async def _serve(self) -> None:
        """Poll until the servo is lost."""
        loop = asyncio.get_running_loop()
        period_s = 1.0 / self.settings.poll_hz
        next_s = loop.time()
        while True:
            async with self._turn:
                await self._cycle(self._connected())
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
                await self._tolerant(self._send_command())

    async def _cycle(self, device: Ph54Device) -> None:
        self._wake.clear()
        now_s = self._clock.now_s()
        if self._goal_deg is not None and now_s - self._goal_s > self.settings.goal_timeout_s:
            self._past["goal_timeouts_n"] += 1
            self.hold()
        await self._tolerant(self._send_command())
        await self._tolerant(self._read_telemetry(device))
        if now_s - self._health_s >= _HEALTH_EVERY_S:
            await self._tolerant(self._read_health(device))
            await self._tolerant(self._send_command())
        if now_s - self._goals_s >= _GOALS_EVERY_S:
            await self._tolerant(self._check_goals(device))
        self._count_corrupt()

    async def _tolerant(self, step: Coroutine[None, None, None]) -> None:
        """Carry out one exchange; a lost packet is nothing, no valid one for ``reply_timeout_s`` is a lost servo."""
        try:
            await step
        except DeviceTimeoutError as e:
            silent_s = self._clock.now_s() - (self._bus.last_valid_s if self._bus else -math.inf)
            if silent_s > self.settings.reply_timeout_s:
                c = self._bus.counters() if self._bus else {}
                seen = f"{c.get('requests_n', 0)} requests, {c.get('foreign_n', 0)} replies with another id"
                raise DeviceTimeoutError(
                    e.where, f"no valid status packet for {silent_s:.2f} s ({seen})", e.remedy
                ) from e

    async def _read_telemetry(self, device: Ph54Device, *, attempts_n: int = 1) -> None:
        values, alert = await device.read_block(device.telemetry_block, attempts_n=attempts_n)
        now_s = self._clock.now_s()
        cal = self.calibration
        was_active = self._lifecycle is Lifecycle.ACTIVE
        counts = self._follow_turns(values["present_position"], now_s)
        angle_deg = cal.blade_deg(counts)
        velocity = cal.blade_deg_per_s(values["present_velocity"])
        current_ma, volts = values["present_current"], values["present_input_voltage"] / 10.0
        celsius = float(values["present_temperature"])
        near = bool(values["moving_status"] & 1)
        self._telemetry = replace(
            self._telemetry,
            angle_deg=Reading(angle_deg, now_s, not self._turns_unknown),
            velocity_deg_per_s=Reading(velocity, now_s),
            current_a=Reading(cal.sign * current_ma / 1000.0, now_s),
            torque_nm=Reading(cal.torque_nm(current_ma), now_s),
            voltage_v=Reading(volts, now_s),
            temperature_c=Reading(celsius, now_s),
            moving=Reading(bool(values["moving"]), now_s),
            in_position=Reading(near, now_s),
        )
        sample = Sample(now_s, angle_deg, velocity, current_ma / 1000.0, volts, celsius, self._standing_goal_deg())
        self._faults.replace(_MOTION_FAULTS, self._detectors.look(sample), now_s)
        self._tell_readers()
        if was_active and self._lifecycle is not Lifecycle.ACTIVE:
            await self._make_safe(device)
        if alert and not any(name in self._faults for name in self._alerts.values()):
            await self._read_health(device)

    def _standing_goal_deg(self) -> float | None:
        """What the servo was last told to do; None while nothing is powered by us."""
        sent = self._telemetry.goal_sent_deg
        return sent.value if self._lifecycle is Lifecycle.ACTIVE and sent is not None else None

    def _tell_readers(self) -> None:
        readers, self._readers = self._readers, []
        for reader in readers:
            if not reader.done():
                reader.set_result(None)

    def _follow_turns(self, counts: int, now_s: float) -> int:
        """Notice a jump by whole turns; returns the count to go by."""
        turn = self.calibration.pulses_per_turn
        before, self._raw_counts = self._raw_counts, counts
        if before is not None and abs(counts - before) > turn // 2:
            turns_n = round((counts - before) / turn)
            detail = f"the servo's turn count jumped by {turns_n:+d}"
            if self._mode == EXTENDED_MODE:
                self._turns_unknown = True
                self._faults.set("turns_lost", f"{detail}: confirm the blade's angle", now_s)
            else:
                self._faults.event("turns_lost", f"{detail}; the angle within one turn is known", now_s)
            if self._lifecycle is Lifecycle.ACTIVE:
                self._lifecycle = Lifecycle.STANDBY  # and _make_safe() follows: no goal of ours is right any more
        if self._mode == POSITION_MODE:
            return (counts + turn // 2) % turn - turn // 2
        return counts

    async def _read_health(self, device: Ph54Device, *, attempts_n: int = 1) -> None:
        """Torque and hardware error; torque found off ends ACTIVE."""
        self._health_s = now_s = self._clock.now_s()
        health, _ = await device.read_block(device.health_block, attempts_n=attempts_n)
        bits = health["hardware_error_status"]
        present = {
            name: f"hardware error bit 0x{bit:02X} is set (status 0x{bits:02X}); cleared by a reboot of the servo only"
            for bit, name in self._alerts.items()
            if bits & bit
        }
        self._faults.replace(frozenset(self._alerts.values()), present, now_s)
        self._set_torque(bool(health["torque_enable"]))
        if self._lifecycle is Lifecycle.ACTIVE and not self._torque_on:
            self._lifecycle = Lifecycle.STANDBY
            self._goal_deg, self._hold_wanted = None, False
            if not bits:
                self._faults.event("torque_off", "torque was found switched off", now_s)
                goals, _ = await device.read_block(device.goal_block, attempts_n=2)
                if goals["bus_watchdog"] == 0:
                    self._faults.clear("torque_off")
                    self._faults.event("ram_reset", "the servo's RAM registers were reset: its power was cut", now_s)

    async def _check_goals(self, device: Ph54Device) -> None:
        """Whether watchdog and profile still stand as they were written."""
        self._goals_s = now_s = self._clock.now_s()
        goals, _ = await device.read_block(device.goal_block, attempts_n=1)
        if goals["bus_watchdog"] == WATCHDOG_TRIPPED:
            self._note_trip(now_s)
            if self._lifecycle is Lifecycle.ACTIVE:
                self._lifecycle = Lifecycle.STANDBY
            await self._make_safe(device)
        elif self._lifecycle is Lifecycle.ACTIVE and goals["bus_watchdog"] != arming.watchdog_counts(self.settings):
            self._faults.event("ram_reset", f"the bus watchdog reads {goals['bus_watchdog']}, not as written", now_s)
            self._lifecycle = Lifecycle.STANDBY
            await self._make_safe(device)

    def _note_trip(self, now_s: float) -> None:
        """Tell of a trip once; the servo's register may stay tripped for long (torque kept on) and no harm in that."""
        if not self._tripped:
            self._faults.event("watchdog_tripped", "the servo's bus watchdog has stopped it; arm again", now_s)
        self._tripped = True

    def _set_torque(self, on: bool) -> None:
        self._torque_on = on
        self._telemetry = replace(self._telemetry, torque_on=Reading(on, self._clock.now_s()))

    def _count_corrupt(self) -> None:
        """Several damaged replies within a second are a fault even where the retries get through."""
        if self._bus is None:
            return
        now_s = self._clock.now_s()
        counters = self._bus.counters()
        seen_n = counters["crc_errors_n"] + counters["invalid_n"]
        self._corrupt_s.extend([now_s] * min(seen_n - self._crc_seen_n, 8))
        self._crc_seen_n = seen_n
        recent_n = sum(1 for at_s in self._corrupt_s if now_s - at_s <= _CORRUPT_WINDOW_S)
        if recent_n >= _CORRUPT_N:
            self._faults.set("corrupt_replies", f"{recent_n} damaged replies within {_CORRUPT_WINDOW_S:g} s", now_s)
        else:
            self._faults.clear("corrupt_replies")

    # -- commands ---------------------------------------------------------------------------------------------

    async def _send_command(self) -> None:
        """Send what was commanded last: a hold, or a goal that is not on the servo yet."""
        device = self._device
        if device is None:
            return
        try:
            if self._hold_wanted:
                await self._send_hold(device)
            elif self._goal_deg is not None and self._lifecycle is Lifecycle.ACTIVE:
                await self._send_goal(device, self.calibration.counts(self._goal_deg))
        except ServoRefusedError as e:
            await self._on_refusal(device, e)

    async def _send_hold(self, device: Ph54Device) -> None:
        angle = self._telemetry.angle_deg
        if not self._torque_on or angle is None:
            self._hold_wanted = False  # nothing is powered: nothing to hold
            return
        if not angle.is_fresh(self._clock.now_s(), self.settings.reply_timeout_s):
            await self._read_telemetry(device)
            angle = self._telemetry.angle_deg or angle
        low, high = self.calibration.servo_limits()
        counts = max(low, min(high, self.calibration.counts(angle.value)))  # beyond them the servo would refuse
        profile = arming.profile_counts(self.settings, self.calibration, arming.HOLD_ACCELERATION_FACTOR)
        await device.write_block(device.profile_block, {**profile, "goal_position": counts}, attempts_n=1, urgent=True)
        self._hold_profile = True
        self._hold_wanted = False
        self._note_sent(counts)

    async def _send_goal(self, device: Ph54Device, counts: int) -> None:
        if self._hold_profile:
            profile = arming.profile_counts(self.settings, self.calibration)
            await device.write_block(device.profile_block, {**profile, "goal_position": counts}, attempts_n=1)
            self._hold_profile = False
        elif counts != self._sent_counts:
            await device.write("goal_position", counts, attempts_n=1)
        else:
            return
        self._note_sent(counts)

    def _note_sent(self, counts: int) -> None:
        self._sent_counts = counts
        sent = Reading(self.calibration.blade_deg(counts), self._clock.now_s())
        self._telemetry = replace(self._telemetry, goal_sent_deg=sent)

    async def _on_refusal(self, device: Ph54Device, error: ServoRefusedError) -> None:
        """A goal was refused: the watchdog has tripped, or the servo is not as we left it. Never go on blindly."""
        log.warning("%s: %s", DEVICE, error)
        self._goal_deg, self._hold_wanted = None, False
        was_active = self._lifecycle is Lifecycle.ACTIVE
        if was_active:
            self._lifecycle = Lifecycle.STANDBY
        if error.error == StatusError.DATA_RANGE:
            await self._check_goals(device)
        elif was_active:
            self._faults.event("ram_reset", f"a goal was refused: {error.cause}", self._clock.now_s())
        await self._make_safe(device)

    async def _power_down(self, *, off: bool, leaving: bool = False) -> None:
        """Hold, wait for rest, then torque off where asked; leaving with torque on, the watchdog is taken off duty."""
        async with self._turn:
            device = self._connected()
            self._goal_deg, self._hold_wanted = None, True
            await self._tolerant(self._send_command())
            loop = asyncio.get_running_loop()
            until_s, still_n = loop.time() + _STOP_S, 0
            while loop.time() < until_s and still_n < _STILL_READS_N:
                await self._tolerant(self._read_telemetry(device))
                speed = self._telemetry.velocity_deg_per_s
                still_n = still_n + 1 if speed is not None and abs(speed.value) < 1.0 else 0
            if off:
                await device.torque(False)
                self._set_torque(False)
                self._torque_is_ours = False
            elif leaving:
                await device.write("bus_watchdog", 0)


def _condition(error: DeviceError) -> str:
    """The fault's name for an error that ended the connection."""
    if isinstance(error, WrongDeviceError):
        return "wrong_device"
    if isinstance(error, DeviceMissingError | DeviceLostError):
        return "unplugged"
    return "no_reply"
