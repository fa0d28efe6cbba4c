"""The interface on TCP: off unless asked for, and then only with token, Host and Origin as they should be."""

from __future__ import annotations

import asyncio
import socket
import stat
from pathlib import Path

import httpx
import pytest
from pydantic import ValidationError
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from graderd.api.app import make_app
from graderd.api.server import SocketError, serve
from graderd.api.settings import TcpSettings
from graderd.api.tcp_guard import load_or_make_token
from graderd.hal.errors import DeviceError
from tests.unit.api_daemon import FakeDaemon, serving, within


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
