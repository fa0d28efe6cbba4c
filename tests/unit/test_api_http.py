"""Requests over a real unix socket: every route, every refusal in the same form, rights and stale sockets."""

from __future__ import annotations

import asyncio
import contextlib
import grp
import json
import os
import re
import stat
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from graderd.api.app import make_app
from graderd.api.port import DaemonPort
from graderd.api.server import SocketError, SocketInUseError, serve
from graderd.api.settings import ApiLimits
from graderd.core import commands as cmd
from graderd.core.machine import Mode, Unmet
from graderd.core.status import Status
from harness.api_daemon import JPEG, FakeDaemon, serving, within

pytestmark = pytest.mark.live


@contextlib.asynccontextmanager
async def client_of(path: Path) -> AsyncIterator[httpx.AsyncClient]:
    transport = httpx.AsyncHTTPTransport(uds=str(path))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost", timeout=10) as client:
        yield client


def test_the_fake_is_a_daemon_port() -> None:
    port: DaemonPort = FakeDaemon()
    assert port.status().mode is Mode.DISARMED


async def test_status_is_the_status_model(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        answer = await client.get("/v1/status")
        assert answer.status_code == 200
        assert Status.model_validate_json(answer.content).axes["rotation"].measured == 0.0
        assert daemon.status().mode is Mode.DISARMED


async def test_the_way_through_the_modes(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        for command, mode in (("arm", Mode.MANUAL), ("auto", Mode.AUTO), ("manual", Mode.MANUAL)):
            answer = await client.post("/v1/commands", json={"command": command})
            assert answer.status_code == 200, answer.text
            assert answer.json()["accepted"] is True
            await daemon.until_mode(mode)
        assert (await client.post("/v1/stop", json={"reason": "test"})).json()["message"] == "stopped"
        assert daemon.status().mode is Mode.STOPPED
        refused = await client.post("/v1/commands", json={"command": "arm"})
        assert refused.status_code == 409
        assert refused.json() == {"error": "stopped: test", "where": "arm", "remedy": "reset first, then arm"}
        assert (await client.post("/v1/commands", json={"command": "reset", "stop_n": 1})).status_code == 200
        assert daemon.status().mode is Mode.DISARMED


@pytest.mark.parametrize("body", [None, {}, {"reason": "x", "client": "y"}])
async def test_stop_needs_no_body_and_may_be_repeated(tmp_path: Path, body: dict[str, str] | None) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        for _ in range(3):
            answer = await client.post("/v1/stop") if body is None else await client.post("/v1/stop", json=body)
            assert answer.status_code == 200, answer.text
        assert daemon.status().mode is Mode.STOPPED


async def test_arm_says_what_is_unmet_and_the_remedy(tmp_path: Path) -> None:
    daemon = FakeDaemon(unmet=(Unmet("camera fresh", "no picture yet", "look at the camera's cable"),))
    async with serving(tmp_path, daemon) as (_, path), client_of(path) as client:
        refused = await client.post("/v1/commands", json={"command": "arm"})
        assert refused.status_code == 409
        assert refused.json()["error"] == "not ready: camera fresh: no picture yet"
        assert refused.json()["remedy"] == "look at the camera's cable"


MALFORMED: list[tuple[bytes, str]] = [
    (b"", "body"),
    (b"{", ""),
    (b"[]", "body"),
    (b"null", "body"),
    (b'"arm"', "body"),
    (b'{"command": "fly"}', "body"),
    (b'{"command": "manual", "now": true}', "manual.now"),
    (b'{"command": "jog", "axis": "rotate", "value": NaN}', "jog.value"),
    (b'{"command": "jog", "axis": "rotate", "value": Infinity}', "jog.value"),
    (b'{"command": "jog", "axis": "rotate", "value": 1e999}', "jog.value"),
    (b'{"command": "jog", "axis": "rotate", "value": "5"}', "jog.value"),
    (b'{"command": "jog", "axis": "rotate", "value": true}', "jog.value"),
    (b'{"command": "jog", "axis": "rotate", "value": 1, "relative": "no"}', "jog.relative"),
    (b'{"command": "reset", "stop_n": true}', "reset.stop_n"),
    (b'{"command": "jog", "axis": "wheel", "value": 1}', "jog.axis"),
    (b'{"command": "jog", "axis": "rotate"}', "jog.value"),
    (b'{"command": "arm", "client": "' + b"x" * 81 + b'"}', "arm.client"),
    (b'{"command": "arm", "client": "\\ud800"}', "arm.client"),
    (b'{"command": "jog", "axis": "rotate", "value": ' + b"9" * 6000 + b"}", ""),
    (b"[" * 8000, ""),
    (b"\xff\xfe\x00", ""),
]


@pytest.mark.parametrize(("body", "where"), MALFORMED, ids=range(len(MALFORMED)))
async def test_malformed_commands_are_told_plainly_and_change_nothing(tmp_path: Path, body: bytes, where: str) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        answer = await client.post("/v1/commands", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 422, answer.text
        assert set(answer.json()) == {"error", "where", "remedy"}
        assert answer.json()["error"]
        assert not where or answer.json()["where"] == where
        assert daemon.seen == []


async def test_a_large_body_is_refused_and_the_next_request_served(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path), client_of(path) as client:
        for target in ("/v1/commands", "/v1/services/rotation.reboot"):
            answer = await client.post(target, content=b" " * 20_000)
            assert answer.status_code == 413
            assert "16384" in answer.json()["error"]
        assert (await client.get("/v1/status")).status_code == 200


async def test_a_body_that_never_ends_is_given_up(tmp_path: Path) -> None:
    async with serving(tmp_path, limits=ApiLimits(body_timeout_s=0.2)) as (_, path):
        reader, writer = await asyncio.open_unix_connection(str(path))
        writer.write(b"POST /v1/commands HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{")
        assert b"408" in await within(5, reader.readline())
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize("said", [b"what is this", b"GET / HTTP/9.9", b"GET /v1/status HTTP/2.0"])
async def test_what_is_no_http_is_told_so_and_fills_no_log(
    said: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(tmp_path) as (_, path):
        for _ in range(5):
            reader, writer = await asyncio.open_unix_connection(str(path))
            writer.write(said + b"\r\n\r\n")
            answer = await within(5, reader.read())
            assert answer.startswith(b"HTTP/1.1 400 ")
            assert json.loads(answer.partition(b"\r\n\r\n")[2])["where"] == "request"
            writer.close()
            await writer.wait_closed()
    assert caplog.records == []


async def test_paths_and_methods_that_do_not_exist(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path), client_of(path) as client:
        assert (await client.get("/nothing")).status_code == 404
        assert (await client.get("/nothing")).json()["where"] == "/nothing"
        assert (await client.delete("/v1/status")).status_code == 405
        for other, allowed in (("/v1/status", "GET"), ("/v1/session", "GET, POST, DELETE"), ("/", "GET, HEAD")):
            assert (await client.patch(other)).headers["allow"] == allowed
        for stream in ("/v1/stream", "/v1/jog", "/v1/bus/can"):
            answer = await client.get(stream)
            assert answer.status_code == 426
            assert "WebSocket" in answer.json()["error"]


async def test_config_preview_and_services(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        assert (await client.get("/v1/config")).json()["machine"]["lease_s"] == 0.3
        picture = await client.get("/v1/preview.jpg")
        assert (picture.headers["content-type"], picture.content) == ("image/jpeg", JPEG)
        assert picture.headers["picture-age-s"] == "0.250"
        daemon.picture = None
        assert (await client.get("/v1/preview.jpg")).status_code == 404
        assert (await client.post("/v1/services/rotation.verify_profile")).json() == {"differences": []}
        refused = await client.post("/v1/services/rotation.reboot", json={})
        assert refused.status_code == 409
        assert refused.json()["where"] == "rotation.reboot"
        assert "consent" in refused.json()["remedy"]
        assert (await client.post("/v1/services/rotation.reboot", json={"consent": True})).json() == {"rebooted": True}
        assert (await client.post("/v1/services/nothing")).status_code == 409
        assert (await client.post("/v1/services/No%20Such")).status_code == 422


async def test_a_tick_that_does_not_answer_is_reported(tmp_path: Path) -> None:
    limits = ApiLimits(command_timeout_s=0.2)
    async with serving(tmp_path, FakeDaemon(frozen=True), limits=limits) as (_, path), client_of(path) as client:
        answer = await client.post("/v1/commands", json={"command": "arm"})
        assert answer.status_code == 504
        assert "control tick" in answer.json()["error"]


async def test_an_internal_error_is_a_problem_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Broken(FakeDaemon):
        def config(self) -> dict[str, Any]:
            raise KeyError("a bug")

    async with serving(tmp_path, Broken()) as (_, path), client_of(path) as client:
        answer = await client.get("/v1/config")
        assert answer.status_code == 500
        assert answer.json()["where"] == "/v1/config"
        assert "a bug" not in answer.text
    assert "a bug" in caplog.text


async def test_the_files_rights_decide(tmp_path: Path) -> None:
    group = grp.getgrgid(os.getgid()).gr_name
    path, ready = tmp_path / "g.sock", asyncio.Event()
    task = asyncio.create_task(serve(make_app(FakeDaemon()), path, 0o640, group, ready=ready), name="api")
    await ready.wait()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert path.stat().st_gid == os.getgid()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not path.exists()


async def test_a_stale_socket_is_replaced_and_a_live_one_is_not(tmp_path: Path) -> None:
    import socket

    path = tmp_path / "api.sock"
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(path))
    left.close()
    assert path.exists()
    async with serving(tmp_path) as (_, path), client_of(path) as client:
        with pytest.raises(SocketInUseError, match=f"another daemon \\(process {os.getpid()}\\) serves it") as error:
            await serve(make_app(FakeDaemon()), path)
        assert "\n" not in str(error.value)
        assert (await client.get("/v1/status")).status_code == 200
    assert list(tmp_path.iterdir()) == []


async def test_what_is_no_socket_of_ours_is_left_alone(tmp_path: Path) -> None:
    import socket

    precious = tmp_path / "precious"
    precious.write_text("data")
    with pytest.raises(SocketError, match="file of another kind"):
        await serve(make_app(FakeDaemon()), precious)
    assert precious.read_text() == "data"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(tmp_path / "other"))
        other.listen()
        with pytest.raises(SocketInUseError, match="another program"):
            await serve(make_app(FakeDaemon()), tmp_path / "other")


@pytest.mark.parametrize(
    ("path", "group", "says"),
    [
        ("missing/api.sock", None, "No such file or directory"),
        ("x" * 200, None, "longer than 107 bytes"),
        ("api.sock", "no-such-group-here", "there is no group"),
    ],
)
async def test_a_socket_that_cannot_be_made(tmp_path: Path, path: str, group: str | None, says: str) -> None:
    with pytest.raises(SocketError, match=says):
        await serve(make_app(FakeDaemon()), tmp_path / path, socket_group=group)
    assert not (tmp_path / path).exists()


async def test_the_description_is_complete(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path), client_of(path) as client:
        description = (await client.get("/v1/openapi.json")).json()
    paths = description["paths"]
    assert set(paths) == {
        "/v1/status",
        "/v1/commands",
        "/v1/stop",
        "/v1/config",
        "/v1/preview.jpg",
        "/v1/services/rotation.verify_profile",
        "/v1/services/rotation.reboot",
        "/v1/services/rotation.step_response",
        "/v1/stream",
        "/v1/jog",
        "/v1/bus/{name}",
        "/v1/session",
        "/metrics",
    }
    for operations in paths.values():
        for operation in operations.values():
            assert operation["summary"]
            assert operation["tags"]
    body = paths["/v1/commands"]["post"]["requestBody"]["content"]["application/json"]
    commands = {reference.rsplit("/", 1)[1] for reference in body["schema"]["discriminator"]["mapping"].values()}
    assert commands == {"Arm", "Disarm", "Stop", "Reset", "Auto", "Manual", "Jog", "Preset", "Renew", "Release"}
    assert set(body["examples"]) >= {"arm", "stop", "jog"}
    step = paths["/v1/services/rotation.step_response"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    arguments = description["components"]["schemas"]["RotationStepResponseRequest"]["properties"]
    assert "RotationStepResponseRequest" in json.dumps(step)
    assert {name: one["type"] for name, one in arguments.items()} == {"step_deg": "number", "consent": "boolean"}
    assert {"409", "422", "503", "504"} <= set(paths["/v1/commands"]["post"]["responses"])
    for operations in paths.values():
        for operation in operations.values():
            assert {"401", "403", "404", "405", "408", "413", "422", "431", "503"} <= set(operation["responses"])
            assert operation["security"] == [{"bearer": []}, {"cookie": []}]
    assert set(description["components"]["securitySchemes"]) == {"bearer", "cookie"}
    text = json.dumps(description, allow_nan=False)
    assert "HTTPValidationError" not in text
    schemas = set(re.findall(r'"#/components/schemas/(\w+)"', text))
    assert schemas <= set(description["components"]["schemas"])
    assert {"Status", "Reply", "Problem", "AxisStatus", "FaultStatus"} <= schemas


async def test_the_oldest_connection_makes_room_for_a_new_one(tmp_path: Path) -> None:
    """Whoever wants to stop the machine gets in, however many connections hang about."""
    async with serving(tmp_path, limits=ApiLimits(connections_max_n=4)) as (daemon, path):
        idle = [await asyncio.open_unix_connection(str(path)) for _ in range(4)]
        async with client_of(path) as client:
            assert (await client.post("/v1/stop")).status_code == 200
        assert daemon.status().mode is Mode.STOPPED
        with contextlib.suppress(ConnectionResetError):
            assert await within(5, idle[0][0].read()) == b""
        assert not idle[1][0].at_eof()
        for _, writer in idle:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


async def test_requests_that_wait_when_the_daemon_ends_are_answered(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(tmp_path, FakeDaemon(frozen=True)) as (daemon, path):
        reader, writer = await asyncio.open_unix_connection(str(path))
        writer.write(
            b"POST /v1/commands HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            b'Content-Length: 18\r\n\r\n{"command": "arm"}'
        )
        await daemon.until(lambda: bool(daemon.waiting))
    answer = await within(2, reader.read())
    assert b" 503 " in answer
    assert b"the daemon ends" in answer
    writer.close()
    await writer.wait_closed()
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


async def test_nothing_moves_for_what_was_sent_ahead_of_the_answers(tmp_path: Path) -> None:
    """A client that sent three hundred renewals at once, and went, was moved for six seconds."""

    def post(body: bytes) -> bytes:
        head = b"POST /v1/commands HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        return head + b"Content-Length: %d\r\n\r\n%b" % (len(body), body)

    async with serving(tmp_path) as (daemon, path), client_of(path) as other:
        await other.post("/v1/commands", json={"command": "arm"})
        await daemon.until_mode(Mode.MANUAL)
        reader, writer = await asyncio.open_unix_connection(str(path))
        move, renewal = (post(b'{"command": "jog", "axis": "rotate", "value": 50}'), post(b'{"command": "renew"}'))
        writer.write(move + renewal * 60 + post(b'{"command": "release"}'))
        for n in range(62):
            answer = await within(5, reader.readuntil(b'"remedy":'))
            assert (b"sent ahead of the answers" in answer) is (0 < n < 61)
        assert not any(isinstance(command, cmd.Renew) for command in daemon.seen)
        writer.close()


async def test_a_request_counts_from_when_it_had_come(tmp_path: Path) -> None:
    """Not from when its turn came in a flood."""
    waits_s: list[float] = []
    async with serving(tmp_path, limits=ApiLimits(rate_hz=10.0, burst_n=1)) as (daemon, path), client_of(path) as one:
        hand_over = daemon.command

        async def noted(command: cmd.Command, waited_s: float = 0.0) -> cmd.Reply:
            waits_s.append(waited_s)
            return await hand_over(command, waited_s)

        daemon.command = noted  # type: ignore[method-assign]
        await asyncio.gather(*(one.post("/v1/commands", json={"command": "renew"}) for _ in range(4)))
    assert max(waits_s) > 0.15


@pytest.mark.parametrize("name", ["", "cab", "jog#1", "cab#1", "maneuver"])
async def test_the_name_of_a_lease_is_the_daemons(tmp_path: Path, name: str) -> None:
    """Whatever a client calls itself: nobody renews, moves or gives back on another connection's lease."""
    jog = {"command": "jog", "axis": "rotate", "value": 50.0, "client": name}
    async with serving(tmp_path) as (daemon, path), client_of(path) as one, client_of(path) as other:
        await one.post("/v1/commands", json={"command": "arm"})
        await daemon.until_mode(Mode.MANUAL)
        assert (await one.post("/v1/commands", json=jog)).status_code == 200
        assert daemon.state.lease is not None
        for command in ({"command": "renew", "client": name}, {"command": "release", "client": name}, jog):
            for taken in (name, daemon.state.lease.client):
                assert (await other.post("/v1/commands", json={**command, "client": taken})).status_code == 409
            assert (await one.post("/v1/commands", json={"command": "renew"})).status_code == 200


@pytest.mark.parametrize("consent", ["false", "no", "true", [0], -1, 1, 1.0, {}, None])
async def test_consent_is_true_and_nothing_that_only_counts_as_true(tmp_path: Path, consent: Any) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        answer = await client.post("/v1/services/rotation.step_response", json={"consent": consent})
        assert answer.status_code == 422
        assert answer.json()["where"] == "consent"
        answer = await client.post("/v1/services/rotation.step_response", json={"consent": True, "step": 5})
        assert (answer.status_code, answer.json()["where"]) == (422, "step")
        assert daemon.maneuvers == []


async def test_a_service_that_moves_is_no_request(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), client_of(path) as client:
        answer = await client.post("/v1/services/rotation.step_response", json={"consent": True})
        assert answer.status_code == 426
        assert "WebSocket" in answer.json()["remedy"]
        assert daemon.maneuvers == []
