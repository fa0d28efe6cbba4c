"""The WebSockets: a stream that never piles up, and a jog whose lease ends with its connection."""

from __future__ import annotations

import asyncio
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, unix_connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from graderd.api import sockets
from graderd.api.settings import ApiLimits
from graderd.client import AsyncClient, RefusedError
from graderd.core import commands as cmd
from graderd.core.machine import MachineSettings, Mode
from graderd.core.status import Status
from harness.api_daemon import FakeDaemon, serving, within

pytestmark = pytest.mark.live


def connect(path: Path, target: str) -> Any:
    return unix_connect(str(path), f"ws://localhost{target}", compression=None)


async def ask(socket: ClientConnection, **message: Any) -> dict[str, Any]:
    await socket.send(json.dumps(message))
    answer: dict[str, Any] = json.loads(await within(5, socket.recv()))
    return answer


async def armed(daemon: FakeDaemon) -> None:
    assert (await daemon.command(cmd.Arm())).accepted
    await daemon.until_mode(Mode.MANUAL)


async def test_the_stream_sends_newer_and_newer_statuses_at_the_rate_asked_for(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path):
        for rate_hz, target in ((20.0, "/v1/stream"), (10.0, "/v1/stream?rate_hz=10"), (20.0, "/v1/stream?rate_hz=99")):
            async with connect(path, target) as socket:
                begin_s = asyncio.get_running_loop().time()
                times = [Status.model_validate_json(await socket.recv()).time_s for _ in range(8)]
                took_s = asyncio.get_running_loop().time() - begin_s
            assert times == sorted(set(times))
            assert took_s >= 7 / rate_hz * 0.95


async def test_the_bus_is_sent_as_it_comes_and_let_go_when_the_client_goes(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        async with connect(path, "/v1/bus/can") as socket:
            assert await within(5, socket.recv()) == "(1.000000) can0 18EF1300#DC05191500000000\n"
            assert str(await within(5, socket.recv())).startswith("# 3 lines lost")
        await daemon.until(lambda: daemon.bus_watched_n == 1)


async def test_a_bus_that_is_not_there_is_refused_with_those_that_are(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, path), AsyncClient(path) as client:
        with pytest.raises(RefusedError, match=r"there is no bus 'ser vo'\. there are: can") as refused:
            async with client.bus_text("ser vo"):
                raise AssertionError("it was opened")
        assert refused.value.status_code == 404


@pytest.mark.parametrize("where", ["bus", "services"])
async def test_a_name_of_control_characters_comes_back_printable(tmp_path: Path, where: str) -> None:
    async with serving(tmp_path) as (_, path):
        with pytest.raises(InvalidStatus) as refused:
            async with connect(path, f"/v1/{where}/a%0ab%1b[2J"):
                raise AssertionError("it was opened")
    told = json.loads(refused.value.response.body or b"{}")
    assert "a\\nb" in f"{told['where']} {told['error']}"
    assert all(text.isprintable() for text in told.values() if isinstance(text, str))


async def test_a_slow_client_gets_no_old_statuses_and_makes_nothing_grow(tmp_path: Path) -> None:
    async with serving(tmp_path, limits=ApiLimits(stream_max_hz=200.0)) as (daemon, path):
        reader, writer = await asyncio.open_unix_connection(str(path), limit=4096)
        writer.write(
            b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        await reader.readuntil(b"\r\n\r\n")
        sent: list[float] = []
        make_text = Status.model_dump_json

        def counted(status: Status, **options: Any) -> str:
            sent.append(status.time_s)
            return make_text(status, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Status, "model_dump_json", counted)
            begin_n = len(daemon.late_s)
            await daemon.until(lambda: len(daemon.late_s) > begin_n + 100)
            stuck_n = len(sent)
            await daemon.until(lambda: len(daemon.late_s) > begin_n + 150)
        assert stuck_n < 40  # what fits into two socket buffers and asyncio's reader, not 100 ticks
        assert len(sent) == stuck_n
        writer.close()
        await writer.wait_closed()


async def test_a_jog_moves_while_it_is_renewed(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        async with connect(path, "/v1/jog?client=cab") as socket:
            reply = await ask(socket, command="jog", axis="rotate", value=10.0)
            assert reply == {
                "command": "jog",
                "accepted": True,
                "message": "moving while the lease is renewed",
                "remedy": "",
            }
            assert daemon.state.lease is not None
            assert daemon.state.lease.client.startswith("cab#")
            while daemon.positions["rotation"] < 10.0:
                assert (await ask(socket, command="renew"))["accepted"]
            assert (await ask(socket, command="release"))["message"] == "released; holding"
            assert daemon.status().lease is None


@pytest.mark.parametrize("how", ["close", "abort"])
async def test_the_lease_is_given_back_when_the_client_goes(tmp_path: Path, how: str) -> None:
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        socket = await connect(path, "/v1/jog")
        assert (await ask(socket, command="jog", axis="rotate", value=50.0))["accepted"]
        if how == "close":
            await socket.close()
        else:
            socket.transport.abort()
        await daemon.until(lambda: daemon.state.lease is None)
        assert daemon.state.reason == "released"
        assert daemon.positions["rotation"] < 30.0


async def test_the_lease_of_a_preset_is_given_back_when_the_client_goes(tmp_path: Path) -> None:
    async with serving(tmp_path, FakeDaemon(settings=MachineSettings(lease_s=5.0))) as (daemon, path):
        await armed(daemon)
        socket = await connect(path, "/v1/jog")
        assert (await ask(socket, command="preset", name="transport"))["accepted"]
        assert daemon.state.lease is not None
        await socket.close()
        await daemon.until(lambda: daemon.state.lease is None, timeout_s=5.0)
        assert daemon.state.reason == "released"


async def test_nobody_keeps_somebody_elses_lease(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        async with connect(path, "/v1/jog?client=a") as first, connect(path, "/v1/jog?client=a") as second:
            assert (await ask(first, command="jog", axis="tilt", value=60.0))["accepted"]
            # The same name, and even the first one's full name, does not make the second the first.
            assert daemon.state.lease is not None
            stolen = await ask(second, command="renew", client=daemon.state.lease.client)
            assert stolen["accepted"] is False
            assert stolen["message"] == "you hold no lease"
            refused = await ask(second, command="jog", axis="tilt", value=10.0)
            assert "is moving the blade" in refused["message"]
            await second.close()
            assert (await ask(first, command="renew"))["accepted"]


async def test_malformed_messages_are_answered_and_slow_the_client_down(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), connect(path, "/v1/jog") as socket:
        begin_s = asyncio.get_running_loop().time()
        for text in ("", "{", "[]", '{"command": "fly"}', b"\xff\xfe"):
            await socket.send(text)
            problem = json.loads(await within(5, socket.recv()))
            assert set(problem) == {"error", "where", "remedy"}
        assert asyncio.get_running_loop().time() - begin_s > 0.4
        assert daemon.seen == []
        assert (await ask(socket, command="stop"))["accepted"]


async def test_who_sends_more_than_is_obeyed_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rather than heard ever later: what comes last may be a stop, and must come to somebody or be known not to."""
    monkeypatch.setattr(sockets, "WAITING_N", 20)
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        async with connect(path, "/v1/jog") as socket:
            assert (await ask(socket, command="jog", axis="rotate", value=50.0))["accepted"]
            with suppress(ConnectionClosed):
                for _ in range(100):
                    await socket.send('{"command": "renew", "value": NaN}')
            await within(5, socket.wait_closed())
            assert socket.close_reason == "more messages than are obeyed"
        await daemon.until(lambda: daemon.state.lease is None)
        assert daemon.state.reason == "released"


async def test_who_renews_more_often_than_it_ticks_is_not_obeyed_ever_later(tmp_path: Path) -> None:
    """A page renews with each of its sixty pictures a second: what waited kept its lease when it had gone."""
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        async with connect(path, "/v1/jog") as socket:
            await socket.send('{"command": "jog", "axis": "rotate", "value": 50.0}')
            for _ in range(300):
                await socket.send('{"command": "renew"}')
            begin_n = len(daemon.late_s)
            for _ in range(301):
                await within(5, socket.recv())
            assert len(daemon.late_s) - begin_n < 100


async def test_a_command_counts_from_when_it_was_heard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "AT_ONCE_N", 1)
    waits_s: list[float] = []
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        hand_over = daemon.command

        async def noted(command: cmd.Command, waited_s: float = 0.0) -> cmd.Reply:
            waits_s.append(waited_s)
            return await hand_over(command, waited_s)

        daemon.command = noted  # type: ignore[method-assign]
        async with connect(path, "/v1/jog") as socket:
            for _ in range(30):
                await socket.send('{"command": "renew"}')
            for _ in range(30):
                await within(5, socket.recv())
    assert waits_s[-1] > 0.2  # thirty ticks of 20 ms, one for each


async def test_a_message_that_is_too_large_ends_the_connection_and_the_lease(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        async with connect(path, "/v1/jog") as socket:
            assert (await ask(socket, command="jog", axis="rotate", value=50.0))["accepted"]
            await socket.send("x" * 100_000)
            with pytest.raises(ConnectionClosed):
                await socket.recv()
        await daemon.until(lambda: daemon.state.lease is None)
        assert daemon.state.reason.startswith("a message too large to be read")


async def test_streams_are_bounded(tmp_path: Path) -> None:
    async with serving(tmp_path, limits=ApiLimits(websockets_max_n=2)) as (_, path):
        async with connect(path, "/v1/stream") as one, connect(path, "/v1/stream") as two:
            await asyncio.gather(one.recv(), two.recv())
            with pytest.raises(InvalidStatus) as refused:
                await connect(path, "/v1/jog")
            assert refused.value.response.status_code == 503
            assert b"streams are open already" in (refused.value.response.body or b"")
        async with asyncio.timeout(10.0):
            while True:  # the places are given back when the server has seen the ends, not when the clients have
                try:
                    async with connect(path, "/v1/stream") as again:
                        await again.recv()
                    break
                except InvalidStatus:
                    await asyncio.sleep(0.01)


@pytest.mark.parametrize("target", ["/v1/stream?rate_hz=0", "/v1/stream?rate_hz=nan", "/v1/nothing"])
async def test_what_is_no_stream_is_refused(tmp_path: Path, target: str) -> None:
    async with serving(tmp_path) as (_, path):
        with pytest.raises(InvalidStatus):
            await connect(path, target)


async def test_the_daemons_end_ends_the_streams(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with serving(tmp_path) as (daemon, path):
        await armed(daemon)
        stream, jog = await connect(path, "/v1/stream"), await connect(path, "/v1/jog")
        assert (await ask(jog, command="jog", axis="rotate", value=50.0))["accepted"]
        await stream.recv()
        begin_s = asyncio.get_running_loop().time()
    assert asyncio.get_running_loop().time() - begin_s < 1.5
    for socket in (stream, jog):
        await within(2, socket.wait_closed())
        assert socket.close_code in (1001, 1012)
    assert daemon.state.lease is None
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


async def test_clients_that_vanish_at_any_moment_leave_nothing_behind(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    handshake = (
        b"GET /v1/%s HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    async with serving(tmp_path, limits=ApiLimits(accept_rate_hz=1e4)) as (daemon, path):
        before = len(asyncio.all_tasks())
        for number in range(60):
            _, writer = await asyncio.open_unix_connection(str(path))
            writer.write(handshake % (b"stream", b"jog")[number % 2])
            await asyncio.sleep((number % 5) * 0.002)
            writer.transport.abort()
        await daemon.until(lambda: len(asyncio.all_tasks()) <= before)
        async with connect(path, "/v1/stream") as stream:
            await stream.recv()
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


STEP = "/v1/services/rotation.step_response"
CONSENT = json.dumps({"consent": True})


async def test_a_maneuver_goes_on_while_its_client_is_heard_and_answers_at_its_end(tmp_path: Path) -> None:
    loop, limits = asyncio.get_running_loop(), ApiLimits(maneuver_lease_s=0.25)
    async with serving(tmp_path, limits=limits) as (daemon, path), AsyncClient(path) as client:
        running = asyncio.create_task(client.maneuver("rotation.step_response", consent=True))
        await daemon.until(lambda: daemon.maneuvers == ["began"])
        began_s = loop.time()
        await daemon.until(lambda: loop.time() - began_s > 3 * 0.25)
        assert daemon.maneuvers == ["began"]
        daemon.maneuver_done.set()
        assert await within(5, running) == {"overshoot_percent": 1.5}


@pytest.mark.parametrize("how", ["silent", "gone", "stop"])
async def test_a_maneuver_ends_with_its_client(tmp_path: Path, how: str) -> None:
    """Also with one that stands still (SIGSTOP) while the kernel keeps its connection open."""
    async with serving(tmp_path) as (daemon, path):
        async with connect(path, STEP) as socket:
            await socket.send(CONSENT)
            await daemon.until(lambda: daemon.maneuvers == ["began"])
            if how == "stop":
                await socket.send(json.dumps({"command": "stop", "reason": "enough"}))
                await daemon.until(lambda: daemon.state.mode is Mode.STOPPED)
                assert "enough" in daemon.state.reason
            if how != "gone":
                assert "was not heard for 0.5 s" in json.loads(await within(5, socket.recv()))["error"]
        await daemon.until(lambda: daemon.maneuvers == ["began", "ended"])


async def test_a_maneuver_is_asked_for_as_its_description_says(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path):
        for asked, where in (({"consent": "false"}, "consent"), ({"consent": True, "step": 5}, "step")):
            async with connect(path, STEP) as socket:
                assert (await ask(socket, **asked))["where"] == where
        for name in ("rotation.reboot", "nothing"):
            with pytest.raises(InvalidStatus) as refused:
                async with connect(path, f"/v1/services/{name}"):
                    raise AssertionError("it was opened")
            assert refused.value.response.status_code == 404
        assert daemon.maneuvers == []
