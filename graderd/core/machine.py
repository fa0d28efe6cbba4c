"""The state machine: ``step(state, inputs, settings) -> (state, intents, replies)``. No I/O, no clock, no surprises.

Modes: DISARMED (devices unpowered or held), MANUAL (armed, takes jogs), AUTO (armed, the rule turns the blade),
STOPPED (latched; left only by reset, which leads to DISARMED). Nothing moves outside MANUAL and AUTO.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

from pydantic import Field

from graderd.core import commands as cmd
from graderd.core.axes import PARTS, Goals, Pose
from graderd.core.faults.monitor import ActiveFault, Reaction, held_axes, worst
from graderd.core.rule import Decision, RuleSettings, Travel, decide, interrupted
from graderd.core.soil import SoilObservation
from graderd.hal.settings import Positive, Settings


class Mode(StrEnum):
    """See the module's text."""

    DISARMED = "disarmed"
    MANUAL = "manual"
    AUTO = "auto"
    STOPPED = "stopped"


ARMED = (Mode.MANUAL, Mode.AUTO)
STANDSTILLS = ("daemon.suspended", "daemon.loop_blocked")
LATE = "daemon.tick_overrun"
NOTHING_HELD: Mapping[str, str] = MappingProxyType({})


class MachineSettings(Settings):
    """Times of the state machine."""

    arm_timeout_s: Positive = Field(
        5.0, le=30, description="arming that takes longer is given up: nothing is armed long after it was asked"
    )
    lease_s: Positive = Field(
        0.3,
        ge=0.1,
        le=5,
        description="motion of a client that no longer renews goes on for so long; slow emulators need 5 s",
    )


@dataclass(frozen=True, slots=True)
class Unmet:
    """A requirement that is not met."""

    name: str
    reason: str
    remedy: str


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to move, held by one client until ``expires_s`` unless renewed."""

    client: str
    expires_s: float


@dataclass(frozen=True, slots=True)
class State:
    """All memory of the machine.

    ``stop_n``: how many stops there were, each counted, also those that met a machine already stopped: a reset names
    the last one it knows of. ``stops``: the reasons of the stop that is latched, the first and the newest after it.
    ``stopping``: the faults that ask for a stop now; each was counted when it came.
    """

    mode: Mode = Mode.DISARMED
    reason: str = "started disarmed"
    stop_n: int = 0
    stops: tuple[str, ...] = ()
    stopping: frozenset[str] = frozenset()
    arming_since_s: float | None = None
    goals: Goals = field(default_factory=Goals)
    later: tuple[Goals, ...] = ()
    lease: Lease | None = None
    decision: Decision = field(default_factory=Decision)
    holding: tuple[str, ...] = ()


class Inputs(NamedTuple):
    """What is known at one tick.

    ``observation``: a new one, not handed in before. ``travel``: how the machine drives, None where it does not say.
    ``settled``: every commanded axis is at its goal, or at the bound
    the gate lets it have; ``arrived``: at its goal. ``held``: why an axis with a goal was not let move, by axis.
    All three speak of the goals of the tick before.
    ``devices_active``: all required devices are ACTIVE. ``arm_error``: why arming the devices failed, once.
    ``waited_s``: for how long each command waited to be obeyed, in their order; not at all beyond its end.
    ``unmet``: mandatory for arming and not met; ``unmet_for_auto``: for automatic operation.
    ``resolve``: turns a jog or preset into goals in stages, or gives the reason it cannot.
    """

    now_s: float
    resolve: Callable[[cmd.Jog | cmd.Preset, Pose], tuple[Goals, ...] | str]
    commands: tuple[cmd.Command, ...] = ()
    waited_s: tuple[float, ...] = ()
    observation: SoilObservation | None = None
    travel: Travel | None = None
    pose: Pose = Pose()
    settled: bool = True
    arrived: bool = True
    held: Mapping[str, str] = NOTHING_HELD
    devices_active: bool = False
    arm_error: str = ""
    unmet: tuple[Unmet, ...] = ()
    unmet_for_auto: tuple[Unmet, ...] = ()
    faults: tuple[ActiveFault, ...] = ()


@dataclass(frozen=True, slots=True)
class Intents:
    """What the machine wants of the devices this tick; the gate has the last word.

    ``power``: devices shall be ACTIVE. ``stop``: motion must end now.
    """

    goals: Goals = field(default_factory=Goals)
    power: bool = False
    stop: bool = False


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one step."""

    state: State
    intents: Intents
    replies: tuple[cmd.Reply, ...] = ()


def step(state: State, inputs: Inputs, settings: MachineSettings, rule: RuleSettings) -> Step:
    """One tick: faults first, then commands in their order, then automatic operation."""
    before = state
    state = _lapse(_react(state, inputs), inputs.now_s)
    replies: list[cmd.Reply] = []
    stops = [isinstance(command, cmd.Stop) for command in inputs.commands]
    for n in sorted(range(len(stops)), key=lambda n: not stops[n]):
        command, heard_s = inputs.commands[n], inputs.now_s - (*inputs.waited_s[n : n + 1], 0.0)[0]
        if any(stops) and isinstance(command, cmd.Reset):
            replies.append(
                cmd.Reply(command="reset", accepted=False, message="stopped this moment", remedy="reset again")
            )
            continue
        state, reply = _obey(state, command, heard_s, inputs, settings)
        replies.append(reply)
    if state.goals is not before.goals and state.goals != before.goals:
        # Taken in this tick: not reached yet, and nothing has held them.
        inputs = inputs._replace(settled=False, arrived=False, held=NOTHING_HELD)
    state = _advance(state, inputs, settings, rule)
    armed = state.mode in ARMED
    return Step(
        state,
        Intents(
            goals=state.goals if armed else Goals(),
            power=armed or state.arming_since_s is not None,
            stop=state.mode is Mode.STOPPED,
        ),
        tuple(replies),
    )


def _react(state: State, inputs: Inputs) -> State:
    """The reactions of faults and lost devices; they come before any command."""
    stopping = [f for f in inputs.faults if f.row.reaction is Reaction.STOP]
    if stopping or state.mode is Mode.STOPPED:
        return _react_stopping(state, stopping)
    fault = worst(inputs.faults)
    if fault is not None and fault.row.reaction >= Reaction.DISARM:
        if state.mode is not Mode.DISARMED or state.arming_since_s is not None:
            return _disarmed(state, _why_lost(inputs, f"{fault.name}: {fault.row.reads}"))
        return state
    if state.mode in ARMED and not inputs.devices_active:
        return _disarmed(state, _why_lost(inputs, "a device left its active state"))
    if fault is not None and fault.row.reaction is Reaction.RETREAT and state.mode is Mode.AUTO:
        return _manual(state, f"{fault.name}: {fault.row.reads}")
    return state


def _react_stopping(state: State, stopping: list[ActiveFault]) -> State:
    """Each fault that comes is a stop of its own, also beside others and after them: who resets an earlier one has not
    seen it. One that only its latch keeps says nothing new."""
    for fault in stopping:
        new = fault.present and fault.name not in state.stopping
        if new or state.mode is not Mode.STOPPED:
            state = _stopped(state, f"{fault.name}: {fault.row.reads}")
    present = frozenset(f.name for f in stopping if f.present)
    return state if present == state.stopping else replace(state, stopping=present)


def _why_lost(inputs: Inputs, told: str) -> str:
    """Why devices seem lost, where the daemon itself stood still just before: their silence is its own deafness, nobody
    needs to look at their power for that, and a device that is really lost is told afterwards. Where it was only late,
    either may be the cause: both are said."""
    own = {f.name: f"{f.name}: {f.row.reads}" for f in inputs.faults if f.present}
    standstill = next((own[name] for name in STANDSTILLS if name in own), "")
    return standstill or (f"{told}; also: {own[LATE]}" if LATE in own else told)


def _lapse(state: State, now_s: float) -> State:
    """A lease that nobody renewed in time is over before any command is heard: a late one renews nothing."""
    if state.lease is None or now_s <= state.lease.expires_s:
        return state
    return _manual(state, lapse_of(state.lease.client))


def lapse_of(client: str) -> str:
    """The reason of a machine whose client did not renew its lease in time."""
    return f"lease of {client or 'the client'} lapsed"


def _obey(
    state: State, command: cmd.Command, heard_s: float, inputs: Inputs, settings: MachineSettings
) -> tuple[State, cmd.Reply]:
    """A lease counts from when its client was heard, not from when its turn came: one that has gone meanwhile moves
    nothing by what it left waiting."""

    def yes(new: State, message: str) -> tuple[State, cmd.Reply]:
        return new, cmd.Reply(command=command.command, accepted=True, message=message)

    def no(message: str, remedy: str) -> tuple[State, cmd.Reply]:
        return state, cmd.Reply(command=command.command, accepted=False, message=message, remedy=remedy)

    match command:
        case cmd.Stop():
            by = f" (by {command.client})" if command.client else ""
            stopped = _stopped(state, command.reason + by)
            return yes(stopped, f"already stopped: {state.reason}" if state.mode is Mode.STOPPED else "stopped")
        case cmd.Disarm():
            if state.mode is Mode.STOPPED:
                return yes(state, "stopped, and so already without power")
            return yes(_disarmed(state, "disarm command"), "disarmed")
        case cmd.Reset():
            if state.mode is not Mode.STOPPED:
                return yes(state, f"nothing to reset: {state.mode}")
            standing = worst(f for f in inputs.faults if f.present and f.row.reaction is Reaction.STOP)
            if standing is not None:
                return no(f"{standing.name} is still present: {standing.row.reads}", standing.row.remedy)
            if command.stop_n != state.stop_n:
                return no(f"stop number {state.stop_n} is latched: {state.reason}", "read why, then reset that one")
            return yes(_disarmed(state, "reset"), "reset; arm when the area around the blade is clear")
        case cmd.Renew() | cmd.Release():
            return _lease_command(state, command, heard_s, settings, yes, no)
    if state.lease is not None and state.lease.client != command.client:
        return no(
            f"{state.lease.client or 'another client'} is moving the blade",
            "wait until it is done, or send stop",
        )
    match command:
        case cmd.Arm():
            return _arm(state, inputs, yes, no)
        case cmd.Auto():
            if state.mode not in ARMED:
                return no(
                    f"automatic operation needs an armed machine; it is {state.mode}",
                    _way_to_armed(state.mode),
                )
            if state.mode is Mode.AUTO:
                return yes(state, "already automatic")
            if inputs.unmet_for_auto:
                return no(*_told(inputs.unmet_for_auto))
            ends = worst(f for f in inputs.faults if f.row.reaction is Reaction.RETREAT)
            if ends is not None:  # in the next tick it would be manual again
                return no(f"{ends.name}: {ends.row.reads}", ends.row.remedy)
            return yes(replace(_manual(state, "automatic operation"), mode=Mode.AUTO), "automatic")
        case cmd.Manual():
            if state.mode not in ARMED:
                return no(f"manual operation needs an armed machine; it is {state.mode}", _way_to_armed(state.mode))
            return yes(_manual(state, "manual operation"), "manual")
    # What is left is a jog or a preset.
    if state.mode is not Mode.MANUAL:
        return no(f"moving by hand needs manual mode; the machine is {state.mode}", _way_to_manual(state.mode))
    stages = inputs.resolve(command, inputs.pose)
    if isinstance(stages, str):
        return no(stages, "ask for a position inside the limits")
    lease = Lease(command.client, heard_s + settings.lease_s)
    if inputs.now_s > lease.expires_s:
        return no(f"asked {inputs.now_s - heard_s:.1f} s ago, and not renewed since", "send the jog again")
    moving = replace(state, goals=stages[0], later=stages[1:], lease=lease, reason=f"{command.command} by hand")
    return yes(moving, "moving while the lease is renewed")


def _lease_command(
    state: State,
    command: cmd.Renew | cmd.Release,
    heard_s: float,
    settings: MachineSettings,
    yes: Callable[[State, str], tuple[State, cmd.Reply]],
    no: Callable[[str, str], tuple[State, cmd.Reply]],
) -> tuple[State, cmd.Reply]:
    if state.lease is None or state.lease.client != command.client:
        return no("you hold no lease", "send the jog again")
    if isinstance(command, cmd.Renew):
        until_s = max(state.lease.expires_s, heard_s + settings.lease_s)
        return yes(replace(state, lease=Lease(command.client, until_s)), "renewed")
    return yes(_manual(state, "released"), "released; holding")


def _arm(
    state: State,
    inputs: Inputs,
    yes: Callable[[State, str], tuple[State, cmd.Reply]],
    no: Callable[[str, str], tuple[State, cmd.Reply]],
) -> tuple[State, cmd.Reply]:
    if state.mode is Mode.STOPPED:
        return no(f"stopped: {state.reason}", "reset first, then arm")
    if state.mode in ARMED:
        return yes(state, f"already armed: {state.mode}")
    if state.arming_since_s is not None:
        return yes(state, "arming")
    if inputs.devices_active:
        # Arming writes and reads back limits and watchdogs; devices left active from before must not skip that.
        return no("the devices are still being released", "arm again in a moment")
    if inputs.unmet:
        return no(*_told(inputs.unmet))
    fault = worst(inputs.faults)
    if fault is not None and fault.row.reaction >= Reaction.DISARM:
        return no(f"{fault.name}: {fault.row.reads}", fault.row.remedy)
    return yes(replace(state, arming_since_s=inputs.now_s, reason="arming"), "arming")


def _told(unmet: tuple[Unmet, ...]) -> tuple[str, str]:
    """What is not met, and the remedies."""
    return (
        "not ready: " + "; ".join(f"{u.name}: {u.reason}" for u in unmet),
        "; ".join(dict.fromkeys(u.remedy for u in unmet if u.remedy)),
    )


def _advance(state: State, inputs: Inputs, settings: MachineSettings, rule: RuleSettings) -> State:
    """Finish arming, end what is held, go to a preset's next stage, follow the rule."""
    if state.arming_since_s is not None:
        if inputs.devices_active:
            return _manual(state, "armed")
        if inputs.arm_error:
            return _disarmed(state, f"arming failed: {inputs.arm_error}")
        if inputs.now_s - state.arming_since_s > settings.arm_timeout_s:
            return _disarmed(state, f"arming took longer than {settings.arm_timeout_s:g} s")
        return state
    held = _held(state, inputs)
    if state.mode is Mode.MANUAL:
        for axis, goal in state.goals.items():
            if goal is not None and axis in held:
                # What was asked for ends here: it must not go on by itself when the cause is gone.
                state = _manual(state, f"{axis} was held: {held[axis]}")
                break
        if state.later and inputs.settled and not inputs.arrived:
            state = _manual(state, "the preset ended: an axis stands at a bound short of its goal")
        elif state.later and inputs.settled:
            state = replace(state, goals=state.later[0], later=state.later[1:])
    if state.mode is Mode.AUTO:
        # A hold takes the angle, and the votes for the next: what moves afterwards was decided afterwards.
        decision = (
            interrupted(state.decision, inputs.now_s, rule, inputs.travel)
            if "rotation" in held
            else decide(state.decision, inputs.observation, inputs.settled, inputs.now_s, rule, inputs.travel)
        )
        goals = Goals(rotation_deg=decision.angle_deg)
        if decision is not state.decision or goals != state.goals:
            state = replace(state, decision=decision, goals=goals)
    if state.mode in ARMED and (holding := _why_holding(state, inputs)) != state.holding:
        return replace(state, holding=holding)
    return state


def _counting(state: State, inputs: Inputs) -> list[ActiveFault]:
    """The faults that count in this mode."""
    return [f for f in inputs.faults if state.mode is Mode.AUTO or not f.row.automatic_only]


def _held(state: State, inputs: Inputs) -> dict[str, str]:
    """Why an axis must stay where it is: a fault that holds it, or the gate that did not let its goal pass."""
    by_part = {part: f"{f.name}: {f.row.reads}" for part, f in held_axes(_counting(state, inputs)).items()}
    if not by_part:
        return dict(inputs.held)
    return dict(inputs.held) | {axis: by_part[part] for axis, part in PARTS.items() if part in by_part}


def _why_holding(state: State, inputs: Inputs) -> tuple[str, ...]:
    reasons = [
        f"{f.name} since {inputs.now_s - f.since_s:.1f} s: {f.row.reads}"
        for f in _counting(state, inputs)
        if f.row.reaction >= Reaction.HOLD
    ]
    if state.mode is Mode.AUTO and state.decision.angle_deg is None and not reasons:
        zone = state.decision.zone
        no_decision = "no decision yet: the camera has not shown soil clearly enough"
        reasons.append(no_decision if zone is None else f"held in mid-pass: {zone} not seen again")
    return tuple(reasons)


def _stopped(state: State, reason: str) -> State:
    """Latched. A further stop is counted and its reason kept beside the first's."""
    others = tuple(why for why in state.stops[:1] if why != reason)
    stops = (*others, reason)
    reason, stop_n = "; also: ".join(stops), state.stop_n + 1
    return State(mode=Mode.STOPPED, reason=reason, stop_n=stop_n, stops=stops, stopping=state.stopping)


def _disarmed(state: State, reason: str) -> State:
    return State(mode=Mode.DISARMED, reason=reason, stop_n=state.stop_n)


def _manual(state: State, reason: str) -> State:
    return State(mode=Mode.MANUAL, reason=reason, stop_n=state.stop_n)


def _way_to_armed(mode: Mode) -> str:
    return "reset, then arm" if mode is Mode.STOPPED else "arm first"


def _way_to_manual(mode: Mode) -> str:
    return {
        Mode.STOPPED: "reset, arm, then manual",
        Mode.DISARMED: "arm first",
        Mode.AUTO: "send manual first",
    }[mode]
