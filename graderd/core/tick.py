"""One control tick as data: what it knows comes in as :class:`Sensed`, what it decided leaves as :class:`Tick`.

The only caller of state machine, readiness, lift pair, gate and fault monitor: what they decide together is decided
here. Pure: no device, no clock; the same list of ``Sensed`` gives the same list of ``Tick``, on every machine and in
every replay. ``graderd.runtime.control`` senses, calls and acts; status, DM1, records and clients read the ``Tick``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from graderd.core import commands as cmd
from graderd.core.attitude import AttitudeGeometry, MeasuredAttitude, Preset, measured_attitude
from graderd.core.axes import AXES, LIFTS, AxisFigures, Pose
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import ActiveFault, Clear, FaultState, clear_faults, update_faults
from graderd.core.gate import AxisPass, GateInputs, GateSettings, GateState, pass_gate
from graderd.core.lift_pair import LiftCoordinator, LiftPairSettings, SideReading
from graderd.core.machine import ARMED, Inputs, Intents, MachineSettings, Mode, State, step
from graderd.core.motion import resolve
from graderd.core.plausibility import AxisSample, MotionFigures, PlausibilityMonitor, axis_sample
from graderd.core.readiness import AUTOMATIC, Requirement, requirements
from graderd.core.rule import RuleSettings, Travel
from graderd.core.soil import SoilObservation
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.vehicle import VehicleTelemetry

BLOCKED_S = 0.5
"""A tick this late: goals have timed out and the servo's watchdog (0.2 s by default) has tripped meanwhile."""
LAPSE_SHOWN_S = 3.0
NO_VEHICLE = VehicleTelemetry()


@dataclass(frozen=True, slots=True)
class TickSettings:
    """What the tick goes by: the configuration, without anything that belongs to a device or a process.

    ``motion``: what is plausible for each axis. ``overrun_s``: a tick later than this is a fault.
    ``max_frame_age_s``: the soil of an older picture is unknown.
    ``max_vehicle_age_s``: with older readings it is not known how the machine drives.
    ``no_auto``: why what sees the soil may not drive; empty where it may.
    """

    figures: Mapping[str, AxisFigures]
    motion: Mapping[str, MotionFigures]
    machine: MachineSettings = field(default_factory=MachineSettings)
    rule: RuleSettings = field(default_factory=RuleSettings)
    gate: GateSettings = field(default_factory=GateSettings)
    lift_pair: LiftPairSettings = field(default_factory=LiftPairSettings)
    attitude: AttitudeGeometry = field(default_factory=AttitudeGeometry)
    presets: Mapping[str, Preset] = field(default_factory=dict)
    overrun_s: float = 0.1
    max_frame_age_s: float = 0.5
    max_vehicle_age_s: float = 0.5
    no_auto: str = ""


@dataclass(frozen=True, slots=True)
class AxisSensed:
    """One axis's device: its lifecycle, its newest readings, and why it is not open (empty where it is)."""

    lifecycle: Lifecycle
    telemetry: RotatorTelemetry | ActuatorTelemetry
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Sensed:
    """Everything one tick knows.

    ``axes``: by axis name. ``faults``: conditions that devices, bus, camera and daemon report now. ``commands``: since
    the tick before, in their order; ``waited_s``: for how long each was waiting by then, not at all beyond its end.
    ``observation``: a new one, once. ``powered``: every device is ACTIVE and none is
    being armed or disarmed. ``arm_error``: why arming the devices failed, once. ``refused``: what a driver said to the
    goal of the tick before, by axis. ``late_s``: how much later than planned this tick comes.
    ``vehicle``: how the machine drives.
    """

    now_s: float
    axes: Mapping[str, AxisSensed]
    faults: tuple[DeviceFault, ...] = ()
    commands: tuple[cmd.AnyCommand, ...] = ()
    waited_s: tuple[float, ...] = ()
    observation: SoilObservation | None = None
    powered: bool = False
    arm_error: str = ""
    refused: Mapping[str, str] = field(default_factory=dict)
    late_s: float = 0.0
    vehicle: VehicleTelemetry = NO_VEHICLE


class AxisTick(NamedTuple):
    """What became of one axis in this tick, in its unit.

    ``requested``: where it was asked to go, None: nowhere. ``limited``: what the gate passed, None: it holds;
    ``because`` says why it is not what was asked. ``bounded``: the nearest to it that limits and window allow.
    ``send``: what its driver is to be told, None: nothing new; ``hold``:
    its driver is to be told to stop. ``speed_share``: of its full speed. ``arrived``: it stands where it was *asked*
    to go.
    """

    requested: float | None = None
    limited: float | None = None
    because: str = ""
    bounded: float | None = None
    send: float | None = None
    hold: bool = False
    speed_share: float = 1.0
    arrived: bool = False


class Tick(NamedTuple):
    """Everything one tick decided.

    ``replies``: to the commands of ``Sensed``, in their order. ``stopped_now``: the stop was latched in this tick.
    ``soil``: the newest observation, UNKNOWN where it is too old by now; None: there was none.
    """

    now_s: float
    pose: Pose
    attitude: MeasuredAttitude
    faults: tuple[ActiveFault, ...]
    readiness: tuple[Requirement, ...]
    state: State
    intents: Intents
    axes: Mapping[str, AxisTick]
    replies: tuple[cmd.Reply, ...] = ()
    stopped_now: bool = False
    soil: SoilObservation | None = None
    overruns_n: int = 0

    def device_faults(self) -> tuple[DeviceFault, ...]:
        """The active faults as a bus publishes them (DM1)."""
        return tuple(
            DeviceFault(device, condition, fault.detail, fault.since_s)
            for fault in self.faults
            for device, _, condition in (fault.name.partition("."),)
        )


class Controller:
    """All memory between two ticks. One per machine; :meth:`step` is its only way in."""

    def __init__(self, settings: TickSettings, state: State | None = None) -> None:
        """``state``: where the machine begins, if it is not disarmed."""
        self._settings = settings
        self._state = state or State()
        self._faults = FaultState()
        self._gate = GateState()
        self._lift = LiftCoordinator(settings.lift_pair, settings.figures)
        self._axes: Mapping[str, AxisTick] = MappingProxyType({axis: AxisTick() for axis in AXES})
        self._sending: frozenset[str] = frozenset()
        self._soil: SoilObservation | None = None
        self._now_s: float | None = None
        self._overruns_n = 0
        self._plausibility = PlausibilityMonitor(settings.motion)
        self._own_faults = PresentFaults("daemon")

    def step(self, sensed: Sensed) -> Tick:
        """Decide once. ``sensed.now_s`` never goes back."""
        settings, now_s = self._settings, sensed.now_s
        dt_s = 0.0 if self._now_s is None else now_s - self._now_s
        self._now_s = now_s
        self._note_late(sensed.late_s, now_s)
        if sensed.observation is not None:
            self._soil = sensed.observation
        pose = _pose_of(sensed, settings.figures)
        self._faults = update_faults(self._faults, self._present(sensed), now_s, CATALOGUE)
        before = self._state
        latched, event = self._faults, _unlatching(before, sensed.commands)
        if event is not None:
            self._faults = clear_faults(latched, event)
        readiness = self._readiness(sensed, pose)
        result = step(
            before,
            Inputs(
                now_s=now_s,
                resolve=lambda command, at: resolve(command, at, settings.attitude, settings.presets, settings.figures),
                commands=sensed.commands,
                waited_s=sensed.waited_s,
                observation=sensed.observation,
                travel=_travel(sensed.vehicle, now_s, settings.max_vehicle_age_s),
                pose=pose,
                settled=self._settled(pose),
                arrived=self._arrived(pose),
                held=self._held(),
                devices_active=sensed.powered,
                arm_error=sensed.arm_error,
                unmet=tuple(r.unmet() for r in readiness if r.mandatory and not r.met),
                unmet_for_auto=tuple(r.unmet() for r in readiness if r.name == AUTOMATIC and not r.met),
                faults=self._faults.active,
            ),
            settings.machine,
            settings.rule,
        )
        self._state = state = result.state
        if event is not None and not _accepted(event, state):
            self._faults = latched
        if state.mode in ARMED and before.mode not in ARMED:
            self._gate = GateState()
            self._faults = clear_faults(self._faults, Clear.ON_REARM)
        self._note_lapse(before, now_s)
        attitude = measured_attitude(settings.attitude, pose)
        self._axes = self._limit(sensed, result.intents, pose, attitude, dt_s)
        return Tick(
            now_s=now_s,
            pose=pose,
            attitude=attitude,
            faults=self._faults.active,
            readiness=readiness,
            state=state,
            intents=result.intents,
            axes=self._axes,
            replies=_in_the_order_asked(sensed.commands, result.replies),
            stopped_now=state.mode is Mode.STOPPED and before.mode is not Mode.STOPPED,
            soil=None if self._soil is None else self._soil.as_of(now_s, settings.max_frame_age_s),
            overruns_n=self._overruns_n,
        )

    def _limit(
        self, sensed: Sensed, intents: Intents, pose: Pose, attitude: MeasuredAttitude, dt_s: float
    ) -> Mapping[str, AxisTick]:
        """The intents through lift pair and gate; nothing else may name a goal."""
        left, right = (_side(sensed, axis) for axis in LIFTS)
        self._gate, passed = pass_gate(
            self._gate,
            intents.goals,
            GateInputs(
                settings=self._settings.gate,
                figures=self._settings.figures,
                mode=self._state.mode,
                pose=pose,
                dt_s=dt_s,
                lease_ok=self._state.mode is Mode.AUTO or self._state.lease is not None,
                height_mm=attitude.height_mm,
            ),
            lambda goals: self._lift.step(goals, sensed.now_s, left, right),
        )
        shares = self._lift.shares
        former, self._sending = (
            self._sending,
            frozenset(axis for axis, result in passed.items() if result.limited is not None and sensed.powered),
        )
        return MappingProxyType(
            {
                axis: self._axis(axis, passed[axis], sensed, position, axis in former, shares.get(axis, 1.0))
                for axis, position in pose.items()
            }
        )

    def _axis(
        self, axis: str, passed: AxisPass, sensed: Sensed, position: float | None, moving: bool, share: float
    ) -> AxisTick:
        sending = axis in self._sending
        requested, refused = self._state.goals[axis], sensed.refused.get(axis, "")
        stopped = self._lift.stopped if axis in LIFTS else ""
        tolerance = self._settings.figures[axis].tolerance
        return AxisTick(
            requested=requested,
            limited=None if refused else passed.limited,
            because=refused or stopped or passed.reason,
            bounded=passed.bounded,
            send=passed.limited if sending else None,
            # Once: a hold renewed every tick would follow every bit of measured drift.
            hold=moving and not sending,
            speed_share=share,
            arrived=requested is not None and position is not None and abs(position - requested) <= tolerance,
        )

    def _settled(self, pose: Pose) -> bool:
        """Whether every axis with a goal stands at it, or at the bound the gate lets it have; judged before this tick's
        commands, on the goals of the tick before."""
        for axis, goal in self._state.goals.items():
            if goal is None:
                continue
            former, position = self._axes[axis], pose[axis]
            at = goal if former.bounded is None else former.bounded
            if position is None or abs(position - at) > self._settings.figures[axis].tolerance:
                return False
        return True

    def _arrived(self, pose: Pose) -> bool:
        """Whether every axis with a goal stands where it was asked to go."""
        return all(
            (position := pose[axis]) is not None and abs(position - goal) <= self._settings.figures[axis].tolerance
            for axis, goal in self._state.goals.items()
            if goal is not None
        )

    def _held(self) -> dict[str, str]:
        """Why the gate, or a driver, did not let an axis's goal pass in the tick before."""
        return {
            axis: decided.because
            for axis, decided in self._axes.items()
            if decided.requested is not None and decided.limited is None and decided.because
        }

    def _present(self, sensed: Sensed) -> list[DeviceFault]:
        implausible = self._plausibility.judge(_samples(sensed), sensed.now_s)
        return [*sensed.faults, *implausible, *self._lift.faults(sensed.now_s), *self._own_faults.present(sensed.now_s)]

    def _readiness(self, sensed: Sensed, pose: Pose) -> tuple[Requirement, ...]:
        settings = self._settings
        faults = self._faults.active
        return requirements(self._state, sensed.axes, pose, settings.figures, faults, settings.no_auto)

    def _note_late(self, late_s: float, now_s: float) -> None:
        if late_s <= self._settings.overrun_s:
            return
        self._overruns_n += 1
        detail = f"tick {late_s * 1e3:.0f} ms late, {self._overruns_n} overruns"
        self._own_faults.tell("loop_blocked" if late_s > BLOCKED_S else "tick_overrun", detail, now_s)

    def _note_lapse(self, before: State, now_s: float) -> None:
        lapsed = before.lease is not None and self._state.lease is None and now_s > before.lease.expires_s
        if lapsed and before.lease is not None and self._state.mode in ARMED:
            self._own_faults.tell("lease_lapsed", f"client {before.lease.client or '?'}", now_s, LAPSE_SHOWN_S)


def _unlatching(state: State, commands: tuple[cmd.AnyCommand, ...]) -> Clear | None:
    """Which latches these commands let go of, if the machine accepts them: a reset of a stop, or an arm."""
    if any(isinstance(command, cmd.Stop) for command in commands):
        return None
    if state.mode is Mode.STOPPED and any(isinstance(command, cmd.Reset) for command in commands):
        return Clear.ON_RESET
    if state.mode is Mode.DISARMED and any(isinstance(command, cmd.Arm) for command in commands):
        return Clear.ON_REARM
    return None


def _accepted(event: Clear, state: State) -> bool:
    """Whether the machine did what lets go of latches; a stop or a fault of the same moment may have been before it."""
    return state.mode is not Mode.STOPPED if event is Clear.ON_RESET else state.arming_since_s is not None


def _pose_of(sensed: Sensed, figures: Mapping[str, AxisFigures]) -> Pose:
    """Measured positions fresh enough to act on."""
    axes, now_s = sensed.axes, sensed.now_s
    return Pose(*(_fresh(axes[axis].telemetry.position, now_s, figures[axis].max_age_s) for axis in AXES))


def _fresh(reading: Reading[float] | None, now_s: float, max_age_s: float) -> float | None:
    """Its value; None where it is old, or no number: a distance that is none would never end a pass."""
    if reading is None or not reading.is_fresh(now_s, max_age_s) or not math.isfinite(reading.value):
        return None
    return reading.value


def _samples(sensed: Sensed) -> Iterator[AxisSample]:
    """What each axis does and was told; an axis without a valid position: nothing."""
    for axis, told in sensed.axes.items():
        sample = axis_sample(axis, told.lifecycle, told.telemetry)
        if sample is not None:
            yield sample


def _travel(vehicle: VehicleTelemetry, now_s: float, max_age_s: float) -> Travel | None:
    """As old as the older of the two readings; what comes from ahead of the clock is of now, or it never grew old."""
    speed, travelled = vehicle.speed_m_per_s, vehicle.travelled_m
    speed_m_per_s, travelled_m = _fresh(speed, now_s, max_age_s), _fresh(travelled, now_s, max_age_s)
    if speed is None or travelled is None or speed_m_per_s is None or travelled_m is None:
        return None
    return Travel(speed_m_per_s, travelled_m, min(speed.time_s, travelled.time_s, now_s))


def _side(sensed: Sensed, axis: str) -> SideReading | None:
    reading = sensed.axes[axis].telemetry.position
    return SideReading(reading.value, reading.time_s) if reading is not None and reading.valid else None


def _in_the_order_asked(commands: tuple[cmd.AnyCommand, ...], replies: tuple[cmd.Reply, ...]) -> tuple[cmd.Reply, ...]:
    """The machine answers stops first; the replies in the order of the commands."""
    if len(replies) < 2:
        return replies
    order = sorted(range(len(commands)), key=lambda i: not isinstance(commands[i], cmd.Stop))
    return tuple(reply for _, reply in sorted(zip(order, replies, strict=True)))
