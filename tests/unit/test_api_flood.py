"""Thousands of requests a second leave the control tick its time, and a stop gets through."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import pytest

from graderd.api.settings import ApiLimits
from graderd.api.stop_socket import stop_socket_beside
from graderd.core.machine import Mode
from graderd.hal.clock import Pace
from harness.api_daemon import TICK_S, longest_hold, serving, within
from tests.unit.test_cli_modes import command_line

pytestmark = pytest.mark.live

FLOOD_S = 2.5
"""Floods are ``nice``: they take what there is, from the daemon under test before all, not from what runs beside it."""


def test_the_pace_lets_a_burst_through_and_then_one_by_one() -> None:
    pace = Pace(rate_hz=10.0, burst_n=3)
    assert [round(pace.delay_s(100.0), 6) for _ in range(5)] == [0.0, 0.0, 0.0, 0.1, 0.2]
    assert pace.delay_s(200.0) == 0.0
    assert [round(pace.delay_s(200.0), 6) for _ in range(3)] == [0.0, 0.0, 0.1]


@pytest.mark.whole_machine
@pytest.mark.parametrize(("kind", "connections_n"), [("ask", 100), ("ask", 300), ("hammer", 50)])
async def test_the_tick_goes_on_and_stop_gets_through(
    tmp_path: Path, kind: str, connections_n: int, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(tmp_path) as (daemon, path), longest_hold() as hold:
        flood = await asyncio.create_subprocess_exec(
            *("nice", sys.executable, "-m", "harness.api_flood", str(path), str(FLOOD_S), kind, str(connections_n)),
            stdout=asyncio.subprocess.PIPE,
        )
        await asyncio.sleep(1.0)  # the flood's own start
        hold.looked.clear()
        stop = await asyncio.create_subprocess_exec(
            *command_line(path, "stop", "--reason", "flooded"), stdout=asyncio.subprocess.DEVNULL
        )
        await daemon.until(lambda: daemon.state.mode is Mode.STOPPED, timeout_s=20)
        tasks_n = len(asyncio.all_tasks())
        assert await within(20, stop.wait()) == 0
        assert flood.stdout is not None
        counts = json.loads(await within(30, flood.stdout.read()))
        await flood.wait()
        each_s = sorted(hold.each_s)
    assert "flooded" in daemon.state.reason
    assert counts["sent"] > 300
    if kind == "ask":
        assert counts["503"] > 0
    # A loop that has no moment to spare computes a tick's time from one tick to the next; what is more made it late.
    assert each_s[len(each_s) // 2] < 1.5 * TICK_S
    assert each_s[int(len(each_s) * 0.9)] < 4 * TICK_S
    limits = ApiLimits()
    assert tasks_n < 3 * limits.connections_max_n
    assert [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []


COLD = """
import socket, sys, time
began_s = time.monotonic()
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(sys.argv[1])
    connection.sendall(b"flooded")
    answer = connection.recv(4096)
print(began_s, time.monotonic(), answer.split()[1].decode())
"""
STOP_S, ON_A_BUSY_MACHINE_S = 0.1, 2.0
"""What the daemon may compute until a stop is answered, a tick before and after it included; and what may pass by."""


@pytest.mark.whole_machine
@pytest.mark.parametrize(("kind", "connections_n"), [("ask", 400), ("hammer", 50), ("stop", 400)])
async def test_the_stop_socket_is_nobodys_queue(tmp_path: Path, kind: str, connections_n: int) -> None:
    """From a new process's connect to its answer, beside clients that fill the queue of the interface itself."""
    async with serving(tmp_path) as (daemon, path), longest_hold() as hold:
        flood = await asyncio.create_subprocess_exec(
            *("nice", sys.executable, "-m", "harness.api_flood", str(path), "4", kind, str(connections_n)),
            stdout=asyncio.subprocess.PIPE,
        )
        await asyncio.sleep(1.5)  # the flood's own start
        took_s, computed_s = [], []
        for _ in range(5):
            stop = await asyncio.create_subprocess_exec(
                *(sys.executable, "-S", "-c", COLD, str(stop_socket_beside(path))), stdout=asyncio.subprocess.PIPE
            )
            told, _ = await within(20, stop.communicate())
            began_s, answered_s, status_code = told.split()
            assert status_code == b"200"
            took_s.append(float(answered_s) - float(began_s))
            await asyncio.sleep(TICK_S)  # another look
            computed_s.append(hold.computed_s(float(began_s), float(answered_s)))
        assert daemon.state.mode is Mode.STOPPED
        assert flood.stdout is not None
        await within(30, flood.stdout.read())
        await flood.wait()
    assert sorted(computed_s)[2] < STOP_S, computed_s
    assert sorted(took_s)[2] < ON_A_BUSY_MACHINE_S, took_s


@pytest.mark.whole_machine
async def test_a_flood_of_stops_is_served_at_its_own_pace(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        flood = await asyncio.create_subprocess_exec(
            *("nice", sys.executable, "-m", "harness.api_flood", str(path), "2", "stop", "50"),
            stdout=asyncio.subprocess.PIPE,
        )
        assert flood.stdout is not None
        counts = json.loads(await within(30, flood.stdout.read()))
        await flood.wait()
    assert set(counts) <= {"sent", "200"}
    assert counts["200"] <= 3.2 * ApiLimits().stop_rate_hz
    assert daemon.state.mode is Mode.STOPPED


async def test_commands_that_only_mention_stop_take_no_shortcut(tmp_path: Path) -> None:
    limits = ApiLimits(rate_hz=1.0, burst_n=1)
    async with serving(tmp_path, limits=limits) as (_, path):
        began_s = asyncio.get_running_loop().time()
        took_s = []
        for body in (b'{"command": "manual", "client": "stop"}', b'{"command": "manual", "client": "\\"stop\\""}'):
            await _post(path, body)
            took_s.append(asyncio.get_running_loop().time() - began_s)
        await _post(path, b'{"client": "x", "command" :"stop"}')
        stop_took_s = asyncio.get_running_loop().time() - began_s - took_s[-1]
    assert took_s[1] >= 0.8
    assert stop_took_s < 0.8


async def _post(path: Path, body: bytes) -> bytes:
    reader, writer = await asyncio.open_unix_connection(str(path))
    head = f"Host: localhost\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\nConnection: close"
    writer.write(b"POST /v1/commands HTTP/1.1\r\n" + head.encode() + b"\r\n\r\n" + body)
    answer = await within(10, reader.read())
    writer.close()
    await writer.wait_closed()
    return answer
