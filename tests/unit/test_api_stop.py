"""A stop is never refused: not for its body, its headers, its spelling, nor for what it came in."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from graderd import client
from graderd.api import server, stop_socket
from graderd.api.app import make_app
from graderd.api.server import ACCEPT_BURST_N
from graderd.api.settings import ApiLimits, TcpSettings
from graderd.api.stop_socket import stop_socket_beside
from graderd.core.machine import Mode
from graderd.tokens import Right, create_token
from harness.api_daemon import FakeDaemon, free_port, serving, within
from harness.awake_clock import AwakeClock
from tests.unit.test_api_sockets import connect

pytestmark = pytest.mark.live
LONG = "x" * 20_000
BODIES = {
    "nothing": b"",
    "reason is a number": b'{"reason": 5}',
    "reason is null": b'{"reason": null, "client": 7}',
    "reason of 201 characters": json.dumps({"reason": "y" * 201}).encode(),
    "unknown field": b'{"reason": "near the blade", "now": true}',
    "broken JSON": b'{"reason": "near the bla',
    "a list": b"[]",
    "NaN": b'{"reason": NaN}',
    "Latin-1": '{"reason": "Räumschild"}'.encode("latin-1"),
    "a person's words": b"somebody is near the blade",
    "20 kB of reason": json.dumps({"reason": LONG}).encode(),
    "deeply nested": b"[" * 8000,
    "a lone surrogate": b'{"reason": "\\ud800"}',
    "control characters": b'{"reason": "a\\nb\\u001b[2J"}',
    "a field of control characters": b'{"a\\nb\\u001b[2J": 1}',
}
COMMANDS = {
    "reason is a number": b'{"command": "stop", "reason": 5}',
    "unknown field": b'{"command": "stop", "now": true}',
    "broken JSON": b'{"command": "stop", "reason": "near the bla',
    "Latin-1": '{"command": "stop", "reason": "Räumschild"}'.encode("latin-1"),
    "20 kB of reason": json.dumps({"command": "stop", "reason": LONG}).encode(),
    "20 kB before it": json.dumps({"reason": LONG, "command": "stop"}).encode(),
    "written with escapes": b'{"command": "\\u0073top", "reason": 5}',
    "capitals": b'{"Command": "STOP"}',
    "as Python writes it": b"{'command': 'stop', 'reason': None}",
    "as a form": b"client=cab&command=stop",
    "the bare word": b" Stop\n",
}
HEADS = {
    "as curl -d sends it": b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\n"
    b"Content-Type: application/x-www-form-urlencoded\r\n",
    "a slash at the end": b"POST /v1/stop/ HTTP/1.1\r\nHost: localhost\r\n",
    "two slashes": b"POST //v1//stop HTTP/1.1\r\nHost: localhost\r\n",
    "capitals": b"POST /V1/Stop HTTP/1.1\r\nHost: localhost\r\n",
    "a query": b"POST /v1/stop?now HTTP/1.1\r\nHost: localhost\r\n",
    "GET": b"GET /v1/stop HTTP/1.1\r\nHost: localhost\r\n",
    "PUT": b"PUT /v1/stop HTTP/1.1\r\nHost: localhost\r\n",
    "a method of its own": b"STOP /v1/stop HTTP/1.1\r\nHost: localhost\r\n",
    "no Host": b"POST /v1/stop HTTP/1.1\r\n",
    "rubbish among the headers": b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\n\x00\xff\r\n",
    "9 kB of headers": b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nX-Long: " + b"x" * 9000 + b"\r\n",
    "HTTP 9": b"POST /v1/stop HTTP/9\r\nHost: localhost\r\n",
}


async def answer_to(path: Path, sent: bytes) -> tuple[int, dict[str, Any]]:
    reader, writer = await asyncio.open_unix_connection(str(path))
    writer.write(sent)
    answer = await within(5, _read_answer(reader))
    writer.close()
    return answer


async def _read_answer(reader: asyncio.StreamReader) -> tuple[int, dict[str, Any]]:
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
    length_n = int(head.split("content-length:", 1)[1].split("\r\n", 1)[0])
    return int(head.split(" ", 2)[1]), json.loads(await reader.readexactly(length_n))


def post(target: bytes, body: bytes) -> bytes:
    head = b"POST " + target + b" HTTP/1.1\r\nHost: localhost\r\nContent-Length: " + str(len(body)).encode()
    return head + b"\r\n\r\n" + body


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
async def test_no_body_is_a_reason_to_refuse_a_stop(tmp_path: Path, body: bytes) -> None:
    async with serving(tmp_path) as (daemon, path):
        status_code, reply = await answer_to(path, post(b"/v1/stop", body))
        assert (status_code, reply["accepted"]) == (200, True)
        assert daemon.state.mode is Mode.STOPPED
        assert daemon.state.reason.isprintable()
        assert reply["message"].isprintable()
        assert 0 < len(daemon.state.reason) < 300


async def test_what_a_body_says_is_kept_and_what_is_wrong_with_it_is_told(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        _, reply = await answer_to(path, post(b"/v1/stop", BODIES["unknown field"]))
        assert daemon.state.reason == "near the blade"
        assert reply["message"] == "stopped (not understood: now)"
    async with serving(tmp_path) as (daemon, path):
        await answer_to(path, post(b"/v1/stop", BODIES["a person's words"]))
        assert daemon.state.reason == "somebody is near the blade"
    async with serving(tmp_path) as (daemon, path):
        await answer_to(path, post(b"/v1/stop", BODIES["Latin-1"]))
        assert daemon.state.reason == "Räumschild"


@pytest.mark.parametrize("head", HEADS.values(), ids=HEADS)
async def test_the_request_line_is_the_stop(tmp_path: Path, head: bytes) -> None:
    async with serving(tmp_path) as (daemon, path):
        status_code, reply = await answer_to(path, head + b"Content-Length: 0\r\n\r\n")
        assert (status_code, reply["accepted"]) == (200, True)
        assert daemon.state.mode is Mode.STOPPED


@pytest.mark.parametrize("body", COMMANDS.values(), ids=COMMANDS)
async def test_a_stop_among_the_commands_is_as_good(tmp_path: Path, body: bytes) -> None:
    async with serving(tmp_path) as (daemon, path):
        status_code, reply = await answer_to(path, post(b"/v1/commands", body))
        assert (status_code, reply["accepted"]) == (200, True)
        assert daemon.state.mode is Mode.STOPPED


@pytest.mark.parametrize("body", COMMANDS.values(), ids=COMMANDS)
async def test_a_stop_on_the_jog_socket_is_as_good(tmp_path: Path, body: bytes) -> None:
    async with serving(tmp_path) as (daemon, path), connect(path, "/v1/jog") as socket:
        await socket.send(body.decode("latin-1"))
        await daemon.until_mode(Mode.STOPPED)


async def test_a_stop_on_the_jog_socket_that_is_no_utf_8_is_as_good(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), connect(path, "/v1/jog") as socket:
        await socket.send('{"command": "stop", "reason": "Räumschild"}'.encode("latin-1"), text=True)
        await daemon.until_mode(Mode.STOPPED)


async def test_a_stop_on_the_jog_socket_overtakes_what_was_sent_before_it(tmp_path: Path) -> None:
    """A network that stalled, or a client in a loop: what waits is void, and nothing of it undoes the stop."""
    async with serving(tmp_path) as (daemon, path), connect(path, "/v1/jog") as socket:
        for _ in range(100):
            await socket.send('{"command": "renew", "value": NaN}')
            await socket.send('{"command": "arm"}')
        await socket.send('{"command": "reset", "stop_n": 1}')
        await socket.send('{"command": "stop", "reason": "near the blade"}')
        await socket.send('{"command": "arm"}')
        answers = [json.loads(await within(5, socket.recv())) for _ in range(203)]
        assert [answer for answer in answers if answer.get("command") == "stop"] == [answers[201]]
        assert answers[201]["accepted"]
        assert answers[200]["error"] == "a stop came first"
        assert (answers[202]["command"], answers[202]["accepted"]) == ("arm", False)
        assert (daemon.state.mode, daemon.state.stop_n) == (Mode.STOPPED, 1)


@pytest.mark.parametrize("between_n", [0, 40])
@pytest.mark.parametrize("at_once", [True, False])
async def test_a_stop_sent_ahead_of_the_answer_to_another_request_waits_for_none(
    tmp_path: Path, at_once: bool, between_n: int
) -> None:
    """HTTP lets a client send the next request before the last is answered; a stop waited 3 s behind a picture."""
    daemon = FakeDaemon(frozen=True)
    async with serving(tmp_path, daemon, limits=ApiLimits(command_timeout_s=10.0)) as (_, path):
        _, writer = await asyncio.open_unix_connection(str(path))
        arm = post(b"/v1/commands", b'{"command": "arm"}').replace(
            b"\r\n", b"\r\nContent-Type: application/json\r\n", 1
        )
        writer.write(arm)
        if not at_once:
            await daemon.until(lambda: bool(daemon.waiting))
        writer.write(arm * between_n)
        head, rest = post(b"/v1/stop", b"").split(b"op", 1)
        writer.write(head)
        await writer.drain()
        writer.write(b"op" + rest)
        await daemon.until_mode(Mode.STOPPED)
        assert daemon.waiting
        writer.close()


@pytest.mark.parametrize("target", [b"/v1/stop", b"/v1/commands"])
async def test_a_stop_does_not_wait_for_a_body_that_stalls(tmp_path: Path, target: bytes) -> None:
    async with serving(tmp_path) as (daemon, path):
        _, writer = await asyncio.open_unix_connection(str(path))
        clock = AwakeClock()
        began_s = stopped_s = clock.now_s()

        def stopped() -> bool:
            nonlocal stopped_s
            stopped_s = clock.now_s()
            return daemon.state.mode is Mode.STOPPED

        writer.write(post(target, b'{"command": "stop", "reason": "and then' + b" " * 100)[:-100])
        await daemon.until(stopped)
        assert stopped_s - began_s < 0.25
        writer.close()


async def test_a_stop_whose_sender_has_hung_up_counts(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        _, writer = await asyncio.open_unix_connection(str(path))
        writer.write(post(b"/v1/stop", b" " * 100)[:-50])
        writer.close()
        await daemon.until_mode(Mode.STOPPED)


async def test_what_only_mentions_a_stop_is_none(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        for sent in (
            post(b"/v1/commands", b'{"command": "manual", "client": "stop"}'),
            post(b"/v1/commands", b'{"command": "manual", "client": "\\"command\\":\\"stop\\""}'),
            post(b"/v1/stops", b'{"command": "stop"}'),
            post(b"/v1/services/stop", b"{}"),
            b"GET /v1/status?then=/v1/stop HTTP/1.1\r\nHost: localhost\r\n\r\n",
        ):
            await answer_to(path, sent)
        assert daemon.state.mode is Mode.DISARMED


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (post(b"/v1/stop", b'{"reason": "near the blade", "client": "cab"}'), "near the blade (by cab)"),
        (b"POST /v1/st", "stop request"),
        (b"GET / HTTP/1.1\r\n\r\n", "stop request"),
        (b"somebody is near the blade\n", "somebody is near the blade"),
        (b"\x00", "\\x00"),
        (post(b"/v1/stop", b"x" * 9000)[:-4000], "x" * 200),
    ],
)
async def test_whatever_is_said_on_the_stop_socket_is_a_stop(tmp_path: Path, said: bytes, reason: str) -> None:
    async with serving(tmp_path) as (daemon, path):
        status_code, reply = await answer_to(stop_socket_beside(path), said)
        assert (status_code, reply["accepted"]) == (200, True)
        assert daemon.state.mode is Mode.STOPPED
        assert daemon.state.reason == reason


async def test_a_stop_on_the_stop_socket_waits_for_nothing_and_counts_when_its_sender_is_gone(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        _, writer = await asyncio.open_unix_connection(str(stop_socket_beside(path)))
        writer.write(b"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 50\r\n\r\n{")
        await daemon.until_mode(Mode.STOPPED)
        stop_n = daemon.state.stop_n
        writer.close()
        _, writer = await asyncio.open_unix_connection(str(stop_socket_beside(path)))
        writer.write(b"!")
        writer.close()
        await daemon.until(lambda: daemon.state.stop_n > stop_n)


async def test_the_client_takes_the_stop_socket(tmp_path: Path) -> None:
    assert client.STOP_SUFFIX == stop_socket.STOP_SUFFIX
    async with serving(tmp_path, limits=ApiLimits(accept_rate_hz=1e-3)) as (daemon, path):
        for _ in range(ACCEPT_BURST_N + 1):  # the interface itself takes nobody any more
            _, writer = await asyncio.open_unix_connection(str(path))
            writer.close()
        reply = await within(5, asyncio.to_thread(client.Client(path).stop, "by the other way"))
        assert reply.accepted
        assert "by the other way" in daemon.state.reason


async def test_who_only_connects_to_the_stop_socket_stops_nothing(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        reader, writer = await asyncio.open_unix_connection(str(stop_socket_beside(path)))
        writer.write_eof()
        assert await within(5, reader.read()) == b""
        writer.close()
        assert daemon.state.mode is Mode.DISARMED


async def test_the_stop_port_needs_the_token(tmp_path: Path) -> None:
    port_n = free_port()
    tcp = TcpSettings(port_n=0, stop_port_n=port_n, token_file=tmp_path / "tokens")
    token = create_token(tcp.token_file, "test", Right.READ)
    async with serving(tmp_path, tcp=tcp) as (daemon, _):
        for given, status_code in (("", 401), (f"Authorization: Bearer {token}\r\n", 200)):
            reader, writer = await asyncio.open_connection("127.0.0.1", port_n)
            assert daemon.state.mode is Mode.DISARMED
            writer.write(f"POST /v1/stop HTTP/1.1\r\nHost: localhost\r\n{given}\r\n".encode())
            assert (await within(5, _read_answer(reader)))[0] == status_code
            writer.close()
        assert daemon.state.mode is Mode.STOPPED


async def test_a_socket_file_that_is_taken_away_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "SOCKET_CHECK_S", 0.02)
    async with serving(tmp_path) as (daemon, path), connect(path, "/v1/jog") as socket:
        for file in (path, stop_socket_beside(path)):
            rights = file.stat().st_mode
            file.unlink()
            await daemon.until(file.is_socket)
            await daemon.until(lambda mode=rights, file=file: file.stat().st_mode == mode)  # type: ignore[misc]  # ours
        for file in (path, path.with_name(path.name + ".lock")):
            file.unlink()
        await daemon.until(path.is_socket)
        status_code, _ = await answer_to(path, b"GET /v1/status HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert status_code == 200
        await socket.send(b'{"command": "renew"}')  # who was connected still is
        assert "lease" in str(await within(5, socket.recv()))
        with pytest.raises(server.SocketInUseError):
            await server.serve(make_app(daemon), path)
        await answer_to(stop_socket_beside(path), b"taken away")
        assert daemon.state.reason == "taken away"
    assert not path.exists()
    assert not stop_socket_beside(path).exists()
