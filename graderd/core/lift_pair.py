"""Two lifts as one axis pair: both sides stay together on the straight line from where they are to their targets.

Each lift reports its position only every 105 ms, one may be much slower than the other (load, wear, supply), and the
motors know speed only as a share of full speed. The coordinator learns how fast each side is for a given share, gives
the pair the pace of the slower one, and corrects the rest by how far each side is ahead or behind. A side that is lost
or does not move stops the other.

Pure: no clock, no device; :meth:`LiftPair.step` is called every control tick with the newest readings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from pydantic import Field, model_validator

from graderd.core.axes import LIFTS, AxisFigures, Goals
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.settings import Positive, Settings


class LiftPairSettings(Settings):
    """How closely the sides are kept together. Shares are of the lifts' ``speed_percent``."""

    full_speed_mm_per_s: Positive = Field(
        33.0, le=100.0, description="guess of a lift's speed at speed share 1, until learned; no Electrak does 100"
    )
    first_share: Positive = Field(
        1.0, le=1.0, description="speed share while a side's speed is still unknown; less is slower, and gentler"
    )
    approach_share: Positive = Field(
        0.7, le=1.0, description="speed share near the target, where an Electrak slows down to 35 % duty by itself"
    )
    min_share: Positive = Field(0.5, le=1.0, description="slowest speed share at which a lift moves well: 25 % duty")
    catch_up_hz: Positive = Field(
        4.0, le=8.0, description="how much slower the side ahead goes, mm/s for each mm; it would hunt with more than 8"
    )
    wait_mm: Positive = Field(
        2.85, le=6.0, description="the side ahead stops from here on until the other has come up; at most stop_apart_mm"
    )
    level_mm: Positive = Field(0.8, le=3.0, description="the other has come up when it is this close")
    apart_mm: Positive = Field(3.0, le=6.0, description="further apart than this is a fault")
    stop_apart_mm: Positive = Field(
        8.0, le=10.0, description="further apart than this stops both; 10 mm rack the blade's frame (0.7 degree)"
    )
    stuck_s: Positive = Field(
        0.9,
        ge=0.5,
        le=2.0,
        description="a commanded side that does not move for so long is stuck; starting takes 0.4 s",
    )
    silent_s: Positive = Field(
        0.135,
        ge=0.12,
        le=0.6,
        description="a position older than this holds both until there is a newer one; 0.105 s are a feedback period",
    )
    reading_max_age_s: Positive = Field(
        0.35, ge=0.25, le=3.0, description="an older position counts as lost and stops both; the sides hold by then"
    )

    @model_validator(mode="after")
    def _order(self) -> LiftPairSettings:
        for less, more in (
            ("silent_s", "reading_max_age_s"),
            ("wait_mm", "stop_apart_mm"),
            ("min_share", "first_share"),
        ):
            if not getattr(self, less) < getattr(self, more):
                raise ValueError(f"{less} ({getattr(self, less):g}) must be below {more} ({getattr(self, more):g})")
        return self


class SideReading(NamedTuple):
    """Measured extension of one lift and the monotonic time it was measured at."""

    position_mm: float
    time_s: float


class SideCommand(NamedTuple):
    """What one lift shall do now: go to ``target_mm`` at ``speed_share`` (0 exclusive to 1), or hold (None)."""

    target_mm: float | None
    speed_share: float = 1.0


class PairCommand(NamedTuple):
    """Commands for both sides; ``apart_mm`` is how far they are from being level with each other on their way.

    ``condition`` is ``sides_apart`` or empty; ``stopped`` says why both hold until the pair is released, or is empty.
    """

    left: SideCommand
    right: SideCommand
    apart_mm: float = 0.0
    condition: str = ""
    stopped: str = ""


_HOLD_BOTH: Final = PairCommand(SideCommand(None), SideCommand(None))
_SOFT_START_S: Final = 0.2
"""An Electrak takes so long from rest to the speed that it was told, evenly; slower it goes at once."""
_BREAK_AWAY_SHARE: Final = 0.4
"""It does not turn before so much of it: 20 % duty of 50."""
_IDLE_SHARE: Final = 0.06
"""So much of it only keeps it from standing: speed begins from there on, on a straight line (3 % duty of 50)."""
_INERTIA_S: Final = 0.025
"""From the motor's duty to the tube's speed, and to the bus."""
_MIN_DRIVE_S: Final = 0.01
_KNOWN_MM: Final = 4.0
"""A side's speed counts as known after this much movement."""
_SHARE_STEP: Final = 0.05
_SLOWEST: Final = 0.2
"""Part of the guessed speed."""
_GUESS_DRIVE_S: Final = 0.06
"""What is guessed before anything was seen weighs as much as so much drive."""
_HINT_DRIVE_S: Final = 0.15
"""What is known of the other direction weighs as much as so much drive in this one, until that is seen."""
_FORGET: Final = 0.85
_TAPER_MM: Final = 6.0
"""Lifts slow down by themselves this close to their target."""
_NEAR_MM: Final = 8.0
"""From here on the pair goes no faster than they will."""
_END_MM: Final = 3.0
"""This close to its target it stops by itself: nothing is learned there."""
_STICKS: Final = 0.65
"""A side that made less than this part of the way expected of it between two readings sticks. One that stuck in the
later two thirds of a period is seen with the next reading, one and a third periods after."""
_STICKS_MM: Final = 0.7
"""And lacks at least so much: more than noise and the readings' times."""
_AHEAD_N: Final = 3
"""A side is held back when it is too far ahead in so many steps; a single estimate is too noisy for that."""
_FAR_AHEAD: Final = 1.3
"""So many times the distance from which the side ahead waits are no noise: it is held back at once."""
_STILL_MM_PER_S: Final = 2.0
_PARALLEL_MM: Final = 3.0
"""Ways that differ by less are meant to be equal."""
_START_MM: Final = 1.3
"""A lift does not start for less than this."""
_MOVED_MM: Final = 0.5
_NEW_TARGET_MM: Final = 0.05


@dataclass(slots=True)
class _Side:
    """One lift: its way, its newest reading, and how fast it is for a speed share.

    ``acting_share`` is the commanded one after a soft start, ``turning`` what it makes of it, as a part of its full
    speed, and ``drive_s`` the time integral of that; a side's gain is millimetres for one second of it. Position
    between two readings is the last one plus gain times the drive since.
    ``sticks``: it ran, and made hardly any of the way that was expected of it between the last two readings.
    """

    guess_mm_per_s: float
    start_mm: float = 0.0
    target_mm: float = 0.0
    position_mm: float = 0.0
    velocity_mm_per_s: float = 0.0
    reading: SideReading | None = None
    reading_drive_s: float = 0.0
    share: float = 0.0
    acting_share: float = 0.0
    turning: float = 0.0
    drive_s: float = 0.0
    runs: bool = False
    sticks: bool = False
    learned: dict[int, tuple[float, float]] = field(default_factory=dict)
    moved_at_s: float = 0.0
    moved_from_mm: float = 0.0

    @property
    def way_mm(self) -> float:
        return self.target_mm - self.start_mm

    @property
    def way_sign(self) -> int:
        """1 where the way of this move extends the lift, -1 where it retracts it."""
        return 1 if self.way_mm >= 0 else -1

    @property
    def direction(self) -> int:
        """By what was measured: an estimate may pass the target, the lift does not."""
        at_mm = self.position_mm if self.reading is None else self.reading.position_mm
        return 1 if self.target_mm >= at_mm else -1

    @property
    def known(self) -> bool:
        """Whether enough was seen of it to say how fast it is, in either direction: wear and supply are the same."""
        return any(moved_mm > _KNOWN_MM for moved_mm, _ in self.learned.values())

    @property
    def gain_mm_per_s(self) -> float:
        """Speed at share 1 in the present direction; one that hardly moved is not thought slower than the slowest."""
        moved_mm, drive_s = self._seen(self.direction)
        return max(moved_mm / drive_s, _SLOWEST * self.guess_mm_per_s)

    def _seen(self, direction: int) -> tuple[float, float]:
        """What is known of a direction: from itself, from the other one, or guessed."""
        if direction in self.learned:
            return self.learned[direction]
        other_mm, other_s = self.learned.get(-direction, (0.0, 0.0))
        if other_mm > _KNOWN_MM:
            return other_mm / other_s * _HINT_DRIVE_S, _HINT_DRIVE_S
        return self.guess_mm_per_s * _GUESS_DRIVE_S, _GUESS_DRIVE_S

    def halt(self) -> None:
        """It is told to hold: nothing drives it from now on."""
        self.share = self.acting_share = self.turning = 0.0
        self.runs = self.sticks = False

    def drive(self, elapsed_s: float, approach_share: float) -> None:
        """Let time pass. Near its target it goes no faster than ``approach_share``, whatever it was told."""
        if self.share <= self.acting_share:
            self.acting_share = self.share
        else:
            self.acting_share = min(self.share, self.acting_share + self.share * elapsed_s / _SOFT_START_S)
        tapers = abs(self.target_mm - self.position_mm) < _TAPER_MM
        acting = min(self.acting_share, approach_share) if tapers else self.acting_share
        turning = (acting - _IDLE_SHARE) / (1.0 - _IDLE_SHARE) if acting >= _BREAK_AWAY_SHARE else 0.0
        self.turning += (turning - self.turning) * (1.0 - math.exp(-elapsed_s / _INERTIA_S))
        self.drive_s += self.turning * elapsed_s

    def see(self, reading: SideReading, now_s: float, *, learn: bool) -> None:
        """Take the newest reading (which may be the one of before)."""
        last = self.reading
        if last is None or reading.time_s > last.time_s:
            drive_s = max(self.reading_drive_s, self.drive_s - self.turning * max(0.0, now_s - reading.time_s))
            if last is not None:
                self.velocity_mm_per_s = (reading.position_mm - last.position_mm) / (reading.time_s - last.time_s)
                self._judge((reading.position_mm - last.position_mm) * self.direction, drive_s, learn=learn)
            self.reading, self.reading_drive_s = reading, drive_s
        coming_mm = 0.0 if self.sticks else self.gain_mm_per_s * (self.drive_s - self.reading_drive_s)
        remaining_mm = abs(self.target_mm - reading.position_mm)
        if remaining_mm < _NEAR_MM:  # it stops by itself
            coming_mm = min(coming_mm, remaining_mm) if abs(self.velocity_mm_per_s) > _STILL_MM_PER_S else 0.0
        self.position_mm = reading.position_mm + self.direction * coming_mm

    def _judge(self, moved_mm: float, drive_s: float, *, learn: bool) -> None:
        """What a newer reading says: it sticks, or how fast it is."""
        driven_s = drive_s - self.reading_drive_s
        lacking_mm = self.gain_mm_per_s * driven_s - moved_mm
        ends = abs(self.target_mm - self.position_mm) < _END_MM
        lags = moved_mm < _STICKS * (moved_mm + lacking_mm)
        self.sticks = lags and lacking_mm > _STICKS_MM and self.known and not ends and (self.runs or self.sticks)
        self.runs = driven_s > _MIN_DRIVE_S and not lags
        if learn and not self.sticks and not ends and driven_s > _MIN_DRIVE_S and moved_mm >= 0.0:
            old_mm, old_s = self._seen(self.direction)
            self.learned[self.direction] = (_FORGET * old_mm + moved_mm, _FORGET * old_s + driven_s)


class LiftPair:
    """Coordinator of one pair. One object for one pair; its memory is what it learned and the move in progress."""

    def __init__(self, settings: LiftPairSettings | None = None, max_speed_mm_per_s: float = math.inf) -> None:
        self._settings = settings or LiftPairSettings()
        self._max_speed_mm_per_s = max_speed_mm_per_s
        guess_mm_per_s = self._settings.full_speed_mm_per_s
        self._sides = (_Side(guess_mm_per_s), _Side(guess_mm_per_s))
        self._moving = False
        self._waiting: int | None = None
        self._ahead_n = 0
        self._stopped = ""
        self._last_s: float | None = None
        self._apart_mm = 0.0

    def release(self) -> None:
        """The pair is commanded no more: forget the move and why it was stopped, keep what was learned."""
        self._moving = False
        self._waiting = None
        self._stopped = ""
        self._last_s = None
        for side in self._sides:
            side.halt()
            side.reading = None
            side.velocity_mm_per_s = 0.0

    def step(
        self,
        now_s: float,
        left: SideReading | None,
        right: SideReading | None,
        left_target_mm: float,
        right_target_mm: float,
    ) -> PairCommand:
        """Commands for this tick. ``left`` and ``right`` are the newest readings, None where there is none."""
        if self._stopped:
            return self._stop(self._stopped)
        for name, reading in zip(LIFTS, (left, right), strict=True):
            if reading is None or now_s - reading.time_s > self._settings.reading_max_age_s:
                return self._stop(f"{name} is not measured")
        assert left is not None  # for the type checker; the loop above returned otherwise
        assert right is not None
        elapsed_s = 0.0 if self._last_s is None else min(max(0.0, now_s - self._last_s), 0.2)
        self._last_s = now_s
        if now_s - min(left.time_s, right.time_s) > self._settings.silent_s:
            return self._pause(now_s)
        for side, reading in zip(self._sides, (left, right), strict=True):
            side.drive(elapsed_s, self._settings.approach_share)
            side.see(reading, now_s, learn=self._moving and self._waiting is None)
        self._aim((left_target_mm, right_target_mm), now_s)
        stuck = self._stuck(now_s)
        if stuck:
            return self._stop(stuck)
        deviations_mm = self._deviations_mm()
        ahead_mm = [side.way_sign * deviation for side, deviation in zip(self._sides, deviations_mm, strict=True)]
        self._apart_mm = abs(ahead_mm[0] - ahead_mm[1])
        if self._apart_mm > self._settings.stop_apart_mm:
            return self._stop(f"the sides are {self._apart_mm:.1f} mm apart")
        self._wait(deviations_mm)
        commands = self._share(deviations_mm) if self._waiting is None else self._catch_up(self._waiting)
        condition = "sides_apart" if self._apart_mm > self._settings.apart_mm else ""
        return PairCommand(*commands, self._apart_mm, condition)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _stop(self, reason: str) -> PairCommand:
        self._stopped = reason
        self._moving = False
        condition = "sides_apart" if self._apart_mm > self._settings.apart_mm else ""
        return PairCommand(_HOLD_BOTH.left, _HOLD_BOTH.right, self._apart_mm, condition, reason)

    def _pause(self, now_s: float) -> PairCommand:
        """Nobody knows where one side is: both hold, and go on along their line when both are measured again."""
        for side in self._sides:
            side.halt()
            side.moved_at_s, side.moved_from_mm = now_s, side.position_mm
        return PairCommand(_HOLD_BOTH.left, _HOLD_BOTH.right, self._apart_mm)

    def _aim(self, targets_mm: tuple[float, float], now_s: float) -> None:
        """Begin a move, or bend the one in progress: the line then goes on from where the pair should be now."""
        if not self._moving:
            for side in self._sides:
                side.start_mm = side.position_mm
                side.moved_at_s, side.moved_from_mm = now_s, side.position_mm
        elif not _differ(targets_mm, (self._sides[0].target_mm, self._sides[1].target_mm)):
            return
        else:
            deviations_mm = self._deviations_mm()
            for side, deviation_mm in zip(self._sides, deviations_mm, strict=True):
                side.start_mm = side.position_mm - deviation_mm
        begins, self._moving = not self._moving, True
        for side, target_mm in zip(self._sides, targets_mm, strict=True):
            side.target_mm = target_mm
        left, right = self._sides
        if begins and abs(left.way_mm - right.way_mm) < _PARALLEL_MM:
            # meant as a parallel move: what the sides differ by now is where they rested, and is made up for on the way
            half_mm = (left.way_mm - right.way_mm) / 2.0
            left.start_mm, right.start_mm = left.start_mm + half_mm, right.start_mm - half_mm

    def _deviations_mm(self) -> tuple[float, float]:
        """How far each side is off the line, in mm of extension."""
        left, right = self._sides
        square = left.way_mm**2 + right.way_mm**2
        progress = 1.0
        if square > 0.01:
            done = left.way_mm * (left.position_mm - left.start_mm) + right.way_mm * (
                right.position_mm - right.start_mm
            )
            progress = min(max(done / square, 0.0), 1.0)
        return (
            left.position_mm - left.start_mm - progress * left.way_mm,
            right.position_mm - right.start_mm - progress * right.way_mm,
        )

    def _stuck(self, now_s: float) -> str:
        for name, side in zip(LIFTS, self._sides, strict=True):
            remaining_mm = abs(side.target_mm - side.position_mm)
            moved = abs(side.position_mm - side.moved_from_mm) > _MOVED_MM
            if moved or side.share == 0.0 or remaining_mm < 3.0:
                side.moved_at_s, side.moved_from_mm = now_s, side.position_mm
            elif now_s - side.moved_at_s > self._settings.stuck_s:
                return f"{name} does not move, {remaining_mm:.1f} mm before its target"
        return ""

    def _wait(self, deviations_mm: tuple[float, float]) -> None:
        """Begin or end the waiting of a side that is too far ahead."""
        settings = self._settings
        if all(abs(side.target_mm - side.position_mm) < settings.apart_mm for side in self._sides):
            self._waiting = None  # at the end each side finds its own rest
        elif self._waiting is None and any(side.sticks for side in self._sides):
            self._waiting = 1 if self._sides[0].sticks else 0
        elif self._waiting is None:
            ahead_mm = [2.0 * d * s.way_sign for s, d in zip(self._sides, deviations_mm, strict=True)]
            index = 0 if ahead_mm[0] > ahead_mm[1] else 1
            far = ahead_mm[index] > settings.wait_mm and abs(self._sides[index].way_mm) > _MOVED_MM
            self._ahead_n = self._ahead_n + 1 if far else 0
            if self._ahead_n >= _AHEAD_N or (far and ahead_mm[index] > _FAR_AHEAD * settings.wait_mm):
                self._waiting = index
        else:
            behind = self._sides[1 - self._waiting]
            left_mm = abs(self._catch_up_mm(self._waiting) - behind.position_mm)
            if abs(behind.velocity_mm_per_s) < _STILL_MM_PER_S and (
                self._apart_mm < settings.level_mm or left_mm < _START_MM
            ):
                behind.halt()  # both begin anew
                self._waiting = None

    def _catch_up_mm(self, waiting: int) -> float:
        """Where the side behind is level with the one that waits."""
        ahead, behind = self._sides[waiting], self._sides[1 - waiting]
        progress = min(max((ahead.position_mm - ahead.start_mm) / ahead.way_mm, 0.0), 1.0)
        return behind.start_mm + progress * behind.way_mm

    def _catch_up(self, waiting: int) -> tuple[SideCommand, SideCommand]:
        """One side holds; the other goes slowly to the same point of the way and rests there, then both start anew."""
        ahead, behind = self._sides[waiting], self._sides[1 - waiting]
        ahead.halt()
        behind.share = self._settings.min_share
        command = SideCommand(self._catch_up_mm(waiting), behind.share)
        return (SideCommand(None), command) if waiting == 0 else (command, SideCommand(None))

    def _share(self, deviations_mm: tuple[float, float]) -> tuple[SideCommand, SideCommand]:
        """Speed shares that give both sides the pace of the slower one; the side ahead goes a little slower still."""
        settings = self._settings
        longest_mm = max(abs(side.way_mm) for side in self._sides)
        moving = [side for side in self._sides if abs(side.way_mm) > _MOVED_MM]
        most_share, near = 1.0, False
        if len(moving) > 1:
            near = any(abs(side.target_mm - side.position_mm) < _NEAR_MM for side in moving)
            if near:
                most_share = settings.approach_share
            if not all(side.known for side in moving):
                shortest_mm = min(abs(side.way_mm) for side in moving)
                most_share = min(most_share, settings.first_share * longest_mm / shortest_mm)
        gains_mm_per_s = [side.gain_mm_per_s for side in self._sides]
        fastest_mm_per_s = [min(most_share * gain, self._max_speed_mm_per_s) for gain in gains_mm_per_s]
        pace_mm_per_s = min(
            (
                fastest * longest_mm / abs(side.way_mm)
                for side, fastest in zip(self._sides, fastest_mm_per_s, strict=True)
                if abs(side.way_mm) > _MOVED_MM
            ),
            default=settings.full_speed_mm_per_s,
        )
        own_mm_per_s = [pace_mm_per_s * (abs(s.way_mm) / longest_mm if longest_mm else 1.0) for s in self._sides]
        ahead_mm = [2.0 * d * s.way_sign for s, d in zip(self._sides, deviations_mm, strict=True)]
        ahead = 0 if ahead_mm[0] > ahead_mm[1] else 1
        behind = 1 - ahead
        # The side behind makes up for it as far as it can go faster, and the side ahead waits for the rest.
        wanted_mm_per_s = settings.catch_up_hz * max(0.0, -ahead_mm[behind])
        more_mm_per_s = min(wanted_mm_per_s, max(0.0, fastest_mm_per_s[behind] - own_mm_per_s[behind]))
        left = 1.0 - more_mm_per_s / wanted_mm_per_s if wanted_mm_per_s else 1.0
        own_mm_per_s[behind] += more_mm_per_s
        own_mm_per_s[ahead] -= left * settings.catch_up_hz * max(0.0, ahead_mm[ahead])
        for side, speed_mm_per_s, gain in zip(self._sides, own_mm_per_s, gains_mm_per_s, strict=True):
            share = speed_mm_per_s / gain
            # One that may be as fast as it slows down to by itself is left to that: it starts sooner when told more.
            side.share = 1.0 if near and share > most_share - _SHARE_STEP else min(max(share, settings.min_share), 1.0)
        return self._commands()

    def _commands(self) -> tuple[SideCommand, SideCommand]:
        left, right = self._sides
        return SideCommand(left.target_mm, left.share), SideCommand(right.target_mm, right.share)


class LiftCoordinator:
    """Turns the two lifts' goals into what each side shall do this tick, so that they keep together."""

    def __init__(self, settings: LiftPairSettings, figures: Mapping[str, AxisFigures]) -> None:
        self._pair = LiftPair(settings, min(figures[axis].speed for axis in LIFTS))
        self._targets: tuple[float, float] | None = None
        self._last: PairCommand | None = None
        self._faults = PresentFaults("lift_left")

    @property
    def stopped(self) -> str:
        """Why both sides hold although a goal is set; empty where they do not. A new goal starts anew."""
        return self._last.stopped if self._last is not None else ""

    @property
    def shares(self) -> dict[str, float]:
        """Speed share of each lift, by axis; empty where the pair is not commanded."""
        if self._last is None:
            return {}
        return {"lift_left": self._last.left.speed_share, "lift_right": self._last.right.speed_share}

    def step(self, goals: Goals, now_s: float, left: SideReading | None, right: SideReading | None) -> Goals:
        """Where each lift goes in this tick on the way to ``goals``; one without the other stays."""
        if goals.lift_left_mm is None or goals.lift_right_mm is None:
            if self._targets is not None:
                self._pair.release()
            self._targets = self._last = None
            self._faults.clear_all()
            return Goals()
        targets = (goals.lift_left_mm, goals.lift_right_mm)
        if self._targets is not None and self.stopped and _differ(targets, self._targets):
            self._pair.release()
        self._targets = targets
        command = self._last = self._pair.step(now_s, left, right, *targets)
        if command.condition or command.stopped:
            detail = command.stopped or f"{command.apart_mm:.1f} mm apart on their way"
            self._faults.set("sides_apart", detail, now_s)
        else:
            self._faults.clear("sides_apart")
        return Goals(lift_left_mm=command.left.target_mm, lift_right_mm=command.right.target_mm)

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """``sides_apart`` while the sides are further apart than allowed, or one stopped the other."""
        return self._faults.present(now_s)


def _differ(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return abs(one[0] - other[0]) > _NEW_TARGET_MM or abs(one[1] - other[1]) > _NEW_TARGET_MM
