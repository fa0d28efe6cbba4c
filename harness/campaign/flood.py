"""``python -m harness.campaign.flood SOCKET SECONDS``: as many requests a second as one process can send.

Pipelines over a few connections and reads whatever comes back; prints ``begun``, and at the end
``{"sent_per_s", "refused_after_s"}`` (None where the daemon refused nothing and closed no connection).
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from contextlib import suppress

REQUEST = b"GET /v1/status HTTP/1.1\r\nHost: graderd\r\n\r\n"
BATCH_N = 50
CONNECTIONS_N = 8


class Hammer:
    """Counts what it sends and notes when it was first refused."""

    def __init__(self, path: str, seconds: float) -> None:
        self._path = path
        self._began_s = time.monotonic()
        self._end_s = self._began_s + seconds
        self.sent_n = 0
        self.refused_after_s: float | None = None

    async def run(self) -> None:
        """One connection after the other until the time is over."""
        while time.monotonic() < self._end_s:
            with suppress(OSError, TimeoutError):
                reader, writer = await asyncio.open_unix_connection(self._path)
                try:
                    await self._one(reader, writer)
                finally:
                    writer.close()
            await asyncio.sleep(0)

    async def _one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while time.monotonic() < self._end_s:
            writer.write(REQUEST * BATCH_N)
            async with asyncio.timeout(0.2):
                await writer.drain()
            self.sent_n += BATCH_N
            with suppress(TimeoutError):
                async with asyncio.timeout(0.02):
                    answer = await reader.read(1 << 16)
                if (not answer or b"503" in answer) and self.refused_after_s is None:
                    self.refused_after_s = time.monotonic() - self._began_s
                if not answer:
                    return

    def result(self) -> dict[str, float | None]:
        """What it found."""
        sent_per_s = self.sent_n / (time.monotonic() - self._began_s)
        return {"sent_per_s": sent_per_s, "refused_after_s": self.refused_after_s}


async def main() -> None:
    """Hammer until the time is over."""
    hammer = Hammer(sys.argv[1], float(sys.argv[2]))
    sys.stdout.write("begun\n")
    sys.stdout.flush()
    await asyncio.gather(*(hammer.run() for _ in range(CONNECTIONS_N)))
    sys.stdout.write(json.dumps(hammer.result()) + "\n")


if __name__ == "__main__":
    asyncio.run(main())
