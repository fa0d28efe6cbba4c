"""Serves the application inside the daemon's event loop: on a unix socket, and on TCP where asked for."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import grp
import itertools
import logging
import os
import socket
import ssl
import stat
import struct
import sys
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from graderd.api.http_head import SENT_AHEAD, JudgedConnection, problem_of_head
from graderd.api.settings import ApiLimits, TcpSettings
from graderd.api.stop import StopLane, is_stop_line, is_stop_target
from graderd.api.stop_socket import serving_stops, stop_socket_beside
from graderd.api.tcp_guard import Grant, TcpGuard, Tokens
from graderd.hal.clock import Pace
from graderd.hal.errors import DeviceError
from graderd.tokens import Right

if TYPE_CHECKING:
    from uvicorn._types import ASGISendEvent

MAX_PATH_BYTES = 107
SOCKET_CHECK_S = 1.0

log = logging.getLogger(__name__)


class SocketInUseError(DeviceError):
    """Another daemon serves this socket."""


class SocketError(DeviceError):
    """The socket cannot be made or given its rights."""


@contextlib.contextmanager
def unix_socket(path: Path, mode: int, group: str | None) -> Iterator[socket.socket]:
    """A listening socket at ``path``. A lock beside it, which dies with its process, tells a living daemon from a
    socket file that a dead one left behind.

    Raises:
        SocketInUseError: see :func:`serve`.
        SocketError: see :func:`serve`.
    """
    where = f"api socket {path}"
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise SocketError(where, f"the path is longer than {MAX_PATH_BYTES} bytes", "choose a shorter one")
    with contextlib.ExitStack() as stack:
        try:
            ours = _is_locked_by_us(path)
            if not ours:
                stack.enter_context(_lock(path))
            _remove_stale(path, ours=ours)
            listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            # Linux takes the rights of the new file from the socket: nobody else gets in before they are set for good.
            os.fchmod(listener.fileno(), 0o600)
            listener.bind(str(path))
            stack.callback(path.unlink, missing_ok=True)
            if group is not None:
                os.chown(path, -1, _group_id(group, where))
            os.chmod(path, mode)
        except OSError as error:
            raise SocketError(
                where, str(error.strerror or error), "see that the directory exists and the daemon may write to it"
            ) from error
        listener.setblocking(False)
        yield listener


def _is_locked_by_us(path: Path) -> bool:
    """Whether this process holds the lock already: the socket file alone was taken away, and is made again."""
    held = _locks.get(path)
    lock_path = path.with_name(path.name + ".lock")
    return held is not None and lock_path.exists() and os.path.samestat(os.fstat(held), lock_path.stat())


_locks: dict[Path, int] = {}


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold the lock beside the socket. The file carries our process id, for people, and goes with us."""
    lock_path = path.with_name(path.name + ".lock")
    while True:
        descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.read(descriptor, 32).decode("ascii", "replace").strip()
            os.close(descriptor)
            raise SocketInUseError(
                f"api socket {path}",
                f"another daemon{f' (process {pid})' if pid else ''} serves it",
                "stop that one, or give this one another socket",
            ) from None
        # Its former holder may have taken the file away between our open and our lock: then it locks nobody out.
        if lock_path.exists() and os.path.samestat(os.fstat(descriptor), lock_path.stat()):
            break
        os.close(descriptor)
    try:
        os.truncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        _locks[path] = descriptor
        yield
    finally:
        if _locks.get(path) == descriptor:
            del _locks[path]
        lock_path.unlink(missing_ok=True)
        os.close(descriptor)


def _remove_stale(path: Path, *, ours: bool) -> None:
    """Take away what a dead daemon left at ``path``, and nothing else. ``ours``: this process had its lock before."""
    try:
        kind = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(kind):
        raise SocketError(f"api socket {path}", "there is a file of another kind", "remove it, or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except BlockingIOError:
            pass  # its queue is full: somebody listens
    if ours:
        raise SocketInUseError(
            f"api socket {path}",
            f"another daemon (process {os.getpid()}) serves it",
            "stop that one, or give this one another socket",
        )
    raise SocketInUseError(
        f"api socket {path}", "another program listens on it", "stop that one, or choose another path"
    )


def _group_id(group: str, where: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise SocketError(where, f"there is no group {group}", "create it, or change socket_group") from None


@contextlib.contextmanager
def tcp_socket(host: str, port_n: int) -> Iterator[socket.socket]:
    where = f"api tcp {host}:{port_n}"
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port_n))
        except OSError as error:
            raise SocketError(where, str(error.strerror or error), "choose another host or port") from error
        listener.setblocking(False)
        yield listener


def tls_context(tcp: TcpSettings) -> ssl.SSLContext | None:
    """What TLS is spoken with; None: none.

    Raises:
        DeviceError: certificate or key cannot be used, or others may read the key.
    """
    if tcp.certificate_file is None or tcp.key_file is None:
        return None
    where = f"api tcp {tcp.certificate_file}, {tcp.key_file}"
    try:
        if tcp.key_file.stat().st_mode & 0o007:
            raise DeviceError(where, "others may read the key", f"chmod 600 {tcp.key_file}")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(tcp.certificate_file, tcp.key_file, lambda: "")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        remedy = "give a PEM certificate and its key, without a passphrase, which the daemon may read"
        raise DeviceError(where, str(error), remedy) from error
    return context


ACCEPT_BURST_N = 20
ACCEPT_RETRY_S = 0.1
LISTEN_QUEUE_N = 128
STREAM_BUFFER_BYTES = 16_384
READ_BYTES = 1024
"""Some hundred of the smallest frames: a few milliseconds."""
READ_AHEAD_BYTES = 16_384
"""So much of what is sent ahead of its answers is taken, and looked through for a stop."""
LINGER_S = 0.5
HANDSHAKE_S = 5.0
HANDSHAKES_N = 64
"""Under way at once; the oldest makes room for a new one."""
LOST_AFTER_S = 3


async def serve(
    app: FastAPI,
    socket_path: Path,
    socket_mode: int = 0o660,
    socket_group: str | None = None,
    tcp: TcpSettings | None = None,
    *,
    limits: ApiLimits | None = None,
    ready: asyncio.Event | None = None,
) -> None:
    """Serve ``app`` until cancelled; then end open streams, close, and take the socket file away.

    Runs in the caller's event loop and leaves signals alone. ``ready`` is set when requests are answered.

    Raises:
        SocketInUseError: another daemon has the socket; it is not disturbed.
        SocketError: the socket cannot be made, or not with these rights.
        DeviceError: the token file, the certificate or its key is not usable.
    """
    limits = limits or ApiLimits()
    stops: StopLane = app.state.stop_socket
    async with contextlib.AsyncExitStack() as stack:
        listener = stack.enter_context(unix_socket(socket_path, socket_mode, socket_group))
        servers = [_Server(_config(app, limits), listener, limits)]
        helpers: list[Coroutine[Any, Any, None]] = []
        stop_listener = stack.enter_context(unix_socket(stop_socket_beside(socket_path), socket_mode, socket_group))
        await stack.enter_async_context(serving_stops(stop_listener, stops))
        if tcp is not None:
            listener = stack.enter_context(tcp_socket(tcp.host, tcp.port_n))
            stop_listener = stack.enter_context(tcp_socket(tcp.host, tcp.port_of_stop_n()))
            tls = tls_context(tcp)
            tokens = Tokens(tcp.token_file)
            ports = (listener.getsockname()[1], stop_listener.getsockname()[1])
            guard, stop_guard = (TcpGuard(tokens, port_n, tcp.allowed_hosts) for port_n in ports)
            await stack.enter_async_context(serving_stops(stop_listener, stops, stop_guard, tls))
            servers.append(_Server(_config(app, limits, guard), listener, limits, tls))
            helpers.append(tokens.keep_watching())
        tasks = [asyncio.create_task(server.run_until_told(), name=f"api server {server.name}") for server in servers]
        tasks += [asyncio.create_task(helper, name="api tokens") for helper in helpers]

        async def serve_again(listener: socket.socket) -> None:
            servers[0].accept_also(listener)

        async def serve_stops_again(listener: socket.socket) -> None:
            await stack.enter_async_context(serving_stops(listener, stops))

        for path, serve_on in ((socket_path, serve_again), (stop_socket_beside(socket_path), serve_stops_again)):
            make = partial(unix_socket, path, socket_mode, socket_group)
            keeping = _keep_socket_file(path, make, serve_on, stack)
            tasks.append(asyncio.create_task(keeping, name=f"api socket file {path.name}"))
        try:
            for server in servers:
                await server.answering.wait()
            if ready is not None:
                ready.set()
            ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            app.state.closing.begin()
            for server in servers:
                server.should_exit = True
            for task in tasks[len(servers) :]:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _keep_socket_file(
    path: Path,
    make: Callable[[], contextlib.AbstractContextManager[socket.socket]],
    serve_on: Callable[[socket.socket], Awaitable[None]],
    stack: contextlib.AsyncExitStack,
) -> None:
    """Make the socket file again when somebody has taken it away: clients, and a stop, would find nobody. Who is
    connected stays so."""
    ours = _identity(path)
    while True:
        await asyncio.sleep(SOCKET_CHECK_S)
        if ours is not None and _identity(path) == ours:
            continue
        try:
            listener = stack.enter_context(make())
            ours = _identity(path)
        except (OSError, SocketError) as error:
            log.warning("%s was taken away and cannot be made again: %s", path, error)
            continue
        await serve_on(listener)
        log.warning("%s was taken away: made again", path)


def _identity(path: Path) -> tuple[int, int] | None:
    """Which file is there; None: there is none."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _config(app: FastAPI, limits: ApiLimits, guard: TcpGuard | None = None) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=_bounded_http(limits, guard, app.state.stops),
        ws=_StreamProtocol,
        ws_max_size=limits.body_max_bytes_n,
        ws_per_message_deflate=False,
        lifespan="off",
        log_config=None,
        # Below that uvicorn writes a line for every malformed request: a flood of those would fill the log.
        log_level="error",
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=1,
    )


class _Server(uvicorn.Server):
    """uvicorn on one socket of ours. It ends when ``should_exit`` is set and by nothing else: signals belong to the
    daemon. It takes new connections one by one and at a pace: asyncio's own server takes all that wait at once."""

    def __init__(
        self, config: uvicorn.Config, listener: socket.socket, limits: ApiLimits, tls: ssl.SSLContext | None = None
    ) -> None:
        super().__init__(config)
        self._listener = listener
        self._tls = tls
        self._handshakes: dict[asyncio.Task[None], None] = {}
        self._pace = Pace(limits.accept_rate_hz, ACCEPT_BURST_N)
        self._also_accepting: list[asyncio.Task[None]] = []
        self.answering = asyncio.Event()
        self.name = str(listener.getsockname())

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def run_until_told(self) -> None:
        """Serve until ``should_exit``."""
        serving = asyncio.create_task(self.serve(), name=f"api serve {self.name}")
        accepting = asyncio.create_task(self._accept(self._listener), name=f"api accept {self.name}")
        try:
            # Neither ends by itself: the first that does has failed, or was told to.
            await asyncio.wait((accepting, serving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.should_exit = True
            for task in (accepting, *self._also_accepting, *self._handshakes):
                task.cancel()
            await asyncio.gather(*self._handshakes, return_exceptions=True)
            results = await asyncio.gather(accepting, *self._also_accepting, serving, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Take part in uvicorn's start without a listener of its own."""
        del sockets
        await self.lifespan.startup()
        self.servers = []
        self.started = True
        self._listener.listen(LISTEN_QUEUE_N)
        self.answering.set()

    def accept_also(self, listener: socket.socket) -> None:
        """Take connections from a further socket."""
        listener.listen(LISTEN_QUEUE_N)
        self._also_accepting.append(asyncio.create_task(self._accept(listener), name=f"api accept again {self.name}"))

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        await self.answering.wait()
        while True:
            try:
                connection, _ = await loop.sock_accept(listener)
            except ConnectionError:
                continue
            except OSError as error:
                log.warning("%s: no connection taken: %s", self.name, error)
                await asyncio.sleep(ACCEPT_RETRY_S)
                continue
            if connection.family != socket.AF_UNIX:
                _notice_loss(connection)
            if self._tls is None:
                await loop.connect_accepted_socket(self._protocol, connection)
            else:
                self._begin_handshake(connection)
            await asyncio.sleep(self._pace.delay_s(loop.time()))

    def _begin_handshake(self, connection: socket.socket) -> None:
        """Who is slow at it, or says nothing, keeps nobody else waiting."""
        if len(self._handshakes) >= HANDSHAKES_N:
            next(iter(self._handshakes)).cancel()
        task = asyncio.create_task(self._shake_hands(connection), name=f"api handshake {self.name}")
        self._handshakes[task] = None
        task.add_done_callback(self._handshakes.pop)

    async def _shake_hands(self, connection: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        with contextlib.suppress(OSError):  # no TLS, or gone: a stranger's affair
            await loop.connect_accepted_socket(
                self._protocol, connection, ssl=self._tls, ssl_handshake_timeout=HANDSHAKE_S
            )

    def _protocol(self) -> asyncio.Protocol:
        protocol = cast("type[H11Protocol]", self.config.http_protocol_class)
        return protocol(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)


def _notice_loss(connection: socket.socket) -> None:
    """Have the kernel end a connection whose other end has been gone for :data:`LOST_AFTER_S` without a word (its cable
    pulled, its computer off): what it moves ends with it."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, LOST_AFTER_S - 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LOST_AFTER_S * 1000)


class _SmallReads(asyncio.BufferedProtocol):
    """Takes what came in small pieces. asyncio reads up to 256 KiB at once, and the tick waits while a protocol takes
    all of that apart: tens of thousands of frames, or a head of any length."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._piece = memoryview(bytearray(READ_BYTES))

    def get_buffer(self, sizehint: int) -> memoryview:
        """Where the transport puts the next piece; TLS cuts it, and a cut of a bytearray would be a copy."""
        del sizehint
        return self._piece

    def buffer_updated(self, nbytes: int) -> None:
        """A piece is there."""
        self.data_received(bytes(self._piece[:nbytes]))

    def eof_received(self) -> None:
        """As in uvicorn: the transport closes."""

    if TYPE_CHECKING:

        def data_received(self, data: bytes) -> None:
            """What the protocol does with a piece."""


_numbers = itertools.count(1)


def _numbered(client: tuple[str, int] | None) -> tuple[str, int]:
    """Where a connection comes from, and a number that no other connection of this process has."""
    return (client[0] if client is not None else "unix", next(_numbers))


def _user_of(transport: asyncio.BaseTransport) -> str:
    """Who is at the other end of a unix socket, as the kernel says."""
    connection = transport.get_extra_info("socket")
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return f"uid {struct.unpack('3i', credentials)[1]}"


def _bounded_http(limits: ApiLimits, guard: TcpGuard | None, stops: StopLane) -> type[H11Protocol]:
    """uvicorn's HTTP protocol with a bound on open connections: the oldest makes room for a new one, so that a client
    that wants to send stop gets in however many hang about."""
    open_connections: OrderedDict[H11Protocol, None] = OrderedDict()

    class BoundedProtocol(_SmallReads, H11Protocol):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.conn = self._judged = JudgedConnection(guard)
            self.app_state = self._judged.known
            self._ending: asyncio.TimerHandle | None = None
            self._looked_at_n = 0

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn
            super().connection_made(transport)
            self.client = _numbered(self.client)
            if guard is None:
                self._judged.known["grant"] = Grant(_user_of(transport), Right.COMMAND)
            open_connections[self] = None
            if len(open_connections) > limits.connections_max_n:
                oldest, _ = open_connections.popitem(last=False)
                oldest.transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            open_connections.pop(self, None)
            if self._ending is not None:
                self._ending.cancel()
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            if self._ending is not None:
                return
            super().data_received(data)
            if self.conn.their_state is h11.DONE and (ahead := self.conn.trailing_data[0]):
                self._look_ahead(ahead)

        def _look_ahead(self, ahead: bytes) -> None:
            """What was sent before the request in work was answered. A stop in it waits for no other's answer; what
            moves is not obeyed here any more, for nobody can tell when it was said."""
            self._judged.known[SENT_AHEAD] = True
            if len(ahead) < READ_AHEAD_BYTES:
                self.flow.resume_reading()
            if len(ahead) < self._looked_at_n:
                self._looked_at_n = 0
            # From the beginning of the line that was not complete; a request follows the body before it on one line.
            begin = ahead.rfind(b"\n", 0, self._looked_at_n) + 1
            self._looked_at_n = len(ahead)
            admitted = guard is None or self._judged.known.get("grant") is not None
            if admitted and any(map(is_stop_target, ahead[begin:].split())):
                stops.overtake()

        def send_400_response(self, msg: str) -> None:
            """What was not taken is answered in the same form as everything else, as far as it can be answered."""
            del msg  # uvicorn's word for any of the reasons; the error under way knows which
            status_code, problem = problem_of_head(sys.exc_info()[1])
            body = problem.model_dump_json().encode()
            if guard is None and is_stop_line(self._judged.line):
                # Its line is the stop; who may open the unix socket may stop. On TCP a head without a valid token is
                # nobody's.
                status_code, body = 200, stops.at_once().model_dump_json().encode()
            length = str(len(body))
            headers = [("content-type", "application/json"), ("content-length", length), ("connection", "close")]
            response = h11.Response(status_code=status_code, headers=headers)
            for event in (response, h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
            if self.transport.can_write_eof():
                self.transport.write_eof()
            # What still comes is thrown away for a moment: closed at once, the kernel would take the answer back.
            self._ending = self.loop.call_later(LINGER_S, self.transport.close)

        def handle_websocket_upgrade(self, event: Any) -> None:
            open_connections.pop(self, None)
            super().handle_websocket_upgrade(event)

    return BoundedProtocol


class _StreamProtocol(_SmallReads, WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol with small buffers, so that what a slow client reads at last is not old."""

    _pong = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.client = _numbered(self.client)
        self.transport.set_write_buffer_limits(high=1)  # TLS would take 0 for never
        connection = transport.get_extra_info("socket")
        if connection is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, STREAM_BUFFER_BYTES)

    def handle_ping(self) -> None:
        """Answer; a client that does not read gets the newest answer alone, once it does (RFC 6455, 5.5.3)."""
        answer = b"".join(self.conn.data_to_send())
        if self.writable.is_set():
            self.transport.write(answer)
        else:
            self._pong = answer or self._pong

    async def send(self, message: ASGISendEvent) -> None:
        """As in uvicorn, which takes a refusal for no answer, and would write a line for each into the log."""
        await super().send(message)
        if self.close_sent:
            self.handshake_complete = True

    def resume_writing(self) -> None:
        super().resume_writing()
        answer, self._pong = self._pong, b""
        self.transport.write(answer)
