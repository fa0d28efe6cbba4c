"""A socket that serves nothing but stop: it has a queue of its own, so that no other client is ever before it.

Whatever is said on the unix one is a stop: who may open the file may stop the machine, and opens it for nothing else.
On TCP the head of an HTTP request has to be let in by the guard first. Both answer in HTTP, once, and close.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections import OrderedDict
from collections.abc import AsyncIterator
from pathlib import Path

import h11

from graderd.api.http_head import JudgedConnection, problem_of_head
from graderd.api.stop import GRACE_S, StopLane
from graderd.api.tcp_guard import TcpGuard

STOP_SUFFIX = ".stop"
"""The client has it too, which may load nothing of the interface: a test holds them together."""
QUEUE_N = 16
"""Taken at once in one pass of the event loop; more wait in the kernel."""
OPEN_N = 64
SAID_MOST_BYTES = 4096
TIMEOUT_S = 5.0


def stop_socket_beside(path: Path) -> Path:
    """Where the stop socket of the interface at ``path`` is: ``graderd.stop`` beside ``graderd.sock``."""
    return path.with_suffix(STOP_SUFFIX)


@contextlib.asynccontextmanager
async def serving_stops(
    listener: socket.socket, stops: StopLane, guard: TcpGuard | None = None, tls: ssl.SSLContext | None = None
) -> AsyncIterator[None]:
    """Serve stops on a bound socket for as long as the block lasts."""
    loop = asyncio.get_running_loop()
    open_connections: OrderedDict[_StopProtocol, None] = OrderedDict()

    def protocol() -> _StopProtocol:
        return _StopProtocol(stops, guard, open_connections)

    if listener.family == socket.AF_UNIX:
        server = await loop.create_unix_server(protocol, sock=listener, backlog=QUEUE_N)
    else:
        shake_s = None if tls is None else TIMEOUT_S
        server = await loop.create_server(
            protocol, sock=listener, backlog=QUEUE_N, ssl=tls, ssl_handshake_timeout=shake_s
        )
    try:
        yield
    finally:
        server.close()
        for connection in list(open_connections):
            connection.abort()


class _StopProtocol(asyncio.Protocol):
    def __init__(
        self, stops: StopLane, guard: TcpGuard | None, open_connections: OrderedDict[_StopProtocol, None]
    ) -> None:
        self._stops = stops
        self._connection = JudgedConnection(guard)
        self._admitted = guard is None
        self._open = open_connections
        self._said = bytearray()
        self._body: bytearray | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._soon = False
        self._stopping: asyncio.Task[None] | None = None
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._timer = asyncio.get_running_loop().call_later(TIMEOUT_S, transport.abort)
        self._open[self] = None
        if len(self._open) > OPEN_N:
            next(iter(self._open)).abort()

    def abort(self) -> None:
        """Close at once; a stop that was asked for is carried out all the same."""
        self._open.pop(self, None)
        if self._transport is not None:
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self._open.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()
        if self._said and self._admitted:
            self._act()

    def data_received(self, data: bytes) -> None:
        if self._stopping is not None:
            return  # what its sender still had to say
        self._said += data[: SAID_MOST_BYTES - len(self._said)]
        if self._admitted:
            self._act_soon()
        try:
            self._connection.receive_data(data)
            self._take_events()
        except h11.RemoteProtocolError as error:
            if self._admitted:
                self._act()
            else:
                status_code, problem = problem_of_head(error)
                self._answer(status_code, problem.model_dump_json().encode())

    def eof_received(self) -> bool:
        """Its sender has said all it had to say, and still reads."""
        if self._said and self._admitted:
            self._act()
        return self._stopping is not None

    def _take_events(self) -> None:
        while True:
            event = self._connection.next_event()
            if isinstance(event, h11.Request):
                self._admitted, self._body = True, bytearray()
                self._act_soon()
            elif isinstance(event, h11.Data) and self._body is not None:
                self._body += event.data[: SAID_MOST_BYTES - len(self._body)]
            elif isinstance(event, h11.EndOfMessage):
                self._act()
                return
            else:
                return

    def _act_soon(self) -> None:
        """What comes with it is its reason; what does not is not waited for."""
        if self._soon:
            return
        self._soon = True
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(GRACE_S, self._act)

    def _act(self) -> None:
        if self._stopping is None:
            if self._timer is not None:
                self._timer.cancel()
            words = bytes(self._said if self._body is None else self._body)
            if self._body is None and self._connection.line[:5].upper() in (b"POST ", b"GET /", b"PUT /"):
                words = b""  # the beginning of a request, and nobody's words
            self._stopping = asyncio.get_running_loop().create_task(self._stop(words), name="api stop socket")

    async def _stop(self, words: bytes) -> None:
        grant = self._connection.known.get("grant")
        reply = await self._stops.carry_out(words, by=grant.name if grant is not None else "the stop socket")
        self._answer(200, reply.model_dump_json().encode())

    def _answer(self, status_code: int, body: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        head = (
            f"HTTP/1.1 {status_code} {'OK' if status_code == 200 else 'Refused'}\r\ncontent-type: application/json\r\n"
        )
        transport.write(f"{head}content-length: {len(body)}\r\nconnection: close\r\n\r\n".encode() + body)
        transport.close()
