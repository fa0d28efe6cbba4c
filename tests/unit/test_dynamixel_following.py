"""The gate's goals and the servo's own profile together: one profile, not two that fight. In virtual time."""

from __future__ import annotations

import sys
from collections.abc import Coroutine
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from graderd.config import Config
from graderd.core.axes import Goals, Pose
from graderd.core.gate import GateInputs, GateSettings, GateState, pass_gate
from graderd.core.machine import Mode
from graderd.drivers.dynamixel import arming
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.motion import ServoMotion
from graderd.drivers.dynamixel.servo_task import CommandSlot
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo import VirtualServo
from tests.servo_line import Line

TICK_S = 0.02
LOAD_NM = 20.0
WAY_DEG = (30.0, -30.0, 45.0)
DWELL_S = 5.0
SETTLED_DEG = 0.2
ACCELERATES_DEG_PER_S2 = 5.0
"""A tenth of the profile's: less is the loop's own settling, not a change of mind of whoever leads it."""


@dataclass
class Run:
    """One manoeuvre: per move the time to settle and the reversals of acceleration."""

    settled_s: list[float] = field(default_factory=list)
    reversals_n: list[int] = field(default_factory=list)


class Stand:
    """A virtual servo with a load, armed as the driver arms it, and the gate of a default configuration."""

    def __init__(self) -> None:
        self.settings = Ph54Settings()
        self.figures = Config(rotation=self.settings).figures()
        self.servo = VirtualServo()
        self.line = Line(self.servo)
        self.calibration = Calibration.of(self.settings, self.servo.table)
        self.gate = GateState()
        self.command = CommandSlot(self.settings, self.calibration)
        self.requested_deg = 0.0
        profile = arming.profile_counts(self.settings, self.calibration)
        for name, value in {**profile, "goal_position": self.line.read("present_position"), "torque_enable": 1}.items():
            assert self.line.write(name, value) == 0
        self.servo.load_torque_nm = LOAD_NM
        self.line.run(2.0)

    def tick(self, goal_deg: float, *, gated: bool) -> None:
        """One tick of the controller: what the gate lets through, or the goal itself, goes to the servo."""
        sent_deg = goal_deg
        if gated:
            measured_deg = self.calibration.blade_deg(self.line.read("present_position"))
            inputs = GateInputs(
                GateSettings(), self.figures, Mode.MANUAL, Pose(rotation_deg=measured_deg), TICK_S, lease_ok=True
            )
            self.gate, passed = pass_gate(self.gate, Goals(rotation_deg=goal_deg), inputs)
            limited = passed["rotation"].limited
            assert limited is not None
            sent_deg = limited
        self.command.goal(sent_deg, self.line.now_s)
        motion = ServoMotion(
            self.line.now_s,
            self.calibration.servo_deg(self.line.read("present_position")),
            self.servo.shaft_velocity_deg_per_s,
            self.calibration.servo_deg(self.line.read("position_trajectory")),
            self.servo.trajectory.velocity_deg_per_s,
        )
        _done(self.command.send_goal(self, motion))  # type: ignore[arg-type]  # as far as a device is asked here

    profile_block = None

    async def write(self, name: str, value: int, **_: object) -> None:
        """As the driver's device."""
        assert self.line.write(name, value) == 0

    async def write_block(self, _: None, values: dict[str, int], **__: object) -> None:
        """As the driver's device."""
        for name, value in values.items():
            assert self.line.write(name, value) == 0

    def run(self, *, gated: bool) -> Run:
        """The whole manoeuvre."""
        found = Run()
        for goal_deg in WAY_DEG:
            speeds, angles = [], []
            for _ in range(round(DWELL_S / TICK_S)):
                self.tick(goal_deg, gated=gated)
                for _ in range(2):
                    self.line.run(TICK_S / 2)
                    speeds.append(self.servo.shaft_velocity_deg_per_s)
                    angles.append(self.servo.shaft_deg)
            late = [n for n, angle in enumerate(angles) if abs(angle - goal_deg) > SETTLED_DEG]
            found.settled_s.append((late[-1] + 1) * TICK_S / 2 if late else 0.0)
            found.reversals_n.append(_reversals(speeds))
        return found


def _done(work: Coroutine[None, None, object]) -> None:
    """Carry out what waits for nothing."""
    with pytest.raises(StopIteration):
        work.send(None)


def _reversals(speeds: list[float]) -> int:
    changes = [(after - before) / (TICK_S / 2) for before, after in pairwise(speeds)]
    signs = [change > 0 for change in changes if abs(change) > ACCELERATES_DEG_PER_S2]
    return sum(1 for before, after in pairwise(signs) if before != after)


@pytest.fixture(scope="module")
def alone() -> Run:
    """One goal a move, the servo's own profile alone."""
    return Stand().run(gated=False)


def test_the_gate_is_as_quick_and_smooth_as_one_goal(alone: Run) -> None:
    found = Stand().run(gated=True)
    sys.stdout.write(f"one goal: {alone}\nthrough the gate: {found}\n")
    for gated_s, alone_s in zip(found.settled_s, alone.settled_s, strict=True):
        assert gated_s <= 1.01 * alone_s
    for reversals_n, alone_n in zip(found.reversals_n, alone.reversals_n, strict=True):
        assert reversals_n <= max(2, alone_n)


def test_after_a_dead_master_the_blade_goes_no_further_than_the_lead() -> None:
    stand = Stand()
    while stand.servo.shaft_deg < 20.0:
        stand.tick(55.0, gated=True)
        stand.line.run(TICK_S)
    died_deg = stand.servo.shaft_deg
    stand.line.run(3.0, fed=True)  # somebody else's packets keep the servo's watchdog quiet
    overrun_deg = stand.servo.shaft_deg - died_deg
    sys.stdout.write(f"overrun at a dead master: {overrun_deg:.1f}°\n")
    assert 1.0 < overrun_deg <= stand.settings.lead_deg


def test_a_goal_never_runs_further_ahead_than_the_lead() -> None:
    stand = Stand()
    stand.servo.plant.jammed = True
    for _ in range(100):
        stand.tick(55.0, gated=True)
        stand.line.run(TICK_S)
    goal_deg = stand.calibration.blade_deg(stand.line.read("goal_position"))
    assert goal_deg - stand.servo.shaft_deg <= stand.settings.lead_deg + 0.1


JAMS_S = (0.1, 0.2, 0.3, 0.5, 0.65, 1.0, 2.0, 3.0)
TOO_FAST = 1.5


def test_a_jam_that_comes_free_at_any_time_lets_the_blade_leap_no_further_than_a_few_degrees() -> None:
    """A servo that pushes with its continuous torque passes the largest speed within 8 ms of coming free: what can be
    bounded is how far it goes so."""
    for jam_s in JAMS_S:
        stand = Stand()
        while stand.servo.shaft_deg < 8.0:
            stand.tick(55.0, gated=True)
            stand.line.run(TICK_S)
        stand.servo.plant.jammed = True
        for _ in range(round(jam_s / TICK_S)):
            stand.tick(55.0, gated=True)
            stand.line.run(TICK_S)
        from_deg, fastest, leapt_deg = stand.servo.shaft_deg, 0.0, 0.0
        stand.servo.plant.jammed = False
        for number in range(500):
            if number % 10 == 0:
                stand.tick(55.0, gated=True)
            stand.line.run(TICK_S / 10)
            speed = stand.servo.shaft_velocity_deg_per_s
            fastest = max(fastest, speed)
            if speed > TOO_FAST * stand.settings.speed_deg_per_s:
                leapt_deg = stand.servo.shaft_deg - from_deg
        sys.stdout.write(f"freed after {jam_s:.2f} s: faster than it may for {leapt_deg:.1f}°, at {fastest:.0f} °/s\n")
        assert leapt_deg <= (4.0 if jam_s < 0.2 else 1.5)
        assert fastest <= (100.0 if jam_s < 0.2 else 60.0)
        assert stand.servo.shaft_deg > from_deg + 5.0, "it goes on"
