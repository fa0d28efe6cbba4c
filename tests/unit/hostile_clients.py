"""What an interface on TCP must bear, as a process: ``python -m tests.unit.hostile_clients PORT TOKEN KIND N LEFT``.

KIND, N times each:
``wrong``: requests with a token of their own making. ``foreign``: the right TOKEN from a foreign Origin or Host.
``large``: the right TOKEN and a body that goes on and on. ``slow``: the right TOKEN and a body that does not come.
``idle``: connections on which nothing is said. ``mute``: WebSocket upgrades with the TOKEN that are never read.

Ends when no more than LEFT of them are open without an answer, or after :data:`MOST_S`. Writes what was answered, by
status code, and ``closed`` for what was closed without an answer, as a JSON object.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import secrets
import sys
from collections import Counter

AT_ONCE_N = 20
MOST_S = 20.0
LARGE_BYTES = 1 << 17
FOREIGN = ("localhost:{port_n}\r\nOrigin: http://evil.example", "evil.example", "localhost:{port_n}\r\nOrigin: null")
WEBSOCKET = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n"
KEY = "MDEyMzQ1Njc4OWFiY2RlZg=="


def requests(kind: str, port_n: int, token: str) -> itertools.cycle[bytes]:
    """What the strangers of a kind say, one after the other."""
    host, bearer, body = f"localhost:{port_n}", f"Authorization: Bearer {token}\r\n", b""
    if kind == "idle":
        return itertools.cycle((b"",))
    if kind == "wrong":
        words = [f"GET /v1/status HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {secrets.token_urlsafe()}\r\n"]
        words += [f"POST /v1/stop HTTP/1.1\r\nHost: {host}\r\nCookie: graderd_token={secrets.token_urlsafe()}\r\n"]
    elif kind == "foreign":
        words = [f"POST /v1/stop HTTP/1.1\r\nHost: {name.format(port_n=port_n)}\r\n{bearer}" for name in FOREIGN]
    elif kind == "mute":
        words = [f"GET /v1/stream HTTP/1.1\r\nHost: {host}\r\n{bearer}{WEBSOCKET.format(key=KEY)}"]
    else:
        length_n, body = (10**9, b" " * LARGE_BYTES) if kind == "large" else (100, b"{")
        kept = f"Host: {host}\r\n{bearer}Content-Type: application/json\r\nContent-Length: {length_n}\r\n"
        words = [f"POST /v1/commands HTTP/1.1\r\n{kept}", f"POST /v1/services/x HTTP/1.1\r\n{kept}"]
    return itertools.cycle(f"{head}\r\n".encode() + body for head in words)


async def stranger(port_n: int, request: bytes, wait: asyncio.Semaphore, told: Counter[str]) -> None:
    """Say it and hear what comes of it."""
    async with wait:
        reader, writer = await asyncio.open_connection("127.0.0.1", port_n)
    try:
        writer.write(request)
        answer = await reader.readline()
        if answer.startswith(b"HTTP/1.1 101"):
            await asyncio.Event().wait()
        told[answer.split()[1].decode() if answer else "closed"] += 1
    except ConnectionError:
        told["closed"] += 1
    finally:
        writer.close()


async def main() -> None:
    port_n, token, kind, number, left = int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
    told: Counter[str] = Counter()
    wait = asyncio.Semaphore(AT_ONCE_N)
    said = requests(kind, port_n, token)
    tasks = [asyncio.create_task(stranger(port_n, next(said), wait, told)) for _ in range(number)]
    loop = asyncio.get_running_loop()
    end_s = loop.time() + MOST_S
    while sum(task.done() for task in tasks) < number - left and loop.time() < end_s:
        await asyncio.sleep(0.05)
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main())
