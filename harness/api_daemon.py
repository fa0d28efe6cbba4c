"""A daemon for tests of the interface: the real state machine at 50 Hz over axes that go where they are told."""

from __future__ import annotations

import asyncio
import gc
import itertools
import os
import socket
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from graderd.api.app import make_app
from graderd.api.port import ServiceError
from graderd.api.server import serve
from graderd.api.settings import ApiLimits, TcpSettings
from graderd.core import commands as cmd
from graderd.core.axes import JOG_AXES, UNITS, Goals, Pose
from graderd.core.faults.monitor import ActiveFault
from graderd.core.machine import Inputs, Lease, MachineSettings, Mode, State, Unmet, step
from graderd.core.rule import RuleSettings
from graderd.core.status import (
    AttitudeStatus,
    AxisStatus,
    FaultStatus,
    LeaseStatus,
    RequirementStatus,
    SoilStatus,
    Status,
)
from graderd.hal.device import DeviceService, Lifecycle
from graderd.hal.settings import Finite, Settings
from harness.awake_clock import AwakeClock

T = TypeVar("T")

_PORTS = itertools.count()


def free_port() -> int:
    """A port for a test's daemon; the one after it, which serves stops, is free as well.

    Below those that the kernel gives to whoever connects, and by process: tests beside this one take neither.
    """
    while True:
        port_n = 10_000 + os.getpid() % 100 * 200 + next(_PORTS) % 100 * 2
        with socket.socket() as one, socket.socket() as other:
            try:
                one.bind(("127.0.0.1", port_n))
                other.bind(("127.0.0.1", port_n + 1))
            except OSError:
                continue
            return port_n


TICK_S = 0.02
HOLD_S = 0.05
"""So much may a client make the daemon compute in one go, and so late a tick be for its sake at most."""
SPEED_PER_S = {"rotation": 60.0, "lift_left": 200.0, "lift_right": 200.0, "tilt": 100.0}
LIMITS = {"rotate": 60.0, "lift": 295.0, "tilt": 97.0, "height": 195.0, "slope": 20.0, "pitch": 14.0}


class StepArguments(Settings):
    step_deg: Finite = 10.0


async def _nothing(_: Any) -> dict[str, Any]:
    return {}


SERVICES = {
    "rotation.verify_profile": DeviceService(_nothing, only_reads=True),
    "rotation.reboot": DeviceService(_nothing),
    "rotation.step_response": DeviceService(_nothing, moves=True, arguments=StepArguments),
}
JPEG = b"\xff\xd8\xff\xe0 not much of a picture \xff\xd9"


@dataclass
class FakeDaemon:
    """Implements DaemonPort. ``frozen`` keeps commands unanswered; ``late_s`` records how late ticks came; the axes
    ``held`` do not move, for the faults there.
    """

    settings: MachineSettings = field(default_factory=MachineSettings)
    unmet: tuple[Unmet, ...] = ()
    faults: tuple[ActiveFault, ...] = ()
    picture: bytes | None = JPEG
    frozen: bool = False
    late_s: list[float] = field(default_factory=list)
    seen: list[cmd.Command] = field(default_factory=list)
    held: dict[str, FaultStatus] = field(default_factory=dict)
    bus_watched_n: int = 0
    maneuvers: list[str] = field(default_factory=list)
    maneuver_done: asyncio.Event = field(default_factory=asyncio.Event)
    state: State = field(default_factory=State)
    torque_on: bool | None = None
    positions: dict[str, float] = field(
        default_factory=lambda: {"rotation": 0.0, "lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0}
    )

    def __post_init__(self) -> None:
        self.waiting: list[tuple[cmd.Command, float, asyncio.Future[cmd.Reply]]] = []
        self._clock = AwakeClock()
        self._ticked = asyncio.Event()
        self._moving: set[str] = set()
        self._goals = Goals()
        self._active = False
        self._status = self._make_status(self._clock.now_s())

    async def run(self) -> None:
        """Tick until cancelled."""
        due_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            self.late_s.append(now_s - due_s)
            self._tick(self._clock.now_s())
            due_s = max(due_s + TICK_S, now_s)
            await asyncio.sleep(due_s - time.monotonic())

    def status(self) -> Status:
        return self._status

    async def next_status(self, after_s: float) -> Status:
        while self._status.time_s <= after_s:
            await self._ticked.wait()
        return self._status

    def stop(self, command: cmd.Stop) -> cmd.Reply:
        (reply,) = self._step([command])
        self._status = self._make_status(self._clock.now_s())
        return reply

    async def command(self, command: cmd.Command, waited_s: float = 0.0) -> cmd.Reply:
        future: asyncio.Future[cmd.Reply] = asyncio.get_running_loop().create_future()
        self.waiting.append((command, self._clock.now_s() - waited_s, future))
        return await future

    def config(self) -> dict[str, Any]:
        return {"machine": self.settings.model_dump(mode="json"), "rig": {"port": Path("/dev/null").name}}

    async def preview_jpeg(self, *, labels: bool = True, width_px: int | None = None) -> tuple[bytes, float]:
        del labels, width_px
        if self.picture is None:
            raise ServiceError("no picture yet", "look at the camera's cable")
        return self.picture, 0.25

    def bus_text(self, name: str) -> AsyncGenerator[str, None]:
        if name != "can":
            raise ServiceError(f"there is no bus '{name}'", "there are: can")
        return self._bus_text()

    async def _bus_text(self) -> AsyncGenerator[str, None]:
        try:
            for line in ("(1.000000) can0 18EF1300#DC05191500000000\n", "# 3 lines lost: the reader is too slow\n"):
                yield line
            await asyncio.Event().wait()
        finally:
            self.bus_watched_n += 1

    def services(self) -> Mapping[str, DeviceService]:
        return SERVICES

    async def service(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        if name == "rotation.verify_profile":
            return {"differences": []}
        if name == "rotation.reboot":
            if arguments.get("consent") is not True:
                raise ServiceError("a reboot lets the blade turn freely for a moment", "send consent: true")
            return {"rebooted": True}
        if name == "rotation.step_response":
            self.maneuvers.append("began")
            try:
                await self.maneuver_done.wait()
                return {"overshoot_percent": 1.5}
            finally:
                self.maneuvers.append("ended")
        raise ServiceError(f"there is no service {name}", "see /v1/openapi.json")

    def _tick(self, now_s: float) -> None:
        taken = [] if self.frozen else sorted(self.waiting, key=lambda entry: not isinstance(entry[0], cmd.Stop))
        if taken:
            self.waiting = []
        now_s = self._clock.now_s()
        replies = self._step([command for command, _, _ in taken], tuple(now_s - at_s for _, at_s, _ in taken))
        self._move()
        self._status = self._make_status(now_s)
        self._ticked.set()
        self._ticked = asyncio.Event()
        for (_, _, future), reply in zip(taken, replies, strict=True):
            if not future.done():
                future.set_result(reply)

    def _step(self, commands: list[cmd.Command], waited_s: tuple[float, ...] = ()) -> tuple[cmd.Reply, ...]:
        self.seen += commands
        inputs = Inputs(
            now_s=self._clock.now_s(),
            resolve=self._resolve,
            commands=tuple(commands),
            waited_s=waited_s,
            pose=self._pose(),
            settled=not self._moving and not any(isinstance(command, cmd.Preset) for command in commands),
            devices_active=self._active,
            unmet=self.unmet,
            faults=self.faults,
        )
        result = step(self.state, inputs, self.settings, RuleSettings())
        self.state, self._goals, self._active = result.state, result.intents.goals, result.intents.power
        return result.replies

    def _pose(self) -> Pose:
        return Pose(
            self.positions["rotation"],
            self.positions["lift_left"],
            self.positions["lift_right"],
            self.positions["tilt"],
        )

    def _move(self) -> None:
        goals = {
            "rotation": self._goals.rotation_deg,
            "lift_left": self._goals.lift_left_mm,
            "lift_right": self._goals.lift_right_mm,
            "tilt": self._goals.tilt_mm,
        }
        self._moving = set()
        for axis, goal in goals.items():
            if goal is None or axis in self.held:
                continue
            reach, way = SPEED_PER_S[axis] * TICK_S, goal - self.positions[axis]
            self.positions[axis] += max(-reach, min(reach, way))
            if abs(way) > reach:
                self._moving.add(axis)

    def _resolve(self, command: cmd.Jog | cmd.Preset, pose: Pose) -> tuple[Goals, ...] | str:
        if isinstance(command, cmd.Preset):
            if command.name != "transport":
                return f"there is no preset {command.name!r}; there is transport"
            return (Goals(lift_left_mm=200.0, lift_right_mm=200.0), Goals(rotation_deg=0.0))
        now = {
            "rotate": pose.rotation_deg,
            "lift": pose.lift_left_mm,
            "tilt": pose.tilt_mm,
            "height": (pose.lift_left_mm or 0.0) - 100.0,
            "slope": 0.0,
            "pitch": ((pose.tilt_mm or 0.0) - 50.0) * 0.3,
        }[command.axis]
        value = command.value + (now or 0.0) if command.relative else command.value
        if abs(value) > LIMITS[command.axis]:
            unit = JOG_AXES[command.axis].unit
            return f"{command.axis} {value:+.1f} {unit} is beyond the limit of {LIMITS[command.axis]:+.1f} {unit}"
        match command.axis:
            case "rotate":
                return (Goals(rotation_deg=value),)
            case "lift":
                return (Goals(lift_left_mm=value, lift_right_mm=value),)
            case "height":
                return (Goals(lift_left_mm=value + 100.0, lift_right_mm=value + 100.0),)
            case "slope":
                return (Goals(lift_left_mm=100.0 + 7.0 * value, lift_right_mm=100.0 - 7.0 * value),)
            case "tilt":
                return (Goals(tilt_mm=value),)
            case "pitch":
                return (Goals(tilt_mm=50.0 + value / 0.3),)

    def _make_status(self, now_s: float) -> Status:
        goals = self._goals
        requested = {
            "rotation": goals.rotation_deg,
            "lift_left": goals.lift_left_mm,
            "lift_right": goals.lift_right_mm,
            "tilt": goals.tilt_mm,
        }
        lifecycle = Lifecycle.ACTIVE if self._active else Lifecycle.STANDBY
        axes = {
            name: AxisStatus(
                name=name,
                unit=UNITS[name],
                lifecycle=lifecycle,
                requested=requested[name],
                limited=None if name in self.held else requested[name],
                sent=requested[name],
                arrived=requested[name] == position,
                measured=position,
                measured_age_s=0.01,
                moving=name in self._moving,
                in_position=name not in self._moving,
                torque_on=self.torque_on if name == "rotation" else None,
            )
            for name, position in self.positions.items()
        }
        lease = self.state.lease
        return Status(
            time_s=now_s,
            wall_time="2026-11-22T12:00:00Z",
            version=version("graderd"),
            simulated=True,
            mode=self.state.mode,
            reason=self.state.reason,
            arming=self.state.arming_since_s is not None,
            holding=self.state.holding,
            last_stop=self.state.reason if self.state.mode is Mode.STOPPED else "",
            stop_n=self.state.stop_n,
            soil=SoilStatus(),
            axes=axes,
            faults=tuple(self.held.values()),
            attitude=AttitudeStatus(height_mm=self.positions["lift_left"] - 100.0, slope_deg=0.0, pitch_deg=0.0),
            readiness=tuple(
                RequirementStatus(name=u.name, met=False, mandatory=True, reason=u.reason, remedy=u.remedy)
                for u in self.unmet
            )
            or (RequirementStatus(name="rotation ready", met=True, mandatory=True, reason="", remedy=""),),
            lease=None if lease is None else LeaseStatus(client=lease.client, remaining_s=lease.expires_s - now_s),
            presets=("transport",),
        )

    async def until_mode(self, mode: Mode) -> None:
        """Wait for ``mode``."""
        await self.until(lambda: self.state.mode is mode)

    async def until(self, condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
        """Wait, tick by tick, for ``condition``."""
        async with asyncio.timeout(timeout_s):
            while not condition():
                await self.next_status(self._status.time_s)

    def hold_lease(self, client: str) -> None:
        """Let somebody else have the lease for a minute."""
        self.state = replace(self.state, lease=Lease(client, self._clock.now_s() + 60.0))


async def within(timeout_s: float, awaitable: Awaitable[T]) -> T:
    """Wait for it, not for ever."""
    async with asyncio.timeout(timeout_s):
        return await awaitable


@asynccontextmanager
async def serving(
    directory: Path,
    daemon: FakeDaemon | None = None,
    *,
    limits: ApiLimits | None = None,
    tcp: TcpSettings | None = None,
) -> AsyncIterator[tuple[FakeDaemon, Path]]:
    """A daemon that ticks and serves on ``directory/api.sock``."""
    daemon = daemon or FakeDaemon()
    path = directory / "api.sock"
    app = make_app(daemon, limits)
    ready = asyncio.Event()
    tasks: list[asyncio.Task[None]] = [
        asyncio.create_task(daemon.run(), name="fake tick"),
        asyncio.create_task(serve(app, path, tcp=tcp, limits=limits, ready=ready), name="fake api"),
    ]
    readiness = asyncio.create_task(ready.wait(), name="fake ready")
    try:
        everything: list[asyncio.Task[Any]] = [*tasks, readiness]
        await asyncio.wait(everything, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            if task.done():
                task.result()  # why it could not be served
        yield daemon, path
    finally:
        readiness.cancel()
        # The interface goes first, as in the daemon: its last releases still find a tick that answers.
        for task in reversed(tasks):
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


@dataclass
class Hold:
    """How an event loop kept one of its tasks waiting, in computing time of its thread: waiting for a processor that
    others have is not counted, whatever the machine is busy with.

    ``looked``: at each turn of a task that sleeps for a tick, monotonic seconds and what the thread had computed.
    """

    looked: list[tuple[float, float]] = field(default_factory=list)

    @property
    def each_s(self) -> list[float]:
        """What was computed between two turns, in order."""
        return [after - before for (_, before), (_, after) in pairwise(self.looked)]

    @property
    def longest_s(self) -> float:
        """The most that was computed between two turns."""
        return max(self.each_s, default=0.0)

    def computed_s(self, from_s: float, to_s: float) -> float:
        """What was computed between two monotonic times, all of a turn's that they are in."""
        before = [computed for at_s, computed in self.looked if at_s <= from_s]
        after = [computed for at_s, computed in self.looked if at_s >= to_s]
        return (after or [self.looked[-1][1]])[0] - (before or [self.looked[0][1]])[-1]


@asynccontextmanager
async def longest_hold() -> AsyncIterator[Hold]:
    """Look from now on. What earlier tests left behind is no garbage of the daemon's: it freezes its own start too."""
    gc.collect()
    gc.freeze()
    hold = Hold()

    async def look() -> None:
        while True:
            hold.looked.append((time.monotonic(), time.thread_time()))
            await asyncio.sleep(TICK_S)

    looking = asyncio.create_task(look(), name="longest hold")
    try:
        yield hold
    finally:
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
