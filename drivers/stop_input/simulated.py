"""The simulated stop input: a unix socket that answers each byte with the state of a loop that can be pressed."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from pathlib import Path
from typing import Literal

from graderd.hal.errors import DeviceLostError, DeviceMissingError

_TIMEOUT_S = 0.5
LoopState = Literal["closed", "open", "shorted"]


class SimulatedStopInput:
    """The client: what the daemon's watcher reads."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._socket: socket.socket | None = None

    @property
    def where(self) -> str:
        """The socket, for people."""
        return f"simulated loop at {self._path}"

    def open(self) -> None:
        """See the contract."""
        self.close()
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.settimeout(_TIMEOUT_S)
        try:
            connection.connect(self._path)
        except OSError as error:
            connection.close()
            raise DeviceMissingError(self.where, f"nobody answers there ({error})", "Start the rig") from error
        self._socket = connection

    def is_closed(self) -> bool:
        """See the contract."""
        return self._ask(b"?") == b"1"

    def follows(self) -> bool:
        """See the contract."""
        return self._ask(b"t") == b"0"

    def close(self) -> None:
        """See the contract."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _ask(self, question: bytes) -> bytes:
        if self._socket is None:
            raise DeviceLostError(self.where, "is not open")
        try:
            self._socket.sendall(question)
            answer = self._socket.recv(1)
        except OSError as error:
            self.close()
            raise DeviceLostError(self.where, f"is gone ({error})") from error
        if not answer:
            self.close()
            raise DeviceLostError(self.where, "hung up")
        return answer


class StopLoop:
    """The other end: a loop with a button, served at ``path``. ``shorted``: reads closed whatever drives it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.state: LoopState = "closed"
        self.silent = False
        """Connected, and no answer to anything: an adapter that hangs."""
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.StreamWriter] = set()

    async def start(self) -> None:
        """Serve (again)."""
        self.path.unlink(missing_ok=True)
        self._server = await asyncio.start_unix_server(self._serve, str(self.path))

    async def close(self) -> None:
        """Vanish: nobody listens and every client is cut off; idempotent."""
        server, self._server = self._server, None
        if server is None:
            return
        server.close()
        for client in tuple(self._clients):
            client.close()
        self.path.unlink(missing_ok=True)

    async def become(self, state: LoopState | Literal["silent", "gone"]) -> None:
        """Press, release, short-circuit, hang or unplug the loop."""
        self.silent = state == "silent"
        if state == "gone":
            await self.close()
            return
        if state != "silent":
            self.state = state
        if self._server is None:
            await self.start()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        try:
            while question := await reader.read(1):
                if self.silent:
                    continue
                closed = self.state == "shorted" or (self.state == "closed" and question == b"?")
                writer.write(b"1" if closed else b"0")
                await writer.drain()
        except (OSError, asyncio.CancelledError):
            pass  # gone; asyncio's own callback would print a cancelled client as an error
        finally:
            self._clients.discard(writer)
            with contextlib.suppress(OSError):
                writer.close()
