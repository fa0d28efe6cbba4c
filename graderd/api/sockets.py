"""The WebSockets: status stream, wires, and what moves: jog and maneuver, whose lease ends with their connection."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncGenerator, Coroutine
from typing import Annotated, Any, NamedTuple

from fastapi import APIRouter, Query, WebSocket
from pydantic import BaseModel, TypeAdapter, ValidationError
from starlette.websockets import WebSocketDisconnect

from graderd.api.http_routes import ConnectionNames, StatusTexts, asker_of, grant_of, obey, service_request
from graderd.api.limiter import Closing
from graderd.api.port import DaemonPort, ServiceError
from graderd.api.problem import Problem, ProblemError, answer, problem_of_validation
from graderd.api.settings import ApiLimits
from graderd.api.stop import StopLane, is_stop_command
from graderd.api.tcp_guard import Grant
from graderd.core.commands import (
    STOP_CAME_FIRST,
    STOP_REMEDY,
    AnyCommand,
    Command,
    Jog,
    Preset,
    Release,
    Reply,
)
from graderd.core.status import Status
from graderd.hal.text import printable

COMMAND: TypeAdapter[Command] = TypeAdapter(AnyCommand)
MALFORMED_PAUSE_S = 0.1
POLICY = 1008
"""RFC 6455: the connection was closed because its other end may not have it."""
NEVER_READ = {
    1007: b'{"reason": "a message that was no UTF-8"}',
    1009: b'{"reason": "a message too large to be read"}',
}
"""RFC 6455: the connection was closed because of a message that could not be read. It may have been a stop."""
WAITING_N = 1000
"""Messages of one client that wait for their answers. One that sends more, and faster than it is obeyed, is let go: a
stop of its own would come to nobody."""
AT_ONCE_N = 16
"""Of them handed to one tick: half of what that takes of all its clients."""
log = logging.getLogger(__name__)
UPGRADE_ONLY: dict[int | str, dict[str, Any]] = {
    101: {"description": "the WebSocket is open"},
    426: {"model": Problem, "description": "asked for without a WebSocket upgrade"},
}


def socket_routes(
    port: DaemonPort, limits: ApiLimits, texts: StatusTexts, closing: Closing, stops: StopLane
) -> APIRouter:
    """The WebSockets over ``port``; ``closing`` ends them, ``stops`` carries out what asks for a stop."""
    router = APIRouter(prefix="/v1")

    @router.websocket("/stream")
    async def stream(socket: WebSocket, rate_hz: Annotated[float, Query(gt=0, le=1000)] = limits.stream_max_hz) -> None:
        await socket.accept()
        await _until_closed(socket, _send_status(socket, port, texts, min(rate_hz, limits.stream_max_hz)), closing)

    @router.websocket("/jog")
    async def jog(socket: WebSocket, client: Annotated[str, Query(max_length=60)] = "jog") -> None:
        await socket.accept()
        session = _JogSession(port, limits, stops, ConnectionNames().of(client, socket), asker_of(socket))
        try:
            await _until_closed(socket, session.run(socket), closing, reads=True)
        finally:
            await session.release()

    @router.websocket("/services/{name}")
    async def maneuver(socket: WebSocket, name: str) -> None:
        offered = port.services().get(name)
        if offered is None or not offered.moves:
            problem = Problem(error=f"no service '{printable(name)[:60]}' moves the blade", where="services")
            await answer(404, problem, socket.scope, socket.receive, socket.send)
            return
        await socket.accept()
        session = _ManeuverSession(port, limits, stops, name, service_request(name, offered), asker_of(socket))
        await _until_closed(socket, session.run(socket), closing, reads=True)

    @router.websocket("/bus/{name}")
    async def bus(socket: WebSocket, name: str) -> None:
        name = printable(name)[:60]  # no bus is called otherwise, and whoever is told of it shows it
        try:
            texts = port.bus_text(name)
        except ServiceError as error:
            problem = Problem(error=error.message, where=f"bus {name}", remedy=error.remedy)
            await answer(404, problem, socket.scope, socket.receive, socket.send)
            return
        await socket.accept()
        await _until_closed(socket, _send_texts(socket, texts), closing)

    @router.get("/stream", tags=["status"], summary="WebSocket: status as it changes", responses=UPGRADE_ONLY)
    async def stream_needs_upgrade(
        rate_hz: Annotated[float, Query(gt=0, le=1000)] = limits.stream_max_hz,  # noqa: ARG001  (for the description)
    ) -> Status:
        """One `Status` a message, at most 20 a second (`rate_hz` asks for fewer). A slow client misses statuses; it
        never gets old ones in a row, and it never makes the daemon keep them."""
        raise _upgrade_needed("stream")

    @router.get("/jog", tags=["commands"], summary="WebSocket: move by hand", responses=UPGRADE_ONLY)
    async def jog_needs_upgrade(
        client: Annotated[str, Query(max_length=60)] = "jog",  # noqa: ARG001  (for the description)
    ) -> Reply:
        """The client sends commands (`jog`, `preset`, `renew`, `release`, or any other), one a message, and gets for
        each a `Reply` or a `Problem`, in order. A stop overtakes what was sent before it and was not obeyed yet: that
        is void. Who has more than 1000 messages waiting is let go. The lease belongs to the connection: it is given
        back when that ends for whatever reason, and lapses by itself 0.3 s after the last `renew` came."""
        raise _upgrade_needed("jog")

    @router.get("/bus/{name}", tags=["status"], summary="WebSocket: a wire as it is", responses=UPGRADE_ONLY)
    async def bus_needs_upgrade(name: str) -> str:
        """Everything the daemon receives or sends on the CAN bus (`can`, candump text) or on the servo's wire (`servo`,
        `(seconds) servo rx|tx BYTES`), some lines a message. Times are the daemon's monotonic clock. A slow client
        loses the oldest lines and is told how many in a line that begins with `#`."""
        raise _upgrade_needed(f"bus/{printable(name)[:60]}")

    return router


class _Waiting(NamedTuple):
    """A message that waits for its answer. ``stops_n``: how many stops of this client came before it; ``heard_s``: when
    it came, by the event loop's clock; ``answer``: where it was a stop itself."""

    text: bytes
    stops_n: int
    heard_s: float
    answer: Reply | None = None


class _JogSession:
    """One client's connection: its commands carry a name nobody else has, so its lease is its own.

    They are read ahead, and those that wait are handed to one tick in their order: who sends more often than it ticks
    is not obeyed ever later. A stop among them overtakes what waits, which it makes void.
    """

    def __init__(self, port: DaemonPort, limits: ApiLimits, stops: StopLane, client: str, by: str) -> None:
        self._by = by
        self._port = port
        self._limits = limits
        self._stops = stops
        self._client = client
        self._moved = False
        self._stops_n = self._malformed_n = 0
        self._waiting: asyncio.Queue[_Waiting] = asyncio.Queue(WAITING_N)

    async def run(self, socket: WebSocket) -> None:
        """Obey one message after the other until the client goes; what waits then is nobody's any more."""
        reading = asyncio.create_task(self._read(socket), name="api jog reads")
        obeying = asyncio.create_task(self._obey_all(socket), name="api jog obeys")
        try:
            done, _ = await asyncio.wait((reading, obeying), return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in (reading, obeying):
                task.cancel()
            await asyncio.gather(reading, obeying, return_exceptions=True)

    async def _obey_all(self, socket: WebSocket) -> None:
        while True:
            asked = [await self._waiting.get()]
            while len(asked) < AT_ONCE_N and not self._waiting.empty():
                asked.append(self._waiting.get_nowait())
            answers = await asyncio.gather(*map(self._answer, asked))
            if self._malformed_n:
                # A client in a loop of nonsense is slowed down.
                await asyncio.sleep(MALFORMED_PAUSE_S * self._malformed_n)
                self._malformed_n = 0
            for reply in answers:
                await socket.send_text(reply.model_dump_json())
                await asyncio.sleep(0)  # answers that are ready must not keep the tick waiting for the last of them

    async def _read(self, socket: WebSocket) -> None:
        """Read until the client goes, and carry stops out as they come."""
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                if (reason := NEVER_READ.get(message.get("code", 0))) is not None:
                    await self._stops.carry_out(reason, self._client, self._by)
                return
            text = message.get("text")
            said = text.encode("utf-8", "replace") if text else bytes(message.get("bytes") or b"")
            answer = None
            if is_stop_command(said):
                self._moved = False
                self._stops_n += 1
                answer = await self._stops.carry_out(said, self._client, self._by)
            if self._waiting.full():
                await socket.close(POLICY, "more messages than are obeyed")
                return
            self._waiting.put_nowait(_Waiting(said, self._stops_n, asyncio.get_running_loop().time(), answer))

    async def release(self) -> None:
        """Give the lease back, if this client ever had one. A refusal only says that it has lapsed already."""
        if self._moved:
            self._moved = False
            # A tick that does not answer lets the lease lapse by itself, or has stopped: nothing more to do here.
            with contextlib.suppress(ProblemError):
                now_s = asyncio.get_running_loop().time()
                await obey(self._port, Release(client=self._client), self._limits, self._by, now_s)

    async def _answer(self, asked: _Waiting) -> Reply | Problem:
        if asked.answer is not None:
            return asked.answer
        if asked.stops_n < self._stops_n:
            return Problem(error=STOP_CAME_FIRST, where="jog", remedy=STOP_REMEDY)
        try:
            command = COMMAND.validate_json(asked.text).model_copy(update={"client": self._client})
        except ValidationError as error:
            self._malformed_n += 1
            return problem_of_validation(error.errors(include_input=False, include_url=False))
        if isinstance(command, Jog | Preset):
            self._moved = True
        if isinstance(command, Release):
            self._moved = False
        try:
            reply = await obey(self._port, command, self._limits, self._by, asked.heard_s)
        except ProblemError as error:
            return error.problem
        return reply


class _ManeuverSession:
    """A service that moves the blade, for as long as its client is heard."""

    def __init__(
        self, port: DaemonPort, limits: ApiLimits, stops: StopLane, name: str, arguments: type[BaseModel], by: str
    ) -> None:
        self._by = by
        self._port = port
        self._silence_s = limits.maneuver_lease_s
        self._stops = stops
        self._name = name
        self._arguments = arguments

    async def run(self, socket: WebSocket) -> None:
        """The first message is the request, each further one says that its sender is there."""
        asked = await self._heard(socket)
        if asked is None:
            return
        try:
            given = self._arguments.model_validate_json(asked).model_dump(exclude_unset=True)
        except ValidationError as error:
            problem = problem_of_validation(error.errors(include_input=False, include_url=False))
            await socket.send_text(problem.model_dump_json())
            return
        log.info("service %s by %s", self._name, self._by)
        working = asyncio.create_task(self._port.service(self._name, given), name=f"api maneuver {self._name}")
        listening = asyncio.create_task(self._listen(socket), name=f"api maneuver {self._name} lease")
        try:
            await asyncio.wait((working, listening), return_when=asyncio.FIRST_COMPLETED)
            ended = "" if working.done() else listening.result()
        finally:
            for task in (working, listening):
                task.cancel()
            await asyncio.gather(working, listening, return_exceptions=True)
        await socket.send_text(self._outcome(working, ended))

    def _outcome(self, working: asyncio.Task[dict[str, Any]], ended: str) -> str:
        """What came of it, as JSON."""
        if ended or working.cancelled():
            return Problem(error=ended or "the daemon ends", where=self._name, remedy="ask again").model_dump_json()
        error = working.exception()
        if error is None:
            return json.dumps({"result": working.result()})
        if not isinstance(error, ServiceError):
            raise error
        return Problem(error=error.message, where=self._name, remedy=error.remedy).model_dump_json()

    async def _listen(self, socket: WebSocket) -> str:
        """Why the lease is over."""
        while True:
            try:
                async with asyncio.timeout(self._silence_s):
                    said = await self._heard(socket)
            except TimeoutError:
                return f"its client was not heard for {self._silence_s:g} s: it ended, and the blade holds"
            if said is None:
                return "the client went away"

    async def _heard(self, socket: WebSocket) -> bytes | None:
        """The next message, None: the client has gone. A stop in it is carried out."""
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            if (reason := NEVER_READ.get(message.get("code", 0))) is not None:
                await self._stops.carry_out(reason, by=self._by)
            return None
        text = message.get("text")
        said = text.encode("utf-8", "replace") if text else bytes(message.get("bytes") or b"")
        if is_stop_command(said):
            await self._stops.carry_out(said, by=self._by)
        return said


async def _send_status(socket: WebSocket, port: DaemonPort, texts: StatusTexts, rate_hz: float) -> None:
    """Send the newest status, then wait for a newer one and for the client's rate. ``send_text`` waits while the
    client does not read, and what happened meanwhile is skipped: nothing queues up."""
    loop = asyncio.get_running_loop()
    after_s, due_s = float("-inf"), loop.time()
    while True:
        status = await port.next_status(after_s)
        await socket.send_text(texts.text(status))
        after_s = status.time_s
        due_s = max(due_s + 1.0 / rate_hz, loop.time())
        await asyncio.sleep(max(0.0, due_s - loop.time()))


async def _send_texts(socket: WebSocket, texts: AsyncGenerator[str, None]) -> None:
    async with contextlib.aclosing(texts):
        async for text in texts:
            await socket.send_text(text)


async def _until_closed(
    socket: WebSocket, work: Coroutine[Any, Any, None], closing: Closing, *, reads: bool = False
) -> None:
    """Run ``work`` until it is done, the client goes, or the daemon closes. ``reads``: it reads the messages itself,
    and finds out that the client has gone."""
    path = socket.url.path
    tasks = [
        asyncio.create_task(work, name=f"api {path}"),
        asyncio.create_task(closing.wait(), name=f"api {path} closing"),
    ]
    if not reads:
        # Of a stream's client only the end is of interest.
        tasks.append(asyncio.create_task(_client_gone(socket), name=f"api {path} client"))
    grant = grant_of(socket)
    if grant is not None:
        tasks.append(asyncio.create_task(_revoked(grant), name=f"api {path} token"))
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            error = task.exception()
            # RuntimeError is how starlette says that the connection was closed under a send.
            if error is not None and not isinstance(error, WebSocketDisconnect | RuntimeError):
                raise error
        if closing.begun:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.close(1001, "the daemon ends")
        elif grant is not None and grant.ended.is_set():
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.close(POLICY, "the token is no longer in force")
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _revoked(grant: Grant) -> None:
    await grant.ended.wait()


async def _client_gone(socket: WebSocket) -> None:
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


def _upgrade_needed(what: str) -> ProblemError:
    return ProblemError(426, f"/v1/{what} is a WebSocket", what, f"open ws://localhost/v1/{what}")
