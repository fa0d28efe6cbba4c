"""Keeps a flood of requests away from the control tick, and stop ahead of any flood.

The daemon has one event loop. What decides whether the tick is late is how much work all ready requests do within one
pass of that loop. So few requests are in work at a time, they are paced, some wait, and the others are told 503 late
enough that a client in a loop cannot spin. Stop requests take no part in that: they have their own pace.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from graderd.api.problem import Problem, answer
from graderd.api.settings import ApiLimits
from graderd.api.stop import STOP_PATH, is_stop_command, is_stop_path
from graderd.hal.clock import Pace


class Closing:
    """Told once, by whoever ends the server."""

    def __init__(self) -> None:
        self._event = asyncio.Event()
        self._requests: set[asyncio.Task[Any]] = set()

    @property
    def begun(self) -> bool:
        """Whether the end has begun."""
        return self._event.is_set()

    async def wait(self) -> None:
        """Wait for the end."""
        await self._event.wait()

    def begin(self) -> None:
        """End streams, and interrupt the requests that wait for something."""
        self._event.set()
        for task in self._requests:
            task.cancel()

    @contextmanager
    def interrupts(self) -> Iterator[None]:
        """The calling task may be cancelled at the end; it finds out by ``begun``."""
        task = asyncio.current_task()
        assert task is not None
        self._requests.add(task)
        try:
            yield
        finally:
            self._requests.discard(task)


COMMANDS_PATH = "/v1/commands"
SERVICES_PREFIX = "/v1/services/"
READ_AT_MOST = 4
"""A command that is so many times larger than allowed is looked at for a stop, and no further."""
HEARD_S = "graderd.heard_s"
"""When a request had come whole, by the event loop's clock: in its scope."""
METHODS_WITH_BODY = ("POST", "PUT", "PATCH", "DELETE")


class Limiter:
    """ASGI middleware; see the module's text."""

    def __init__(self, app: ASGIApp, limits: ApiLimits, closing: Closing) -> None:
        self._app = app
        self._limits = limits
        self._closing = closing
        self._pace = Pace(limits.rate_hz, limits.burst_n)
        self._slots = asyncio.Semaphore(limits.active_n)
        self._services = asyncio.Semaphore(limits.services_n)
        self._waiting_n = 0
        self._refusing_n = 0
        self._websockets_n = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        elif scope["type"] == "http":
            await self._unless_closing(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _websocket(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._websockets_n >= self._limits.websockets_max_n:
            problem = Problem(
                error=f"{self._websockets_n} streams are open already",
                where=str(scope["path"]),
                remedy="close one, or try again later",
            )
            await answer(503, problem, scope, receive, send)
            return
        self._websockets_n += 1
        try:
            await self._app(scope, receive, send)
        except WebSocketDisconnect:
            pass  # the client went while it was being answered
        finally:
            self._websockets_n -= 1

    async def _unless_closing(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request; one that still waits for something when the daemon ends is answered so."""
        answered = False

        async def noted(message: Message) -> None:
            nonlocal answered
            answered = True
            await send(message)

        try:
            with self._closing.interrupts():
                if not self._closing.begun:
                    await self._http(scope, receive, noted)
        except asyncio.CancelledError:
            if not self._closing.begun:
                raise
        if self._closing.begun and not answered:
            problem = Problem(error="the daemon ends", where=str(scope["path"]))
            await answer(503, problem, scope, receive, send, {"Connection": "close"})

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        if is_stop_path(scope["path"]):
            # With whatever method, also one that should only ask: nobody who writes this means to let it go on.
            await self._app({**scope, "method": "POST", "path": STOP_PATH}, receive, send)
            return
        if scope["method"] in METHODS_WITH_BODY:
            body = await self._read_body(scope, receive, send)
            if body is None:
                return
            receive = _replay(body, receive)
            if body.is_stop:
                # Whatever else is in it, it goes the way of a stop.
                await self._app({**scope, "method": "POST", "path": STOP_PATH}, receive, send)
                return
        await self._serve(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope[HEARD_S] = asyncio.get_running_loop().time()
        service = scope["path"].startswith(SERVICES_PREFIX)
        if self._waiting_n >= self._limits.waiting_n + self._limits.active_n:
            await self._refuse("more requests at once than the daemon serves", scope, receive, send)
            return
        if service and self._services.locked():
            await self._refuse("as many device services as allowed are running", scope, receive, send)
            return
        self._waiting_n += 1
        try:
            async with self._services if service else self._slots:
                delay_s = self._pace.delay_s(asyncio.get_running_loop().time())
                if delay_s > 0:
                    await asyncio.sleep(delay_s)
                await self._app(scope, receive, send)
        finally:
            self._waiting_n -= 1

    async def _refuse(self, why: str, scope: Scope, receive: Receive, send: Send) -> None:
        """503, later rather than at once; beyond a bound of such sleepers at once, with the connection closed."""
        if self._refusing_n < self._limits.connections_max_n:
            self._refusing_n += 1
            try:
                await asyncio.sleep(self._limits.penalty_s)
            finally:
                self._refusing_n -= 1
        problem = Problem(error=why, where=str(scope["path"]), remedy="send fewer requests; stop is always served")
        headers = {"Retry-After": "1", "Connection": "close"}
        await answer(503, problem, scope, receive, send, headers)

    async def _read_body(self, scope: Scope, receive: Receive, send: Send) -> _Body | None:
        """The request's body; None where it was too large, too slow or cut off, and that was answered. A command is
        looked at while it comes: a stop in it does not wait for its end, nor for its size to be allowed."""
        limit_n = self._limits.body_max_bytes_n
        commands = scope["path"].rstrip("/") == COMMANDS_PATH
        body, size_n = bytearray(), 0
        try:
            async with asyncio.timeout(self._limits.body_timeout_s):
                while True:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        return None
                    piece = message.get("body", b"")
                    size_n += len(piece)
                    body += piece
                    more = message.get("more_body", False)
                    if commands and is_stop_command(body, complete=not more):
                        return _Body(bytes(body), more, True)
                    if size_n > limit_n and (not commands or not more or size_n > READ_AT_MOST * limit_n):
                        break
                    if not more:
                        return _Body(bytes(body), False, False)
        except TimeoutError:
            slow = Problem(
                error=f"the request's body did not arrive within {self._limits.body_timeout_s:g} s",
                where="body",
                remedy="send it again",
            )
            await answer(408, slow, scope, receive, send, {"Connection": "close"})
            return None
        too_large = Problem(
            error=f"the request's body is larger than {limit_n} bytes", where="body", remedy="send less"
        )
        await answer(413, too_large, scope, receive, send, {"Connection": "close"})
        return None


@dataclass(frozen=True, slots=True)
class _Body:
    """What was read of a request's body, and whether more of it comes."""

    data: bytes
    more: bool
    is_stop: bool


def _replay(body: _Body, receive: Receive) -> Callable[[], Awaitable[Message]]:
    """A ``receive`` that gives the body already read, then whatever comes after it."""
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body.data, "more_body": body.more}

    return replayed
