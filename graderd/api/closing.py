"""The end of the interface: whoever waits is let go, with an answer, before the sockets close."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


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
