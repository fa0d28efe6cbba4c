"""The daemon as its clients' interface sees it: implements ``graderd.api.port.DaemonPort``."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Any

from pydantic import ValidationError

from graderd.api.port import ServiceError
from graderd.config import Config
from graderd.core.commands import Command, Reply, Stop
from graderd.core.machine import Mode
from graderd.core.status import RecordingStatus, Status
from graderd.hal.device import DeviceService, WatchBus
from graderd.hal.errors import DeviceError
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import Devices
from graderd.runtime.perception_protocol import PreviewFormat
from graderd.runtime.perception_supervisor import PerceptionSupervisor
from graderd.runtime.status import build_status

BUS_LINES_N = 2000
"""More than a second of a full bus."""
BUS_PAUSE_S = 0.05
"""Frames come in bundles: a message for each would cost more than the bus itself."""


class Port:
    """Status is built once per tick and only when somebody waits for it."""

    def __init__(
        self,
        config: Config,
        loop: ControlLoop,
        devices: Devices,
        eyes: PerceptionSupervisor,
        services: Mapping[str, DeviceService],
        recording: Callable[[], RecordingStatus] = RecordingStatus,
    ) -> None:
        self._config = config
        self._loop = loop
        self._devices = devices
        self._services = services
        self._recording = recording
        self._eyes = eyes
        self._waiting: list[asyncio.Future[Status]] = []
        self._cached: Status | None = None
        self._under_way = ""

    def published(self) -> None:
        """Called after each tick: hand the new status to those who wait."""
        self._cached = None
        if self._waiting:
            status = self.status()
            waiting, self._waiting = self._waiting, []
            for future in waiting:
                if not future.done():
                    future.set_result(status)

    def status(self) -> Status:
        """The state at the last control tick."""
        if self._cached is None:
            self._cached = build_status(self._config, self._loop, self._eyes, self._recording())
        return self._cached

    async def next_status(self, after_s: float) -> Status:
        """Wait for a status newer than ``after_s``."""
        if self._loop.tick.now_s > after_s:
            return self.status()
        future: asyncio.Future[Status] = asyncio.get_running_loop().create_future()
        self._waiting.append(future)
        return await future

    async def command(self, command: Command, waited_s: float = 0.0) -> Reply:
        """Hand a command to the next tick."""
        return await self._loop.command(command, waited_s)

    def stop(self, command: Stop) -> Reply:
        """Every wire is told now, between two ticks: who asks afterwards sees the machine stopped."""
        reply = self._loop.stop_now(command)
        self._cached = None
        return reply

    def config(self) -> dict[str, Any]:
        """The resolved configuration."""
        return self._config.model_dump(mode="json")

    async def preview_jpeg(self, *, labels: bool = True, width_px: int | None = None) -> tuple[bytes, float]:
        """The newest annotated picture, and its age in seconds."""
        try:
            picture = await self._eyes.preview_jpeg(PreviewFormat(labels=labels, width_px=width_px))
        except TimeoutError:
            raise ServiceError("the camera gives no picture", "see graderd status for its fault") from None
        return picture.value, picture.age_s(self._loop.tick.now_s)

    def bus_text(self, name: str) -> AsyncGenerator[str, None]:
        """What is on a wire from now on; a reader that is slow loses the oldest lines and is told how many."""
        watch = self._devices.buses.get(name)
        if watch is None:
            known = ", ".join(sorted(self._devices.buses))
            raise ServiceError(f"there is no bus '{name}'", f"there are: {known}")
        return self._bus_text(watch)

    async def _bus_text(self, watch: WatchBus) -> AsyncGenerator[str, None]:
        lines: deque[str] = deque(maxlen=BUS_LINES_N)
        arrived, heard_n = asyncio.Event(), 0

        def hear(line: str) -> None:
            nonlocal heard_n
            heard_n += 1
            lines.append(line)
            arrived.set()

        end = watch(hear)
        try:
            while True:
                await arrived.wait()
                await asyncio.sleep(BUS_PAUSE_S)
                lost_n, heard_n = heard_n - len(lines), 0
                text = "".join(f"{line}\n" for line in lines)
                lines.clear()
                arrived.clear()
                yield f"# {lost_n} lines lost: the reader is too slow\n{text}" if lost_n else text
        finally:
            end()

    def services(self) -> Mapping[str, DeviceService]:
        """The services there are, by name."""
        return self._services

    async def service(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Run a device service; those that move or unpower need a disarmed machine, consent, and no other under way.
        Cancelled, one that moves ends and the blade holds; another is waited for, which may not be left half done."""
        service = self._services.get(name)
        if service is None:
            known = ", ".join(sorted(self._services))
            raise ServiceError(f"there is no service '{name}'", f"there are: {known}")
        given = {key: value for key, value in arguments.items() if key != "consent"}
        try:
            wanted = service.arguments.model_validate(given)
        except ValidationError as error:
            first = error.errors()[0]
            raise ServiceError(f"{'.'.join(map(str, first['loc'])) or 'arguments'}: {first['msg']}") from None
        if service.only_reads:
            return await _answer_of(service.run(wanted))
        if arguments.get("consent") is not True:
            raise ServiceError(f"{name} may move or unpower the blade", "repeat with consent when the area is clear")
        if self._under_way:
            raise ServiceError(f"{self._under_way} is under way", "wait until it is done, or send stop")
        state = self._loop.tick.state
        if state.mode is not Mode.DISARMED or state.arming_since_s is not None:
            what = state.mode if state.arming_since_s is None else "being armed"
            raise ServiceError(f"{name} needs a disarmed machine; it is {what}", "disarm first")
        self._under_way = name
        try:
            return await _answer_of(service.run(wanted) if service.moves else _to_the_end(service.run(wanted)))
        finally:
            self._under_way = ""


async def _answer_of(work: Awaitable[dict[str, Any]]) -> dict[str, Any]:
    try:
        return await work
    except DeviceError as error:
        raise ServiceError(f"{error.where}: {error.cause}", error.remedy) from error


async def _to_the_end(work: Awaitable[dict[str, Any]]) -> dict[str, Any]:
    """Like ``work``; a first cancellation waits for its end."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)
        raise
