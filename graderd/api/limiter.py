"""Keeps a flood of requests away from the control tick, and stop ahead of any flood.

The daemon has one event loop. What decides whether the tick is late is how much work all ready requests do within one
turn of that loop. So few requests are in work at a time, they are paced, some wait, and the others are told 503 late
enough that a client in a loop cannot spin. Stop requests take no part in that: they have their own pace.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from graderd.api.problem import Problem, answer
from graderd.api.settings import ApiLimits


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


STOP_PATH = "/v1/stop"
COMMANDS_PATH = "/v1/commands"
SERVICES_PREFIX = "/v1/services/"
METHODS_WITH_BODY = ("POST", "PUT", "PATCH", "DELETE")


class Pace:
    """A leaky bucket: at most ``burst_n`` at once and ``rate_hz`` in the long run."""

    def __init__(self, rate_hz: float, burst_n: int) -> None:
        self._interval_s = 1.0 / rate_hz
        self._depth_s = burst_n / rate_hz
        self._next_s = float("-inf")

    def delay_s(self, now_s: float) -> float:
        """Book one turn and say how long to wait for it."""
        self._next_s = max(self._next_s, now_s - self._depth_s) + self._interval_s
        return max(0.0, self._next_s - now_s)

    def take(self, now_s: float) -> bool:
        """Book a turn if it may be had at once, and say whether."""
        if max(self._next_s, now_s - self._depth_s) + self._interval_s > now_s:
            return False
        self.delay_s(now_s)
        return True


def stop_pace(limits: ApiLimits) -> Pace:
    """How many stops a second are carried out in full."""
    return Pace(limits.stop_rate_hz, max(1, round(limits.stop_rate_hz / 10)))


class Limiter:
    """ASGI middleware; see the module's text."""

    def __init__(self, app: ASGIApp, limits: ApiLimits, closing: Closing) -> None:
        self._app = app
        self._limits = limits
        self._closing = closing
        self._pace = Pace(limits.rate_hz, limits.burst_n)
        self._stop_pace = stop_pace(limits)
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
        path = scope["path"]
        if scope["method"] in METHODS_WITH_BODY:
            body = await self._read_body(scope, receive, send)
            if body is None:
                return
            receive = _replay(body, receive)
            if path == STOP_PATH or (path == COMMANDS_PATH and _is_stop(body)):
                await self._serve_stop(scope, receive, send)
                return
        await self._serve(scope, receive, send)

    async def _serve_stop(self, scope: Scope, receive: Receive, send: Send) -> None:
        delay_s = self._stop_pace.delay_s(asyncio.get_running_loop().time())
        if delay_s > 0:
            # Only after a burst of other stops, which did the same: waiting delays an answer, never the first stop.
            await asyncio.sleep(delay_s)
        await self._app(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
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

    async def _read_body(self, scope: Scope, receive: Receive, send: Send) -> bytes | None:
        """The request's body; None where it was too large, too slow or cut off, and that was answered."""
        limit_n = self._limits.body_max_bytes_n
        too_large = Problem(
            error=f"the request's body is larger than {limit_n} bytes", where="body", remedy="send less"
        )
        body = bytearray()
        try:
            async with asyncio.timeout(self._limits.body_timeout_s):
                while True:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        return None
                    body += message.get("body", b"")
                    if len(body) > limit_n:
                        break
                    if not message.get("more_body", False):
                        return bytes(body)
        except TimeoutError:
            slow = Problem(
                error=f"the request's body did not arrive within {self._limits.body_timeout_s:g} s",
                where="body",
                remedy="send it again",
            )
            await answer(408, slow, scope, receive, send, {"Connection": "close"})
            return None
        await answer(413, too_large, scope, receive, send, {"Connection": "close"})
        return None


def _is_stop(body: bytes) -> bool:
    """Whether the body of a command asks for a stop. The cheap look comes first; most bodies are not stops."""
    if b"stop" not in body:
        return False
    try:
        message = json.loads(body)
    except (ValueError, RecursionError):
        return False
    return isinstance(message, dict) and message.get("command") == "stop"


def _replay(body: bytes, receive: Receive) -> Callable[[], Awaitable[Message]]:
    """A ``receive`` that gives the body already read, then whatever comes after it."""
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed
