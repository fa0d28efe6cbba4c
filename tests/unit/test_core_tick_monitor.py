"""A monitor beside the model: random work through the real tick, judged by rules that share none of its code.

The monitor knows what was commanded and answered, what was measured and which rows of the fault catalogue hold what; it
knows nothing of modes, gates or decisions. ``GRADERD_MONITOR_TICKS`` is how many ticks are made (``make monitor``:
1,000,000); a finding names seed and tick, by which it comes again.
"""

from __future__ import annotations

import copy
import math
import os
import random
from dataclasses import dataclass, field

import pytest

from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core import commands as cmd
from graderd.core.attitude import Preset
from graderd.core.axes import ACTUATORS, AXES, JOG_AXES, LIFTS, PARTS
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Reaction
from graderd.core.soil import SoilObservation, Zone
from graderd.core.tick import AxisSensed, AxisTick, Controller, Sensed, Tick
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry

TICKS_N = int(os.environ.get("GRADERD_MONITOR_TICKS", "20000"))
RUN_N = 2000
"""Ticks of one run; each begins with a new controller."""
CONFIG = Config.model_validate({"rotation": {"window_deg": 40.0}, "tilt": {"window_mm": 20.0}})
SETTINGS = tick_settings(CONFIG)
FIGURES = SETTINGS.figures
EPS = 1e-6
LATE_S = 0.1
"""A tick that comes later is not made up for: drivers have held meanwhile."""
ANGLES = {CONFIG.rule.angle_deg(zone): zone for zone in (Zone.LEFT, Zone.RIGHT, Zone.CENTER, Zone.EVEN)}


class Monitor:
    """What must hold of every tick. One call a tick; an ``AssertionError`` says what did not."""

    def __init__(self) -> None:
        self.stopped = self.armed = self.arming = self.auto = False
        self.lease: tuple[str, float] | None = None
        self.asked: frozenset[str] = frozenset()
        self.votes: dict[Zone, int] = {}
        self.void = self.void_votes = False
        self.former: dict[str, AxisTick] = {}
        self.sent: dict[str, float] = {}
        self.armed_at: dict[str, float] = {}
        self.outside: dict[str, float] = {}
        self.last_s: float | None = None
        self.moves_n = dict.fromkeys(AXES, 0)
        self.decided_n = 0

    def judge(self, sensed: Sensed, tick: Tick) -> None:
        dt_s = 0.0 if self.last_s is None else sensed.now_s - self.last_s
        self.last_s = sensed.now_s
        measured = {axis: fresh(sensed, axis) for axis in AXES}
        self._hear(sensed, tick)
        held = held_now(sensed, self.auto)
        if held == frozenset(AXES) and any(reaction_of(fault) >= Reaction.DISARM for fault in sensed.faults):
            self.armed = self.arming = self.auto = False
            self.lease = None
        if self.auto:
            self._see(sensed, tick, held, measured)
        for axis in AXES:
            decided = tick.axes[axis]
            before = self.former.get(axis)
            if before is not None and before.send is not None and decided.send is None:
                assert decided.hold, f"{axis} was not told to hold"
            if decided.send is not None:
                self._judge(axis, decided, sensed, measured[axis], held, dt_s)
        if self.lease is not None:
            going = (axis for axis in AXES if tick.axes[axis].requested is not None)
            self.void = any(axis in held or measured[axis] is None for axis in going)
        if self.armed:
            for axis, position in measured.items():
                if position is not None and math.isfinite(position):
                    self.armed_at.setdefault(axis, position)
        else:
            self.armed_at.clear()
        self.former = dict(tick.axes)
        self.sent = {axis: decided.send for axis, decided in tick.axes.items() if decided.send is not None}

    def _hear(self, sensed: Sensed, tick: Tick) -> None:
        """What was asked, and what of it the daemon said it would do."""
        if self.lease is not None and (sensed.now_s > self.lease[1] or self.void):
            self.lease = None
        self.void = False
        if self.armed and not sensed.powered:
            self.armed = self.auto = False
            self.lease = None
        if self.arming and sensed.powered:
            self.arming, self.armed = False, True
            self.armed_at.clear()
        pairs = list(zip(sensed.commands, tick.replies, strict=True))
        for command, reply in sorted(pairs, key=lambda pair: not isinstance(pair[0], cmd.Stop)):
            if not reply.accepted:
                assert not isinstance(command, cmd.Stop), "a stop was refused"
                continue
            match command:
                case cmd.Stop():
                    self.stopped, self.armed, self.arming, self.auto, self.lease = True, False, False, False, None
                case cmd.Reset():
                    if self.stopped:
                        assert not any(isinstance(c, cmd.Stop) for c in sensed.commands)
                    self.stopped = False
                case cmd.Disarm():
                    self.armed, self.arming, self.auto, self.lease = False, False, False, None
                case cmd.Arm():
                    assert not self.stopped, "armed while stopped"
                    self.arming = self.arming or not self.armed
                case cmd.Auto():
                    if not self.auto:
                        self.votes = {}
                    self.auto, self.lease = True, None
                case cmd.Manual():
                    self.auto, self.lease = False, None
                case cmd.Jog():
                    self.asked = frozenset(JOG_AXES[command.axis].moves)
                    self.lease = (command.client, sensed.now_s + CONFIG.machine.lease_s)
                    self.auto = False
                case cmd.Preset():
                    self.asked = moved_by(CONFIG.presets[command.name])
                    self.lease = (command.client, sensed.now_s + CONFIG.machine.lease_s)
                    self.auto = False
                case cmd.Renew():
                    if self.lease is not None and self.lease[0] == command.client:
                        self.lease = (command.client, sensed.now_s + CONFIG.machine.lease_s)
                case cmd.Release():
                    self.lease = None

    def _see(self, sensed: Sensed, tick: Tick, held: frozenset[str], measured: dict[str, float | None]) -> None:
        """Votes since nothing was in the way: what interrupts the rotation makes those before it void."""
        seen = sensed.observation
        if "rotation" in held or self.void_votes or any(reaction_of(f) is Reaction.RETREAT for f in sensed.faults):
            self.votes = {}
        elif seen is not None and abs(sensed.now_s - seen.capture_s) <= CONFIG.rule.vote_max_age_s:
            self.votes[seen.zone] = self.votes.get(seen.zone, 0) + 1
        self.void_votes = tick.axes["rotation"].requested is not None and measured["rotation"] is None

    def _judge(
        self,
        axis: str,
        decided: AxisTick,
        sensed: Sensed,
        measured: float | None,
        held: frozenset[str],
        dt_s: float,
    ) -> None:
        send, figures = decided.send, FIGURES[axis]
        assert send is not None
        assert math.isfinite(send)
        self.moves_n[axis] += 1
        assert not self.stopped, f"{axis} moves while stopped"
        assert self.armed, f"{axis} moves while disarmed"
        assert sensed.powered, f"{axis} moves without power"
        assert axis not in held, f"{axis} moves although a fault holds it"
        assert measured is not None, f"{axis} moves unmeasured"
        if self.lease is not None:
            assert axis in self.asked, f"{axis} moves, nobody asked for it"
        else:
            assert self.auto, f"{axis} moves without a lease"
            assert axis == "rotation", f"{axis} moves in automatic operation"
            assert decided.requested in ANGLES, "automatic operation goes to no angle of the rule"
            zone = ANGLES[decided.requested]
            assert self.votes.get(zone, 0) >= CONFIG.rule.votes_needed_n, f"turns for {zone} on {self.votes}"
            self.decided_n += 1
        assert 0.0 < decided.speed_share <= 1.0
        assert abs(send - measured) <= figures.lead + EPS or not figures.low < measured < figures.high, (
            f"{axis} is led too far"
        )
        middle = self.armed_at.get(axis, measured)
        low, high = max(figures.low, middle - figures.window), min(figures.high, middle + figures.window)
        last = self.sent.get(axis, measured)
        assert min(low, last, measured) - EPS <= send <= max(high, last, measured) + EPS, f"{axis} out of bounds"
        if axis in LIFTS or figures.profile_in_device:
            return  # its pace is the lift pair's, or the device's own: the lead bounds it
        nearer = abs(send - measured) <= abs(last - measured) + EPS
        assert abs(send - last) <= figures.speed * min(dt_s, LATE_S) + EPS or nearer, (
            f"{axis} jumps from {last} to {send}"
        )


def moved_by(preset: Preset) -> frozenset[str]:
    """Axes that a preset may move."""
    named = {
        "rotation": preset.rotation_deg is not None,
        **dict.fromkeys(LIFTS, preset.height_mm is not None or preset.slope_deg is not None),
        "tilt": preset.pitch_deg is not None,
    }
    return frozenset(axis for axis, moves in named.items() if moves)


def fresh(sensed: Sensed, axis: str) -> float | None:
    reading = sensed.axes[axis].telemetry.position
    if reading is None or not reading.valid or not math.isfinite(reading.value):
        return None
    return reading.value if sensed.now_s - reading.time_s <= FIGURES[axis].max_age_s else None


def row_of(fault: DeviceFault) -> str:
    return f"{'actuator' if fault.device in ACTUATORS else fault.device}.{fault.condition}"


def reaction_of(fault: DeviceFault) -> Reaction:
    """The reaction of a fault that counts at once; of one that has to last first, nothing is said."""
    row = CATALOGUE[row_of(fault)]
    return row.reaction if not row.debounce_s else Reaction.WARN


def held_now(sensed: Sensed, auto: bool) -> frozenset[str]:
    """Axes that must not move in this tick."""
    held: set[str] = set()
    for fault in sensed.faults:
        row, reaction = CATALOGUE[row_of(fault)], reaction_of(fault)
        if reaction >= Reaction.DISARM:
            return frozenset(AXES)
        if reaction >= Reaction.HOLD and (auto or not row.automatic_only):
            parts = {PARTS[fault.device]} if row.axes == frozenset({"own"}) else row.axes
            held |= {axis for axis, part in PARTS.items() if part in parts}
    return frozenset(held)


@dataclass
class World:
    """A machine that mostly does as told, clients that do as they like, and trouble."""

    chance: random.Random
    now_s: float = 1000.0
    at: dict[str, float] = field(
        default_factory=lambda: {"rotation": 0.0, "lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0}
    )
    readings: dict[str, Reading[float] | None] = field(default_factory=dict)
    faults: dict[str, tuple[DeviceFault, int]] = field(default_factory=dict)
    silent: dict[str, int] = field(default_factory=dict)
    jammed: dict[str, int] = field(default_factory=dict)
    powered: bool = False
    wanted_n: int = 0
    zone: Zone = Zone.NONE
    stop_n: int = 0
    client: str = "a"

    def sense(self, tick: Tick | None) -> Sensed:
        chance = self.chance
        dt_s = chance.choices((0.02, 0.0, 0.001, 0.05, 0.15, 0.4, 2.0, 300.0), (200, 3, 3, 8, 3, 1, 0.3, 0.05))[0]
        self.now_s += dt_s
        if tick is not None:
            self._follow(tick, dt_s)
        self._trouble()
        for axis in AXES:
            if self.silent.get(axis, 0) > 0:
                continue
            if axis == "rotation" or chance.random() < 0.2 or axis not in self.readings:
                age_s = chance.choices((0.0, 0.01, -5.0, 0.3, 3.0), (60, 40, 0.05, 0.05, 0.05))[0]
                value = self.at[axis] if chance.random() > 0.0002 else chance.choice((math.nan, math.inf, -1e9))
                self.readings[axis] = Reading(value, self.now_s - age_s, valid=chance.random() > 0.0005)
        lifecycle = Lifecycle.ACTIVE if self.powered else Lifecycle.STANDBY
        sending = [] if tick is None else [axis for axis in AXES if tick.axes[axis].send is not None]
        return Sensed(
            self.now_s,
            {
                axis: AxisSensed(
                    lifecycle,
                    RotatorTelemetry(angle_deg=self.readings.get(axis))
                    if axis == "rotation"
                    else ActuatorTelemetry(position_mm=self.readings.get(axis)),
                )
                for axis in AXES
            },
            faults=tuple(fault for fault, _ in self.faults.values()),
            commands=self._commands(tick),
            observation=self._observation(),
            powered=self.powered,
            arm_error="no reply" if chance.random() < 0.0005 else "",
            refused={axis: "soft limit" for axis in sending if chance.random() < 0.001},
            late_s=chance.choice((0.0, 0.0, 0.0, 0.15, 0.7)) if chance.random() < 0.01 else 0.0,
        )

    def _follow(self, tick: Tick, dt_s: float) -> None:
        wanted = tick.intents.power
        drops = self.chance.random() < 0.0005
        self.wanted_n = self.wanted_n + 1 if wanted and not drops else 0
        self.powered = self.wanted_n > 5
        self.stop_n = tick.state.stop_n
        for axis in AXES:
            send = tick.axes[axis].send
            if send is not None and not self.jammed.get(axis):
                most = 1.2 * FIGURES[axis].speed * max(dt_s, 0.001)
                self.at[axis] += min(max(send - self.at[axis], -most), most)

    def _trouble(self) -> None:
        chance = self.chance
        for kept in (self.silent, self.jammed):
            for axis in AXES:
                kept[axis] = max(0, kept.get(axis, 0) - 1)
                if chance.random() < 0.001:
                    kept[axis] = chance.choice((3, 10, 30, 100))
        if chance.random() < 0.002:
            axis = chance.choice(AXES)
            self.at[axis] += chance.gauss(0.0, 0.2 * (FIGURES[axis].high - FIGURES[axis].low))  # somebody pushes it
        self.faults = {name: (fault, n - 1) for name, (fault, n) in self.faults.items() if n > 0}
        if chance.random() < 0.006:
            part, _, condition = chance.choice(list(CATALOGUE)).partition(".")
            device = chance.choice(ACTUATORS) if part == "actuator" else part
            if not (device == "daemon" and condition in ("loop_blocked", "tick_overrun", "lease_lapsed")):
                fault = DeviceFault(device, condition, "", self.now_s)
                self.faults[fault.name] = (fault, chance.choice((1, 2, 10, 50)))

    def _observation(self) -> SoilObservation | None:
        chance = self.chance
        if chance.random() < 0.01:
            self.zone = chance.choice(list(Zone))
        if chance.random() > 0.5:
            return None
        zone = self.zone if chance.random() > 0.1 else chance.choice(list(Zone))
        age_s = chance.choices((0.03, 0.5, 4.0, -4.0), (50, 3, 1, 0.3))[0]
        share = {zone: 0.8}
        return SoilObservation(
            self.now_s - age_s, zone, chance.choice((0.9, 0.9, 0.2)), "",
            share.get(Zone.LEFT, 0.1), share.get(Zone.CENTER, 0.1), share.get(Zone.RIGHT, 0.1),
        )  # fmt: skip

    def _commands(self, tick: Tick | None) -> tuple[cmd.AnyCommand, ...]:
        """Mostly what leads to motion, so that there is something to judge; then anything."""
        chance = self.chance
        mode = "disarmed" if tick is None else str(tick.state.mode)
        made: list[cmd.AnyCommand] = []
        if mode == "manual" and tick is not None and tick.state.lease is not None and chance.random() < 0.25:
            made.append(cmd.Renew(client=self.client))
        if chance.random() < 0.05:
            likely: dict[str, list[cmd.AnyCommand]] = {
                "stopped": [cmd.Reset(stop_n=self.stop_n, client=self.client)],
                "disarmed": [cmd.Arm(client=self.client)],
                "manual": [self._jog(), self._jog(), cmd.Auto(client=self.client)],
                "auto": [cmd.Auto(client=self.client), cmd.Manual(client=self.client)],
            }
            made.append(chance.choice(likely[mode]))
        while chance.random() < 0.008:
            client = self.client = chance.choice(("a", "b", ""))
            made.append(
                chance.choice(
                    (
                        cmd.Arm(client=client), cmd.Disarm(client=client), cmd.Stop(client=client), self._jog(),
                        cmd.Reset(client=client, stop_n=max(0, self.stop_n - chance.choice((0, 0, 1)))),
                        cmd.Auto(client=client), cmd.Manual(client=client), cmd.Renew(client=client),
                        cmd.Release(client=client),
                        cmd.Preset(client=client, name=chance.choice(tuple(CONFIG.presets))),
                    )
                )
            )  # fmt: skip
        return tuple(made)

    def _jog(self) -> cmd.Jog:
        axis = self.chance.choice(tuple(JOG_AXES))
        middle, spread = {
            "rotate": (0.0, 30.0), "lift": (150.0, 50.0), "tilt": (50.0, 20.0), "height": (40.0, 40.0),
            "slope": (0.0, 4.0), "pitch": (0.0, 5.0),
        }[axis]  # fmt: skip
        relative = self.chance.random() < 0.3
        value = self.chance.gauss(0.0 if relative else middle, spread)
        return cmd.Jog(axis=axis, value=value, relative=relative, client=self.client)


def run(seed: int, ticks_n: int, monitor: Monitor) -> None:
    world, controller, tick = World(random.Random(seed)), Controller(SETTINGS), None
    for number in range(ticks_n):
        sensed = world.sense(tick)
        tick = controller.step(sensed)
        try:
            monitor.judge(sensed, tick)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}, tick {number}: {error}") from error


@pytest.mark.slow
@pytest.mark.timeout(120.0 + 0.01 * TICKS_N)
def test_nothing_moves_that_must_not() -> None:
    moved, decided_n = dict.fromkeys(AXES, 0), 0
    for seed in range(max(1, TICKS_N // RUN_N)):
        monitor = Monitor()
        run(seed, RUN_N, monitor)
        decided_n += monitor.decided_n
        moved = {axis: moved[axis] + monitor.moves_n[axis] for axis in AXES}
    assert all(n > TICKS_N / 500 for n in moved.values()), f"too little moved for a judgement: {moved}"
    assert decided_n > TICKS_N / 500, "automatic operation hardly turned anything"


def _first_motion() -> tuple[Sensed, Tick, Monitor]:
    """A tick in which the rotation moves, and the monitor as it was before."""
    monitor, world, controller, tick = Monitor(), World(random.Random(0)), Controller(SETTINGS), None
    for _ in range(RUN_N):
        before = copy.deepcopy(monitor)
        sensed = world.sense(tick)
        tick = controller.step(sensed)
        monitor.judge(sensed, tick)
        if tick.axes["rotation"].send is not None and before.lease is not None and not sensed.commands:
            return sensed, tick, before
    raise AssertionError("the rotation never moved")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"stopped": True}, "stopped"),
        ({"armed": False}, "disarmed"),
        ({"lease": None}, "without a lease"),
        ({"lease": ("a", 0.0)}, "without a lease"),
        ({"asked": frozenset({"tilt"})}, "nobody asked"),
        ({"armed_at": {"rotation": 1000.0}}, "bounds"),
    ],
)
def test_the_monitor_sees_what_it_is_for(wrong: dict[str, object], said: str) -> None:
    sensed, tick, monitor = _first_motion()
    for name, value in wrong.items():
        setattr(monitor, name, value)
    with pytest.raises(AssertionError, match=said):
        monitor.judge(sensed, tick)


def test_the_monitor_sees_a_goal_led_too_far() -> None:
    sensed, tick, monitor = _first_motion()
    axis = tick.axes["rotation"]
    assert axis.send is not None
    for offset, said in ((30.0, "led too far"),):
        changed = tick._replace(axes={**tick.axes, "rotation": axis._replace(send=axis.send + offset)})
        with pytest.raises(AssertionError, match=said):
            copy.deepcopy(monitor).judge(sensed, changed)
