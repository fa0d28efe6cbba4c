"""Floods a socket with requests, as a process of its own: ``python -m harness.api_flood SOCKET SECONDS KIND N``.

SOCKET: a unix socket's path, or HOST:PORT (then without a token).

KIND ``ask``: N connections, each sends the next request as soon as it has the answer. ``hammer``: N workers, each
connects, sends and hangs up without reading. ``stop``: like ``ask``, with stop commands. Prints one JSON object.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections import Counter

REQUESTS = {
    "none": b"",
    "ask": b"GET /v1/status HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "hammer": b"POST /v1/commands HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\n{]}",
    "stop": b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n",
}


async def flood(path: str, seconds: float, kind: str, connections_n: int) -> dict[str, int]:
    """Flood for ``seconds`` and count: requests ``sent``, answers by status code, connections ``dropped``."""
    counts: Counter[str] = Counter()
    end_s = asyncio.get_running_loop().time() + seconds
    try:
        async with asyncio.timeout(seconds + 1.0):
            async with asyncio.TaskGroup() as group:
                for number in range(connections_n):
                    group.create_task(_client(path, end_s, kind, counts), name=f"flood {number}")
    except TimeoutError:
        pass  # some are waiting for their turn still
    return dict(counts)


async def _client(path: str, end_s: float, kind: str, counts: Counter[str]) -> None:
    loop = asyncio.get_running_loop()
    while loop.time() < end_s:
        try:
            reader, writer = await _connected(path)
        except OSError:
            counts["not connected"] += 1
            await asyncio.sleep(0.001)
            continue
        try:
            while loop.time() < end_s:
                writer.write(REQUESTS[kind])
                counts["sent"] += 1
                if kind == "hammer":
                    break
                head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
                counts[head.split(" ", 2)[1]] += 1
                await reader.readexactly(int(head.split("content-length:", 1)[1].split("\r\n", 1)[0]))
                if "connection: close" in head:
                    break
        except (OSError, asyncio.IncompleteReadError):
            counts["dropped"] += 1
        finally:
            writer.close()


async def _connected(target: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    if target.startswith("/"):
        return await asyncio.open_unix_connection(target)
    host, port = target.split(":")
    return await asyncio.open_connection(host, int(port))


if __name__ == "__main__":
    print(json.dumps(asyncio.run(flood(sys.argv[1], float(sys.argv[2]), sys.argv[3], int(sys.argv[4])))))
