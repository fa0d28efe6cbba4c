"""The interface on TCP: off unless asked for, and then only with token, Host and Origin as they should be."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import socket
import ssl
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from fastapi import FastAPI
from pydantic import ValidationError
from starlette.types import Receive, Scope, Send
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from graderd.api.app import make_app
from graderd.api.server import LINGER_S, STREAM_BUFFER_BYTES, SocketError, _StreamProtocol, serve
from graderd.api.settings import TcpSettings
from graderd.api.tcp_guard import Tokens
from graderd.client import AsyncClient
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.hal.errors import DeviceError
from graderd.tokens import Right, create_token, revoke_token
from harness.api_daemon import HOLD_S, FakeDaemon, free_port, longest_hold, serving, within

pytestmark = pytest.mark.live


def tcp_settings(tmp_path: Path, *allowed_hosts: str) -> TcpSettings:
    return TcpSettings(port_n=free_port(), token_file=tmp_path / "tokens", allowed_hosts=allowed_hosts)


def token_for(tcp: TcpSettings, right: Right = Right.COMMAND) -> str:
    return create_token(tcp.token_file, f"{right}-1", right)


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
    token = token_for(tcp)
    async with serving(tmp_path, tcp=tcp):
        sent = {k: v.replace("TOKEN", token).replace("PORT", str(tcp.port_n)) for k, v in headers.items()}
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False) as client:
            answer = await client.get("/v1/status", headers=sent)
    assert answer.status_code == status_code, answer.text
    if status_code != 200:
        assert answer.json()["where"] == where
        assert token not in answer.text


async def test_websockets_take_the_token_from_the_query_as_well(tmp_path: Path) -> None:
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp)
    async with serving(tmp_path, tcp=tcp):
        address = f"ws://127.0.0.1:{tcp.port_n}/v1/stream"
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


def test_beyond_loopback_the_names_and_a_certificate_must_be_given(tmp_path: Path) -> None:
    tls = {"certificate_file": tmp_path / "c.pem", "key_file": tmp_path / "k.pem"}
    with pytest.raises(ValidationError, match="list in allowed_hosts"):
        TcpSettings(host="0.0.0.0", **tls)
    with pytest.raises(ValidationError, match="without TLS anybody on the way reads the tokens"):
        TcpSettings(host="0.0.0.0", allowed_hosts=("grader.local",))
    with pytest.raises(ValidationError, match="go together"):
        TcpSettings(certificate_file=tmp_path / "c.pem")
    assert TcpSettings(host="0.0.0.0", allowed_hosts=("grader.local",), **tls).port_n == 8431


# ---- rights ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "path", "body", "may"),
    [
        ("GET", "/v1/status", None, True),
        ("GET", "/v1/config", None, True),
        ("POST", "/v1/stop", None, True),
        ("PUT", "/V1/stop/", None, True),
        ("GET", "/v1/session", None, True),
        ("POST", "/v1/commands", {"command": "arm"}, False),
        ("POST", "/v1/commands/", {"command": "arm"}, False),
        ("POST", "/v1/%63ommands", {"command": "arm"}, False),
        ("POST", "/v1/services/rotation.verify_profile", {}, False),
        ("PATCH", "/v1/status", {}, False),
    ],
)
async def test_who_may_read_does_not_command(tmp_path: Path, method: str, path: str, body: Any, may: bool) -> None:
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp, Right.READ)
    async with serving(tmp_path, tcp=tcp) as (daemon, _):
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False) as client:
            answer = await client.request(method, path, json=body, headers={"Authorization": f"Bearer {token}"})
        stopped = daemon.status().mode is Mode.STOPPED
        assert [command.command for command in daemon.seen if command.command != "stop"] == []
    assert answer.status_code == (200 if may else 403), answer.text
    if not may:
        assert answer.json()["where"] == "token"
    assert stopped == ("stop" in path)


@pytest.mark.parametrize(
    ("path", "may"),
    [
        ("/v1/stream", True),
        ("/v1/bus/can", True),
        ("/v1/jog", False),
        ("/v1/%6aog", False),
        ("/v1/services/rotation.step_response", False),
        ("/v1/anything", False),
    ],
)
async def test_who_may_read_opens_no_socket_that_commands(tmp_path: Path, path: str, may: bool) -> None:
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp, Right.READ)
    async with serving(tmp_path, tcp=tcp):
        address = f"ws://127.0.0.1:{tcp.port_n}{path}?token={token}"
        if may:
            async with connect(address, proxy=None) as stream:
                assert await within(5, stream.recv())
            return
        with pytest.raises(InvalidStatus) as refused:
            await connect(address, proxy=None)
    assert refused.value.response.status_code == 403


async def test_a_token_that_is_revoked_ends_what_it_moves(tmp_path: Path) -> None:
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp)
    async with serving(tmp_path, tcp=tcp) as (daemon, _):
        await daemon.command(cmd.Arm())
        await daemon.until_mode(Mode.MANUAL)
        async with connect(f"ws://127.0.0.1:{tcp.port_n}/v1/jog?client=cab&token={token}", proxy=None) as jog:
            await jog.send('{"command": "jog", "axis": "rotate", "value": 50}')
            assert '"accepted":true' in str(await within(5, jog.recv()))
            lease = daemon.status().lease
            assert lease is not None
            assert lease.client.startswith("cab@command-1#")
            revoke_token(tcp.token_file, "command-1")
            with contextlib.suppress(ConnectionClosed):
                while True:
                    await jog.send('{"command": "renew"}')
                    await within(5, jog.recv())
            assert jog.close_code == 1008
            await daemon.until(lambda: daemon.state.lease is None)
        with pytest.raises(InvalidStatus) as refused:
            await connect(f"ws://127.0.0.1:{tcp.port_n}/v1/stream?token={token}", proxy=None)
    assert refused.value.response.status_code == 401


async def test_a_token_made_meanwhile_is_taken_and_a_damaged_file_locks_nobody_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "graderd")
    path = tmp_path / "tokens"
    tokens = Tokens(path)
    assert "graderd token create" in caplog.text
    first = create_token(path, "one", Right.READ).encode()
    tokens.reload()
    grant = tokens.grant_of(first)
    assert grant is not None
    assert (grant.name, grant.right, grant.ended.is_set()) == ("one", Right.READ, False)
    path.write_text("rubbish\n")
    tokens.reload()
    assert tokens.grant_of(first) is grant
    assert "this is no line" in caplog.text
    path.unlink()
    tokens.reload()
    assert tokens.grant_of(first) is None
    assert grant.ended.is_set()


async def test_who_did_what_stands_in_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "graderd")
    tcp = tcp_settings(tmp_path)
    headers = {"Authorization": f"Bearer {token_for(tcp)}"}
    async with serving(tmp_path, tcp=tcp) as (daemon, path):
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False) as client:
            await client.post("/v1/commands", json={"command": "arm", "client": "cab"}, headers=headers)
            await daemon.until_mode(Mode.MANUAL)
            jog = {"command": "jog", "axis": "rotate", "value": 3.0, "client": "cab"}
            await client.post("/v1/commands", json=jog, headers=headers)
            await client.post("/v1/services/rotation.verify_profile", headers=headers)
            await client.post("/v1/stop", json={"reason": "look out"}, headers=headers)
        async with httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(uds=str(path))) as client:
            await client.post("http://localhost/v1/commands", json={"command": "auto", "client": "cab"})
    told = [re.sub(r"#\d+", "#N", record.getMessage()) for record in caplog.records]
    assert told == [
        "arm by cab@command-1#N (command-1 at 127.0.0.1): arming",
        "jog axis=rotate value=3.0 by cab@command-1#N (command-1 at 127.0.0.1): moving while the lease is renewed",
        "service rotation.verify_profile by command-1 at 127.0.0.1",
        "stop by - (command-1 at 127.0.0.1): stopped",
        f"auto by cab#N (uid {os.getuid()} at unix): "
        "refused: automatic operation needs an armed machine; it is stopped",
    ]


async def test_a_browser_keeps_its_token_as_a_cookie_no_script_can_read(tmp_path: Path) -> None:
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp, Right.READ)
    async with serving(tmp_path, tcp=tcp) as (_, path):
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False) as client:
            assert (await client.post("/v1/session")).status_code == 401
            begun = await client.post("/v1/session", headers={"Authorization": f"Bearer {token}"})
            assert begun.json() == {"name": "read-1", "right": "read"}
            kept = begun.headers["set-cookie"]
            assert ("HttpOnly" in kept, "SameSite=strict" in kept, "Secure" in kept) == (True, True, False)
            assert (await client.get("/v1/session")).json()["name"] == "read-1"
            assert (await client.delete("/v1/session")).status_code == 204
            assert (await client.get("/v1/session")).status_code == 401
        async with httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(uds=str(path))) as client:
            asked = {"Authorization": f"Bearer {token}"}
            assert (await client.post("http://localhost/v1/session", headers=asked)).status_code == 409


# ---- TLS ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate for localhost and its key beside it, made by openssl."""
    directory = tmp_path_factory.mktemp("tls")
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"),
            *("-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"),
            *("-keyout", directory / "key.pem", "-out", directory / "certificate.pem"),
        ],
        check=True,
        capture_output=True,
    )
    return directory / "certificate.pem"


async def test_tls_with_status_jog_and_stop(tmp_path: Path, certificate: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tcp = TcpSettings(
        port_n=free_port(),
        token_file=tmp_path / "tokens",
        certificate_file=certificate,
        key_file=certificate.with_name("key.pem"),
    )
    token = token_for(tcp)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    async with serving(tmp_path, tcp=tcp) as (daemon, _):
        silent = [await asyncio.open_connection("127.0.0.1", tcp.port_n) for _ in range(100)]
        plain = await asyncio.open_connection("127.0.0.1", tcp.port_n)
        plain[1].write(head(tcp.port_n, f"Authorization: Bearer {token}"))
        assert b"HTTP/1.1" not in await within(5, plain[0].read())
        async with AsyncClient(f"https://localhost:{tcp.port_n}", token=token) as client:
            await client.command("arm")
            await daemon.until_mode(Mode.MANUAL)
            async with client.lease() as lease:
                await lease.jog("rotate", 3.0)
                assert (await client.status()).lease is not None
            assert (await client.stop()).accepted
        async with httpx.AsyncClient(
            base_url=f"https://localhost:{tcp.port_n}", trust_env=False, verify=ssl.create_default_context()
        ) as browser:
            begun = await browser.post("/v1/session", headers={"Authorization": f"Bearer {token}"})
            assert "Secure" in begun.headers["set-cookie"]
        for _, writer in (*silent, plain):
            writer.close()


@pytest.mark.parametrize("fault", ["missing", "no certificate", "open key"])
async def test_a_certificate_that_cannot_be_used_is_told(tmp_path: Path, certificate: Path, fault: str) -> None:
    pair = [tmp_path / "certificate.pem", tmp_path / "key.pem"]
    for copy, of in zip(pair, (certificate, certificate.with_name("key.pem")), strict=True):
        copy.write_bytes(of.read_bytes())
        copy.chmod(0o600)
    if fault == "missing":
        pair[1].unlink()
    elif fault == "no certificate":
        pair[0].write_text("nothing of the kind\n")
    else:
        pair[1].chmod(0o644)
    tcp = TcpSettings(port_n=0, token_file=tmp_path / "tokens", certificate_file=pair[0], key_file=pair[1])
    with pytest.raises(DeviceError, match=r"chmod 600" if fault == "open key" else r"key\.pem"):
        await serve(make_app(FakeDaemon()), tmp_path / "api.sock", tcp=tcp)


async def test_a_token_in_the_query_of_a_plain_request_is_none(tmp_path: Path) -> None:
    """It would stay in histories and logs; only a browser's WebSocket has no other place for it."""
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp)
    browser = httpx.AsyncClient(base_url=f"http://127.0.0.1:{tcp.port_n}", trust_env=False)
    async with serving(tmp_path, tcp=tcp), browser as client:
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
    token = token_for(tcp)
    async with serving(tmp_path, tcp=tcp) as (_, path):
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
            *("nice", sys.executable, "-m", "harness.api_flood", f"localhost:{tcp.port_n}", "3", "ask", "100"),
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
    token = token_for(tcp)
    async with serving(tmp_path, tcp=tcp) as (daemon, path):
        target = str(path) if wire == "unix" else f"localhost:{tcp.port_n}:{token}"
        # A client's own making takes longer than all that the daemon may compute in one go.
        async with (
            httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(uds=str(path))) as client,
            longest_hold() as hold,
        ):
            flood = await asyncio.create_subprocess_exec(
                *("nice", sys.executable, "-m", "tests.unit.ws_flood", target, "/v1/jog", "stop", "30000", "4")
            )
            await daemon.until_mode(Mode.STOPPED)
            # Others are served meanwhile. The reset names a stop that is no longer the last: it is refused.
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
    tmp_path: Path, wire: str, stream: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tcp = tcp_settings(tmp_path)
    token = token_for(tcp)
    pings_n = unread_most_n = 0  # answers that wait for a client who reads none of them, after each ping
    answer = _StreamProtocol.handle_ping

    def handle_ping(self: _StreamProtocol) -> None:
        nonlocal pings_n, unread_most_n
        answer(self)
        pings_n += 1
        unread_most_n = max(unread_most_n, self.transport.get_write_buffer_size())

    monkeypatch.setattr(_StreamProtocol, "handle_ping", handle_ping)
    async with serving(tmp_path, tcp=tcp) as (_, path):
        target = str(path) if wire == "unix" else f"localhost:{tcp.port_n}:{token}"
        before_n = resident_bytes()
        async with longest_hold() as hold:
            flood = await asyncio.create_subprocess_exec(
                *("nice", sys.executable, "-m", "tests.unit.ws_flood", target, stream, "ping", "400000", "2")
            )
            assert await within(30, flood.wait()) == 0
        grown_n = resident_bytes() - before_n
    assert hold.longest_s < HOLD_S
    assert pings_n > 5_000
    assert unread_most_n < STREAM_BUFFER_BYTES
    assert grown_n < 4e6
    assert caplog.records == []


def resident_bytes() -> int:
    return psutil.Process().memory_info().rss
