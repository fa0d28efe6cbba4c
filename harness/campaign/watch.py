"""Looks at the virtual devices while a fault is present: where they are, how fast they are, when they came to rest."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graderd.hal.errors import DeviceError
from graderd.simulator.control_client import RigControl

PERIOD_S = 0.02
KEPT_S = 40.0
MOVING = {
    "rotation": ("blade_velocity_deg_per_s", 0.5),
    "lift_left": ("lift_left_velocity_mm_per_s", 1.0),
    "lift_right": ("lift_right_velocity_mm_per_s", 1.0),
    "tilt": ("tilt_velocity_mm_per_s", 1.0),
}
"""Field of the rig's state and the speed below which an axis stands, in deg/s or mm/s."""
AXES_OF = {"rotation": ("rotation",), "lift": ("lift_left", "lift_right"), "tilt": ("tilt",)}


def axes_of(kinds: frozenset[str]) -> tuple[str, ...]:
    """Axis names of kinds ``rotation``, ``lift``, ``tilt`` (axis names stand for themselves)."""
    return tuple(axis for kind in sorted(kinds) for axis in AXES_OF.get(kind, (kind,)))


@dataclass(frozen=True, slots=True)
class Sample:
    """The rig's truth at one moment; ``time_s`` is the rig's monotonic clock, the same as ours."""

    time_s: float
    state: dict[str, Any]

    def moves(self, axis: str) -> bool:
        """Whether an axis moves."""
        name, still = MOVING[axis]
        return bool(abs(self.state[name]) > still)


class Watch:
    """Samples the rig's state in a task of its own, over a connection of its own."""

    def __init__(self, control: Path) -> None:
        self._control = RigControl(control, timeout_s=3.0)
        self._task: asyncio.Task[None] | None = None
        self.samples: list[Sample] = []

    async def start(self) -> None:
        """Begin (again, after the rig was started anew)."""
        await self.stop()
        self._task = asyncio.create_task(self._run(), name="campaign-watch")

    async def stop(self) -> None:
        """End."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        await self._control.close()

    async def _run(self) -> None:
        while True:
            with suppress(DeviceError):
                state = await self._control.state()
                self.samples.append(Sample(state["time_s"], state))
                if self.samples[0].time_s < state["time_s"] - KEPT_S:
                    del self.samples[: len(self.samples) // 2]
            await asyncio.sleep(PERIOD_S)

    def newest(self) -> Sample:
        """The newest sample (one exists once the rig is ready)."""
        return self.samples[-1]

    def moving(self, axes: tuple[str, ...]) -> bool:
        """Whether one of the axes moves now."""
        return bool(self.samples) and any(self.newest().moves(axis) for axis in axes)

    def since(self, time_s: float) -> list[Sample]:
        """Samples from a moment on."""
        return [sample for sample in self.samples if sample.time_s >= time_s]

    def standstill_s(self, axes: tuple[str, ...], from_s: float) -> float:
        """Seconds from ``from_s`` to the last sample in which one of the axes still moved; 0 where none did."""
        last_s = max((s.time_s for s in self.since(from_s) if any(s.moves(a) for a in axes)), default=from_s)
        return last_s - from_s

    async def until_still(self, axes: tuple[str, ...], for_s: float, timeout_s: float) -> bool:
        """Wait until the axes have stood for ``for_s``; False where they do not come to rest in time."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            await asyncio.sleep(PERIOD_S)
            recent = self.since(time.monotonic() - for_s)
            old_enough = bool(self.samples) and self.samples[0].time_s < time.monotonic() - for_s
            if old_enough and recent and not any(s.moves(axis) for s in recent for axis in axes):
                return True
        return False
