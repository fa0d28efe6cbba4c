"""The lifts in virtual time, from a client's command to the tubes: control loop, tick, drivers, bus, virtual Electraks.

Nothing of the way is left out: ``ControlLoop`` runs as in the daemon, the jog is renewed as a client renews it, control
messages go out every 100 ms and feedback comes every 105 ms. Rotation and tilt are there and stand still.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Final

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.axes import LIFTS
from graderd.core.machine import Mode
from graderd.core.tick import Tick
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import Devices
from graderd.runtime.state_file import StateFile
from graderd.simulator.actuators import VirtualElectrak
from harness.electrak_sim import Machine, SimulatedLoop
from harness.fakes import FakeActuator, FakeEyes, FakeRotator

CONTROL_PERIOD_S: Final = 0.1
"""Of the control messages on the bus."""
FEEDBACK_PERIOD_S: Final = 0.105
RENEW_S: Final = 0.1
LOOK_S: Final = 0.01
AT_TARGET_MM: Final = 1.6
"""An Electrak rests up to 1.4 mm short of its target."""


@dataclass(frozen=True)
class Move:
    """One move as it was seen from outside. ``own_s``: what the slower side by itself takes; ``apart_mm``: the most the
    tubes differed; ``stopped``: why it ended before its goal, empty where it did not; ``faults``: the names of all that
    were active at any time."""

    way_mm: float
    took_s: float
    own_s: float
    apart_mm: float
    stopped: str
    faults: frozenset[str]


class LiftMachine:
    """A daemon's control loop on two virtual lifts; :func:`lift_machine` makes and ends it."""

    def __init__(self, clock: SimulatedLoop, machine: Machine, config: Config) -> None:
        log: list[str] = []
        self.clock, self.machine = clock, machine
        self.units: dict[str, VirtualElectrak] = {name: machine.units[name] for name in LIFTS}
        devices = Devices(
            rotation=FakeRotator("rotation", clock, 0.0, log),
            link=machine.link,
            actuators={**{name: machine.axes[name] for name in LIFTS}, "tilt": FakeActuator("tilt", clock, 50.0, log)},
        )
        self.loop = ControlLoop(config, devices, FakeEyes(), clock, StateFile(""))

    @property
    def tick(self) -> Tick:
        return self.loop.tick

    @property
    def apart_mm(self) -> float:
        """How much the tubes differ now."""
        return abs(self.units["lift_left"].position_mm - self.units["lift_right"].position_mm)

    def still(self) -> bool:
        return not any(unit.velocity_mm_per_s for unit in self.units.values())

    async def arm(self) -> None:
        reply = await self.loop.command(cmd.Arm(client="test"))
        assert reply.accepted, reply.message
        async with asyncio.timeout(5.0):
            while self.tick.state.mode is not Mode.MANUAL:
                await asyncio.sleep(LOOK_S)

    async def rearm(self) -> None:
        await self.loop.command(cmd.Disarm(client="test"))
        await asyncio.sleep(0.5)
        await self.arm()

    async def jog(self, target_mm: float, *, axis: str = "lift") -> None:
        command: Any = cmd.Jog(axis=axis, value=target_mm, relative=False, client="test")
        reply = await self.loop.command(command)
        assert reply.accepted, reply.message

    async def follow(self, target_mm: float, timeout_s: float = 40.0) -> tuple[float, float, str, frozenset[str]]:
        """From a jog just taken to its end: seconds, the most the tubes differed, why it was stopped (or not), and the
        faults told on the way."""
        start_s, renewed_s, apart_mm = self.clock.now_s(), self.clock.now_s(), self.apart_mm
        faults: set[str] = set()
        stopped = ""
        while True:
            await asyncio.sleep(LOOK_S)
            now_s, tick = self.clock.now_s(), self.tick
            apart_mm = max(apart_mm, self.apart_mm)
            faults |= {fault.name for fault in tick.faults}
            if tick.state.lease is None:
                stopped = tick.state.reason
            elif now_s - start_s > timeout_s:
                stopped = f"not there after {timeout_s:g} s"
            elif self.there(target_mm):
                break
            if stopped:
                break
            if now_s - renewed_s >= RENEW_S:
                await self.loop.command(cmd.Renew(client="test"))
                renewed_s = now_s
        took_s = self.clock.now_s() - start_s
        await self.loop.command(cmd.Release(client="test"))
        return took_s, apart_mm, stopped, frozenset(faults)

    async def settle(self, timeout_s: float = 40.0) -> str:
        """Renew the jog until the tick says that both arrived; why it was stopped, empty where it was not."""
        async with asyncio.timeout(timeout_s):
            while True:
                await asyncio.sleep(RENEW_S)
                if self.tick.state.lease is None:
                    return self.tick.state.reason
                await self.loop.command(cmd.Renew(client="test"))
                if all(self.tick.axes[axis].arrived for axis in LIFTS) and self.still():
                    return ""

    def there(self, target_mm: float) -> bool:
        return self.still() and all(abs(u.position_mm - target_mm) < AT_TARGET_MM for u in self.units.values())


@asynccontextmanager
async def lift_machine(
    clock: SimulatedLoop, seed: int = 0, config: Config | None = None, *, offset_s: float = 0.05
) -> AsyncIterator[LiftMachine]:
    """Armed and at rest. ``offset_s``: how much later than the bus the daemon's ticks and a client begin, which decides
    how they fall to control messages and feedback; feedback is at a phase of its own for each ``seed``."""
    config = config or Config()
    speed_percent = config.lift_left.model_dump()["speed_percent"]
    async with Machine(clock, names=(*LIFTS, "spare"), seed=seed, speed_percent=speed_percent) as machine:
        lifts = LiftMachine(clock, machine, config)
        await asyncio.sleep(0.02 + offset_s)
        running = asyncio.create_task(lifts.loop.run(), name="control")
        try:
            await lifts.arm()
            yield lifts
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)


class SlowSide:
    """The slower side by itself at full speed, on the same bus: what the pair's time is measured by."""

    def __init__(self, clock: SimulatedLoop, machine: Machine) -> None:
        self._clock, self._axis, self.unit = clock, machine.axes["spare"], machine.units["spare"]

    async def lift(self, from_mm: float, target_mm: float) -> float:
        """Seconds from one place to the other; begins some control periods later, at the same point of one."""
        await self._axis.disarm()
        self.unit.position_mm = from_mm
        await asyncio.sleep(5 * CONTROL_PERIOD_S)
        await self._axis.arm()
        start_s = self._clock.now_s()
        while True:
            self._axis.set_target_mm(target_mm)
            await asyncio.sleep(LOOK_S)
            took_s = self._clock.now_s() - start_s
            if abs(self.unit.position_mm - target_mm) < AT_TARGET_MM and not self.unit.velocity_mm_per_s:
                return took_s
            assert took_s < 60.0


@dataclass(frozen=True)
class Trial:
    """One machine's moves. ``factors``: speed of left and right against the model's; ``hitch``: what befalls a side in
    mid-move: ``""``, ``"sticks"`` (up to 0.4 s) or ``"deaf"`` (two feedbacks in a row are lost). ``offset_s``: see
    :func:`lift_machine`."""

    seed: int
    factors: tuple[float, float]
    load_n: float
    moves_n: int
    hitch: str = ""
    offset_s: float = 0.05


def trials(moves_n: int, *, hitch: str = "", per_machine_n: int = 10, seed: int = 0) -> list[Trial]:
    """So many moves over machines of every kind: equal sides, one side 10 to 40 % slower, and every way that ticks,
    control messages and feedback may fall to each other."""
    chance, found = random.Random(f"{seed}/{hitch}"), []
    for number in range(-(-moves_n // per_machine_n)):
        slow = 1.0 if number % 5 == 0 else chance.uniform(0.6, 0.9)
        both = (slow, 1.0) if chance.random() < 0.5 else (1.0, slow)
        load_n = chance.choice((0.0, 0.0, 400.0, 800.0))
        found.append(Trial(1000 * seed + number, both, load_n, min(per_machine_n, moves_n), hitch, _offset_s(number)))
    return found


def _offset_s(number: int) -> float:
    """Evenly over a feedback period, however many there are."""
    return number * 0.618 % 1.0 * FEEDBACK_PERIOD_S


async def run_trial(clock: SimulatedLoop, trial: Trial) -> list[Move]:
    """All moves of one machine, one after the other from where it rested."""
    moves: list[Move] = []
    chance = random.Random(f"{trial.seed}/moves")
    async with lift_machine(clock, trial.seed, offset_s=trial.offset_s) as lifts:
        for unit, factor in zip(lifts.units.values(), trial.factors, strict=True):
            unit.behaviour.speed_factor, unit.load_n = factor, trial.load_n
        slow = SlowSide(clock, lifts.machine)
        slow.unit.behaviour.speed_factor, slow.unit.load_n = min(trial.factors), trial.load_n
        at_mm = 100.0
        for _ in range(trial.moves_n):
            target_mm = _target_mm(at_mm, chance)
            await asyncio.sleep(0.3 + chance.random() * 0.3)
            await lifts.jog(target_mm)
            own = asyncio.create_task(slow.lift(at_mm, target_mm), name="own")
            hitch = asyncio.create_task(_hitch(lifts, trial.hitch, chance), name="hitch")
            took_s, apart_mm, stopped, faults = await lifts.follow(target_mm)
            hitch.cancel()
            await asyncio.gather(hitch, return_exceptions=True)
            for unit, factor in zip(lifts.units.values(), trial.factors, strict=True):
                unit.behaviour.speed_factor, unit.faults.silent = factor, False
            moves.append(Move(target_mm - at_mm, took_s, await own, apart_mm, stopped, faults))
            at_mm = target_mm
            if stopped:
                await asyncio.sleep(1.0)
                for unit in lifts.units.values():
                    unit.position_mm = target_mm
                await asyncio.sleep(1.0)
                await lifts.rearm()
    return moves


def _target_mm(at_mm: float, chance: random.Random) -> float:
    while True:
        target_mm = at_mm + chance.choice((-1, 1)) * chance.uniform(5.0, 250.0)
        if 8.0 <= target_mm <= 292.0:
            return target_mm


async def _hitch(lifts: LiftMachine, kind: str, chance: random.Random) -> None:
    """Befalls one side some time into the move; ends by itself."""
    if not kind:
        return
    unit = chance.choice(list(lifts.units.values()))
    await asyncio.sleep(chance.uniform(0.3, 2.5))
    factor = unit.behaviour.speed_factor
    try:
        if kind == "sticks":
            unit.behaviour.speed_factor = 0.0
            await asyncio.sleep(chance.uniform(0.1, 0.4))
        else:
            unit.faults.silent = True
            await asyncio.sleep(0.2)  # feedback comes every 105 ms: one or two are lost, never three
    finally:
        unit.behaviour.speed_factor, unit.faults.silent = factor, False


@dataclass(frozen=True)
class Loss:
    """What became of a pair that lost a side at full speed. ``held_s``: from the loss until the other was told to hold;
    ``apart_mm``: the most they came to be apart; ``named_mm``: how far the lost side was from where it was lost when a
    fault was told, which is ``reason``."""

    held_s: float
    apart_mm: float
    named_mm: float
    reason: str


async def lose_a_side(clock: SimulatedLoop, loss: str, seed: int) -> Loss:
    """Lift both at full speed; a fault of the simulated actuator befalls one, at any point of its feedback period."""
    chance = random.Random(f"{seed}/{loss}")
    async with lift_machine(clock, seed, offset_s=_offset_s(seed)) as lifts:
        lost, other = (lifts.units[name] for name in chance.sample(LIFTS, 2))
        await lifts.jog(60.0)
        await lifts.settle()
        await lifts.jog(280.0)
        renewing = asyncio.create_task(lifts.settle(), name="renew")
        await asyncio.sleep(2.0 + chance.random() * 0.5)
        from_s, from_mm, held_s = clock.now_s(), lost.position_mm, 0.0
        if loss == "manual_override":
            lost.manual_override = "retract"
        else:
            lifts.machine.bus.inject(loss, address=lost.address)
        apart_mm, named_mm, reason = 0.0, 0.0, ""
        while clock.now_s() - from_s < 2.0:
            await asyncio.sleep(LOOK_S / 2)
            if not held_s and not other.motion_enabled:
                held_s = clock.now_s() - from_s
            apart_mm = max(apart_mm, lifts.apart_mm)
            if not reason and lifts.tick.state.lease is None:
                named_mm, reason = abs(lost.position_mm - from_mm), lifts.tick.state.reason
        lost.manual_override = None
        renewing.cancel()
        await asyncio.gather(renewing, return_exceptions=True)
        return Loss(held_s, apart_mm, named_mm, reason)
