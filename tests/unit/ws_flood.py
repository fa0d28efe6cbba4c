"""Floods one WebSocket, as a process of its own: ``python -m tests.unit.ws_flood TARGET PATH KIND N SECONDS``.

TARGET: a unix socket's path, or HOST:PORT:TOKEN. KIND ``stop`` or ``ping``: N such frames, written as fast as the
daemon takes them, pings with as many bytes as one may have. Answers to stops are read and thrown away, those to pings
never read. After SECONDS the process ends without a word.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
import time

MASK = b"\x01\x02\x03\x04"
STOP = b'{"command":"stop"}'


def frame(opcode: int, payload: bytes) -> bytes:
    """One masked frame of less than 126 bytes."""
    masked = bytes(byte ^ MASK[i % 4] for i, byte in enumerate(payload))
    return bytes((0x80 | opcode, 0x80 | len(payload))) + MASK + masked


def connected(target: str) -> tuple[socket.socket, str]:
    """A connection to ``target``, and the header that lets it in."""
    if target.startswith("/"):
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.connect(target)
        return connection, ""
    host, port, token = target.split(":", 2)
    return socket.create_connection((host, int(port))), f"Authorization: Bearer {token}\r\n"


def read_all(connection: socket.socket) -> None:
    """Until the other side is gone."""
    with contextlib.suppress(OSError):
        while connection.recv(65_536):
            pass


def main() -> None:
    target, path, kind, frames_n, seconds = sys.argv[1:]
    connection, header = connected(target)
    port = "" if target.startswith("/") else ":" + target.split(":")[1]
    connection.sendall(
        f"GET {path} HTTP/1.1\r\nHost: localhost{port}\r\n{header}Connection: Upgrade\r\nUpgrade: websocket\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
    )
    head = connection.recv(4096)
    if not head.startswith(b"HTTP/1.1 101"):
        sys.exit(head.decode("latin-1"))
    connection.settimeout(float(seconds))
    if kind == "stop":
        threading.Thread(target=read_all, args=(connection,), daemon=True).start()
    one = frame(1, STOP) if kind == "stop" else frame(9, b"p" * 125)
    try:
        connection.sendall(one * int(frames_n))
    except (TimeoutError, ConnectionError):
        sys.exit(0)  # it takes no more, or has thrown us out
    time.sleep(float(seconds))


if __name__ == "__main__":
    main()
