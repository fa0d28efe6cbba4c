"""Clients of the rig's control socket: one for asyncio, one call for everything else."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from pathlib import Path
from types import TracebackType
from typing import Any

from graderd.hal.errors import DeviceLostError, DeviceMissingError, DeviceRefusedError, DeviceTimeoutError

_LIMIT = 1 << 20


class RigControl:
    """Tells a running rig what to do. One request at a time; used as ``async with RigControl(path) as rig``.

    ``path`` is the rig's ``control.sock``. All requests raise ``DeviceRefusedError`` where the rig says no,
    ``DeviceLostError`` where it is gone and ``DeviceTimeoutError`` where it does not answer within ``timeout_s``.
    """

    def __init__(self, path: Path | str, timeout_s: float = 10.0) -> None:
        self._path = str(path)
        self._timeout_s = timeout_s
        self._lock = asyncio.Lock()
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def __aenter__(self) -> RigControl:
        await self.connect()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def connect(self) -> None:
        """Connect to the rig.

        Raises:
            DeviceMissingError: none listens there.
        """
        try:
            self._reader, self._writer = await asyncio.open_unix_connection(self._path, limit=_LIMIT)
        except OSError as error:
            raise _missing(self._path, error) from error

    async def close(self) -> None:
        """Hang up; idempotent."""
        writer, self._reader, self._writer = self._writer, None, None
        if writer is not None:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def request(self, command: str, /, **params: Any) -> dict[str, Any]:
        """Send one command (see :mod:`graderd.simulator.control_server`) and return its answer."""
        async with self._lock:
            if self._reader is None or self._writer is None:
                await self.connect()
            assert self._reader is not None
            assert self._writer is not None
            try:
                self._writer.write(_line(command, params))
                await self._writer.drain()
                async with asyncio.timeout(self._timeout_s):
                    line = await self._reader.readline()
            except TimeoutError:
                await self.close()  # an answer that comes later must not be taken for the next one's
                raise DeviceTimeoutError(self._path, f"no answer to {command!r} for {self._timeout_s} s") from None
            except OSError as error:
                await self.close()
                raise _lost(self._path) from error
            if not line:
                await self.close()
                raise _lost(self._path)
            return _answer(self._path, line)

    async def scene(self, zone: str, seed: int = 0) -> dict[str, Any]:
        """Lay ``left``, ``center``, ``right``, ``even`` or ``none`` in front of the blade."""
        return await self.request("scene", zone=zone, seed=seed)

    async def drive(self, speed_m_per_s: float, distance_m: float) -> dict[str, Any]:
        """Drive; returns at once, with the distance the bed allows."""
        return await self.request("drive", speed_m_per_s=speed_m_per_s, distance_m=distance_m)

    async def halt(self) -> dict[str, Any]:
        """Brake."""
        return await self.request("halt")

    async def state(self) -> dict[str, Any]:
        """What is true of machine and soil."""
        return await self.request("state")

    async def quit(self) -> None:
        """End the rig."""
        await self.request("quit")
        await self.close()


def rig_request(path: Path | str, command: str, /, timeout_s: float = 10.0, **params: Any) -> dict[str, Any]:
    """One command to the rig over a connection of its own, for code without an event loop.

    Raises:
        DeviceMissingError, DeviceLostError, DeviceTimeoutError, DeviceRefusedError: as :class:`RigControl`.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        try:
            connection.connect(str(path))
        except OSError as error:
            raise _missing(str(path), error) from error
        try:
            connection.sendall(_line(command, params))
            with connection.makefile("rb") as lines:
                line = lines.readline(_LIMIT)
        except TimeoutError:
            raise DeviceTimeoutError(str(path), f"no answer to {command!r} for {timeout_s} s") from None
        except OSError as error:
            raise _lost(str(path)) from error
    if not line:
        raise _lost(str(path))
    return _answer(str(path), line)


def _line(command: str, params: dict[str, Any]) -> bytes:
    return json.dumps({"cmd": command, **params}).encode() + b"\n"


def _answer(path: str, line: bytes) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads(line)
    if "error" in answer:
        raise DeviceRefusedError(path, str(answer["error"]))
    return answer


def _missing(path: str, error: OSError) -> DeviceMissingError:
    return DeviceMissingError(path, f"no rig answers there ({error})", "Start it with: graderd rig")


def _lost(path: str) -> DeviceLostError:
    return DeviceLostError(path, "the rig hung up", "Start the rig again")
