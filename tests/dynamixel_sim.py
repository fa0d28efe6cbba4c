"""Virtual servos for tests: on the test's own event loop, or in a process of their own beside clients that block."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from graderd.config import Config
from graderd.core.plausibility import PlausibilityMonitor, axis_sample, motion_figures
from graderd.drivers.dynamixel import Ph54Rotator
from graderd.hal.clock import Clock
from graderd.hal.device import Lifecycle
from graderd.hal.settings import Ph54Settings
from graderd.simulator.servo import VirtualServo, VirtualServoBus
from harness.awake_clock import AwakeClock

TIMEOUT_S = 15.0
"""Deadline of waits in tests: long, because the machine may be busy; nothing is measured by it."""


@dataclass
class Bench:
    """A rotator and the virtual servo it drives, with the daemon's judgement of its motion."""

    rotator: Ph54Rotator
    servo: VirtualServo
    bus: VirtualServoBus
    clock: Clock
    monitor: PlausibilityMonitor

    def conditions(self) -> set[str]:
        """What the driver tells, and what the readings say about the motion."""
        sample = axis_sample("rotation", self.rotator.lifecycle, self.rotator.telemetry())
        judged = self.monitor.judge(() if sample is None else (sample,), self.clock.now_s())
        return {f.condition for f in (*self.rotator.faults(), *judged)}

    async def until(self, met: Callable[[], object], what: str = "", timeout_s: float = TIMEOUT_S) -> None:
        """Wait until ``met()`` is true, looking every few milliseconds."""
        await until(met, what or f"not met; faults {self.conditions()}", timeout_s)

    async def drive(self, goal_deg: float, met: Callable[[], object], timeout_s: float = TIMEOUT_S) -> None:
        """Renew a goal every 20 ms, as the control tick does, until ``met()`` is true."""
        deadline_s = time.monotonic() + timeout_s
        while not met():
            assert time.monotonic() < deadline_s, f"{self.rotator.lifecycle} {self.rotator.faults()}"
            self.rotator.set_goal_deg(goal_deg)
            await asyncio.sleep(0.02)

    def past(self, angle_deg: float) -> Callable[[], bool]:
        """Condition: the measured angle is there or beyond (a moving blade may pass an exact angle unseen)."""

        def beyond() -> bool:
            angle = self.rotator.telemetry().angle_deg
            return angle is not None and angle.value >= angle_deg

        return beyond

    def at(self, angle_deg: float, tolerance_deg: float = 0.5) -> Callable[[], bool]:
        """Condition: the measured angle is there."""

        def there() -> bool:
            angle = self.rotator.telemetry().angle_deg
            return angle is not None and abs(angle.value - angle_deg) <= tolerance_deg

        return there


async def armed_at(rig: Bench, goal_deg: float) -> None:
    """Arm and drive somewhere, so that there is something to lose."""
    await rig.rotator.arm()
    await rig.drive(goal_deg, rig.at(goal_deg))


async def works_again(rig: Bench, goal_deg: float = 10.0) -> None:
    """Faults gone, arm, and the blade goes where it is told: without a jump on the way."""
    await rig.until(lambda: rig.rotator.lifecycle is Lifecycle.STANDBY, "not in standby")
    await rig.until(lambda: not rig.conditions(), "faults did not clear")
    before_deg = rig.servo.shaft_deg
    await rig.rotator.arm()
    await asyncio.sleep(0.1)
    assert rig.servo.shaft_deg == pytest.approx(before_deg, abs=0.3)
    await rig.drive(goal_deg, rig.at(goal_deg))
    assert not rig.conditions()


def standing(rig: Bench) -> bool:
    return abs(rig.servo.shaft_velocity_deg_per_s) < 0.5


async def until(met: Callable[[], object], what: str, timeout_s: float = TIMEOUT_S) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not met():
        assert time.monotonic() < deadline_s, what
        await asyncio.sleep(0.005)


LOST_S = 0.25
"""As the configuration has it: for tests of what is told of a servo that does not answer."""


@asynccontextmanager
async def bench(
    folder: Path,
    servo: VirtualServo | None = None,
    *,
    opened: bool = True,
    wire: dict[str, Any] | None = None,
    clock: Clock | None = None,
    **changes: Any,
) -> AsyncIterator[Bench]:
    """A virtual servo at ``folder/servo`` and a rotator on it, opened unless told otherwise; all closed at the end."""
    servo = servo or VirtualServo()
    clock = clock or AwakeClock()
    bus = VirtualServoBus([servo], folder / "servo", clock=clock, **(wire or {}))
    brisk = {"speed_deg_per_s": 50.0, "acceleration_deg_per_s2": 200.0}  # so that tests need not wait for the blade
    # Without a processor to spare seven answers in a row are held back: whoever tests a lost servo says when it is one.
    patient = {"reply_timeout_s": 1.0}
    settings = Ph54Settings(**{"port": str(folder / "servo"), **brisk, **patient, **changes})
    rotator = Ph54Rotator(settings, clock=clock)
    await bus.start()
    try:
        if opened:
            await rotator.open()
        config = Config().model_copy(update={"rotation": settings})  # a slow watchdog among them
        motion = motion_figures(settings, config.actuators(), config.figures())
        yield Bench(rotator, servo, bus, clock, PlausibilityMonitor(motion))
    finally:
        await rotator.close()
        await bus.close()


class ServoProcess:
    """``python -m graderd.simulator.servo`` in a process of its own; commands by its standard input."""

    def __init__(self, link: Path, *arguments: str) -> None:
        self.link = link
        command = [sys.executable, "-m", "graderd.simulator.servo", "--link", str(link), *arguments]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.hello = self._line()

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the virtual servo died"
        return line

    def tell(self, command: str) -> dict[str, Any]:
        """Send a console line; returns the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._line())
        return answer

    def end(self) -> int:
        self.process.terminate()
        code = self.process.wait(timeout=TIMEOUT_S)
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        return code


@contextmanager
def servo_process(link: Path, *arguments: str) -> Iterator[ServoProcess]:
    process = ServoProcess(link, *arguments)
    try:
        yield process
    finally:
        process.end()
