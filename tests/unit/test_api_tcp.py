"""The interface on TCP: off unless asked for, and then only with token, Host and Origin as they should be."""

from __future__ import annotations

import asyncio
import logging
import socket
import stat
import sys
from pathlib import Path

import httpx
import psutil
import pytest
from fastapi import FastAPI
from pydantic import ValidationError
from starlette.types import Receive, Scope, Send
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from graderd.api.app import make_app
from graderd.api.server import LINGER_S, SocketError, serve
from graderd.api.settings import TcpSettings
from graderd.api.tcp_guard import load_or_make_token
from graderd.core.machine import Mode
from graderd.hal.errors import DeviceError
from harness.api_daemon import FakeDaemon, longest_hold, serving, within

pytestmark = pytest.mark.live

HOLD_S = 0.05
"""What the interface may keep the tick waiting, in computing time: what else the machine does does not count."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def tcp_settings(tmp_path: Path, *allowed_hosts: str) -> TcpSettings:
    return TcpSettings(port_n=free_port(), token_file=tmp_path / "token", allowed_hosts=allowed_hosts)


@pytest.mark.parametrize(
    ("headers", "status_code", "where"),
    [
        ({}, 401, "token"),
        ({"Authorization": "Bearer wrong"}, 401, "token"),
        ({"Authorization": "Basic TOKEN"}, 401, "token"),
        ({"Authorization": "Bearer"}, 401, "token"),
        ({"Authorization": "Bearer TOKEN"}, 200, ""),
        ({"Authorization": "bearer TOKEN"}, 200, ""),
        ({"Cookie": "graderd_token=TOKEN"}, 200, ""),
        ({"Cookie": "graderd_token=wrong"}, 401, "token"),
        ({"Authorization": "Bearer TOKEN", "Host": "evil.example"}, 403, "Host"),
        ({"Authorization": "Bearer TOKEN", "Host": "localhost.evil.example"}, 403, "Host"),
        ({"Authorization": "Bearer TOKEN", "Host": "grader.local"}, 200, ""),
        ({"Authorization": "Bearer TOKEN", "Host": "GRADER.local:PORT"}, 200, ""),
        ({"Authorization": "Bearer TOKEN", "Host": "localhost:1"}, 403, "Host"),
        ({"Authorization": "Bearer TOKEN", "Origin": "http://evil.example"}, 403, "Origin"),
        ({"Authorization": "Bearer TOKEN", "Origin": "null"}, 403, "Origin"),
        ({"Authorization": "Bearer TOKEN", "Origin": "http://localhost:PORT"}, 200, ""),
    ],
)
async def test_who_may_come_in(tmp_path: Path, headers: dict[str, str], status_code: int, where: str) -> None:
    tcp = tcp_settings(tmp_path, "grader.local")
    async with serving(tmp_path, tcp=tcp):
        token = tcp.token_file.read_text().strip()
        sent = {k: v.replace("TOKEN", token).replace("PORT", str(tcp.port_n)) for k, v in headers.items()}
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False) as client:
            answer = await client.get("/v1/status", headers=sent)
    assert answer.status_code == status_code, answer.text
    if status_code != 200:
        assert answer.json()["where"] == where
        assert token not in answer.text


async def test_websockets_take_the_token_from_the_query_as_well(tmp_path: Path) -> None:
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp):
        address = f"ws://127.0.0.1:{tcp.port_n}/v1/stream"
        token = tcp.token_file.read_text().strip()
        async with connect(f"{address}?token={token}", proxy=None) as stream:
            assert "disarmed" in str(await within(5, stream.recv()))
        for target in (address, f"{address}?token=wrong"):
            with pytest.raises(InvalidStatus) as refused:
                await connect(target, proxy=None)
            assert refused.value.response.status_code == 401
        with pytest.raises(InvalidStatus) as refused:
            await connect(f"{address}?token={token}", proxy=None, origin="http://evil.example")  # type: ignore[arg-type]  # a plain str is one
        assert refused.value.response.status_code == 403


async def test_nothing_listens_on_tcp_unless_asked(tmp_path: Path) -> None:
    port = free_port()
    async with serving(tmp_path):
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("127.0.0.1", port)


async def test_a_taken_port_is_told_and_the_unix_socket_not_left_behind(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        tcp = TcpSettings(port_n=other.getsockname()[1], token_file=tmp_path / "token")
        with pytest.raises(SocketError, match="in use"):
            await serve(make_app(FakeDaemon()), tmp_path / "api.sock", tcp=tcp)
    assert not (tmp_path / "api.sock").exists()


def test_beyond_loopback_the_names_must_be_given() -> None:
    with pytest.raises(ValidationError, match="list in allowed_hosts"):
        TcpSettings(host="0.0.0.0")
    assert TcpSettings(host="0.0.0.0", allowed_hosts=("grader.local",)).port_n == 8431


def test_the_token_is_made_once_and_kept_private(tmp_path: Path) -> None:
    path = tmp_path / "token"
    token = load_or_make_token(path)
    assert len(token) >= 32
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_or_make_token(path) == token
    path.chmod(0o644)
    with pytest.raises(DeviceError, match="others may read"):
        load_or_make_token(path)
    path.chmod(0o600)
    path.write_text("short")
    with pytest.raises(DeviceError, match="shorter than 16"):
        load_or_make_token(path)
    with pytest.raises(DeviceError, match="No such file"):
        load_or_make_token(tmp_path / "missing" / "token")


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601])
def test_a_token_that_the_group_may_read_is_none(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "token"
    load_or_make_token(path)
    path.chmod(mode)
    with pytest.raises(DeviceError, match=f"chmod 600 {path}"):
        load_or_make_token(path)


async def test_a_token_in_the_query_of_a_plain_request_is_none(tmp_path: Path) -> None:
    """It would stay in histories and logs; only a browser's WebSocket has no other place for it."""
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp):
        token = tcp.token_file.read_text().strip()
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False) as client:
            for upgrade in ({}, {"Upgrade": "h2c"}):
                answer = await client.get(f"/v1/status?token={token}", headers=upgrade)
                assert answer.status_code == 401


# ---- strangers, and floods ------------------------------------------------------------------------------------------


async def said_to(port_n: int, request: bytes) -> bytes:
    """Everything that is answered to ``request``, sent as it is."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port_n)
    try:
        writer.write(request)
        return await within(10, reader.read())
    finally:
        writer.close()


def head(port_n: int, *lines: str, path: str = "/v1/status", method: str = "GET") -> bytes:
    return "\r\n".join((f"{method} {path} HTTP/1.1", f"Host: localhost:{port_n}", *lines, "", "")).encode("latin-1")


QUOTED = 'graderd_token="' + "\\" * 60_000
"""A cookie that never closes its quotation mark: the standard library's parser tries every place where it might."""


@pytest.mark.parametrize("length_n", [7_900, 60_000])
async def test_no_cookie_of_a_stranger_holds_up_the_tick(tmp_path: Path, length_n: int) -> None:
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp), longest_hold() as hold:
        answer = await said_to(tcp.port_n, head(tcp.port_n, f"Cookie: {QUOTED[:length_n]}"))
    assert answer.startswith(b"HTTP/1.1 401" if length_n < 8_000 else b"HTTP/1.1 431"), answer[:200]
    assert hold.longest_s < HOLD_S


@pytest.mark.parametrize(("length_n", "status_code"), [(7_800, 200), (8_300, 431), (11_000, 431), (200_000, 431)])
async def test_a_head_has_8_kb_whoever_sends_it(tmp_path: Path, length_n: int, status_code: int) -> None:
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp) as (_, path):
        token = tcp.token_file.read_text().strip()
        lines = (f"X-Long: {'x' * length_n}", f"Authorization: Bearer {token}", "Connection: close")
        by_tcp = await said_to(tcp.port_n, head(tcp.port_n, *lines))
        reader, writer = await asyncio.open_unix_connection(str(path))
        writer.write(head(tcp.port_n, *lines))
        by_socket = await within(10, reader.read())
        writer.close()
    for answer in (by_tcp, by_socket):
        assert answer.startswith(f"HTTP/1.1 {status_code} ".encode()), answer[:200]
        if status_code == 431:
            assert b"longer than 8192 bytes" in answer


@pytest.mark.parametrize(
    "lines",
    [
        ("Content-Type: application/json", "Content-Length: 1000000000", "Expect: 100-continue"),
        ("Transfer-Encoding: chunked",),
        ("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: no key"),
        ("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Extensions: " + "a; b=" * 1_500),
        ("Connection: Upgrade", "Upgrade: h2c"),
    ],
)
@pytest.mark.parametrize("host", ["localhost", "evil.example"])
async def test_nothing_of_a_strangers_request_reaches_the_application(
    tmp_path: Path, lines: tuple[str, ...], host: str, caplog: pytest.LogCaptureFixture
) -> None:
    reached = []

    class Spy(FastAPI):
        async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
            reached.append(scope)

    app = Spy()
    app.state = make_app(FakeDaemon()).state
    tcp = tcp_settings(tmp_path)
    ready = asyncio.Event()
    server = asyncio.create_task(serve(app, tmp_path / "api.sock", tcp=tcp, ready=ready))
    try:
        await within(5, ready.wait())
        request = head(tcp.port_n, *lines, path="/v1/commands?token=%ff%00wrong", method="POST")
        answer = await said_to(tcp.port_n, request.replace(b"localhost", host.encode()) + b"{" * 3000)
    finally:
        server.cancel()
        await asyncio.gather(server, return_exceptions=True)
    assert answer.startswith(b"HTTP/1.1 401" if host == "localhost" else b"HTTP/1.1 403"), answer[:200]
    assert answer.count(b"HTTP/1.1") == 1
    assert reached == []
    assert caplog.records == []


async def test_a_stranger_who_hangs_on_is_let_go_and_does_not_keep_the_daemon(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tcp = tcp_settings(tmp_path)
    ready = asyncio.Event()
    server = asyncio.create_task(serve(make_app(FakeDaemon()), tmp_path / "api.sock", tcp=tcp, ready=ready))
    await within(5, ready.wait())
    hanging = [await asyncio.open_connection("127.0.0.1", tcp.port_n) for _ in range(2)]
    for reader, writer in hanging:
        writer.write(head(tcp.port_n, f"X-Long: {'x' * 9_000}"))
        assert (await within(5, reader.readuntil(b"\r\n\r\n"))).startswith(b"HTTP/1.1 431")
    first, _ = hanging[0]
    assert await within(2 * LINGER_S + 5, first.read()) != b""
    server.cancel()
    with pytest.raises(asyncio.CancelledError):
        await within(3, server)
    for _, writer in hanging:
        writer.close()
    assert caplog.records == []


@pytest.mark.whole_machine
async def test_a_flood_of_strangers_leaves_the_tick_its_time(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp) as (daemon, _), longest_hold() as hold:
        flood = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "harness.api_flood", f"localhost:{tcp.port_n}", "3", "ask", "100"),
            stdout=asyncio.subprocess.PIPE,
        )
        assert flood.stdout is not None
        said = await within(30, flood.stdout.read())
        await flood.wait()
    assert b'"401"' in said
    assert b'"200"' not in said
    assert daemon.seen == []
    assert hold.longest_s < HOLD_S
    assert caplog.records == []


@pytest.mark.whole_machine
@pytest.mark.parametrize("wire", ["tcp", "unix"])
async def test_30_000_stops_on_the_jog_socket(tmp_path: Path, wire: str, caplog: pytest.LogCaptureFixture) -> None:
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp) as (daemon, path):
        target = str(path) if wire == "unix" else f"localhost:{tcp.port_n}:{tcp.token_file.read_text().strip()}"
        async with longest_hold() as hold:
            flood = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "tests.unit.ws_flood", target, "/v1/jog", "stop", "30000", "4")
            )
            await daemon.until_mode(Mode.STOPPED)
            # Others are served meanwhile. The reset names a stop that is no longer the last: it is refused.
            async with httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(uds=str(path))) as client:
                answer = await client.post("http://localhost/v1/commands", json={"command": "reset", "stop_n": 1})
            assert answer.status_code == 409
            assert await within(30, flood.wait()) == 0
            await daemon.until_mode(Mode.STOPPED)
    assert hold.longest_s < HOLD_S
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.mark.whole_machine
@pytest.mark.parametrize("wire", ["tcp", "unix"])
@pytest.mark.parametrize("stream", ["/v1/stream", "/v1/jog"])
async def test_a_flood_of_pings_costs_neither_time_nor_memory_nor_log(
    tmp_path: Path, wire: str, stream: str, caplog: pytest.LogCaptureFixture
) -> None:
    tcp = tcp_settings(tmp_path)
    async with serving(tmp_path, tcp=tcp) as (_, path):
        target = str(path) if wire == "unix" else f"localhost:{tcp.port_n}:{tcp.token_file.read_text().strip()}"
        before_n = resident_bytes()
        async with longest_hold() as hold:
            flood = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "tests.unit.ws_flood", target, stream, "ping", "2000000", "2")
            )
            assert await within(30, flood.wait()) == 0
        grown_n = resident_bytes() - before_n
    assert hold.longest_s < HOLD_S
    assert grown_n < 4e6
    assert caplog.records == []


def resident_bytes() -> int:
    return psutil.Process().memory_info().rss
