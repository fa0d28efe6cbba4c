"""No fault of perception moves the blade outside its window or makes it swing more often than the dwell allows.

The whole control loop over fake devices on a manual clock: perception lies at random for a part of the frames, or sends
nothing but nonsense for seconds. Some hundred thousand ticks in all.
"""

from __future__ import annotations

import asyncio
import random
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.core.soil import SoilObservation, Zone
from graderd.runtime.control import ControlLoop
from graderd.runtime.state_file import StateFile
from harness.fakes import FakeMachine

TICK_S = 0.02
FRAME_EVERY_N = 3
"""Ticks for one picture: 17 a second."""
SHARES = {
    Zone.LEFT: (0.9, 0.1, 0.0),
    Zone.CENTER: (0.05, 0.9, 0.05),
    Zone.RIGHT: (0.0, 0.1, 0.9),
    Zone.EVEN: (0.33, 0.34, 0.33),
}
ANGLES_DEG = {Zone.LEFT: 30.0, Zone.CENTER: 15.0, Zone.RIGHT: -30.0, Zone.EVEN: 45.0}


@dataclass
class Run:
    """What one run did: measured angle at every tick, and the times at which a new angle was decided."""

    angles_deg: list[float]
    decided_s: list[float]
    decided: list[Zone]


def picture(now_s: float, zone: Zone, confidence: float = 0.95) -> SoilObservation:
    """A picture that is as sure of itself as pictures get."""
    left, center, right = SHARES.get(zone, (0.0, 0.0, 0.0))
    return SoilObservation(now_s, zone, confidence, "", left, center, right)


class Grader:
    """The control loop in automatic operation."""

    def __init__(self, directory: Path) -> None:
        self.machine = FakeMachine()
        self.config = Config()
        self.loop = ControlLoop(
            self.config, self.machine.devices, self.machine.eyes, self.machine.clock, StateFile(str(directory))
        )
        self.run = Run([], [], [])

    async def tick(self) -> None:
        self.machine.clock.advance(TICK_S)
        before_s = self.loop.tick.state.decision.decided_s
        self.loop.run_tick()
        await asyncio.sleep(0)
        decision = self.loop.tick.state.decision
        if decision.decided_s != before_s and decision.zone is not None:
            self.run.decided_s.append(decision.decided_s)
            self.run.decided.append(decision.zone)
        self.run.angles_deg.append(self.machine.rotation.position)

    async def command(self, command: cmd.Command) -> None:
        task = asyncio.create_task(self.loop.command(command))
        for _ in range(10):
            await asyncio.sleep(0)
            await self.tick()
            if task.done():
                break
        assert (await task).accepted

    async def to_auto(self) -> None:
        await self.command(cmd.Arm(client="t"))
        for _ in range(10):
            await self.tick()
        await self.command(cmd.Auto(client="t"))
        self.run = Run([], [], [])

    async def see(self, observation: SoilObservation) -> None:
        """One picture, and the ticks until the next."""
        self.machine.eyes.next = observation
        for _ in range(FRAME_EVERY_N):
            await self.tick()

    def judge(self) -> None:
        rotation = self.config.rotation
        low, high = rotation.min_deg, rotation.max_deg
        assert all(low <= angle <= high for angle in self.run.angles_deg)
        decided = self.run.decided_s
        assert all(later - earlier >= self.config.rule.dwell_s - 1e-9 for earlier, later in pairwise(decided))
        fastest_deg = rotation.speed_deg_per_s * TICK_S
        steps = [abs(b - a) for a, b in pairwise(self.run.angles_deg)]
        assert max(steps, default=0.0) <= fastest_deg + 1e-6
        # A swing is a way of a few degrees in one direction: no more of them than decisions that asked for one.
        assert _swings_n(self.run.angles_deg) <= len(decided)

    async def close(self) -> None:
        await self.loop._power.close()


def _swings_n(angles_deg: list[float]) -> int:
    moving = [abs(b - a) > 1e-6 for a, b in pairwise(angles_deg)]
    return sum(now and not before for before, now in pairwise([False, *moving]))


@pytest.mark.parametrize("seed", range(12))
async def test_wrong_zones_in_a_tenth_of_the_pictures(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    grader = Grader(tmp_path)
    await grader.to_auto()
    truth = rng.choice(list(ANGLES_DEG))
    for _ in range(600):  # 36 s
        wrong = rng.random() < 0.1
        zone = rng.choice(list(Zone)) if wrong else truth
        await grader.see(picture(grader.machine.clock.now_s(), zone, rng.random() if wrong else 0.95))
    grader.judge()
    # A tenth of lies never outvotes the truth.
    assert set(grader.run.decided) == {truth}
    assert grader.machine.rotation.position == pytest.approx(ANGLES_DEG[truth], abs=0.6)
    await grader.close()


@pytest.mark.parametrize("seed", range(12))
async def test_five_seconds_of_nonsense(tmp_path: Path, seed: int) -> None:
    rng = random.Random(1000 + seed)
    grader = Grader(tmp_path)
    await grader.to_auto()
    for _ in range(60):
        await grader.see(picture(grader.machine.clock.now_s(), Zone.LEFT))
    before = len(grader.run.decided)
    # Each seed lies in its own way: every picture another zone, the same wrong zone for a while, shares without sense.
    stretch = rng.choice((1, 2, 5, 12, 40))
    zone = Zone.LEFT
    for index in range(84):  # 5 s
        if index % stretch == 0:
            zone = rng.choice(list(Zone))
        now_s = grader.machine.clock.now_s()
        shares = (rng.random(), rng.random(), rng.random())
        await grader.see(SoilObservation(now_s, zone, rng.random(), "", *shares))
    assert len(grader.run.decided) - before <= 3
    # What nonsense made of it is kept for the pass, and ends with it: no soil, then soil for the next one.
    for zone, pictures_n in ((Zone.NONE, 12), (Zone.LEFT, 120)):
        for _ in range(pictures_n):
            await grader.see(picture(grader.machine.clock.now_s(), zone))
    grader.judge()
    assert grader.loop.tick.state.mode is Mode.AUTO
    assert grader.machine.rotation.position == pytest.approx(30.0, abs=0.6)
    await grader.close()


@pytest.mark.parametrize("capture_s", [-1e12, 0.0, 900.0, 1e12])
async def test_pictures_out_of_time_count_for_nothing_or_no_longer_than_others(
    tmp_path: Path, capture_s: float
) -> None:
    grader = Grader(tmp_path)
    await grader.to_auto()
    for _ in range(100):
        await grader.see(picture(capture_s, Zone.RIGHT))
    grader.judge()
    assert grader.run.decided == []
    assert grader.machine.rotation.position == 0.0
    await grader.close()


async def test_shares_that_are_no_numbers_overturn_nothing(tmp_path: Path) -> None:
    grader = Grader(tmp_path)
    await grader.to_auto()
    for _ in range(60):
        await grader.see(picture(grader.machine.clock.now_s(), Zone.LEFT))
    for value in (float("nan"), float("inf"), -1e300):
        for _ in range(60):
            now_s = grader.machine.clock.now_s()
            await grader.see(SoilObservation(now_s, Zone.RIGHT, value, "", value, value, value))
    grader.judge()
    await grader.close()
