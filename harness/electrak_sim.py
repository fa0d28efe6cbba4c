"""Simulated time for asyncio, and a machine of virtual Electraks in process: seconds of motion in milliseconds."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from graderd.config import Config
from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import Reaction, row_for
from graderd.core.plausibility import PlausibilityMonitor, axis_sample, motion_figures
from graderd.drivers.electrak import CanLink, ElectrakActuator
from graderd.drivers.j1939.can_port import BusPort
from graderd.hal.device import Lifecycle
from graderd.hal.fault import DeviceFault
from graderd.hal.settings import CanSettings, ElectrakSettings
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak

T = TypeVar("T")


class _JumpingSelector(selectors.DefaultSelector):
    """Never waits: where nothing is ready, time jumps to the next timer."""

    jump: Callable[[float], None]

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout is not None and timeout > 0:
            self.jump(timeout)
        elif not ready and timeout is None:
            raise RuntimeError("the simulated loop has nothing to wait for: a deadlock")
        return ready


class SimulatedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is simulated; also a :class:`graderd.hal.clock.Clock`."""

    def __init__(self) -> None:
        self._simulated_s = 1000.0
        selector = _JumpingSelector()
        selector.jump = self._jump
        super().__init__(selector)

    def _jump(self, seconds: float) -> None:
        self._simulated_s += seconds

    def time(self) -> float:
        return self._simulated_s

    def now_s(self) -> float:
        return self._simulated_s


def run_simulated(main: Callable[[SimulatedLoop], Coroutine[Any, Any, T]]) -> T:
    """Run ``main(loop)`` to its end in simulated time; a task it leaves behind is an error."""
    loop = SimulatedLoop()
    try:
        result = loop.run_until_complete(main(loop))
        left = [task.get_name() for task in asyncio.all_tasks(loop)]
        assert not left, f"tasks left behind: {left}"
        return result
    finally:
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.close()


async def until(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Wait in real time, on a machine that may be busy, until something is so."""
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.01)


def conditions(link: CanLink) -> set[str]:
    return {fault.condition for fault in link.faults()}


def state(axis: ElectrakActuator) -> Lifecycle:
    """A call, so that the type checker does not take the state for a constant."""
    return axis.lifecycle


class Machine:
    """Two HD and one MD in process, a link, and their drivers; ``async with`` opens and closes everything. ``spare``
    is a third HD, for comparison with the two."""

    NAMES = ("lift_left", "lift_right", "tilt")

    def __init__(
        self,
        clock: SimulatedLoop,
        *,
        names: tuple[str, ...] = NAMES,
        can: CanSettings | None = None,
        open_axes: bool = True,
        seed: int = 0,
        on_stop: Callable[[str], None] | None = None,
        watched: bool = False,
        **changes: Any,
    ) -> None:
        """``watched``: a task judges the motion every 20 ms and disarms where the catalogue says so, as the daemon."""
        self.clock = clock
        self.judged: tuple[DeviceFault, ...] = ()
        self._watched = watched
        self._watch_task: asyncio.Task[None] | None = None
        self._open_axes = open_axes
        all_units = {
            "lift_left": VirtualElectrak("electrak_hd_b017", 19, 100.0, seed),
            "lift_right": VirtualElectrak("electrak_hd_b017", 20, 100.0, seed),
            "tilt": VirtualElectrak("electrak_md_a050", 27, 50.0, seed),
            "spare": VirtualElectrak("electrak_hd_b017", 21, 100.0, seed),
        }
        self.units = {name: all_units[name] for name in names}
        self.bus = VirtualActuatorBus(tuple(self.units.values()), clock=clock)
        self.frames: list[tuple[float, Any]] = []
        self.stops: list[str] = []
        self.link = CanLink(
            can or CanSettings(interface="virtual"),
            clock,
            bus_factory=lambda: BusPort(self.bus.connect()),
            on_stop=on_stop or self.stops.append,
        )
        defaults: dict[str, dict[str, Any]] = {
            "lift_left": {"address_n": 19},
            "lift_right": {"address_n": 20},
            "spare": {"address_n": 21},
            "tilt": {"address_n": 27, "profile": "electrak_md_a050", "max_mm": 95.0, "current_limit_a": 5.0},
        }
        self.axes = {
            name: ElectrakActuator(name, ElectrakSettings.model_validate(defaults[name] | changes), self.link, clock)
            for name in names
        }

    async def __aenter__(self) -> Machine:
        await self.bus.start()
        self.bus.listen(lambda frame: self.frames.append((self.clock.now_s(), frame)))
        if self._open_axes:
            await asyncio.gather(*(axis.open() for axis in self.axes.values()))
        if self._watched:
            self._watch_task = asyncio.get_running_loop().create_task(self._watch(), name="plausibility")
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._watch_task is not None:
            self._watch_task.cancel()
            await asyncio.gather(self._watch_task, return_exceptions=True)
        for axis in self.axes.values():
            await axis.close()
        await self.link.close()
        await self.bus.close()

    def conditions(self, name: str) -> set[str]:
        """What the driver tells, and what the readings say about the motion."""
        judged = (fault for fault in self.judged if fault.device == name)
        return {fault.condition for fault in (*self.axes[name].faults(), *judged)}

    async def _watch(self) -> None:
        config = Config()
        monitor = PlausibilityMonitor(motion_figures(config.rotation, config.actuators(), config.figures()))
        while True:
            samples = [axis_sample(name, axis.lifecycle, axis.telemetry()) for name, axis in self.axes.items()]
            self.judged = monitor.judge((sample for sample in samples if sample is not None), self.clock.now_s())
            for fault in self.judged:
                if row_for(fault, CATALOGUE).reaction is Reaction.DISARM:
                    await self.axes[fault.device].disarm()
            await asyncio.sleep(0.02)

    async def drive(self, targets: dict[str, float], seconds: float, share: float = 1.0) -> None:
        """Renew targets as the 50 Hz control tick does."""
        for _ in range(round(seconds * 50)):
            for name, target in targets.items():
                self.axes[name].set_target_mm(target, share)
            await asyncio.sleep(0.02)
