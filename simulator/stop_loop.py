"""The simulated stop loop: a unix socket that answers each byte with the state of a loop that can be pressed."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Literal

LoopState = Literal["closed", "open", "shorted"]


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
