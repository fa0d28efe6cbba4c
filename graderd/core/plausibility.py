"""Whether the axes move as they were told: one judgement for every axis and every device, from readings and goals.

Five things are told: *not moving* (a goal ahead and no movement), *not arriving* (movement, but hardly toward the
goal), *wrong way* (away from the goal), *uncommanded* (moved while it was to stay) and *overspeed*. All are judged by
displacement: speeds are noisy, and a blade that creeps goes as far in the end as one that runs.

Readings arrive at their own rates; the monitor is called every tick, and a reading seen before is no new one. Pure: no
clock and no device.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from pydantic import Field

from graderd.core.axes import ACTUATORS, UNITS, AxisFigures
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.settings import ActuatorSettings, NotNegative, Positive, RotatorSettings, Settings


class MotionFigures(Settings):
    """What is plausible for one axis, in its unit (``graderd.core.axes.UNITS``) and seconds."""

    speed: Positive = Field(description="fastest that the gate lets its goal move: overspeed and arrival go by it")
    fastest: Positive = Field(description="fastest that its device drives it: braking from it takes longest")
    acceleration: Positive = Field(description="how hard its device brakes at least, per second squared")
    near: Positive = Field(description="this close to its goal it has arrived: devices rest so far from it")
    tolerance: Positive = Field(description="displacement that play, load and noise may cause at rest")
    still: Positive = Field(description="slower than this is noise of the speed reading")
    reaction_s: NotNegative = Field(description="from a goal to the first reading that shows its effect")
    rest_s: Positive = Field(description="once it has braked, so long until it rests")
    moved: Positive = Field(description="a movement that shows that it is not stuck: more than play and noise")
    not_moving_s: Positive = Field(description="a goal ahead and no movement for so long: breaking away takes less")
    not_arriving_s: Positive = Field(description="so long with hardly any way made toward the goal")
    wrong_way: Positive = Field(description="so far away from the goal: more than play and load do at a start")
    wrong_way_s: NotNegative = Field(description="and for so long, that one odd reading tells nothing")
    overspeed_margin: Positive = Field(description="way gained on the permitted speed before it is overspeed")
    gap_s: Positive = Field(0.5, description="readings further apart say nothing about what was between them")

    @property
    def overrun(self) -> float:
        """The longest way from any permitted speed to rest."""
        return self.fastest * self.reaction_s + _OVERRUN_FACTOR * self.fastest**2 / (2.0 * self.acceleration)

    def braking_s(self, speed: float) -> float:
        """How long braking from ``speed`` takes; a runaway's speed counts as no more than the fastest permitted."""
        return _BRAKING_FACTOR * min(speed, self.fastest) / self.acceleration


_OVERRUN_FACTOR = 1.5
_BRAKING_FACTOR = 1.2
"""Real braking is not as even as the profile."""
_OVERSPEED_FACTOR = 1.5
"""So much faster than permitted is no lag that is being made up for."""
_LEAST_SHARE = 0.1
"""The slowest move (a lift at its lowest duty under load) makes more way than this share of the permitted speed."""
_LEAST_FOLLOWING = 0.5
"""A goal close by, or one that moves slowly, asks for no more way than this share of its own."""
_SETTLE_S = 0.5
"""After the move's own duration, so much more until the axis is expected to stand at its goal."""
_SAME_GOAL = 0.05


def motion_figures(
    rotation: RotatorSettings, actuators: Mapping[str, ActuatorSettings], figures: Mapping[str, AxisFigures]
) -> dict[str, MotionFigures]:
    """For every axis in ``figures``, from its section of the configuration; what stands here as a number is not the
    device's: play of 0.1 degree at the blade and 0.5 mm at a rod, and a noise of 0.1 mm in a position.
    """
    found: dict[str, MotionFigures] = {}
    for axis, its in figures.items():
        if axis == "rotation":
            found[axis] = MotionFigures(
                speed=its.speed,
                fastest=rotation.profile_velocity_deg_per_s,
                acceleration=rotation.profile_acceleration_deg_per_s2,
                near=its.tolerance,
                tolerance=its.tolerance,
                still=0.8,
                reaction_s=0.0,
                rest_s=0.3,
                moved=min(0.2, 0.3 * rotation.profile_velocity_deg_per_s * rotation.not_moving_s),
                not_moving_s=rotation.not_moving_s,
                not_arriving_s=4.0 * rotation.not_moving_s,
                wrong_way=1.0,
                wrong_way_s=0.15,
                overspeed_margin=3.0,
            )
        else:
            own = actuators[axis]
            found[axis] = MotionFigures(
                speed=its.speed,
                fastest=max(its.speed, own.fastest_mm_per_s),
                acceleration=own.braking_mm_per_s2,
                near=2.0 * its.tolerance,
                tolerance=its.tolerance + 0.5,
                still=1.0,
                reaction_s=own.reaction_s,
                rest_s=0.3,
                moved=0.5,
                not_moving_s=own.not_moving_s,
                not_arriving_s=4.0 * own.not_moving_s,
                wrong_way=1.5,
                wrong_way_s=0.0,
                overspeed_margin=10.0,
            )
    return found


class AxisSample(NamedTuple):
    """What is known of one axis at a tick; position, velocity and goal in its unit.

    ``time_s``: when the position was measured. ``velocity``: None where the device gives none; it follows from the
    positions then. ``goal``: where the device drives the axis to now; None where it lets it stay. ``powered``: whether
    the device may move at all. ``current_a``: only for the words of a fault.
    """

    name: str
    position: float
    time_s: float
    velocity: float | None
    goal: float | None
    powered: bool
    current_a: float | None = None


def axis_sample(name: str, lifecycle: Lifecycle, told: RotatorTelemetry | ActuatorTelemetry) -> AxisSample | None:
    """The sample that a device's telemetry gives; None without a valid position.

    None, too, of a disarmed blade whose servo says that its torque is off: a person may turn that by hand, and is asked
    to (``graderd calibrate rotation``). Where the torque is on, or not known, whatever turns is uncommanded.
    """
    position, velocity, current = told.position, told.velocity, told.current_a
    if position is None or not position.valid:
        return None
    torque_on = told.torque_on if isinstance(told, RotatorTelemetry) else None
    if lifecycle is not Lifecycle.ACTIVE and torque_on is not None and torque_on.valid and not torque_on.value:
        return None
    return AxisSample(
        name,
        position.value,
        position.time_s,
        None if velocity is None else velocity.value,
        told.goal,
        lifecycle is Lifecycle.ACTIVE,
        None if current is None else current.value,
    )


class PlausibilityMonitor:
    """Watches all axes. :meth:`judge` is called every tick."""

    def __init__(self, figures: Mapping[str, MotionFigures]) -> None:
        self._watches = {axis: _AxisWatch(axis, its) for axis, its in figures.items()}

    def judge(self, samples: Iterable[AxisSample], now_s: float) -> tuple[DeviceFault, ...]:
        """What is implausible now; each is shown for a second after it was seen last.

        An axis without a sample has no valid reading: nothing is concluded about it, until it has one again.
        """
        known = {sample.name: sample for sample in samples}
        found: list[DeviceFault] = []
        for axis, watch in self._watches.items():
            found += watch.judge(known.get(axis), now_s)
        return tuple(found)


class _AxisWatch:
    """One axis. It is either *driven* (it has a goal) or *held*, and each change of that begins anew."""

    def __init__(self, name: str, figures: MotionFigures) -> None:
        self._figures = figures
        self._faults = PresentFaults(name)
        actuator = name in ACTUATORS
        self._uncommanded = "uncommanded_motion" if actuator else "moving_uncommanded"
        self._wrong_way = "uncommanded_motion" if actuator else "wrong_way"
        self._unit = "°" if UNITS[name] == "deg" else " mm"
        self._last: AxisSample | None = None
        self._velocity = self._gained = 0.0
        # held or settled at its goal: where it rests, once it does
        self._rest: float | None = None
        self._held_since_s = self._settle_s = self._held_from = self._unseen = 0.0
        # driven
        self._goal: float | None = None
        self._goal_since_s = self._move_s = 0.0
        self._mark = self._mark_s = 0.0
        self._direction = 0.0
        self._furthest = self._furthest_s = self._most_away = self._braking_s = 0.0
        self._way_from = self._way_since_s = self._way_goal = 0.0

    def judge(self, sample: AxisSample | None, now_s: float) -> tuple[DeviceFault, ...]:
        last = self._last
        if sample is not None and last is not None and sample.time_s - last.time_s > self._figures.gap_s:
            last = None
        self._last = sample
        if sample is not None:
            new = last is None or sample.time_s > last.time_s
            if new:
                self._take_velocity(sample, last)
            # Also between two readings: a goal given and taken back meanwhile has moved the axis all the same.
            self._follow(sample, last, now_s)
            if new:
                too_fast = self._too_fast(sample, last)
                if self._goal is None:
                    self._held(sample)
                else:
                    self._driven(sample, self._goal, too_fast)
        return self._faults.present(now_s)

    # -- what it was told -------------------------------------------------------------------------------------------

    def _take_velocity(self, s: AxisSample, last: AxisSample | None) -> None:
        if s.velocity is not None:
            self._velocity = s.velocity
        else:
            self._velocity = 0.0 if last is None else (s.position - last.position) / (s.time_s - last.time_s)

    def _follow(self, s: AxisSample, last: AxisSample | None, now_s: float) -> None:
        goal = s.goal if s.powered else None
        if last is None:
            self._gained = 0.0
        if last is None or (goal is None) != (self._goal is None) or s.powered != last.powered:
            self._rest = None
            self._held_since_s, self._held_from = now_s, s.position
            # A reading of a bad line may be old: what the axis went on to its goal since was commanded.
            self._unseen = self._figures.fastest * max(0.0, now_s - s.time_s)
            self._settle_s = self._figures.rest_s + self._figures.braking_s(abs(self._velocity))
            self._mark, self._mark_s = s.position, now_s
            self._direction = 0.0
            self._goal = None
        if goal is not None and (self._goal is None or abs(goal - self._goal) > _SAME_GOAL):
            self._rest = None
            self._goal, self._goal_since_s = goal, now_s
            self._move_s = self._duration_s(abs(goal - s.position), abs(self._velocity))
            if abs(goal - s.position) > self._figures.near:
                self._set_direction(s, goal)

    def _duration_s(self, way: float, speed: float) -> float:
        """How long a move takes at the device's own speed, braking from a speed in the wrong direction first."""
        top, acceleration = self._figures.fastest, self._figures.acceleration
        way += speed**2 / acceleration
        if way < top**2 / acceleration:
            move_s = 2.0 * math.sqrt(way / acceleration)
        else:
            move_s = way / top + top / acceleration
        return move_s + speed / acceleration + self._figures.reaction_s

    # -- judgement --------------------------------------------------------------------------------------------------

    def _too_fast(self, s: AxisSample, last: AxisSample | None) -> bool:
        """The way gained on what is permitted: it grows while the axis is too fast and shrinks while it is not."""
        if last is None:
            return False
        permitted = _OVERSPEED_FACTOR * self._figures.speed
        moved, took_s = s.position - last.position, s.time_s - last.time_s
        self._gained = max(0.0, self._gained + abs(moved) - permitted * took_s)
        if self._gained <= self._figures.overspeed_margin:
            return False
        self._gained = 0.0  # told anew only after another margin, so that it ends a second after the speed did
        unit = self._unit
        detail = f"{abs(moved) / took_s:.0f}{unit}/s, {self._figures.speed:g}{unit}/s are permitted"
        self._faults.tell("overspeed", detail, s.time_s)
        return True

    def _held(self, s: AxisSample) -> None:
        """Displacement from where it was held; while it may still be braking, more than that can take it."""
        figures = self._figures
        rest, allowed = self._rest, figures.tolerance
        if rest is None:
            rest, allowed = self._held_from, self._unseen + figures.overrun + figures.tolerance
        if self._displaced(s, rest, allowed, " without a command"):
            self._rest = s.position  # told again when it goes on, and over when it does not
        elif self._rest is None and s.time_s - self._held_since_s >= self._settle_s:
            self._rest = s.position

    def _displaced(self, s: AxisSample, rest: float, allowed: float, how: str) -> bool:
        moved = s.position - rest
        if abs(moved) <= allowed:
            return False
        self._faults.tell(self._uncommanded, f"moved {moved:+.1f}{self._unit}{how}{_at(s)}", s.time_s)
        return True

    def _driven(self, s: AxisSample, goal: float, too_fast: bool) -> None:
        error = goal - s.position
        if abs(error) <= self._figures.near:
            self._mark, self._mark_s = s.position, s.time_s
            self._direction = 0.0
            if self._rest is None and s.time_s - self._goal_since_s >= self._move_s + _SETTLE_S:
                self._rest = s.position
            return
        if self._rest is not None and self._displaced(s, self._rest, self._figures.tolerance, " away from its goal"):
            self._rest = None
        self._set_direction(s, goal)
        self._away(s, error, too_fast)
        if not self._stuck(s, error):
            self._arriving(s, goal, error)

    def _set_direction(self, s: AxisSample, goal: float) -> None:
        """Where its goal lies; one on the other side of a moving axis is legal, and leaves it the time to brake."""
        direction = math.copysign(1.0, goal - s.position)
        if direction == self._direction:
            return
        figures, opposed = self._figures, -direction * self._velocity
        self._direction = direction
        self._furthest, self._furthest_s, self._most_away = s.position, s.time_s, 0.0
        self._braking_s = figures.reaction_s + figures.braking_s(opposed) if opposed > figures.still else 0.0
        self._way_from, self._way_since_s, self._way_goal = s.position, s.time_s, goal

    def _away(self, s: AxisSample, error: float, too_fast: bool) -> None:
        figures = self._figures
        away = (self._furthest - s.position) * self._direction
        self._most_away = max(self._most_away, away)
        if away < 0.0 or away < self._most_away - figures.moved:
            # It obeys: what it does from here on is not the braking of what it did before.
            self._furthest, self._most_away, self._braking_s, away = s.position, 0.0, 0.0, 0.0
        if away <= figures.moved and not self._braking_s:
            self._furthest_s = s.time_s
        lasted_s = s.time_s - self._furthest_s
        allowed_s = figures.wrong_way_s + self._braking_s
        # A runaway is not given the time that braking would take: nobody brakes from a speed that is not permitted,
        # and no permitted one takes so far.
        runaway = too_fast or away > figures.wrong_way + figures.overrun
        if away > figures.wrong_way and (lasted_s >= allowed_s or runaway):
            unit = self._unit
            detail = f"went {away:.1f}{unit} away from its goal in {lasted_s:.2f} s, {error:+.1f}{unit} to go{_at(s)}"
            self._faults.tell(self._wrong_way, detail, s.time_s)

    def _stuck(self, s: AxisSample, error: float) -> bool:
        if abs(s.position - self._mark) > self._figures.moved:
            self._mark, self._mark_s = s.position, s.time_s
        stuck_s = s.time_s - self._mark_s
        if stuck_s <= self._figures.not_moving_s:
            return False
        detail = f"{error:+.1f}{self._unit} to go, no movement for {stuck_s:.1f} s{_at(s)}"
        self._faults.tell("not_moving", detail, s.time_s)
        return True

    def _arriving(self, s: AxisSample, goal: float, error: float) -> None:
        figures = self._figures
        made = (s.position - self._way_from) * self._direction
        asked = max(abs(goal - self._way_goal), abs(self._way_goal - self._way_from))
        least = min(_LEAST_SHARE * figures.speed * figures.not_arriving_s, _LEAST_FOLLOWING * asked)
        took_s = s.time_s - self._way_since_s
        if made >= least:
            self._way_from, self._way_since_s, self._way_goal = s.position, s.time_s, goal
        elif took_s > figures.not_arriving_s:
            unit = self._unit
            detail = f"{error:+.1f}{unit} to go, only {made:+.1f}{unit} made in {took_s:.1f} s{_at(s)}"
            self._faults.tell("not_arriving", detail, s.time_s)


def _at(s: AxisSample) -> str:
    return "" if s.current_a is None else f" at {abs(s.current_a):.1f} A"
