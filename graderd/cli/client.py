"""The daemon as the command line sees it: requests and WebSockets over the unix socket.

Requests use the standard library alone: ``graderd stop`` shall not wait for large imports.
"""

from __future__ import annotations

import errno
import getpass
import http.client
import json
import os
import socket
import struct
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import quote, urlencode

import typer

from graderd import places
from graderd.cli.console import CliError, ExitCode

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

TIMEOUT_S = 5.0
BUSY_RETRY_S = 3.0


def default_socket() -> Path:
    """$GRADERD_SOCKET, else the one the machine's configuration names, else the service's, else the one of a daemon
    this user runs: the first that is there, or else is kept from this user."""
    named = os.environ.get("GRADERD_SOCKET")
    if named:
        return Path(named)
    own = os.environ.get("XDG_RUNTIME_DIR")
    own_socket = [Path(own) / "graderd" / "graderd.sock"] if own else []
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
        socket_path = tomllib.loads(places.CONFIG.read_text(encoding="utf-8"))["api"]["socket"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [Path(socket_path)] if isinstance(socket_path, str) and socket_path else []


def client_name() -> str:
    """Who asks, for the daemon's records: the user."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


@dataclass(frozen=True)
class Answer:
    """One answer of the daemon."""

    status_code: int
    body: bytes

    def json(self) -> Any:
        """The body, decoded."""
        return json.loads(self.body)


class Daemon:
    """A client of the daemon's interface."""

    def __init__(self, socket_path: Path) -> None:
        self.socket_path = socket_path

    def get(self, path: str) -> Any:
        """The JSON answer to GET ``path``.

        Raises:
            CliError: no daemon, or it refused.
        """
        return self._checked(self._request("GET", path))

    def post(self, path: str, body: Any = None, timeout_s: float = TIMEOUT_S) -> Any:
        """The JSON answer to POST ``path``.

        Raises:
            CliError: no daemon, or it refused.
        """
        return self._checked(self._request("POST", path, body, timeout_s))

    def command(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command and return the reply.

        Raises:
            CliError: no daemon, or it refused.
        """
        body = {"command": command, "client": client_name(), **arguments}
        return cast("dict[str, Any]", self.post("/v1/commands", body))

    def service(self, name: str, timeout_s: float, **arguments: Any) -> dict[str, Any]:
        """Run a device service and return what it found.

        Raises:
            CliError: no daemon, or it refused or failed.
        """
        return cast("dict[str, Any]", self.post(f"/v1/services/{quote(name)}", arguments, timeout_s))

    @contextmanager
    def websocket(self, path: str, **query: str | float) -> Iterator[ClientConnection]:
        """An open WebSocket.

        Raises:
            CliError: no daemon, or it refused.
        """
        from websockets.exceptions import ConnectionClosed, InvalidHandshake
        from websockets.sync.client import connect

        uri = f"ws://localhost{path}?{urlencode(query)}" if query else f"ws://localhost{path}"
        try:
            sock = _connect(self.socket_path, TIMEOUT_S)
            # `legacy` pins what the call returns: a connection, whatever the library's default becomes.
            connection = connect(uri, sock=sock, compression=None, proxy=None, open_timeout=TIMEOUT_S, legacy=True)
        except OSError as error:
            raise self._unreachable(error) from error
        except InvalidHandshake as error:
            raise CliError(path, f"the daemon refused the stream: {error}", "try again when others are done") from error
        try:
            with connection:
                yield connection
        except ConnectionClosed as error:
            raise CliError("daemon", "it closed the connection", "see graderd status") from error

    def _request(self, method: str, path: str, body: Any = None, timeout_s: float = TIMEOUT_S) -> Answer:
        payload = None if body is None else json.dumps(body, allow_nan=False)
        headers = {} if payload is None else {"Content-Type": "application/json"}
        give_up_s = time.monotonic() + BUSY_RETRY_S
        while True:
            connection = _UnixConnection(self.socket_path, timeout_s)
            try:
                connection.request(method, path, payload, headers)
                response = connection.getresponse()
                return Answer(response.status, response.read())
            except (OSError, http.client.HTTPException) as error:
                if not _worth_retrying(error, path) or time.monotonic() > give_up_s:
                    raise self._unreachable(error) from error
            finally:
                connection.close()
            time.sleep(0.02)

    def _checked(self, answer: Answer) -> Any:
        try:
            content = answer.json()
        except ValueError as error:
            raise CliError(
                str(self.socket_path), "what answers is not graderd", "see --socket", ExitCode.NO_DAEMON
            ) from error
        if answer.status_code >= 400:
            problem = content if isinstance(content, dict) else {}
            raise CliError(
                str(problem.get("where", "")),
                str(problem.get("error", f"HTTP {answer.status_code}")),
                str(problem.get("remedy", "")),
            )
        return content

    def _unreachable(self, error: Exception) -> CliError:
        where = str(self.socket_path)
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):
            return CliError(
                where,
                "no daemon serves this socket",
                "start it with 'graderd run' or 'systemctl start graderd', or name its socket with --socket",
                ExitCode.NO_DAEMON,
            )
        if isinstance(error, PermissionError):
            return CliError(
                where, "this user may not use the daemon's socket", "join its group (graderd)", ExitCode.NO_DAEMON
            )
        if isinstance(error, TimeoutError | BlockingIOError):
            return CliError(where, "the daemon did not answer in time", "see its log", ExitCode.NO_DAEMON)
        return CliError(where, f"the daemon cannot be reached: {error}", "see its log", ExitCode.NO_DAEMON)


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a unix socket."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path

    def connect(self) -> None:
        self.sock = _connect(self._path, self.timeout or TIMEOUT_S)


def _connect(path: Path, timeout_s: float) -> socket.socket:
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


def _worth_retrying(error: Exception, path: str) -> bool:
    """A flooded daemon's queue is full for a moment, or it made room by dropping us. Commands are safe to repeat: each
    names a state, and jogs do not come this way. A service may have begun: it is repeated only if it never got in."""
    if isinstance(error, OSError) and error.errno == errno.EAGAIN:
        return True
    dropped = isinstance(error, ConnectionResetError | BrokenPipeError | http.client.RemoteDisconnected)
    return dropped and not path.startswith("/v1/services/")


def daemon_of(context: typer.Context) -> Daemon:
    """The daemon the global options name."""
    options = context.find_root().obj
    path = options if isinstance(options, Path) else default_socket()
    return Daemon(path)
