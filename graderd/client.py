"""The one client of a running daemon: :class:`Client`, and :class:`AsyncClient` for programs with an event loop.

::

    with Client() as grader:
        grader.command("arm")
        grader.until(lambda status: status.mode == "manual", 10.0, "armed")
        with grader.lease() as lease:
            lease.jog("rotate", 5.0, relative=True)  # degrees
            for status in lease.statuses():          # renews the lease; the blade holds when the block ends
                if status.axes["rotation"].in_position:
                    break

Both speak over the unix socket, whose file rights decide who may command, or over TCP with the daemon's token. Lengths
are millimetres, angles degrees counter-clockwise seen from above, times seconds.

**Nothing that may move the machine is ever sent twice.** A request that met a full queue never went out, and is tried
again. One that went out and was not answered is repeated only where it is a question or a stop; for everything else the
error says that it :attr:`~ClientError.may_be_done`.

Loaded with this module is the standard library alone. What a method needs beyond (pydantic for typed answers,
websockets for streams and leases) is loaded when it is called: ``graderd stop`` waits for none of it.
"""

from __future__ import annotations

import asyncio
import errno
import getpass
import http.client
import json
import os
import socket
import struct
import threading
import time
import tomllib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar
from urllib.parse import quote, urlencode, urlsplit

from graderd import places

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection as AsyncConnection
    from websockets.sync.client import ClientConnection

    from graderd.core.commands import Reply
    from graderd.core.status import Status

T = TypeVar("T")

STOP_SUFFIX: Final = ".stop"
"""Beside the interface's socket ``graderd.sock``, ``graderd.stop`` serves nothing but stop."""
STOP_PATH: Final = "/v1/stop"
STOP_LANE_S: Final = 0.5
"""On TCP, a port that serves nothing but stop is asked first where the program names it. Where it does not answer in so
long, the interface is asked."""
TIMEOUT_S: Final = 5.0
SERVICE_TIMEOUT_S: Final = 120.0
LEASE_HZ: Final = 10.0
"""How often a lease is renewed, and how often its holder sees a status: three times within the 0.3 s that it lasts."""
RENEWAL: Final = '{"command": "renew"}'
"""What a jog's lease is renewed with; a maneuver takes any message for it."""
BUSY_RETRY_S: Final = 3.0
RETRY_PAUSE_S: Final = 0.02
POLL_S: Final = 0.05


class ClientError(Exception):
    """What was asked of the daemon did not happen, or may not have happened.

    ::

        ClientError
        ├── NoDaemonError        nobody answers at this address, or what answers is not graderd
        ├── RefusedError         the daemon answered, and did not do it
        │   └── LeaseLostError   the lease ended on the way; the blade holds
        └── NotReachedError      the state waited for did not come in time

    ``where`` names the socket, command or field, ``cause`` says why, ``remedy`` what a person does about it; ``str()``
    gives the three in one line. ``may_be_done``: the request went out, and no answer says what became of it.
    """

    def __init__(self, where: str, cause: str, remedy: str = "", *, may_be_done: bool = False) -> None:
        super().__init__(where, cause, remedy)
        self.where = where
        self.cause = cause
        self.remedy = remedy
        self.may_be_done = may_be_done

    def __str__(self) -> str:
        head = f"{self.where}: {self.cause}" if self.where else self.cause
        return f"{head}. {self.remedy}" if self.remedy else head


class NoDaemonError(ClientError):
    """Nobody answers at this address, or not in time, or what answers is not graderd."""


class _ClosedError(NoDaemonError):
    """A connection ended under way. Where a lease was on it, that is over too."""


class RefusedError(ClientError):
    """The daemon answered with a problem.

    ``status_code`` is the answer's HTTP status (the table of docs/integrators/api.md), None on the lease's WebSocket.
    """

    def __init__(self, where: str, cause: str, remedy: str = "", *, status_code: int | None = None) -> None:
        # 500 and 504: the daemon failed while it was at it.
        super().__init__(where, cause, remedy, may_be_done=status_code in (500, 504))
        self.status_code = status_code


class LeaseLostError(RefusedError):
    """The lease ended before its holder gave it back: a stop, a fault, or a renewal that came too late."""


class NotReachedError(ClientError):
    """What was waited for did not come in time; ``status`` is the last one seen, None where nobody answered."""

    def __init__(self, where: str, cause: str, remedy: str, status: Status | None) -> None:
        super().__init__(where, cause, remedy)
        self.status = status


def default_socket() -> Path:
    """$GRADERD_SOCKET, else the one the machine's configuration names, else the service's, else the one of a daemon
    this user runs: the first that is there, or else is kept from this user."""
    named = os.environ.get("GRADERD_SOCKET")
    if named:
        return Path(named)
    own = places.own_socket()
    own_socket = [] if own is None else [own]
    known = [*_configured_socket(), places.SOCKET, *own_socket]
    for wanted in (_Presence.THERE, _Presence.KEPT_FROM_US):
        for path in known:
            if _presence(path) is wanted:
                return path
    return (own_socket or known)[0]


class _Presence(Enum):
    THERE = auto()
    KEPT_FROM_US = auto()
    ABSENT = auto()


def _presence(path: Path) -> _Presence:
    try:
        path.stat()
    except PermissionError:
        return _Presence.KEPT_FROM_US
    except OSError:
        return _Presence.ABSENT
    return _Presence.THERE


def _configured_socket() -> list[Path]:
    """``api.socket`` of the machine's configuration, read without judging the rest."""
    try:
        socket_path = tomllib.loads(places.config().read_text(encoding="utf-8"))["api"]["socket"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [Path(socket_path)] if isinstance(socket_path, str) and socket_path else []


def _is_socket(path: Path) -> bool:
    """A place that this user may not look into has none for him: the connection then says so."""
    try:
        return path.is_socket()
    except PermissionError:
        return False


def user_name() -> str:
    """Who asks, for the daemon's records: the user."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


class Client:
    """A client that waits for its answers.

    Args:
        address: path of the unix socket, or ``http://HOST:PORT`` (``https://`` by the system's certificate
            authorities, or those of ``$SSL_CERT_FILE``); None: :func:`default_socket`.
        token: one that ``graderd token create`` made, on TCP.
        stop_port_n: on TCP, the port of the same host that serves stop alone (the daemon's ``api.tcp.stop_port_n``,
            8432 as it comes). None: a stop goes to the interface like everything else. It is never guessed: what
            listens on another port may be anybody's, and would be handed the token.
        name: who asks, for the daemon's records; None: the user.
        timeout_s: how long to wait for an answer.

    Raises:
        ValueError: the address is no such thing.

    Nothing stays open between requests. Every method raises :class:`ClientError`.
    """

    def __init__(
        self,
        address: Path | str | None = None,
        *,
        token: str = "",
        name: str | None = None,
        timeout_s: float = TIMEOUT_S,
        stop_port_n: int | None = None,
    ) -> None:
        self._address = _Address.of(address, token, stop_port_n)
        self.name = (user_name() if name is None else name)[:80]
        self.timeout_s = timeout_s

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    # -- as it is ------------------------------------------------------------------------------------------------------

    def get(self, path: str) -> Any:
        """The JSON answer to GET ``path``."""
        return self._address.json_of(self._request("GET", path))

    def post(self, path: str, body: Mapping[str, Any], timeout_s: float | None = None) -> Any:
        """The JSON answer to POST ``path``. ``body`` holds no infinity and no NaN (ValueError)."""
        return self._address.json_of(self._request("POST", path, body, timeout_s))

    # -- questions -----------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """Everything at the last control tick."""
        return self._address.status_of(self.get("/v1/status"))

    @contextmanager
    def statuses(self, rate_hz: float = 20.0) -> Iterator[Iterator[Status]]:
        """The status as it changes, at most so often: each the newest there is, however slowly they are taken."""
        with self.raw_statuses(rate_hz) as statuses:
            yield map(self._address.status_of, statuses)

    @contextmanager
    def raw_statuses(self, rate_hz: float = 20.0) -> Iterator[Iterator[dict[str, Any]]]:
        """:meth:`statuses` as the dictionaries that came, without pydantic."""
        with self._websocket("/v1/stream", rate_hz=rate_hz) as stream:
            yield iter(_Newest(stream, self._address, self.timeout_s + 1.0 / rate_hz).take, None)

    def until(self, reached: Callable[[Status], bool], timeout_s: float, what: str) -> Status:
        """The first status for which ``reached`` is true. A daemon that does not answer (yet) is waited for.

        Raises:
            NotReachedError: none within ``timeout_s``; ``what`` says what was waited for.
        """
        give_up_s = time.monotonic() + timeout_s
        status: Status | None = None
        while True:
            try:
                status = self.status()
                if reached(status):
                    return status
            except ClientError as error:
                if not _may_pass(error):
                    raise
            if time.monotonic() > give_up_s:
                raise _not_reached(what, timeout_s, status)
            time.sleep(POLL_S)

    def config(self) -> dict[str, Any]:
        """The configuration in force."""
        found: dict[str, Any] = self.get("/v1/config")
        return found

    def preview_jpeg(self) -> bytes:
        """The newest picture with the three zones drawn on it."""
        return self._request("GET", "/v1/preview.jpg")

    @contextmanager
    def bus_text(self, name: str = "can") -> Iterator[Iterator[str]]:
        """A wire's traffic (``can``, ``servo``), some lines a piece; one that begins with ``#`` tells of lost ones."""
        with self._websocket(f"/v1/bus/{quote(name, safe='')}") as stream:
            yield iter(lambda: str(stream.recv()), None)

    # -- commands ------------------------------------------------------------------------------------------------------

    def stop(self, reason: str = "stop request") -> Reply:
        """End motion at once and latch. Wins over everything; repeated by itself until it is answered."""
        return _reply_of(self.post(STOP_PATH, _stop_body(self.name, reason)))

    def command(self, command: str, **fields: Any) -> Reply:
        """One command (``arm``, ``disarm``, ``auto``, ``manual``…): see docs/integrators/api.md.

        For ``jog`` and ``preset`` there is :meth:`lease`, which ends with its block.

        Raises:
            RefusedError: refused; the machine is as it was.
            NoDaemonError: not answered, perhaps done (``may_be_done``). It is not repeated.
        """
        return _reply_of(self.post("/v1/commands", {"command": command, "client": self.name, **fields}))

    def reset(self, stop_n: int | None = None) -> Reply:
        """Leave the latched stop for disarmed.

        It clears the stop with this number (``stop_n`` of the status), None: the one that is latched at the call; never
        one that came meanwhile.
        """
        return self.command("reset", stop_n=self.get("/v1/status")["stop_n"] if stop_n is None else stop_n)

    def service(self, name: str, timeout_s: float = SERVICE_TIMEOUT_S, **arguments: Any) -> dict[str, Any]:
        """Run a device service, such as ``rotation.verify_profile``, and return what it found."""
        found: dict[str, Any] = self.post(f"/v1/services/{quote(name)}", arguments, timeout_s)
        return found

    def maneuver(self, name: str, timeout_s: float = SERVICE_TIMEOUT_S, **arguments: Any) -> dict[str, Any]:
        """Run a service that moves the blade, such as ``rotation.step_response``, and return what it found. It ends,
        and the blade holds, when this program ends or stands still.

        Raises:
            RefusedError: refused, failed, or ended under way.
        """
        from websockets.exceptions import ConnectionClosed

        give_up_s = time.monotonic() + timeout_s
        with self._websocket(f"/v1/services/{quote(name)}") as connection:
            connection.send(json.dumps(arguments, allow_nan=False))
            while time.monotonic() < give_up_s:
                with suppress(TimeoutError):
                    return _result_of(name, connection.recv(1.0 / LEASE_HZ))
                with suppress(ConnectionClosed):  # its last word has come meanwhile, and is read next
                    connection.send(RENEWAL)
        raise self._address.unreachable(TimeoutError(), went_out=True)

    @contextmanager
    def lease(self, name: str = "", rate_hz: float = LEASE_HZ) -> Iterator[Lease]:
        """Move by hand for as long as the block lasts: see :class:`Lease`. ``name`` is added to the client's."""
        with (
            self._websocket("/v1/stream", rate_hz=rate_hz) as stream,
            self._websocket("/v1/jog", client=_lease_name(self.name, name)) as jog,
        ):
            newest = _Newest(stream, self._address, self.timeout_s + 1.0 / rate_hz)
            newest.take()  # the stream works before anything moves
            lease = Lease(self, self._address, jog, newest)
            try:
                yield lease
            finally:
                # Closing the connection does the same; this way it is done when the block is left.
                with suppress(ClientError):
                    lease.release()

    # -- wires ---------------------------------------------------------------------------------------------------------

    def _request(
        self, method: str, path: str, body: Mapping[str, Any] | None = None, timeout_s: float | None = None
    ) -> bytes:
        payload = None if body is None else json.dumps(body, allow_nan=False)
        give_up_s = time.monotonic() + BUSY_RETRY_S
        stop_lane = path == STOP_PATH
        while True:
            connection = self._address.http_connection(timeout_s or self.timeout_s, stop_lane)
            went_out = False
            try:
                connection.connect()
                went_out = True
                connection.request(method, path, payload, self._address.headers(with_body=payload is not None))
                answer = connection.getresponse()
                content = answer.read()
                if not stop_lane or answer.status == http.HTTPStatus.OK:
                    return self._address.checked(answer.status, content)
                stop_lane = False  # it is not what we took it for: a stop may be asked for twice
                continue
            except (OSError, http.client.HTTPException) as error:
                if stop_lane:
                    stop_lane = False
                    continue
                again = _may_repeat(error, method, path) if went_out else _is_full(error)
                if not again or time.monotonic() > give_up_s:
                    raise self._address.unreachable(error, went_out) from error
            finally:
                connection.close()
            time.sleep(RETRY_PAUSE_S)

    @contextmanager
    def _websocket(self, path: str, **query: str | float) -> Iterator[ClientConnection]:
        from websockets.exceptions import ConnectionClosed, InvalidHandshake
        from websockets.sync.client import connect

        address = self._address
        try:
            connection = connect(
                address.websocket_uri(path, query),
                sock=None if address.path is None else _connect_unix(address.path, self.timeout_s),
                additional_headers=address.headers(),
                compression=None,
                max_size=None,
                proxy=None,
                open_timeout=self.timeout_s,
                # Pins what the call returns: a connection, whatever the library's default becomes.
                legacy=True,
            )
        except OSError as error:
            raise address.unreachable(error) from error
        except InvalidHandshake as error:
            raise _stream_refused(path, error) from error
        try:
            with connection:
                yield connection
        except ConnectionClosed as error:
            raise address.closed() from error


class Lease:
    """The right to move by hand, from :meth:`Client.lease`; another client's jog is refused meanwhile.

    It lapses 0.3 s after its last renewal, and ends with the connection, however the program ends. :meth:`statuses`
    renews it at each step: so a program that hangs moves nothing for longer. Several motions may follow each other.
    """

    def __init__(self, client: Client, address: _Address, jog: ClientConnection, newest: _Newest) -> None:
        self._client = client
        self._address = address
        self._jog = jog
        self._newest = newest
        self._motion = "lease"

    def jog(self, axis: str, value: float, *, relative: bool = False) -> None:
        """Move one axis: ``rotate``, ``slope``, ``pitch`` in degrees, ``lift``, ``tilt``, ``height`` in mm.

        Raises:
            RefusedError: mode, limits, or somebody else's lease; nothing moves.
        """
        self._begin({"command": "jog", "axis": axis, "value": value, "relative": relative})

    def preset(self, name: str) -> None:
        """Move to a pose of the configuration.

        Raises:
            RefusedError: as for :meth:`jog`, or there is no such pose.
        """
        self._begin({"command": "preset", "name": name})

    def renew(self) -> None:
        """Keep the lease.

        Raises:
            LeaseLostError: it has ended; says why.
        """
        try:
            self._ask({"command": "renew"})
        except (RefusedError, _ClosedError) as error:
            raise self._lost(error) from error

    def release(self) -> None:
        """Hold where the blade is, and give the lease back. A lease that has ended already is no error."""
        with suppress(RefusedError, _ClosedError):
            self._ask({"command": "release"})

    def statuses(self) -> Iterator[Status]:
        """The status as it changes, none from before the last motion began; each step renews the lease.

        Raises:
            LeaseLostError: the lease has ended; says why.
        """
        return map(self._address.status_of, self.raw_statuses())

    def raw_statuses(self) -> Iterator[dict[str, Any]]:
        """:meth:`statuses` as the dictionaries that came, without pydantic."""
        return iter(self._step, None)

    def _step(self) -> dict[str, Any]:
        try:
            status = self._newest.take()
        except _ClosedError as error:
            raise self._lost(error) from error
        self.renew()
        return status

    def _lost(self, error: ClientError) -> ClientError:
        """Why there is no lease any more: the daemon knows, if it is still there. One that stood still for long
        (halted, asleep) finds its connections closed, too."""
        try:
            return _lease_lost(self._motion, self._client.get("/v1/status"))
        except NoDaemonError:
            return error

    def _begin(self, message: dict[str, Any]) -> None:
        self._motion = message["command"]
        self._newest.forget()
        self._ask(message)

    def _ask(self, message: dict[str, Any]) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            self._jog.send(json.dumps(message, allow_nan=False))
            answer = json.loads(self._jog.recv(self._client.timeout_s))
        except TimeoutError as error:
            self._jog.close()  # an answer that comes later must not be taken for the next one's
            raise self._address.unreachable(error, went_out=True) from error
        except ConnectionClosed as error:
            raise self._address.closed() from error
        _check_reply(message["command"], answer)


class AsyncClient:
    """:class:`Client` for programs with an event loop: same arguments, methods and errors.

    A request runs in a thread of its own, so none waits behind another; streams and leases are on the loop. Cancelling
    a call ends the waiting, not what went out.
    """

    def __init__(
        self,
        address: Path | str | None = None,
        *,
        token: str = "",
        name: str | None = None,
        timeout_s: float = TIMEOUT_S,
        stop_port_n: int | None = None,
    ) -> None:
        self._waiting = Client(address, token=token, name=name, timeout_s=timeout_s, stop_port_n=stop_port_n)
        self._address = _Address.of(address, token, stop_port_n)
        self.name = self._waiting.name
        self.timeout_s = timeout_s

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def get(self, path: str) -> Any:
        """See :meth:`Client.get`."""
        return await _in_thread(lambda: self._waiting.get(path))

    async def post(self, path: str, body: Mapping[str, Any], timeout_s: float | None = None) -> Any:
        """See :meth:`Client.post`."""
        return await _in_thread(lambda: self._waiting.post(path, body, timeout_s))

    async def status(self) -> Status:
        """See :meth:`Client.status`."""
        return self._address.status_of(await self.get("/v1/status"))

    @asynccontextmanager
    async def statuses(self, rate_hz: float = 20.0) -> AsyncIterator[AsyncIterator[Status]]:
        """See :meth:`Client.statuses`."""
        async with self._websocket("/v1/stream", rate_hz=rate_hz) as stream:
            newest = _AsyncNewest(stream, self._address, self.timeout_s + 1.0 / rate_hz)

            async def take() -> Status:
                return self._address.status_of(await newest.take())

            yield _Each(take)

    async def until(self, reached: Callable[[Status], bool], timeout_s: float, what: str) -> Status:
        """See :meth:`Client.until`."""
        give_up_s = time.monotonic() + timeout_s
        status: Status | None = None
        while True:
            try:
                status = await self.status()
                if reached(status):
                    return status
            except ClientError as error:
                if not _may_pass(error):
                    raise
            if time.monotonic() > give_up_s:
                raise _not_reached(what, timeout_s, status)
            await asyncio.sleep(POLL_S)

    async def config(self) -> dict[str, Any]:
        """See :meth:`Client.config`."""
        return await _in_thread(self._waiting.config)

    async def preview_jpeg(self) -> bytes:
        """See :meth:`Client.preview_jpeg`."""
        return await _in_thread(self._waiting.preview_jpeg)

    @asynccontextmanager
    async def bus_text(self, name: str = "can") -> AsyncIterator[AsyncIterator[str]]:
        """See :meth:`Client.bus_text`."""
        async with self._websocket(f"/v1/bus/{quote(name, safe='')}") as stream:

            async def take() -> str:
                return str(await stream.recv())

            yield _Each(take)

    async def stop(self, reason: str = "stop request") -> Reply:
        """See :meth:`Client.stop`."""
        return await _in_thread(lambda: self._waiting.stop(reason))

    async def command(self, command: str, **fields: Any) -> Reply:
        """See :meth:`Client.command`."""
        return await _in_thread(lambda: self._waiting.command(command, **fields))

    async def reset(self, stop_n: int | None = None) -> Reply:
        """See :meth:`Client.reset`."""
        return await _in_thread(lambda: self._waiting.reset(stop_n))

    async def service(self, name: str, timeout_s: float = SERVICE_TIMEOUT_S, **arguments: Any) -> dict[str, Any]:
        """See :meth:`Client.service`."""
        return await _in_thread(lambda: self._waiting.service(name, timeout_s, **arguments))

    async def maneuver(self, name: str, timeout_s: float = SERVICE_TIMEOUT_S, **arguments: Any) -> dict[str, Any]:
        """See :meth:`Client.maneuver`; it ends, too, when this is cancelled."""
        from websockets.exceptions import ConnectionClosed

        try:
            async with asyncio.timeout(timeout_s), self._websocket(f"/v1/services/{quote(name)}") as connection:
                await connection.send(json.dumps(arguments, allow_nan=False))
                while True:
                    with suppress(TimeoutError):
                        async with asyncio.timeout(1.0 / LEASE_HZ):
                            return _result_of(name, await connection.recv())
                    with suppress(ConnectionClosed):
                        await connection.send(RENEWAL)
        except TimeoutError as error:
            raise self._address.unreachable(error, went_out=True) from error

    @asynccontextmanager
    async def lease(self, name: str = "", rate_hz: float = LEASE_HZ) -> AsyncIterator[AsyncLease]:
        """See :meth:`Client.lease`."""
        async with (
            self._websocket("/v1/stream", rate_hz=rate_hz) as stream,
            self._websocket("/v1/jog", client=_lease_name(self.name, name)) as jog,
        ):
            newest = _AsyncNewest(stream, self._address, self.timeout_s + 1.0 / rate_hz)
            await newest.take()  # the stream works before anything moves
            lease = AsyncLease(self, self._address, jog, newest)
            try:
                yield lease
            finally:
                with suppress(ClientError):
                    await lease.release()

    @asynccontextmanager
    async def _websocket(self, path: str, **query: str | float) -> AsyncIterator[AsyncConnection]:
        from websockets.asyncio.client import connect
        from websockets.exceptions import ConnectionClosed, InvalidHandshake

        address = self._address
        where: dict[str, Any] = {}
        try:
            if address.path is not None:
                where["sock"] = await _in_thread(partial(_connect_unix, address.path, self.timeout_s))
            connection = await connect(
                address.websocket_uri(path, query),
                additional_headers=address.headers(),
                compression=None,
                max_size=None,
                proxy=None,
                open_timeout=self.timeout_s,
                **where,
            )
        except OSError as error:
            raise address.unreachable(error) from error
        except InvalidHandshake as error:
            raise _stream_refused(path, error) from error
        try:
            async with connection:
                yield connection
        except ConnectionClosed as error:
            raise address.closed() from error


class AsyncLease:
    """:class:`Lease` for programs with an event loop."""

    def __init__(self, client: AsyncClient, address: _Address, jog: AsyncConnection, newest: _AsyncNewest) -> None:
        self._client = client
        self._address = address
        self._jog = jog
        self._newest = newest
        self._motion = "lease"

    async def jog(self, axis: str, value: float, *, relative: bool = False) -> None:
        """See :meth:`Lease.jog`."""
        await self._begin({"command": "jog", "axis": axis, "value": value, "relative": relative})

    async def preset(self, name: str) -> None:
        """See :meth:`Lease.preset`."""
        await self._begin({"command": "preset", "name": name})

    async def renew(self) -> None:
        """See :meth:`Lease.renew`."""
        try:
            await self._ask({"command": "renew"})
        except (RefusedError, _ClosedError) as error:
            raise await self._lost(error) from error

    async def release(self) -> None:
        """See :meth:`Lease.release`."""
        with suppress(RefusedError, _ClosedError):
            await self._ask({"command": "release"})

    def statuses(self) -> AsyncIterator[Status]:
        """See :meth:`Lease.statuses`."""
        return _Each(self._step)

    async def _step(self) -> Status:
        try:
            status = await self._newest.take()
        except _ClosedError as error:
            raise await self._lost(error) from error
        await self.renew()
        return self._address.status_of(status)

    async def _lost(self, error: ClientError) -> ClientError:
        """See :meth:`Lease._lost`."""
        try:
            return _lease_lost(self._motion, await self._client.get("/v1/status"))
        except NoDaemonError:
            return error

    async def _begin(self, message: dict[str, Any]) -> None:
        self._motion = message["command"]
        await self._newest.forget()
        await self._ask(message)

    async def _ask(self, message: dict[str, Any]) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            async with asyncio.timeout(self._client.timeout_s):
                await self._jog.send(json.dumps(message, allow_nan=False))
                answer = json.loads(await self._jog.recv())
        except TimeoutError as error:
            await self._jog.close()
            raise self._address.unreachable(error, went_out=True) from error
        except ConnectionClosed as error:
            raise self._address.closed() from error
        _check_reply(message["command"], answer)


# -- what both have in common ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Address:
    """Where the daemon is, and what its answers and silences mean there. ``path`` None: TCP."""

    path: Path | None
    host: str
    port_n: int
    token: str
    tls: bool = False
    stop_port_n: int | None = None

    @classmethod
    def of(cls, address: Path | str | None, token: str, stop_port_n: int | None) -> _Address:
        if isinstance(address, str) and "://" in address:
            parts = urlsplit(address)
            if parts.scheme not in ("http", "https") or not parts.hostname or parts.path.strip("/"):
                raise ValueError(f"{address}: the daemon speaks http://HOST:PORT, and with a certificate https://")
            tls = parts.scheme == "https"
            return cls(None, parts.hostname, parts.port or (443 if tls else 80), token, tls, stop_port_n)
        return cls(default_socket() if address is None else Path(address), "localhost", 80, token)

    def __str__(self) -> str:
        return f"http{'s' * self.tls}://{self.netloc}" if self.path is None else str(self.path)

    @property
    def netloc(self) -> str:
        """Host and port as URIs and the Host header have them."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.path is not None else f"{host}:{self.port_n}"

    def headers(self, *, with_body: bool = False) -> dict[str, str]:
        token = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        return token | ({"Content-Type": "application/json"} if with_body else {})

    def websocket_uri(self, path: str, query: Mapping[str, str | float]) -> str:
        return f"ws{'s' * self.tls}://{self.netloc}{path}{'?' if query else ''}{urlencode(query)}"

    def http_connection(self, timeout_s: float, stop_lane: bool = False) -> http.client.HTTPConnection:
        """``stop_lane``: where stop alone is served, and nobody else waits, if there is such a place."""
        if self.path is None:
            connection = http.client.HTTPSConnection if self.tls else http.client.HTTPConnection
            if stop_lane and self.stop_port_n is not None:
                return connection(self.host, self.stop_port_n, timeout=min(timeout_s, STOP_LANE_S))
            return connection(self.host, self.port_n, timeout=timeout_s)
        stop_socket = self.path.with_suffix(STOP_SUFFIX)
        if stop_lane and _is_socket(stop_socket):
            return _UnixConnection(stop_socket, timeout_s)
        return _UnixConnection(self.path, timeout_s)

    def checked(self, status_code: int, body: bytes) -> bytes:
        """The body of an answer that is no problem."""
        if status_code < 400:
            return body
        problem = self.json_of(body)
        if not isinstance(problem, dict):
            problem = {}
        raise RefusedError(
            str(problem.get("where", "")),
            str(problem.get("error", f"HTTP {status_code}")),
            str(problem.get("remedy", "")),
            status_code=status_code,
        )

    def json_of(self, body: bytes) -> Any:
        try:
            return json.loads(body)
        except ValueError as error:
            raise NoDaemonError(str(self), "what answers is not graderd", "see --socket") from error

    def status_of(self, found: Any) -> Status:
        from pydantic import ValidationError

        from graderd.core.status import Status

        try:
            return Status.model_validate(found)
        except ValidationError as error:
            first = error.errors()[0]
            what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
            raise NoDaemonError(
                str(self), f"its status is another version's ({what})", "use the client of the daemon's version"
            ) from error

    def unreachable(self, error: BaseException, went_out: bool = False) -> NoDaemonError:
        where = str(self)
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):
            return NoDaemonError(
                where,
                "no daemon serves this socket",
                "start it with 'graderd run' (without a machine: 'graderd run --sim') or 'systemctl start graderd', or "
                "name its socket with --socket",
            )
        if isinstance(error, PermissionError):
            return NoDaemonError(where, "this user may not use the daemon's socket", "join its group (graderd)")
        if isinstance(error, TimeoutError | BlockingIOError):
            return NoDaemonError(where, "the daemon did not answer in time", "see its log", may_be_done=went_out)
        return NoDaemonError(where, f"the daemon cannot be reached: {error}", "see its log", may_be_done=went_out)

    def closed(self) -> NoDaemonError:
        return _ClosedError(str(self), "the daemon closed the connection", "see graderd status")


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a unix socket."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        self.sock = _connect_unix(self._path, self.timeout or TIMEOUT_S)


class _Newest:
    """The newest status of a stream; what queued up before it is skipped."""

    def __init__(self, stream: ClientConnection, address: _Address, timeout_s: float) -> None:
        self._stream = stream
        self._address = address
        self._timeout_s = timeout_s

    def take(self) -> dict[str, Any]:
        """Wait for a status that has not been taken yet.

        Raises:
            NoDaemonError: none comes, or the connection ended.
        """
        from websockets.exceptions import ConnectionClosed

        try:
            text = self._stream.recv(self._timeout_s)
            with suppress(TimeoutError):
                while True:
                    text = self._stream.recv(0)
        except TimeoutError as error:
            raise self._address.unreachable(error) from error
        except ConnectionClosed as error:
            raise self._address.closed() from error
        status: dict[str, Any] = json.loads(text)
        return status

    def forget(self) -> None:
        """Skip what has come so far."""
        with suppress(TimeoutError):
            while True:
                self._stream.recv(0)


class _AsyncNewest:
    """:class:`_Newest` on an event loop."""

    def __init__(self, stream: AsyncConnection, address: _Address, timeout_s: float) -> None:
        self._stream = stream
        self._address = address
        self._timeout_s = timeout_s

    async def take(self) -> dict[str, Any]:
        """See :meth:`_Newest.take`."""
        from websockets.exceptions import ConnectionClosed

        try:
            async with asyncio.timeout(self._timeout_s):
                text = await self._stream.recv()
            with suppress(TimeoutError):
                while True:
                    async with asyncio.timeout(0):
                        text = await self._stream.recv()
        except TimeoutError as error:
            raise self._address.unreachable(error) from error
        except ConnectionClosed as error:
            raise self._address.closed() from error
        status: dict[str, Any] = json.loads(text)
        return status

    async def forget(self) -> None:
        """See :meth:`_Newest.forget`."""
        with suppress(TimeoutError):
            while True:
                async with asyncio.timeout(0):
                    await self._stream.recv()


class _Each(AsyncIterator[T]):
    """What a call gives, again and again: ``iter(call, None)`` for a coroutine."""

    def __init__(self, take: Callable[[], Awaitable[T]]) -> None:
        self._take = take

    async def __anext__(self) -> T:
        return await self._take()


async def _in_thread(call: Callable[[], T]) -> T:
    """What a blocking call returns. Its thread is its own and a daemon: it waits for no other call, and a program that
    ends does not wait for it."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def finish(outcome: Callable[[], None]) -> None:
        if not done.done():
            outcome()

    def run() -> None:
        try:
            outcome = partial(done.set_result, call())
        except Exception as error:
            outcome = partial(done.set_exception, error)
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(finish, outcome)

    threading.Thread(target=run, name="graderd client", daemon=True).start()
    return await done


def _connect_unix(path: Path, timeout_s: float) -> socket.socket:
    """A connection to the daemon. Where its queue is full, we wait in the kernel's line: a socket with a Python
    timeout is told "try again" instead, and whoever tries more often gets in first.

    Raises:
        OSError: no daemon, no right, or not within ``timeout_s`` (BlockingIOError).
    """
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        wait = struct.pack("@ll", int(timeout_s), int(timeout_s % 1 * 1e6))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, wait)
        connection.connect(str(path))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", 0, 0))
        connection.settimeout(timeout_s)
    except OSError:
        connection.close()
        raise
    return connection


def _is_full(error: BaseException) -> bool:
    """Whether a connection was not taken because the daemon's queue was full for a moment."""
    return isinstance(error, OSError) and error.errno == errno.EAGAIN


def _may_repeat(error: BaseException, method: str, path: str) -> bool:
    """Whether a request that went out and was dropped (a flooded daemon makes room) may go out again: a question and a
    stop may. A reset may not: somebody may have stopped the machine in between."""
    dropped = isinstance(error, ConnectionResetError | BrokenPipeError | http.client.RemoteDisconnected)
    return dropped and (method == "GET" or path == STOP_PATH)


def _may_pass(error: ClientError) -> bool:
    """Whether somebody who waits goes on waiting: nobody answers yet, or the daemon is busy."""
    return isinstance(error, NoDaemonError) or (isinstance(error, RefusedError) and (error.status_code or 0) >= 500)


def _lease_name(client: str, name: str) -> str:
    return f"{client[:40]} {name}".strip()[:60]


def _stop_body(name: str, reason: str) -> dict[str, str]:
    return {"client": name, "reason": reason[:200]}


def _reply_of(found: Any) -> Reply:
    from graderd.core.commands import Reply

    return Reply.model_validate(found)


def _result_of(name: str, text: str | bytes) -> dict[str, Any]:
    """A maneuver's last word.

    Raises:
        RefusedError: a problem.
    """
    answer = json.loads(text)
    if "result" not in answer:
        raise RefusedError(answer.get("where") or name, answer.get("error", ""), answer.get("remedy", ""))
    found: dict[str, Any] = answer["result"]
    return found


def _check_reply(command: str, answer: dict[str, Any]) -> None:
    """An answer on the lease's WebSocket: a reply, or a problem.

    Raises:
        RefusedError: refused.
    """
    if not answer.get("accepted"):
        raise RefusedError(command, answer.get("message") or answer.get("error", ""), answer.get("remedy", ""))


def _lease_lost(motion: str, status: dict[str, Any]) -> LeaseLostError:
    return LeaseLostError(motion, f"ended on the way: {status['mode']}, {status['reason']}", "see graderd status")


def _stream_refused(path: str, error: Exception) -> RefusedError:
    """Why a WebSocket was not opened: the daemon's problem, where it sent one."""
    from websockets.exceptions import InvalidStatus

    if isinstance(error, InvalidStatus):
        with suppress(ValueError, KeyError, TypeError):
            problem = json.loads(error.response.body)
            where = problem["where"] or path
            return RefusedError(where, problem["error"], problem["remedy"], status_code=error.response.status_code)
    return RefusedError(path, f"the daemon refused the stream: {error}", "try again when others are done")


def _not_reached(what: str, timeout_s: float, status: Status | None) -> NotReachedError:
    seen = "nobody answers" if status is None else f"{status.mode}, {status.reason}"
    return NotReachedError(what, f"not within {timeout_s:g} s ({seen})", "see graderd status", status)
