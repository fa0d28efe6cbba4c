"""A recording played to the daemon's interface: whoever can look at a machine can look at a day of it. Read only.

The interface is the daemon's own, over a port that has a recording behind it instead of a machine. It plays at a speed,
pauses and jumps by services; every command is refused, and says why.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from graderd.api.app import make_app
from graderd.api.port import ServiceError
from graderd.api.server import serve
from graderd.api.settings import TcpSettings
from graderd.config import Config
from graderd.config.tick import tick_settings
from graderd.core.axes import AxisFigures
from graderd.core.commands import Command, Reply, Stop
from graderd.core.status import CameraStatus, FaultStatus, Status
from graderd.core.tick import Sensed, Tick
from graderd.hal.device import DeviceService, NoArguments
from graderd.hal.errors import DeviceError, ProtocolError
from graderd.hal.settings import Finite, Settings
from graderd.record.layout import GAP, PREVIEW, SENSED, TICK, WIRE, WIRES, Gap, Message, Wire, clock, sensed_of, tick_of
from graderd.record.reader import Recording, picture_data
from graderd.runtime.status import build_status

NO_MACHINE = "this is a recording: there is no machine behind it"


class PlayArguments(Settings):
    """Arguments of ``replay.play``."""

    speed: Finite = Field(1.0, gt=0, le=100, description="times real time")


class SeekArguments(Settings):
    """Arguments of ``replay.seek``."""

    to_s: Finite = Field(ge=0, description="seconds after the recording's beginning")


@dataclass(slots=True)
class _Loop:
    """What a status is built from, as a control loop shows it."""

    tick: Tick
    sensed: Sensed
    figures: Mapping[str, AxisFigures]
    lateness_s: deque[float]
    last_stop: None = None
    ticks_n: int = 0
    decisions_n: int = 0


@dataclass(slots=True)
class _Eyes:
    """The same of perception."""

    captures_s: deque[float] = field(default_factory=lambda: deque(maxlen=30))

    @property
    def frames_per_s(self) -> float:
        span_s = self.captures_s[-1] - self.captures_s[0] if len(self.captures_s) > 1 else 0.0
        return (len(self.captures_s) - 1) / span_s if span_s > 0.0 else 0.0

    def status(self) -> CameraStatus:
        return CameraStatus(description="recorded")


class Player:
    """Goes through a recording in its time, or faster; implements ``graderd.api.port.DaemonPort``."""

    def __init__(self, recording: Recording, speed: float = 1.0, from_s: float = 0.0) -> None:
        """Stands at ``from_s``, ready to play.

        Raises:
            ProtocolError: there is no tick in it that today's status could be built from.
        """
        self._recording = recording
        self._config: Config = recording.config
        extent, self._gaps = recording.extent, [gap.model_dump() for gap in recording.gaps]
        if extent.first_ns is None:
            raise ProtocolError(str(recording.path), "nothing is in it")
        self._first_ns = extent.first_ns
        self.duration_s = extent.duration_s
        self._speed = speed
        self._paused = False
        self._missing = ""
        self._jump_s: float | None = from_s
        self._begun_n = 0
        self._figures = tick_settings(self._config).figures
        self._eyes = _Eyes()
        self._loop: _Loop | None = None
        self._at_ns = self._first_ns
        self._picture: tuple[bytes, float] | None = None
        self._lines: dict[str, list[asyncio.Queue[str]]] = {name: [] for name in WIRES}
        self._changed = asyncio.Event()
        self._shown = asyncio.Condition()
        self._show_first()

    def _show_first(self) -> None:
        knew: Message | None = None
        for message in self._recording.messages((SENSED, TICK)):
            if message.topic == SENSED:
                knew = message
            elif knew is not None and self._show(knew, message):
                return
        why = next((f": {each}" for each in self._recording.unreadable), "")
        raise ProtocolError(str(self._recording.path), f"no tick is in it that can be shown{why}")

    def _show(self, knew: Message, told: Message) -> bool:
        """The machine as it was at a tick. What is not as graderd writes it is not shown."""
        sensed = self._recording.value_of(knew, sensed_of)
        tick = self._recording.value_of(told, tick_of)
        if sensed is None or tick is None:
            return False
        former = self._loop, self._at_ns
        self._take(sensed, tick, told.log_ns)
        # Values that no machine has are found where the status is made of them.
        if self._recording.value_of(told, lambda _: self.status()) is None:
            self._loop, self._at_ns = former
            return False
        return True

    def _take(self, sensed: Sensed, tick: Tick, log_ns: int) -> None:
        if sensed.observation is not None:
            self._eyes.captures_s.append(sensed.observation.capture_s)
        late_s = self._loop.lateness_s if self._loop else deque[float](maxlen=500)
        late_s.append(sensed.late_s)
        self._loop = _Loop(tick, sensed, self._figures, late_s)
        self._at_ns = log_ns

    async def run(self) -> None:
        """Play until cancelled; at the end it stands still, and can be sent back."""
        while True:
            start_s, self._jump_s = self._jump_s or 0.0, None
            await self._play(self._first_ns + int(start_s * 1e9))
            while self._jump_s is None:
                self._changed.clear()
                await self._changed.wait()

    async def _play(self, from_ns: int) -> None:
        """To the end, or to a jump."""
        topics = (SENSED, TICK, GAP, PREVIEW, *(WIRE + name for name in WIRES))
        clock_s, clock_ns, first = time.monotonic(), from_ns, True
        knew: Message | None = None
        self._eyes.captures_s.clear()
        self._missing = ""
        for message in self._recording.messages(topics, from_ns):
            if message.topic == SENSED:
                knew = message
            elif message.topic == GAP:
                gap = self._recording.value_of(message, Gap.model_validate_json)
                self._missing, knew = str(gap or _not_as_written(message)), None
            elif message.topic == PREVIEW:
                if (picture := self._recording.value_of(message, picture_data)) is not None:
                    self._picture = picture, message.log_ns / 1e9
            elif message.topic.startswith(WIRE):
                if (wire := self._recording.value_of(message, Wire.model_validate_json)) is not None:
                    self._tell_lines(message.topic.removeprefix(WIRE), wire.lines)
            elif knew is not None:
                while not first:
                    if self._jump_s is not None:
                        return
                    due_s = clock_s + (message.log_ns - clock_ns) / 1e9 / self._speed
                    wait_s = due_s - time.monotonic()
                    if not self._paused and wait_s <= 0.0:
                        break
                    self._changed.clear()
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(None if self._paused else wait_s):
                            await self._changed.wait()
                            # Paused, sped up or sent elsewhere: what was due is due anew from here.
                            clock_s, clock_ns = time.monotonic(), self._at_ns
                self._missing = "" if self._show(knew, message) else _not_as_written(message)
                self._begun_n += first
                first = False
                async with self._shown:
                    self._shown.notify_all()
                await asyncio.sleep(0)

    def _tell_lines(self, name: str, lines: Iterable[str]) -> None:
        for queue in self._lines.get(name, ()):
            with contextlib.suppress(asyncio.QueueFull):
                queue.put_nowait("".join(f"{line}\n" for line in lines))

    # ---- the port -------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """The state at this moment of the recording."""
        loop: Any = self._loop
        eyes: Any = self._eyes
        wall = datetime.fromtimestamp(self._at_ns / 1e9, UTC).isoformat(timespec="milliseconds")
        told = build_status(self._config, loop, eyes)
        told = told.model_copy(update={"wall_time": wall, "version": self._recording.head.get("version", "")})
        return told.model_copy(update={"faults": (_damaged(self._missing), *told.faults)}) if self._missing else told

    async def next_status(self, after_s: float) -> Status:  # noqa: ARG002  (the port's)
        """The next tick that is shown; ``after_s`` does not count: a recording also goes back."""
        async with self._shown:
            await self._shown.wait()
        return self.status()

    async def command(self, command: Command, waited_s: float = 0.0) -> Reply:  # noqa: ARG002  (the port's)
        """Refused."""
        return Reply(command=command.command, accepted=False, message=NO_MACHINE, remedy="ask the daemon itself")

    def stop(self, command: Stop) -> Reply:
        """There is nothing to stop; said so that nobody takes it for a stop of the machine."""
        return Reply(command=command.command, accepted=False, message=NO_MACHINE, remedy="send it to the daemon itself")

    def config(self) -> dict[str, Any]:
        """The recording's."""
        return self._config.model_dump(mode="json")

    async def preview_jpeg(self, *, labels: bool = True, width_px: int | None = None) -> tuple[bytes, float]:
        """The picture of this moment, as it was recorded."""
        del labels, width_px
        if self._picture is None:
            raise ServiceError("no picture was recorded so far", "play on")
        data, taken_s = self._picture
        return data, max(0.0, self._at_ns / 1e9 - taken_s)

    def bus_text(self, name: str) -> AsyncGenerator[str, None]:
        """What crossed the wire, as it is played."""
        if name not in self._lines:
            raise ServiceError(f"there is no bus '{name}'", f"there are: {', '.join(self._lines)}")
        return self._bus_text(name)

    async def _bus_text(self, name: str) -> AsyncGenerator[str, None]:
        queue: asyncio.Queue[str] = asyncio.Queue(1000)
        self._lines[name].append(queue)
        try:
            while True:
                yield await queue.get()
        finally:
            self._lines[name].remove(queue)

    def services(self) -> Mapping[str, DeviceService]:
        """Play, pause, seek; and where it stands."""

        async def play(wanted: PlayArguments) -> dict[str, Any]:
            self._speed, self._paused = wanted.speed, False
            self._changed.set()
            return self._where()

        async def pause(_: NoArguments) -> dict[str, Any]:
            self._paused = True
            self._changed.set()
            return self._where()

        async def seek(wanted: SeekArguments) -> dict[str, Any]:
            if wanted.to_s > self.duration_s:
                raise ServiceError(f"the recording is {self.duration_s:.1f} s long", "seek to before its end")
            async with self._shown:
                before_n = self._begun_n
                self._jump_s = wanted.to_s
                self._changed.set()
                await self._shown.wait_for(lambda: self._begun_n > before_n)
            return self._where()

        async def where(_: NoArguments) -> dict[str, Any]:
            return self._where()

        return {
            "replay.play": DeviceService(play, only_reads=True, arguments=PlayArguments, summary="Play on, at a speed"),
            "replay.pause": DeviceService(pause, only_reads=True, summary="Stand still"),
            "replay.seek": DeviceService(seek, only_reads=True, arguments=SeekArguments, summary="Go on there"),
            "replay.where": DeviceService(where, only_reads=True, summary="Where it stands"),
        }

    def _where(self) -> dict[str, Any]:
        at_s = (self._at_ns - self._first_ns) / 1e9
        stands = {"at_s": at_s, "duration_s": self.duration_s, "speed": self._speed, "paused": self._paused}
        return {**stands, "in_gap": bool(self._missing), "gaps": self._gaps}

    async def service(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Run one of them."""
        service = self.services().get(name)
        if service is None:
            raise ServiceError(f"there is no service '{name}'", f"there are: {', '.join(self.services())}")
        try:
            wanted = service.arguments.model_validate({k: v for k, v in arguments.items() if k != "consent"})
        except ValidationError as error:
            first = error.errors()[0]
            raise ServiceError(f"{'.'.join(map(str, first['loc'])) or 'arguments'}: {first['msg']}") from None
        return await service.run(wanted)


def _not_as_written(message: Message) -> str:
    return f"{message.topic} at {clock(message.log_ns)} is not as graderd writes it"


def _damaged(what: str) -> FaultStatus:
    """What clients are shown while what they see is older than where the playing is."""
    return FaultStatus(
        name="recording.damaged",
        reads="The recording cannot be read here: what is shown is from before",
        detail=what,
        remedy="It goes on after the gap",
        reaction="warn",
        clears="when gone",
        age_s=0.0,
        present=True,
    )


def serve_recording(
    recording: Recording, socket: Path, port_n: int | None, speed: float, from_s: float, ready: Callable[[float], None]
) -> None:
    """Serve a recording until SIGINT or SIGTERM; ``ready`` is told its length once clients are answered.

    Raises:
        ConfigError, DeviceError: it cannot be played, or not served.
    """
    player = Player(recording, speed, from_s)
    tcp = None if port_n is None else TcpSettings(port_n=port_n)

    async def run() -> None:
        answering, ended = asyncio.Event(), asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        async with asyncio.TaskGroup() as group:
            tasks = [
                group.create_task(player.run(), name="player"),
                group.create_task(serve(make_app(player), socket, tcp=tcp, ready=answering), name="api"),
            ]
            await answering.wait()
            ready(player.duration_s)
            await ended.wait()
            for task in tasks:
                task.cancel()

    try:
        asyncio.run(run())
    except* DeviceError as group:
        raise first_of(group) from None


def first_of(group: BaseExceptionGroup[DeviceError]) -> DeviceError:
    """One error of a group, which is told for all."""
    error = group.exceptions[0]
    return first_of(error) if isinstance(error, BaseExceptionGroup) else error
