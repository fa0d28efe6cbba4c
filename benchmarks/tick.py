"""CPU time of a control tick with a status, beside another checkout: ``python -m benchmarks.tick [CHECKOUT]``.

Each checkout runs in a process of its own on stand-in devices that keep their readings ready, so that asking them costs
nothing. The two take turns, a batch each, in one run: what else the machine does meets both alike. ``disarmed``: it
stands. ``jog``: both lifts move under a lease. ``auto``: the blade turns by observations, one every second tick. Only
the tick and the status are timed; the stand-ins move between.

Prints microseconds a tick, the median of all batches, and with two checkouts the median of the ratios batch by batch.
A checkout is taken that has a control loop, whatever its modules were called.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from statistics import median
from types import ModuleType
from typing import Any

HERE = Path(__file__).resolve().parents[1]
TICK_S = 0.02
DEG_PER_S, MM_PER_S = 20.0, 15.0
BATCH_N = 250
SCENARIOS = ("disarmed", "jog", "auto")


def first_of(*names: str) -> ModuleType:
    """The first of these modules that the checkout has."""
    for name in names:
        with suppress(ModuleNotFoundError):
            return importlib.import_module(name)
    raise ModuleNotFoundError(f"none of {', '.join(names)}")


@dataclass
class Clock:
    """Time that moves when told."""

    time_s: float = 1000.0

    def now_s(self) -> float:
        return self.time_s


@dataclass
class Axis:
    """A device that goes where it is told at a steady speed. Its telemetry is made once a tick, not when asked."""

    clock: Clock
    make: Any
    lifecycles: Any
    speed: float
    position: float
    goal: float | None = None
    lifecycle: Any = None
    newest: Any = None

    def __post_init__(self) -> None:
        self.lifecycle = self.lifecycles.STANDBY
        self.move()

    def move(self) -> None:
        """What a tick's time does."""
        moving = self.goal is not None and self.goal != self.position
        if self.goal is not None:
            most = self.speed * TICK_S
            self.position += min(most, max(-most, self.goal - self.position))
        self.newest = self.make(self.position, self.speed if moving else 0.0, self.goal, self.clock.time_s)

    def telemetry(self) -> Any:
        return self.newest

    def faults(self) -> tuple[()]:
        return ()

    def set_goal_deg(self, goal_deg: float) -> None:
        self.goal = goal_deg

    def set_target_mm(self, target_mm: float, speed_share: float = 1.0) -> None:
        self.goal = target_mm if speed_share > 0.0 else None

    def hold(self) -> None:
        self.goal = None

    async def arm(self) -> None:
        self.lifecycle = self.lifecycles.ACTIVE

    async def disarm(self) -> None:
        self.lifecycle = self.lifecycles.STANDBY


class Link:
    """A bus without faults."""

    def faults(self) -> tuple[()]:
        return ()


@dataclass
class Eyes:
    """Perception that sees what it is given."""

    camera: Any
    newest: Any = None
    taken: bool = True
    frames_per_s: float = 25.0
    angles: list[float] = field(default_factory=list)

    def see(self, observation: Any) -> None:
        self.newest, self.taken = observation, False

    def take_observation(self) -> Any:
        if self.taken:
            return None
        self.taken = True
        return self.newest

    def faults(self) -> tuple[()]:
        return ()

    def send_angle(self, angle_deg: float, *_: Any) -> None:
        self.angles[:] = [angle_deg]

    def status(self) -> Any:
        return self.camera


class Bench:
    """One scenario of one checkout, ticked by hand."""

    def __init__(self, scenario: str, directory: str) -> None:
        config = importlib.import_module("graderd.config").Config()
        control = importlib.import_module("graderd.runtime.control")
        self._commands = importlib.import_module("graderd.core.commands")
        soil = first_of("graderd.core.soil", "graderd.core.zones")
        lifecycles = first_of("graderd.hal.device", "graderd.hal.lifecycle").Lifecycle
        reading = importlib.import_module("graderd.hal.reading").Reading
        camera = importlib.import_module("graderd.core.status").CameraStatus()
        build_status = importlib.import_module("graderd.runtime.status").build_status
        state_file = importlib.import_module("graderd.runtime.state_file").StateFile(directory)

        def telemetry(kind: Any, unit: str) -> Any:
            known = {f.name for f in fields(kind)}
            names = {"rotation": ("angle_deg", "goal_sent_deg"), "actuator": ("position_mm", "target_sent_mm")}[unit]
            rest = "deg" if unit == "rotation" else "mm"

            def make(position: float, speed: float, goal: float | None, now_s: float) -> Any:
                told: dict[str, Any] = {
                    names[0]: reading(position, now_s),
                    names[1]: None if goal is None else reading(goal, now_s),
                    f"velocity_{rest}_per_s": reading(speed, now_s),
                    "current_a": reading(1.0, now_s),
                    "moving": reading(speed != 0.0, now_s),
                    f"goal_{rest}": goal,
                }
                return kind(**{name: value for name, value in told.items() if name in known})

            return make

        of_rotator = telemetry(importlib.import_module("graderd.hal.rotator").RotatorTelemetry, "rotation")
        of_actuator = telemetry(importlib.import_module("graderd.hal.linear_actuator").ActuatorTelemetry, "actuator")
        self._clock = Clock()
        at_mm = {"lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0}
        rotation = Axis(self._clock, of_rotator, lifecycles, DEG_PER_S, 0.0)
        actuators = {n: Axis(self._clock, of_actuator, lifecycles, MM_PER_S, mm) for n, mm in at_mm.items()}
        self._axes = [rotation, *actuators.values()]
        self._eyes = Eyes(camera)
        devices = importlib.import_module("graderd.runtime.devices").Devices(rotation, Link(), actuators)
        self.loop = control.ControlLoop(config, devices, self._eyes, self._clock, state_file)
        self._tick: Any = getattr(self.loop, "run_tick", None) or getattr(self.loop, "turn", None) or self.loop.tick
        older = "config" not in build_status.__code__.co_varnames[: build_status.__code__.co_argcount]
        arguments = (self.loop, self._eyes) if older else (config, self.loop, self._eyes)
        self._status: Any = lambda: build_status(*arguments)
        self._see = soil.SoilObservation
        self._zone = soil.Zone.LEFT
        self._scenario = scenario
        self._asked: set[asyncio.Task[Any]] = set()
        self._ticks_n = 0

    async def start(self) -> None:
        """Bring the machine to what is measured."""
        if self._scenario != "disarmed":
            await self.ask("Arm")
            await self.run(20)
        if self._scenario == "auto":
            await self.ask("Auto")
        await self.run(5)
        wanted = {"disarmed": "disarmed", "jog": "manual", "auto": "auto"}[self._scenario]
        if (mode := str(self._status().mode)) != wanted:
            raise RuntimeError(f"the machine is {mode}, not {wanted}")

    async def ask(self, command: str, **arguments: Any) -> None:
        """Hand a command to the loop; the next tick answers."""
        model = getattr(self._commands, command)(client="bench", **arguments)
        task = asyncio.create_task(self.loop.command(model))
        self._asked.add(task)
        task.add_done_callback(self._asked.discard)
        await asyncio.sleep(0)

    async def run(self, ticks_n: int) -> float:
        """Tick so often; microseconds of CPU a tick with a status."""
        spent_ns = 0
        for _ in range(ticks_n):
            self._clock.time_s += TICK_S
            for axis in self._axes:
                axis.move()
            await self._ask_on()
            began_ns = time.thread_time_ns()
            self._tick()
            self._status()
            spent_ns += time.thread_time_ns() - began_ns
            self._ticks_n += 1
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        return spent_ns / ticks_n / 1e3

    async def _ask_on(self) -> None:
        """What keeps the scenario going."""
        if self._scenario == "auto" and self._ticks_n % 2 == 0:
            self._eyes.see(self._see(self._clock.time_s, self._zone, 0.9, "most of it lies left", 0.8, 0.15, 0.05))
        if self._scenario == "jog" and self._ticks_n > 25:
            if self._ticks_n % 500 == 26:  # there and back, so that the lifts never arrive for long
                await self.ask("Jog", axis="lift", value=150.0 if self._ticks_n % 1000 < 500 else 60.0)
            elif self._ticks_n % 5 == 0:
                await self.ask("Renew")


async def serve() -> None:
    """Run a batch of a scenario for each line read; the child's part."""
    with tempfile.TemporaryDirectory() as directory:
        benches = {scenario: Bench(scenario, directory) for scenario in SCENARIOS}
        for bench in benches.values():
            await bench.start()
        for line in sys.stdin:  # nothing else happens in this process: it may wait here
            print(json.dumps(await benches[line.strip()].run(BATCH_N)), flush=True)


class Child:
    """A checkout at work."""

    def __init__(self, checkout: Path) -> None:
        self.checkout = checkout
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        command = [sys.executable, "-P", str(Path(__file__).resolve()), "--serve"]
        self._process = subprocess.Popen(
            command, cwd=checkout, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def batch_us(self, scenario: str) -> float:
        """Microseconds a tick in one more batch."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{scenario}\n")
        self._process.stdin.flush()
        if not (line := self._process.stdout.readline()):
            raise SystemExit(f"{self.checkout}: the benchmark does not run there; its words stand above")
        return float(line)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


def measure(checkouts: list[Path], batches_n: int) -> list[dict[str, Any]]:
    """The batches of every scenario, checkout by checkout in turn; the first batch of each is not counted."""
    children = [Child(checkout) for checkout in checkouts]
    try:
        rows = []
        for scenario in SCENARIOS:
            batches: list[list[float]] = [[] for _ in children]
            for number in range(batches_n + 1):
                for at in range(len(children)) if number % 2 else reversed(range(len(children))):
                    batches[at].append(children[at].batch_us(scenario))
            row: dict[str, Any] = {"scenario": scenario, "tick_us": [round(median(of[1:]), 1) for of in batches]}
            if len(batches) == 2:
                ratios = [here / there for here, there in zip(batches[0][1:], batches[1][1:], strict=True)]
                row["ratio"] = round(median(ratios), 3)
            rows.append(row)
        return rows
    finally:
        for child in children:
            child.close()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tick", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("checkout", nargs="?", type=Path, help="another checkout to measure in the same run")
    parser.add_argument("--batches", type=int, default=40, help=f"batches of {BATCH_N} ticks a scenario and checkout")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        asyncio.run(serve())
        return 0
    checkouts = [HERE, *([arguments.checkout.resolve()] if arguments.checkout else [])]
    print(
        json.dumps({"batch_n": BATCH_N, "batches_n": arguments.batches, "tick": measure(checkouts, arguments.batches)})
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
