"""What anybody may do to the interface on TCP: it is refused, it costs little, and a stop is answered all the same.

Each case names the guard that it is about; with that guard taken out it fails.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from graderd.api.settings import ApiLimits, TcpSettings
from graderd.api.stop_socket import OPEN_N, stop_socket_beside
from graderd.core.machine import Mode
from graderd.tokens import Right, create_token
from harness.api_daemon import HOLD_S, FakeDaemon, Hold, free_port, longest_hold, serving, within

pytestmark = [pytest.mark.live, pytest.mark.whole_machine]

STOP_S = 0.1
GROWN_BYTES = 8e6
LIMITS = ApiLimits(body_timeout_s=0.5, connections_max_n=40, websockets_max_n=8)
SPARE_N = 24
"""Sockets that the test itself opens, and those just being taken or let go: a queue of each port (QUEUE_N) at most."""


@dataclass(frozen=True)
class Case:
    """``answers``: what may come of it, and nothing else. ``left_n``: so many may stay without one. ``open_n``: so many
    connections may be open at a time."""

    kind: str
    number_n: int
    answers: frozenset[str]
    left_n: int = 0
    open_n: int = LIMITS.connections_max_n
    port: Callable[[TcpSettings], int] = lambda tcp: tcp.port_n


CASES = {
    "TcpGuard: tokens": Case("wrong", 1000, frozenset({"401"})),
    "TcpGuard: Host and Origin": Case("foreign", 150, frozenset({"403"})),
    "Limiter: body_max_bytes_n": Case("large", 100, frozenset({"413", "408", "503", "closed"})),
    "Limiter: body_timeout_s": Case("slow", 100, frozenset({"408", "closed"})),
    "connections_max_n": Case("idle", 500, frozenset({"closed"}), LIMITS.connections_max_n),
    "Limiter: websockets_max_n": Case("mute", 50, frozenset({"503"}), LIMITS.websockets_max_n),
    "stop socket: OPEN_N": Case("idle", 500, frozenset({"closed"}), OPEN_N, OPEN_N, TcpSettings.port_of_stop_n),
    "stop socket: TcpGuard": Case("wrong", 300, frozenset({"401"}), 0, OPEN_N, TcpSettings.port_of_stop_n),
}


def sockets_n() -> int:
    """Descriptors of this process, the daemon's."""
    return len(os.listdir("/proc/self/fd"))


async def stopped_after_s(path: Path, hold: Hold) -> float:
    """What the daemon computes until a stop by the socket that serves nothing else is answered."""
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    reader, writer = await asyncio.open_unix_connection(str(stop_socket_beside(path)))
    writer.write(b"strangers about")
    assert (await within(10, reader.readline())).startswith(b"HTTP/1.1 200")
    answered_s = loop.time()
    writer.close()
    await asyncio.sleep(0.05)  # another look
    return hold.computed_s(began_s, answered_s)


@pytest.mark.parametrize("guard", CASES)
async def test_strangers_are_refused_and_stop_is_answered(
    guard: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    case = CASES[guard]
    tcp = TcpSettings(port_n=free_port(), stop_port_n=free_port(), token_file=tmp_path / "tokens")
    token = create_token(tcp.token_file, "cab", Right.COMMAND)
    daemon = FakeDaemon()
    async with serving(tmp_path, daemon, limits=LIMITS, tcp=tcp) as (_, path):
        await stopped_after_s(path, Hold([(0.0, 0.0)]))  # what a first time makes is made
        seen_n, sockets_before_n, bytes_before_n = len(daemon.seen), sockets_n(), psutil.Process().memory_info().rss
        most_n = 0
        async with longest_hold() as hold:
            words = (case.port(tcp), token, case.kind, case.number_n, case.left_n)
            strangers = await asyncio.create_subprocess_exec(
                *("nice", sys.executable, "-m", "tests.unit.hostile_clients", *map(str, words)),
                stdout=asyncio.subprocess.PIPE,
            )
            assert strangers.stdout is not None
            answered = asyncio.create_task(strangers.stdout.readline())
            stops_s: list[float] = []
            while not answered.done():
                stops_s.append(await stopped_after_s(path, hold))
                most_n = max(most_n, sockets_n() - sockets_before_n)
            told = json.loads(await answered)
            await strangers.wait()
        grown_n = psutil.Process().memory_info().rss - bytes_before_n
    assert set(told) <= case.answers, told
    assert sum(told.values()) >= case.number_n - case.left_n, told
    assert most_n <= case.open_n + SPARE_N, most_n
    assert grown_n < GROWN_BYTES
    assert caplog.records == []
    assert {command.command for command in daemon.seen[seen_n:]} == {"stop"}
    assert daemon.state.mode is Mode.STOPPED
    assert hold.longest_s < HOLD_S
    assert sorted(stops_s)[len(stops_s) // 2] < STOP_S
    assert max(stops_s) < 2 * STOP_S
