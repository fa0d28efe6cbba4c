"""Devices and eyes for tests of the runtime: they obey the contracts and do what they are told."""

from __future__ import annotations

import asyncio

from graderd.core.attitude import MeasuredAttitude
from graderd.core.soil import SoilObservation
from graderd.hal.clock import Clock, ManualClock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import CommandRangeError, DeviceError, DeviceMissingError, LifecycleError
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.runtime.devices import Devices


class FakeAxis:
    """What rotator and actuator have in common; open and readable from the beginning.

    ``log`` is shared, so that the order across devices shows.
    """

    LIMIT = 400.0
    LOST = "no_reply"

    def __init__(self, name: str, clock: Clock, position: float, log: list[str]) -> None:
        self.name = name
        self.clock = clock
        self.position = position
        self.goal: float | None = None
        self.log = log
        self.lifecycle = Lifecycle.STANDBY
        self.present: list[DeviceFault] = []
        self.refuse_arm: DeviceError | None = None
        self.arm_takes_s = 0.0
        self.refuse_goal: DeviceError | None = None
        self.stuck = False
        self.silent_since_s: float | None = None
        self.hold_raises = False
        self.held_n = 0
        self.sent: Reading[float] | None = None

    def lose(self) -> None:
        """Its wire is cut."""
        self.silent_since_s = self.clock.now_s()
        if self.lifecycle is not Lifecycle.CLOSED:
            self.lifecycle = Lifecycle.FAILED
            self.present.append(DeviceFault(self.name, self.LOST, "its wire is cut", self.clock.now_s()))

    def restore(self) -> None:
        """Its wire is whole again."""
        self.silent_since_s = None
        if self.lifecycle is Lifecycle.FAILED:
            self.lifecycle = Lifecycle.STANDBY
            self.present.clear()

    def reading(self) -> Reading[float]:
        time_s = self.clock.now_s() if self.silent_since_s is None else self.silent_since_s
        return Reading(self.position, time_s)

    def faults(self) -> tuple[DeviceFault, ...]:
        return tuple(self.present)

    def go(self, goal: float) -> None:
        if self.refuse_goal is not None:
            raise self.refuse_goal
        if self.lifecycle is not Lifecycle.ACTIVE:
            raise LifecycleError(self.name, "not active")
        if not -self.LIMIT <= goal <= self.LIMIT:
            raise CommandRangeError(self.name, "beyond")
        self.sent = Reading(goal, self.clock.now_s())
        self.log.append(f"{self.name} goal {goal:.3f}")
        self.goal = goal
        if not self.stuck:
            self.move(goal)

    def move(self, goal: float) -> None:
        """Go there."""
        self.position = goal

    def hold(self) -> None:
        self.log.append(f"{self.name} hold")
        self.goal = None
        self.held_n += 1
        if self.hold_raises:
            raise RuntimeError("driver bug")

    async def open(self) -> None:
        self._require(Lifecycle.CLOSED)
        if self.silent_since_s is not None:
            raise DeviceMissingError(self.name, "its wire is cut")
        self.lifecycle = Lifecycle.STANDBY
        self.log.append(f"{self.name} open")

    async def arm(self) -> None:
        if self.arm_takes_s:
            await asyncio.sleep(self.arm_takes_s)
        if self.refuse_arm is not None:
            raise self.refuse_arm
        self._require(Lifecycle.STANDBY)
        self.lifecycle = Lifecycle.ACTIVE
        self.log.append(f"{self.name} arm")

    async def disarm(self) -> None:
        if self.lifecycle is Lifecycle.ACTIVE:
            self.lifecycle = Lifecycle.STANDBY
        self.goal = None
        self.log.append(f"{self.name} disarm")

    async def close(self) -> None:
        self.lifecycle = Lifecycle.CLOSED
        self.present.clear()
        self.log.append(f"{self.name} close")

    def _require(self, wanted: Lifecycle) -> None:
        if self.lifecycle is not wanted:
            raise LifecycleError(self.name, f"needs the state {wanted}, it is {self.lifecycle}")


class FakeRotator(FakeAxis):
    """A rotator that turns to where it was told with a speed of its own, as a servo does; it stops at once."""

    SPEED, RENEWED_S = 25.0, 0.2

    def __init__(self, name: str, clock: Clock, position: float, log: list[str]) -> None:
        super().__init__(name, clock, position, log)
        self.moved_s = clock.now_s()

    def move(self, goal: float) -> None:
        """Only time moves it."""

    def turn(self) -> None:
        """Let it have turned until now."""
        now_s = self.clock.now_s()
        if self.goal is not None and self.sent is not None and self.lifecycle is Lifecycle.ACTIVE and not self.stuck:
            expires_s = self.sent.time_s + self.RENEWED_S
            most = self.SPEED * max(0.0, min(now_s, expires_s) - self.moved_s)
            self.position += min(most, max(-most, self.goal - self.position))
            if now_s > expires_s:
                self.goal = None
        self.moved_s = now_s

    def hold(self) -> None:
        self.turn()
        super().hold()

    def telemetry(self) -> RotatorTelemetry:
        self.turn()
        return RotatorTelemetry(angle_deg=self.reading(), goal_sent_deg=self.sent, goal_deg=self.goal)

    def set_goal_deg(self, goal_deg: float) -> None:
        self.turn()
        self.go(goal_deg)


class FakeActuator(FakeAxis):
    """An actuator that is where it was told to be."""

    LOST = "no_feedback"

    def telemetry(self) -> ActuatorTelemetry:
        at, flags = self.reading(), frozenset[str]()
        return ActuatorTelemetry(
            position_mm=at, flags=Reading(flags, at.time_s), target_sent_mm=self.sent, goal_mm=self.goal
        )

    def set_target_mm(self, target_mm: float, speed_share: float = 1.0) -> None:
        if not 0.0 < speed_share <= 1.0:
            raise CommandRangeError(self.name, "no such share")
        self.go(target_mm)


class FakeLink:
    """A bus that is always there."""

    def __init__(self) -> None:
        self.present: list[DeviceFault] = []

    async def open(self) -> None:
        return None

    def faults(self) -> tuple[DeviceFault, ...]:
        return tuple(self.present)

    async def close(self) -> None:
        return None


class FakeEyes:
    """Perception whose next observation the test sets."""

    def __init__(self) -> None:
        self.next: SoilObservation | None = None
        self.present: list[DeviceFault] = []
        self.angles: list[tuple[float, float]] = []

    def take_observation(self) -> SoilObservation | None:
        taken, self.next = self.next, None
        return taken

    def faults(self) -> tuple[DeviceFault, ...]:
        return tuple(self.present)

    def send_angle(self, angle_deg: float, time_s: float, attitude: MeasuredAttitude) -> None:
        self.angles.append((angle_deg, time_s))


class FakeMachine:
    """All four axes at their resting place, eyes, bus and a clock that moves when told."""

    def __init__(self) -> None:
        self.clock = ManualClock(1000.0)
        self.log: list[str] = []
        self.rotation = FakeRotator("rotation", self.clock, 0.0, self.log)
        self.lift_left = FakeActuator("lift_left", self.clock, 100.0, self.log)
        self.lift_right = FakeActuator("lift_right", self.clock, 100.0, self.log)
        self.tilt = FakeActuator("tilt", self.clock, 50.0, self.log)
        self.link = FakeLink()
        self.eyes = FakeEyes()
        self.devices = Devices(
            rotation=self.rotation,
            link=self.link,
            actuators={"lift_left": self.lift_left, "lift_right": self.lift_right, "tilt": self.tilt},
        )
