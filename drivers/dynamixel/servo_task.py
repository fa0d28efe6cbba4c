"""The task that owns the servo's wire: it polls, sends what was commanded, and goes on looking for a lost servo."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Coroutine
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from graderd.drivers.dynamixel import arming
from graderd.drivers.dynamixel.bus import NotCarriedOutError, ServoRefusedError
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.codec import StatusError
from graderd.drivers.dynamixel.connection import ServoLink, condition_of
from graderd.drivers.dynamixel.device import ATTEMPTS_N, Ph54Device
from graderd.drivers.dynamixel.motion import MoveProfile, ServoMotion, led_back_deg, rest_deg
from graderd.drivers.dynamixel.observer import SUPPLY_FAULTS, ServoObserver
from graderd.hal.clock import Clock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceError, DeviceLostError, DeviceRefusedError, DeviceTimeoutError, LifecycleError
from graderd.hal.settings import Ph54Settings

log = logging.getLogger(__name__)

DEVICE = "rotation"
FIELDS = {"device": DEVICE}


class CommandSlot:
    """What was commanded and what of it the servo has taken.

    ``goal_deg``: the goal in force, None while holding. ``hold_wanted``: a hold that has not gone out yet.
    """

    def __init__(self, settings: Ph54Settings, calibration: Calibration) -> None:
        self.goal_deg: float | None = None
        self.hold_wanted = False
        self.hold_acceleration_counts = arming.hold_acceleration_counts(settings, calibration)
        self._goal_s = -math.inf
        self._settings = settings
        self.calibration = calibration
        self._sent_counts: int | None = None
        self._held_deg: float | None = None
        self._held_s = -math.inf
        self._holding = False
        self._hard_profile = False
        self._led_back = False
        self._taken = False

    def goal(self, goal_deg: float, now_s: float) -> None:
        """The newest goal wins, also over a hold that has not gone out yet."""
        self.goal_deg, self._goal_s, self.hold_wanted = goal_deg, now_s, False

    def hold(self) -> None:
        """Hold with the next packet; nothing to do where the last thing sent was a hold."""
        if self.goal_deg is None and self._holding and not self.hold_wanted:
            return
        self.goal_deg, self.hold_wanted, self._led_back = None, True, False

    def withdraw(self) -> None:
        """No command in force. What the servo has, or may have, stays known: the next hold goes by it."""
        self.goal_deg, self.hold_wanted, self._holding, self._led_back = None, False, False, False

    def forget(self, sent_counts: int | None = None) -> None:
        """No command in force; ``sent_counts``: the goal that is on the servo, where that is known."""
        self.withdraw()
        self._sent_counts, self._held_deg = sent_counts, None

    def armed(self, armed: arming.Armed) -> None:
        """Begin anew with what arming has left on the servo."""
        self.forget(armed.goal_counts)
        self._hard_profile, self.hold_acceleration_counts = False, armed.hold_acceleration_counts

    @property
    def holding(self) -> bool:
        """Whether the last thing sent was a hold."""
        return self._holding

    @property
    def sent_counts(self) -> int | None:
        """The goal that the servo has, or may have."""
        return self._sent_counts

    def expired(self, now_s: float) -> bool:
        """Whether the goal was not renewed in time."""
        return self.goal_deg is not None and now_s - self._goal_s > self._settings.goal_timeout_s

    def sent_hold_after(self, motion: ServoMotion) -> bool:
        """Whether a hold went out after that reading: the blade may brake since, and the reading not know of it."""
        return self._held_deg is not None and motion.time_s <= self._held_s

    async def send_hold(self, device: Ph54Device, motion: ServoMotion, now_s: float, *, attempts_n: int = 1) -> int:
        """The goal where it comes to rest soonest, with a harder profile, in one packet. Returns the counts sent.

        A servo that refuses the profile still gets the goal, and brakes with the profile it has. Where a former hold
        went unanswered and no newer reading tells whether it was taken, the same goal is sent again.

        Raises:
            ServoRefusedError: it refuses the goal too.
            DeviceRefusedError: its count is so far outside its limits that no goal would hold it.
        """
        profile = arming.profile_counts(self._settings, self.calibration)
        gentle, hard = profile["profile_acceleration"], self.hold_acceleration_counts
        try:
            counts = self._rest_counts(motion, now_s, hard)
            values = {**profile, "profile_acceleration": hard, "goal_position": counts}
            self._hard_profile = True
            await device.write_block(device.profile_block, values, attempts_n=attempts_n, urgent=True)
        except NotCarriedOutError:
            self._held_deg = None  # it turns on, and the next hold is another
            raise
        except ServoRefusedError as e:
            self._held_deg, self._hard_profile = None, False
            if e.error == StatusError.DATA_RANGE:  # its watchdog has tripped: it brakes by itself
                raise
            counts = self._rest_counts(motion, now_s, gentle)
            await device.write("goal_position", counts, attempts_n=attempts_n, urgent=True)
        self._sent_counts, self._holding, self.hold_wanted = counts, True, False
        return counts

    def _rest_counts(self, motion: ServoMotion, now_s: float, acceleration_counts: int) -> int:
        cal = self.calibration
        braking = acceleration_counts * cal.acceleration_deg_per_s2_per_count
        goal_deg = None if self._sent_counts is None else cal.servo_deg(self._sent_counts)
        if self._held_deg is None or not self.sent_hold_after(motion):
            profile = arming.profile_counts(self._settings, cal)
            move = MoveProfile(
                profile["profile_velocity"] * cal.velocity_deg_per_s_per_count,
                profile["profile_acceleration"] * cal.acceleration_deg_per_s2_per_count,
            )
            self._held_deg, self._held_s = rest_deg(motion, now_s, braking, goal_deg, move, self._held_deg), now_s
        wanted = cal.servo_counts(self._held_deg)
        low, high = cal.servo_limits()
        counts = max(low, min(high, wanted))  # beyond them the servo would refuse
        if abs(counts - wanted) > cal.pulses_per_turn // 4:
            cause = f"it stands {cal.servo_deg(wanted - counts):+.0f}° outside its limits"
            raise DeviceRefusedError(DEVICE, cause, "Its turns were lost: reboot it")
        return counts

    async def send_goal(self, device: Ph54Device, motion: ServoMotion | None) -> int | None:
        """The goal, where the servo has not got it yet. Returns the counts sent, None where nothing was to send.

        While the blade stands against something the servo's own set point runs on towards the goal, and its profile
        would bring it back slowly: the goal is led back with the hold's.
        """
        if self.goal_deg is None:
            return None
        cal = self.calibration
        counts, back_deg = cal.counts(self.goal_deg), None
        if motion is not None and not self.sent_hold_after(motion):
            share, led = self._settings.gear_ratio, self._led_back
            back_deg = led_back_deg(motion, cal.servo_deg(counts), share, was_led_back=led)
        self._led_back = back_deg is not None
        if back_deg is not None:
            low, high = cal.servo_limits()
            counts = max(low, min(high, cal.servo_counts(back_deg)))
        former, self._held_deg = self._sent_counts, None
        if self._hard_profile is not self._led_back:
            profile = arming.profile_counts(self._settings, cal)
            if self._led_back:
                profile["profile_acceleration"] = self.hold_acceleration_counts
            self._sent_counts = counts
            await device.write_block(device.profile_block, {**profile, "goal_position": counts}, attempts_n=1)
        elif counts != former or not self._taken or self._holding:
            self._sent_counts, self._taken = counts, False
            await device.write("goal_position", counts, attempts_n=1)
        else:
            return None
        self._hard_profile, self._holding, self._taken = self._led_back, False, True
        return counts


LINK_FAULTS = ("no_reply", "corrupt_replies", "unplugged", "wrong_device")
"""Conditions that end when the servo is found again."""
_HEALTH_EVERY_S = 0.1
_GOALS_EVERY_S = 0.5
_RECONNECT_FIRST_S = 0.1
_RECONNECT_MOST_S = 1.0
_RUNAWAY_DEG = 8.0
"""Braking from the fastest permitted turn takes 5.2 degrees. A blade that goes further under a hold is not braking: its
servo runs the wrong way, and a goal, even that of staying, only drives it on."""
_STILL_DEG_PER_S = 1.0
_AWAY_DEG = 0.5
_STOP_S = 0.5
"""A disarm gives the blade so long to come to rest before torque goes off."""
_STILL_READS_N = 5
"""So many reads in a row without movement are rest; one alone may be a turning point."""
_UNANSWERED_N = 7
"""A lost servo left so many requests in a row unanswered. Where one exchange in seven is lost that happens once in
700,000; a program that stood still asked none."""
_IN_DOUBT_N = 4
"""A hold that went unanswered was taken or not: only a reading tells, and it is asked for so often. What is sent
without one turns the blade back where the hold was not taken, or on where it was."""
_OLD_S = 0.15
"""A hold reads the angle again where the last reading is older; a younger one tells well enough where the blade is."""


class Event(StrEnum):
    """What happens to a servo. ``DISARMED``: asked for, or it is not as arming left it. ``LOST``: silent or gone."""

    OPENED = "opened"
    ARMED = "armed"
    DISARMED = "disarmed"
    LOST = "lost"
    FOUND = "found"
    CLOSED = "closed"


_NEXT: Final = MappingProxyType(
    {
        (Lifecycle.CLOSED, Event.OPENED): Lifecycle.STANDBY,
        (Lifecycle.STANDBY, Event.ARMED): Lifecycle.ACTIVE,
        (Lifecycle.ACTIVE, Event.DISARMED): Lifecycle.STANDBY,
        (Lifecycle.STANDBY, Event.LOST): Lifecycle.FAILED,
        (Lifecycle.ACTIVE, Event.LOST): Lifecycle.FAILED,
        (Lifecycle.FAILED, Event.FOUND): Lifecycle.STANDBY,
        **{(state, Event.CLOSED): Lifecycle.CLOSED for state in Lifecycle},
    }
)


def after(state: Lifecycle, event: Event) -> Lifecycle:
    """The state that ``event`` leads to; where the table has none, nothing changes."""
    return _NEXT.get((state, event), state)


class ServoTask:
    """Keeps one servo in the state it should be in, poll by poll, whatever the wire does.

    ``torque_is_ours``: torque was switched on by us.
    ``wire_lock``: held by whoever has several exchanges to make that belong together.
    """

    def __init__(
        self, settings: Ph54Settings, link: ServoLink, observer: ServoObserver, command: CommandSlot, clock: Clock
    ) -> None:
        self._state = Lifecycle.CLOSED
        self.torque_is_ours = False
        self.wire_lock = asyncio.Lock()
        self._settings = settings
        self._calibration = command.calibration
        self._link = link
        self._observer = observer
        self._command = command
        self._clock = clock
        self._task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()
        self._readers: list[asyncio.Future[None]] = []
        self._powering_down = False

    @property
    def lifecycle(self) -> Lifecycle:
        """Where the servo is in its life."""
        return self._state

    def note(self, event: Event) -> None:
        """Something happened to it."""
        self._state = after(self._state, event)

    def start(self) -> None:
        """Begin to poll."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="rotation-servo")
        self._task.add_done_callback(self._on_task_done)

    async def stop(self) -> None:
        """End the task and let go of the wire; idempotent."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        self._link.disconnect()
        self._command.forget()
        self._tell_readers()

    def wake(self) -> None:
        """There is a command: it goes out at once, not with the next poll."""
        self._wake.set()

    async def next_poll(self) -> None:
        """Wait until telemetry was read, or the connection's state changed.

        Raises:
            LifecycleError: closed: there will be none.
        """
        if self._state is Lifecycle.CLOSED:
            raise LifecycleError(DEVICE, "there is no telemetry while it is closed", "Open it first")
        reader: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._readers.append(reader)
        await reader

    # -- connection -------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Find and identify the servo, and take its first readings; nothing moves and torque is left as it is.

        Raises:
            DeviceError: see :meth:`ServoLink.connect`.
        """
        self._observer.new_wire()
        await self.first_readings(await self._link.connect())
        self._observer.faults.clear(*LINK_FAULTS)

    async def first_readings(self, device: Ph54Device) -> None:
        """First readings of a servo just found, and what its registers tell of the time without us."""
        observer = self._observer
        observer.restart(position_known=True)
        goals = await observer.read_goals(device, attempts_n=ATTEMPTS_N)
        await observer.read_health(device, attempts_n=ATTEMPTS_N)
        await observer.read_telemetry(device, None, attempts_n=ATTEMPTS_N)
        if self.torque_is_ours and not observer.torque_on:
            observer.name_torque_loss(goals)
        self._command.forget(goals["goal_position"])
        await self._make_safe(device)

    async def _make_safe(self, device: Ph54Device) -> None:
        """Nothing drives the blade on; torque that we had switched on goes where ``torque_at_disarm`` says.

        A stranger's torque is left alone, and so is a servo that stands; one on its way somewhere holds first.
        """
        observer = self._observer
        self._command.withdraw()
        off = self.torque_is_ours and self._settings.torque_at_disarm == "off"
        if observer.torque_on and self._on_its_way():
            await self._come_to_rest(device, off=off, wait=off)
        if observer.torque_on and off:
            await self._torque_off(device)
        self.torque_is_ours = self.torque_is_ours and observer.torque_on
        if observer.tripped and not observer.torque_on:  # unpowered, no stale goal can come alive
            await device.write("bus_watchdog", 0)
            observer.tripped = False

    def _on_its_way(self) -> bool:
        """Whether the servo moves, or has a goal elsewhere than where it stands."""
        motion, sent = self._observer.motion, self._command.sent_counts
        if motion is None:
            return False
        away_deg = 0.0 if sent is None else abs(self._calibration.servo_deg(sent) - motion.position_deg)
        return abs(motion.velocity_deg_per_s) > _STILL_DEG_PER_S or away_deg > _AWAY_DEG

    async def _torque_off(self, device: Ph54Device) -> None:
        await device.torque(False)
        self._observer.set_torque(False)

    # -- leaving --------------------------------------------------------------------------------------------

    async def power_down(self, *, off: bool, leaving: bool = False) -> None:
        """Hold, wait for rest, then torque off where asked; leaving with torque on, the watchdog is taken off duty."""
        self._powering_down = True
        try:
            await self._power_down_in_turn(off=off, leaving=leaving)
        finally:
            self._powering_down = False

    async def _power_down_in_turn(self, *, off: bool, leaving: bool) -> None:
        async with self.wire_lock:
            device = self._link.device
            await self._come_to_rest(device, off=off, wait=True)
            if off:
                await self._torque_off(device)
                self.torque_is_ours = False
            elif leaving:
                await device.write("bus_watchdog", 0)

    async def _come_to_rest(self, device: Ph54Device, *, off: bool, wait: bool) -> None:
        """Hold, and wait for rest where asked; a servo whose watchdog has tripped brakes by itself.

        ``off``: torque goes off afterwards, and sooner where the hold is not obeyed or refused.
        """
        observer, loop = self._observer, asyncio.get_running_loop()
        until_s, still_n = loop.time() + _STOP_S, 0
        began = None  # where the blade was when the servo had taken the hold, which a bad line may delay
        if not observer.tripped:
            self._command.hold()
        while loop.time() < until_s and still_n < _STILL_READS_N:
            try:
                if self._command.hold_wanted:
                    await self._tolerant(self._hold(device))
            except DeviceRefusedError as e:
                log.warning("%s: %s", DEVICE, e, extra=FIELDS)
                self._command.withdraw()
                if off:
                    break
            if not wait and not self._command.hold_wanted:
                break
            await self._tolerant(observer.read_telemetry(device, None))
            speed, angle = observer.telemetry.velocity_deg_per_s, observer.telemetry.angle_deg
            still_n = still_n + 1 if speed is not None and abs(speed.value) < 1.0 else 0
            if began is None and not self._command.hold_wanted:
                began = angle
            if off and began is not None and angle is not None and abs(angle.value - began.value) > _RUNAWAY_DEG:
                log.warning("%s: does not obey the hold: torque off without waiting for rest", DEVICE, extra=FIELDS)
                break

    # -- the servo's own task ---------------------------------------------------------------------------------

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        """The owner of the wire must not die while the rotator is open: start it again."""
        if task is self._task and self.lifecycle is not Lifecycle.CLOSED:
            cause = "was cancelled" if task.cancelled() else f"failed: {task.exception()!r}"
            log.error("%s: the servo task %s; starting it again", DEVICE, cause, extra=FIELDS)
            self._fail(DeviceLostError(DEVICE, f"the servo task {cause}"))
            self.start()

    async def _run(self) -> None:
        pause_s = _RECONNECT_FIRST_S
        while self._state is not Lifecycle.CLOSED:
            try:
                if not self._link.is_up:
                    self._link.disconnect()
                    async with self.wire_lock:
                        await self.connect()
                        self.note(Event.FOUND)
                    self._link.happened["reconnects_n"] += 1
                    port = self._link.bus.port if self._link.bus else "?"
                    log.info("%s: servo found at %s", DEVICE, port, extra=FIELDS)
                pause_s = _RECONNECT_FIRST_S
                await self._serve()
            except DeviceError as e:
                self._fail(e)
            except Exception as e:  # a bug in here must not end the search for the servo
                log.exception("%s: unexpected error in the servo task", DEVICE, extra=FIELDS)
                self._fail(DeviceLostError(DEVICE, f"internal error {e!r}"))
            await asyncio.sleep(pause_s)
            pause_s = min(_RECONNECT_MOST_S, 2 * pause_s)

    def condition_of(self, error: DeviceError) -> str:
        """The fault's name for an error that ended or prevented a connection, while its bus is still there."""
        condition = condition_of(error)
        if self._link.bus is not None:
            self._observer.count_damage(self._link.bus)
        if condition == "no_reply" and self._observer.damaged_lately():
            return "corrupt_replies"
        return condition

    def _fail(self, error: DeviceError) -> None:
        condition, faults = self.condition_of(error), self._observer.faults
        faults.set(condition, error.cause, self._clock.now_s())
        # At every attempt: the log repeats it ever more rarely.
        log.warning("%s: %s", condition, error, extra={**FIELDS, "fault": f"{DEVICE}.{condition}"})
        faults.clear(*(c for c in LINK_FAULTS if c != condition), *SUPPLY_FAULTS)
        self.note(Event.LOST)
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
        period_s = 1.0 / self._settings.poll_hz
        next_s = loop.time()
        while True:
            async with self.wire_lock:
                await self._cycle(self._link.device)
            next_s = max(next_s + period_s, loop.time())
            if self._link.silence()[1]:
                next_s = loop.time()  # a lost packet is asked for again at once
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
            async with self.wire_lock:
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
        if observer.witness_due is not None:
            await self._tolerant(self._leave_witness(device))
        if now_s - observer.health_s >= _HEALTH_EVERY_S:
            await self._tolerant(self._send_command(device))
            await self._tolerant(observer.read_health(device))
        if now_s - observer.goals_s >= _GOALS_EVERY_S:
            await self._tolerant(self._send_command(device))
            await self._tolerant(self._check_goals(device))
        await self._tolerant(self._protect(device))
        if self._link.bus is not None:
            observer.count_damage(self._link.bus)
            observer.count_doubles(self._link.bus)
            self._link.judge_loss()

    async def _leave_witness(self, device: Ph54Device) -> None:
        """The servo's RAM shall say whether its turns are known."""
        if (due := self._observer.witness_due) is not None:
            await device.write_block(device.witness_block, due, attempts_n=1)  # it stays due
            self._observer.witness_due = None

    def _standing_goal_deg(self) -> float | None:
        """Where the servo drives the blade to; None while it is not powered by us, or was told to hold."""
        sent = self._observer.telemetry.goal_sent_deg
        drives = self.lifecycle is Lifecycle.ACTIVE and not self._command.holding
        return sent.value if drives and sent is not None else None

    async def _check_goals(self, device: Ph54Device) -> None:
        """Whether the watchdog still stands as it was written."""
        goals = await self._observer.read_goals(device)
        wanted, found = arming.watchdog_counts(self._settings), goals["bus_watchdog"]
        if self.lifecycle is Lifecycle.ACTIVE and not self._observer.tripped and found != wanted:
            detail = f"the bus watchdog reads {found}, not {wanted} as written"
            await self._end_active(device, "ram_reset", detail)

    async def _protect(self, device: Ph54Device) -> None:
        """End ACTIVE where torque is gone, the watchdog has tripped or turns were lost. Only arm() brings it back.

        In STANDBY finish what an interrupted disarm left: torque of ours that should be off, a trip to be cleared.
        """
        observer = self._observer
        if self.lifecycle is Lifecycle.ACTIVE:
            if not observer.torque_on:
                await self._end_active(device)
                observer.name_torque_loss(await observer.read_goals(device, attempts_n=ATTEMPTS_N))
            elif observer.tripped or observer.turns_jumped:
                await self._end_active(device)
        elif not self._powering_down and (
            (self.torque_is_ours and observer.torque_on and self._settings.torque_at_disarm == "off")
            or (observer.tripped and not observer.torque_on)
        ):
            await self._make_safe(device)

    async def _end_active(self, device: Ph54Device, condition: str = "", detail: str = "") -> None:
        self.note(Event.DISARMED)
        if condition:
            self._observer.faults.tell(condition, detail, self._clock.now_s())
        await self._make_safe(device)

    async def _tolerant(self, step: Coroutine[None, None, None]) -> None:
        """Carry out one exchange; a lost packet is nothing, no valid one for ``reply_timeout_s`` is a lost servo."""
        try:
            await step
        except DeviceTimeoutError as e:
            if self._is_silent():
                silent_s, c = self._link.silence()[0], self._link.counters()
                seen = f"{c.get('requests_n', 0)} requests, {c.get('foreign_n', 0)} replies with another id"
                cause = f"no valid status packet for {silent_s:.2f} s ({seen})"
                raise DeviceTimeoutError(e.where, cause, e.remedy) from e

    def _is_silent(self) -> bool:
        """Whether the servo is lost: a program that stood still would have asked nothing, hence the requests."""
        silent_s, unanswered_n = self._link.silence()
        return silent_s > self._settings.reply_timeout_s and unanswered_n >= _UNANSWERED_N

    async def _send_command(self, device: Ph54Device) -> None:
        """Send what was commanded last: a hold, or a goal that is not on the servo yet."""
        command, observer, sent = self._command, self._observer, None
        try:
            if command.hold_wanted:
                await self._hold(device)
            elif self.lifecycle is Lifecycle.ACTIVE:
                sent = await command.send_goal(device, observer.motion)
        except DeviceRefusedError as e:
            await self._on_refusal(device, e)
        if sent is not None:
            observer.note_sent(sent)

    async def _hold(self, device: Ph54Device) -> None:
        """Send the hold, by a reading as young as can be had."""
        command, observer = self._command, self._observer
        if not observer.torque_on or observer.motion is None:
            command.forget()  # nothing is powered: nothing to hold
            return
        too_old = self._clock.now_s() - observer.motion.time_s > _OLD_S
        in_doubt = command.sent_hold_after(observer.motion)
        if too_old or in_doubt:
            for _ in range(_IN_DOUBT_N if in_doubt else 1):
                with contextlib.suppress(DeviceTimeoutError):
                    await observer.read_telemetry(device, None)
                    break
                if self._is_silent():
                    break  # more questions would only put off that it is told
        observer.note_sent(await command.send_hold(device, observer.motion, self._clock.now_s()))

    async def _on_refusal(self, device: Ph54Device, error: DeviceRefusedError) -> None:
        """A goal was refused: the watchdog has tripped, or the servo is not as we left it. Never go on blindly."""
        log.warning("%s: %s", DEVICE, error, extra=FIELDS)
        was_active = self.lifecycle is Lifecycle.ACTIVE
        self.note(Event.DISARMED)
        if isinstance(error, ServoRefusedError) and error.error == StatusError.DATA_RANGE:
            await self._observer.read_goals(device, attempts_n=ATTEMPTS_N)
        elif was_active:
            detail = f"a goal was refused: {error.cause}"
            self._observer.faults.tell("ram_reset", detail, self._clock.now_s())
        await self._make_safe(device)
