"""One Electrak as a linear axis: the driver behind :class:`graderd.hal.linear_actuator.LinearActuator`."""

from __future__ import annotations

import asyncio
import math
from typing import Final

from graderd.drivers.electrak.codec import SELECTABLE_ADDRESSES, Control, ElectrakCodec
from graderd.drivers.electrak.feedback import (
    FAILING,
    INFORMATIVE,
    RECOVERY_N,
    TRIPPING,
    TRUST_N,
    FeedbackMonitor,
    FeedbackTrack,
)
from graderd.drivers.electrak.planner import MotionPlanner
from graderd.drivers.electrak.profile import load_profile
from graderd.drivers.electrak.thermal import OverloadPolicy, ThermalGuard, Verdict
from graderd.drivers.j1939.ids import Frame, Pgn, make_id
from graderd.drivers.j1939.link import CanLink
from graderd.hal.clock import Clock, SystemClock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceRefusedError,
    DeviceTimeoutError,
    LifecycleError,
)
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.settings import ElectrakSettings

WAKE_TIMEOUT_S: Final = 3.0
_SILENCE_S: Final = 1.0
_WAKING_S: Final = 0.5
"""A claim so soon after our first message of a while is that of a unit which fell asleep meanwhile."""
_APART_S: Final = 0.015
"""Control messages out of turn come no closer after one another than this, so a tick that wants many sends few."""
_CLOSE_REPEATS_N: Final = 3
_CONTROL_PRIORITY: Final = 6


class ElectrakActuator:
    """A Thomson Electrak HD or MD (option CNO) on a shared :class:`CanLink`.

    ``name`` is ``lift_left``, ``lift_right`` or ``tilt``. See the contract for the calls; what is special here:

    * the control message goes out every 100 ms in every state but closed, with motion disabled unless a fresh target
      exists, which keeps the actuator awake and its feedback coming;
    * after an overload, motion stays disabled until the actuator's flag is gone, then the settings' number of retries
      follows, one a second; when they are used up the overload is told and the axis is in standby.
    """

    def __init__(self, name: str, settings: ElectrakSettings, link: CanLink, clock: Clock | None = None) -> None:
        self.name = name
        self.settings = settings
        self.profile = load_profile(settings.profile).with_figures(settings.figures)
        figures = self.profile.figures
        self._check_settings()
        self._link = link
        self._clock = clock or SystemClock()
        self._codec = ElectrakCodec(self.profile.layout)
        self._planner = MotionPlanner(
            figures, current_limit_a=settings.current_limit_a, speed_percent=settings.speed_percent
        )
        self._faults = PresentFaults(name)
        self._monitor = FeedbackMonitor(figures, settings.address_n, self._faults)
        self._thermal = ThermalGuard(figures)
        self._lifecycle = Lifecycle.CLOSED
        self._opened_at_s = 0.0
        self._track = FeedbackTrack(figures)
        self._heard = asyncio.Event()
        self._target_at_s = 0.0
        self._control_at_s = -math.inf
        self._resumed_at_s = -math.inf
        self._sent: Reading[float] | None = None
        self._sent_enabled = False
        self._may_move = False
        self._overload = OverloadPolicy(settings.overload_retries_n)
        self._overload_detail = ""
        self._claimed_name: int | None = None
        self._counters = {"feedback_n": 0, "control_n": 0, "restarts_n": 0, "target_timeouts_n": 0}

    # -- what is known ----------------------------------------------------------------------------------------------

    @property
    def address(self) -> int:
        """J1939 address of the actuator."""
        return self.settings.address_n

    @property
    def feedback_pgn(self) -> int:
        """Group of the actuator feedback message."""
        return Pgn.PROPRIETARY_A2

    @property
    def lifecycle(self) -> Lifecycle:
        """Present lifecycle state."""
        self._watch(self._clock.now_s())
        return self._lifecycle

    def telemetry(self) -> ActuatorTelemetry:
        """Newest readings, each with its time."""
        feedback, at_s = self._track.feedback, self._track.feedback_at_s
        counters = {
            **self._counters,
            "overloads_n": self._overload.overloads_n,
            "bad_feedback_n": self._monitor.bad_n,
        }
        if feedback is None:
            return ActuatorTelemetry(thermal_load=self._thermal.load, target_sent_mm=self._sent, counters=counters)
        return ActuatorTelemetry(
            position_mm=Reading(feedback.position_mm, at_s),
            goal_mm=self._planner.target_mm if self._sent_enabled else None,
            velocity_mm_per_s=Reading(self._track.velocity_mm_per_s, at_s),
            current_a=Reading(feedback.current_a, at_s),
            duty_percent=Reading(feedback.duty_percent, at_s),
            moving=Reading(feedback.moving, at_s),
            flags=Reading(feedback.flags, at_s),
            target_sent_mm=self._sent,
            thermal_load=self._thermal.load,
            counters=counters,
        )

    def faults(self) -> tuple[DeviceFault, ...]:
        """Conditions present now. Events (a restart, an overload) stay visible for a second after they happened."""
        now_s = self._clock.now_s()
        self._watch(now_s)
        return self._faults.present(now_s)

    # -- life -------------------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """closed -> standby: claim our address, wake the device with motion disabled, wait for its first feedback.

        Raises:
            LifecycleError: it is open already.
            DeviceMissingError: the channel does not exist.
            DeviceTimeoutError: no address or no feedback within three seconds.
        """
        if self._lifecycle is not Lifecycle.CLOSED:
            raise LifecycleError(self.name, f"cannot open while {self._lifecycle}", "Close it first")
        await self._link.open()
        now_s = self._clock.now_s()
        self._forget()
        self._opened_at_s = now_s
        self._link.attach(self)
        try:
            async with asyncio.timeout(WAKE_TIMEOUT_S):
                await self._heard.wait()
        except TimeoutError:
            self._link.detach(self)
            self._faults.clear_all()
            raise self._no_feedback_error() from None
        except BaseException:
            self._link.detach(self)
            raise
        self._lifecycle = Lifecycle.STANDBY

    async def arm(self) -> None:
        """standby -> active: motion may be enabled from now on; nothing moves until a target is set.

        Raises:
            LifecycleError: not in standby.
            DeviceRefusedError: a fault is present, or a stop could not be sent now.
            DeviceTimeoutError: feedback is stale.
        """
        now_s = self._clock.now_s()
        self._watch(now_s)
        if self._lifecycle is not Lifecycle.STANDBY:
            raise LifecycleError(self.name, f"cannot arm while {self._lifecycle}", self._remedy())
        await self._link.prove_stop(self)
        now_s = self._clock.now_s()
        self._watch(now_s)
        if self._lifecycle is not Lifecycle.STANDBY:
            raise LifecycleError(self.name, f"became {self._lifecycle} while it was armed", self._remedy())
        if self._track.age_s(now_s) > self.settings.feedback_timeout_s:
            raise DeviceTimeoutError(self.name, f"feedback is {self._track.age_s(now_s):.2f} s old")
        standing = [flag for flag in ("overload", "fatal") if flag in self._track.flags]
        self._faults.clear(*(TRIPPING - set(standing)))
        left = self._faults.names(now_s) - INFORMATIVE
        if left:
            details = "; ".join(f.detail for f in self._faults.present(now_s) if f.condition in left)
            raise DeviceRefusedError(self.name, f"cannot arm with {', '.join(sorted(left))}: {details}")
        self._planner.hold()
        self._monitor.reset()
        self._overload.rearm()
        self._lifecycle = Lifecycle.ACTIVE

    async def disarm(self) -> None:
        """active -> standby: motion disabled at once, keep-alive and feedback go on."""
        self.hold()
        if self._lifecycle is Lifecycle.ACTIVE:
            self._lifecycle = Lifecycle.STANDBY

    async def close(self) -> None:
        """Any state -> closed: motion disabled several times, then silent."""
        if self._lifecycle is Lifecycle.CLOSED:
            return
        self._planner.hold()
        self._lifecycle = Lifecycle.STANDBY
        for repeat in range(_CLOSE_REPEATS_N):
            if repeat:
                await asyncio.sleep(0.01)
            self._link.send_control(self)
        self._link.detach(self)
        self._lifecycle = Lifecycle.CLOSED
        self._faults.clear_all()

    # -- commands ---------------------------------------------------------------------------------------------------

    def set_target_mm(self, target_mm: float, speed_share: float = 1.0) -> None:
        """Take a new target; see the contract.

        Raises:
            LifecycleError: not active.
            CommandRangeError: not finite or outside the soft limits; the former target stays.
        """
        now_s = self._clock.now_s()
        self._watch(now_s)
        if self._lifecycle is not Lifecycle.ACTIVE:
            raise LifecycleError(self.name, f"no target while {self._lifecycle}", self._remedy())
        low, high = self.settings.min_mm, self.settings.max_mm
        if not (math.isfinite(target_mm) and low <= target_mm <= high):
            raise CommandRangeError(self.name, f"target {target_mm} mm is outside {low} to {high} mm")
        if not (math.isfinite(speed_share) and 0.0 < speed_share <= 1.0):
            raise CommandRangeError(self.name, f"speed share {speed_share} is not above 0 and at most 1")
        self._target_at_s = now_s
        self._planner.set_target(target_mm, speed_share)
        urgent = self._rested(now_s) and self._planner.is_urgent(self._track.motion(now_s))
        if urgent and now_s - self._control_at_s >= _APART_S:
            self._link.send_control(self)

    def hold(self) -> None:
        """Motion disabled with the next control message, sent at once. Allowed in every state, idempotent."""
        self._planner.hold()
        if self._sent_enabled:
            self._link.send_control(self)

    # -- the link's side --------------------------------------------------------------------------------------------

    def control_frame(self, source: int, now_s: float) -> Frame:
        """The control message that goes out now."""
        if now_s - self._control_at_s > _SILENCE_S:
            self._resumed_at_s = now_s
        self._control_at_s = now_s
        self._watch(now_s)
        return self._control_message(self._next_control(now_s), source, now_s)

    def stop_frame(self, source: int, now_s: float) -> Frame | None:
        """Motion disabled; None where the actuator was told so and is seen at rest since."""
        if not self._may_move:
            return None
        here_mm = self._track.feedback.position_mm if self._track.feedback else 0.0
        return self._control_message(self._planner.disabled(here_mm), source, now_s)

    def on_feedback(self, data: bytes, now_s: float) -> None:
        """A feedback message from this address."""
        try:
            feedback = self._codec.decode_feedback(data)
        except ValueError as error:
            self._track.good_n = 0
            self._monitor.on_garbage(str(error), now_s)
            self._watch(now_s)
            return
        if self._track.age_s(now_s) > self.settings.feedback_timeout_s:
            self._track.begin_anew()
            self._monitor.reset()
        if not self._monitor.on_feedback(feedback, now_s):
            self._track.good_n = 0
            self._watch(now_s)
            return
        self._counters["feedback_n"] += 1
        self._track.take(feedback, now_s)
        self._thermal.update(feedback.current_a, now_s)
        self._planner.on_feedback(self._track.motion(now_s))
        self._may_move = feedback.moving or self._sent_enabled
        if self._link.address is None:
            # Still awake from before, and about to sleep: what is heard while we may not speak is no answer to us.
            self._track.good_n = 0
        else:
            self._heard.set()
        if self._track.good_n >= RECOVERY_N:
            self._faults.clear("no_feedback", "wrong_address")
        if self._track.good_n >= TRUST_N:
            self._faults.clear("implausible_feedback")
        self._on_overload_flag("overload" in feedback.flags, now_s)
        self._watch(now_s)

    def on_claim(self, name: int, solicited: bool, now_s: float) -> None:
        """An address claim from this address: an unasked one of a unit that was awake means that it restarted."""
        awake = self._track.age_s(now_s) < 2.0 and now_s - self._resumed_at_s > _WAKING_S
        moved_in = self._claimed_name is not None and name != self._claimed_name
        self._claimed_name = name
        if self._lifecycle is Lifecycle.CLOSED or (solicited and not moved_in) or not awake:
            return
        self._counters["restarts_n"] += 1
        what = "another unit claimed its address" if moved_in else "it claimed its address anew: a power cut?"
        self._faults.tell("restarted", what, now_s)
        self._watch(now_s)

    def on_link_lost(self, now_s: float) -> None:
        """The bus is gone."""
        self._track.good_n = 0
        self._sent_enabled = False
        self._faults.set("no_feedback", f"{self._link.where} is lost", now_s)
        self._fail()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _control_message(self, control: Control, source: int, now_s: float) -> Frame:
        self._sent_enabled = control.motion_enable
        if control.motion_enable:
            self._sent, self._may_move = Reading(control.target_mm, now_s), True
        self._counters["control_n"] += 1
        can_id = make_id(_CONTROL_PRIORITY, Pgn.PROPRIETARY_A, source, self.address)
        return Frame(can_id, self._codec.encode_control(control))

    def _next_control(self, now_s: float) -> Control:
        feedback = self._track.feedback
        here_mm = feedback.position_mm if feedback else 0.0
        if self._lifecycle is not Lifecycle.ACTIVE or feedback is None:
            return self._planner.disabled(here_mm)
        if self._planner.target_mm is not None and now_s - self._target_at_s > self.settings.target_timeout_s:
            self._counters["target_timeouts_n"] += 1
            self._planner.hold()
        return self._planner.control(self._track.motion(now_s), may_move=self._rested(now_s))

    def _rested(self, now_s: float) -> bool:
        """Neither too warm nor waiting after an overload."""
        return self._thermal.may_move(now_s) and not self._overload.waiting

    def _on_overload_flag(self, tripped: bool, now_s: float) -> None:
        verdict = self._overload.on_feedback(tripped, self._lifecycle is Lifecycle.ACTIVE, now_s)
        if verdict is Verdict.RETRY and self._sent_enabled:
            self._link.send_control(self)  # motion disabled now, not with the next period
        elif verdict is Verdict.LATCH:
            tried_n = self.settings.overload_retries_n
            detail = f"more than {self.settings.current_limit_a:.1f} A for 50 ms"
            detail += f", {tried_n} retries used up" if tried_n else ""
            self._overload_detail = detail
            self._faults.tell("overload", detail, now_s)
        elif tripped and "overload" in self._faults.names(now_s):
            self._faults.tell("overload", self._overload_detail, now_s)  # present as long as the flag is

    def _watch(self, now_s: float) -> None:
        """Draw the consequences: lost feedback fails the axis, disarming faults take it out of the active state."""
        if self._lifecycle is Lifecycle.CLOSED:
            return
        age_s = now_s - max(self._track.feedback_at_s, self._opened_at_s)
        if age_s > self.settings.feedback_timeout_s:
            self._track.good_n = 0
            unknown = self._unattached(now_s)
            detail = f"no feedback from address {self.address} for {age_s:.2f} s"
            if unknown and self._link.is_open:
                heard = ", ".join(str(a) for a in unknown)
                self._faults.set("wrong_address", f"{detail}, but an actuator at address {heard} is heard", now_s)
            else:
                self._faults.set("no_feedback", detail, now_s)
        names = self._faults.names(now_s)
        if names & FAILING:
            self._fail()
        elif self._lifecycle is Lifecycle.FAILED:
            self._lifecycle = Lifecycle.STANDBY
        if self._lifecycle is Lifecycle.ACTIVE and names & TRIPPING:
            self._lifecycle = Lifecycle.STANDBY
            self.hold()
        thermal = self._thermal
        load = f"{100 * thermal.load:.0f} % of the heat budget"
        self._faults.keep("thermal_limit", thermal.limited, f"{load}: no motion until it is cooler", now_s)
        self._faults.keep("thermal_derating", thermal.derating and not thermal.limited, f"{load}: rests added", now_s)

    def _unattached(self, now_s: float) -> list[int]:
        """Addresses within an Electrak's reach that give an Electrak's feedback and belong to no configured axis."""
        return [a for a in self._link.unattached(self.feedback_pgn, now_s) if a in SELECTABLE_ADDRESSES]

    def _fail(self) -> None:
        if self._lifecycle is not Lifecycle.CLOSED and self._lifecycle is not Lifecycle.FAILED:
            self._lifecycle = Lifecycle.FAILED
            self.hold()

    def _forget(self) -> None:
        self._planner.hold()
        self._monitor.reset()
        self._faults.clear_all()
        self._track.forget()
        self._heard.clear()
        self._sent, self._sent_enabled, self._may_move = None, False, False
        self._overload.rearm()
        self._claimed_name = None

    def _check_settings(self) -> None:
        figures, settings = self.profile.figures, self.settings
        wrong = []
        if settings.max_mm > figures.stroke_mm:
            wrong.append(f"max_mm {settings.max_mm} is beyond the stroke of {figures.stroke_mm} mm")
        if settings.current_limit_a > figures.current_limit_max_a:
            wrong.append(f"current_limit_a {settings.current_limit_a} is above {figures.current_limit_max_a} A")
        if settings.feedback_timeout_s <= 2 * figures.afm_period_s:
            wrong.append(f"feedback_timeout_s {settings.feedback_timeout_s} is not even two feedback periods")
        if wrong:
            raise CommandRangeError(f"settings of {self.name}", "; ".join(wrong), f"Profile: {self.profile.name}")

    def _remedy(self) -> str:
        match self._lifecycle:
            case Lifecycle.CLOSED:
                return "Open it first"
            case Lifecycle.STANDBY:
                return "Arm it first"
            case Lifecycle.ACTIVE:
                return "It is active already"
        return (
            "; ".join(fault.detail for fault in self._faults.present(self._clock.now_s()))
            or "Wait until its feedback is back"
        )

    def _no_feedback_error(self) -> DeviceError:
        now_s = self._clock.now_s()
        unknown = self._unattached(now_s)
        cause = f"no feedback from address {self.address}"
        remedy = "Check its supply, the 120 ohm terminators and address_n"
        if unknown:
            remedy = f"Actuators are heard at address {', '.join(map(str, unknown))}: check address_n and select pins"
        if self._link.address is None:
            cause, remedy = "graderd got no J1939 address", "Look at the can faults"
        return DeviceTimeoutError(self.name, f"{cause} within {WAKE_TIMEOUT_S:.0f} s", remedy)
