"""The client, waiting and on an event loop: typed answers, its errors, the lease, and what is never sent twice."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio import client as async_client
from websockets.sync import client as sync_client

from graderd.api.settings import ApiLimits, TcpSettings
from graderd.client import (
    AsyncClient,
    Client,
    ClientError,
    LeaseLostError,
    NoDaemonError,
    NotReachedError,
    RefusedError,
)
from graderd.core.machine import MachineSettings, Mode, Unmet
from graderd.tokens import Right, create_token
from harness.api_daemon import JPEG, FakeDaemon, free_port, serving

pytestmark = pytest.mark.live


async def in_thread(work: Callable[[], Any]) -> Any:
    """The daemon lives in this event loop, so a client that waits does it elsewhere."""
    return await asyncio.to_thread(work)


async def test_everything_but_moving_both_ways(tmp_path: Path) -> None:
    def waiting(path: Path) -> None:
        with Client(path, name="test") as client:
            assert client.status().mode is Mode.DISARMED
            assert client.command("arm").message == "arming"
            client.until(lambda status: status.mode is Mode.MANUAL, 5.0, "armed")
            assert "machine" in client.config()
            assert client.preview_jpeg() == JPEG
            assert client.service("rotation.verify_profile") == {"differences": []}
            with client.statuses(20.0) as statuses:
                times = [next(statuses).time_s for _ in range(3)]
            assert times == sorted(set(times))
            with client.bus_text() as texts:
                assert next(texts).startswith("(1.000000) can0")
            assert client.stop("enough").accepted
            assert client.status().last_stop == "enough (by test)"
            assert client.reset().accepted

    async def on_a_loop(path: Path) -> None:
        async with AsyncClient(path, name="test") as client:
            assert (await client.status()).mode is Mode.DISARMED
            assert (await client.command("arm")).message == "arming"
            await client.until(lambda status: status.mode is Mode.MANUAL, 5.0, "armed")
            assert "machine" in await client.config()
            assert await client.preview_jpeg() == JPEG
            assert await client.service("rotation.verify_profile") == {"differences": []}
            async with client.statuses(20.0) as statuses:
                times = [(await anext(statuses)).time_s for _ in range(3)]
            assert times == sorted(set(times))
            async with client.bus_text() as texts:
                assert (await anext(texts)).startswith("(1.000000) can0")
            assert (await client.stop("enough")).accepted
            assert (await client.status()).last_stop == "enough (by test)"
            assert (await client.reset()).accepted

    async with serving(tmp_path) as (_, path):
        await in_thread(lambda: waiting(path))
        await on_a_loop(path)


async def test_a_lease_moves_and_is_given_back_at_the_end_of_its_block(tmp_path: Path) -> None:
    def waiting(path: Path) -> None:
        with Client(path, name="test").lease("sync") as lease:
            lease.jog("rotate", 6.0)
            for status in lease.statuses():
                assert status.axes["rotation"].requested == 6.0  # none is from before the jog
                if status.axes["rotation"].in_position:
                    break
            lease.preset("transport")
            for status in lease.statuses():
                if (status.axes["lift_left"].measured, status.axes["rotation"].measured) == (200.0, 0.0):
                    break  # the blade too, from where the next jog is told

    async def on_a_loop(path: Path) -> None:
        async with AsyncClient(path, name="test") as client, client.lease("async") as lease:
            await lease.jog("rotate", 4.0, relative=True)
            async for status in lease.statuses():
                if status.axes["rotation"].in_position and status.axes["rotation"].measured == 4.0:
                    break

    daemon = FakeDaemon(settings=MachineSettings(lease_s=1.0))  # for a busy machine: what lapses is another test's
    async with serving(tmp_path, daemon) as (_, path):
        async with AsyncClient(path) as client:
            await client.command("arm")
            await client.until(lambda status: status.mode is Mode.MANUAL, 5.0, "armed")
        await in_thread(lambda: waiting(path))
        assert daemon.state.lease is None
        assert daemon.positions["lift_left"] == 200.0
        await on_a_loop(path)
        assert daemon.state.lease is None
        assert daemon.positions["rotation"] == 4.0
        names = {command.client for command in daemon.seen if command.command == "renew"}
        assert {name.partition("#")[0] for name in names} == {"test sync", "test async"}


async def test_a_program_that_hangs_loses_its_lease_and_is_told_why(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), AsyncClient(path) as client:
        await client.command("arm")
        await client.until(lambda status: status.mode is Mode.MANUAL, 5.0, "armed")
        async with client.lease() as lease:
            await lease.jog("rotate", 60.0)
            await daemon.until(lambda: daemon.state.lease is None)
            with pytest.raises(LeaseLostError, match="jog: ended on the way: manual, "):
                async for _ in lease.statuses():
                    pass
        assert daemon.positions["rotation"] < 45.0


@asynccontextmanager
async def go_between(path: Path, to: Path) -> AsyncIterator[set[asyncio.StreamWriter]]:
    """A way to the daemon whose connections can be broken: those that are open now."""
    ways: set[asyncio.StreamWriter] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_unix_connection(str(to))
        ways.update((writer, far_writer))

        async def carry(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
            with suppress(OSError):
                while piece := await source.read(65536):
                    sink.write(piece)
                    await sink.drain()
            sink.close()

        await asyncio.gather(carry(reader, far_writer), carry(far_reader, writer))
        ways.difference_update((writer, far_writer))

    async with await asyncio.start_unix_server(serve, path):
        yield ways


async def test_who_finds_his_connections_closed_is_told_what_became_of_his_lease(tmp_path: Path) -> None:
    """As a program that was halted for long: its lease lapsed, and then the daemon closed what answers no ping."""
    between = tmp_path / "between.sock"

    async def lapsed(jog: Awaitable[None]) -> None:
        await jog
        await daemon.until(lambda: daemon.state.lease is None)
        for way in list(ways):
            way.transport.abort()
        await daemon.until(lambda: not ways)

    async with serving(tmp_path) as (daemon, path), go_between(between, path) as ways:
        async with AsyncClient(path) as client:
            await client.command("arm")
            await client.until(lambda status: status.mode is Mode.MANUAL, 5.0, "armed")
        async with AsyncClient(between) as client, client.lease() as lease:
            await lapsed(lease.jog("rotate", 60.0))
            with pytest.raises(LeaseLostError, match=r"^jog: ended on the way: manual, lease of .* lapsed"):
                await anext(lease.statuses())
        block = Client(between).lease()
        waiting = await in_thread(block.__enter__)
        await lapsed(in_thread(lambda: waiting.jog("rotate", 60.0)))
        with pytest.raises(LeaseLostError, match=r"^jog: ended on the way: manual, lease of .* lapsed"):
            await in_thread(lambda: next(waiting.statuses()))
        await in_thread(lambda: block.__exit__(None, None, None))


async def test_who_was_halted_in_a_maneuver_is_told_that_it_was_not_heard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It wakes, and wants to renew, when the daemon has said its last word and closed."""
    halted = [True, True]
    waiting_recv, loop_recv = sync_client.ClientConnection.recv, async_client.ClientConnection.recv

    def recv(self: sync_client.ClientConnection, timeout: float | None = None) -> str | bytes:
        if halted.pop():
            self.recv_events_thread.join(10.0)
            raise TimeoutError
        return waiting_recv(self, timeout)

    async def recv_on_a_loop(self: async_client.ClientConnection) -> str | bytes:
        if halted.pop():
            await self.wait_closed()
            raise TimeoutError
        return await loop_recv(self)

    monkeypatch.setattr(sync_client.ClientConnection, "recv", recv)
    monkeypatch.setattr(async_client.ClientConnection, "recv", recv_on_a_loop)
    monkeypatch.setattr("graderd.client.LEASE_HZ", 0.1)  # ten seconds, in which it does not look
    async with serving(tmp_path) as (daemon, path):
        halted[:] = [False, True]
        with pytest.raises(RefusedError, match=r"was not heard for 0\.5 s"):
            await in_thread(lambda: Client(path).maneuver("rotation.step_response", consent=True))
        halted[:] = [False, True]
        with pytest.raises(RefusedError, match=r"was not heard for 0\.5 s"):
            await AsyncClient(path).maneuver("rotation.step_response", consent=True)
        await daemon.until(lambda: daemon.maneuvers == ["began", "ended"] * 2)


async def test_the_status_taken_is_the_newest_however_slowly_they_are_taken(tmp_path: Path) -> None:
    async with serving(tmp_path) as (daemon, path), AsyncClient(path) as client, client.statuses(20.0) as statuses:
        first = await anext(statuses)
        await daemon.until(lambda: daemon.status().time_s > first.time_s + 1.0)
        assert (await anext(statuses)).time_s > first.time_s + 0.7


async def test_a_refusal_names_place_cause_and_remedy(tmp_path: Path) -> None:
    daemon = FakeDaemon(unmet=(Unmet("camera fresh", "no picture yet", "look at the camera's cable"),))
    async with serving(tmp_path, daemon) as (_, path), AsyncClient(path) as client:
        with pytest.raises(RefusedError) as refused:
            await client.command("arm")
        assert (refused.value.where, refused.value.status_code, refused.value.may_be_done) == ("arm", 409, False)
        assert str(refused.value) == "arm: not ready: camera fresh: no picture yet. look at the camera's cable"
        async with client.lease() as lease:
            with pytest.raises(RefusedError, match=r"^jog: .*arm first"):
                await lease.jog("rotate", 1.0)
        with pytest.raises(RefusedError) as malformed:
            await client.command("fly")
        assert malformed.value.status_code == 422
        with pytest.raises(NotReachedError, match=r"^armed: not within 0.1 s \(disarmed, ") as late:
            await client.until(lambda status: status.mode is Mode.MANUAL, 0.1, "armed")
        assert late.value.status is not None


async def test_a_control_tick_that_does_not_answer_leaves_it_open_whether_it_was_done(tmp_path: Path) -> None:
    daemon = FakeDaemon(frozen=True)
    limits = ApiLimits(command_timeout_s=0.1)
    async with serving(tmp_path, daemon, limits=limits) as (_, path), AsyncClient(path) as client:
        with pytest.raises(RefusedError) as unanswered:
            await client.command("arm")
    assert unanswered.value.status_code == 504
    assert unanswered.value.may_be_done


@pytest.mark.parametrize("lane", ["serves stops", "hangs", "is a stranger's", "is not there", "was not named"])
async def test_a_stop_over_tcp_takes_the_port_that_was_named_for_it_and_else_the_interfaces(lane: str) -> None:
    """Nobody who was not named hears of the token, also on the port where the daemon serves stop if told nothing."""
    heard: list[str] = []

    def server(name: str, answer: bytes) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with suppress(OSError, asyncio.IncompleteReadError):
                await reader.readuntil(b"\r\n\r\n")
                heard.append(name)
                writer.write(answer)
                await reader.read()
            writer.close()

        return serve

    reply = b'{"command": "stop", "accepted": true, "message": "stopped"}'
    stopped = b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(reply), reply)
    answers = {
        "serves stops": stopped,
        "hangs": b"",
        "is a stranger's": b"HTTP/1.1 404 No\r\ncontent-length: 0\r\n\r\n",
        "was not named": stopped,
    }
    port_n, sockets = _two_ports()
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(await asyncio.start_server(server("interface", stopped), sock=sockets[0]))
        if lane in answers:
            await stack.enter_async_context(await asyncio.start_server(server("lane", answers[lane]), sock=sockets[1]))
        else:
            sockets[1].close()
        named_n = None if lane == "was not named" else port_n + 1
        assert (await AsyncClient(f"http://127.0.0.1:{port_n}", token="t", stop_port_n=named_n).stop()).accepted
    expected = {"serves stops": ["lane"], "is not there": ["interface"], "was not named": ["interface"]}
    assert heard == expected.get(lane, ["lane", "interface"])


def _two_ports() -> tuple[int, list[socket.socket]]:
    """Two free ports, one after the other."""
    while True:
        first, second = socket.socket(), socket.socket()
        first.bind(("127.0.0.1", 0))
        try:
            second.bind(("127.0.0.1", first.getsockname()[1] + 1))
        except (OSError, OverflowError):
            first.close()
            second.close()
            continue
        return first.getsockname()[1], [first, second]


async def test_over_tcp_with_the_token_and_not_without(tmp_path: Path) -> None:
    tcp = TcpSettings(port_n=free_port(), token_file=tmp_path / "tokens")
    token = create_token(tcp.token_file, "test", Right.COMMAND)
    address = f"http://127.0.0.1:{tcp.port_n}"
    async with serving(tmp_path, tcp=tcp):

        def waiting() -> None:
            client = Client(address, token=token)
            assert client.status().mode is Mode.DISARMED
            with client.statuses() as statuses:
                assert next(statuses).mode is Mode.DISARMED
            stranger = Client(address)
            with pytest.raises(RefusedError, match="token: no token, or not the right one"):
                stranger.stop()
            with pytest.raises(RefusedError) as refused, stranger.statuses():
                pass
            assert (refused.value.where, refused.value.status_code) == ("token", 401)

        await in_thread(waiting)
        async with AsyncClient(address, token=token) as client:
            assert (await client.status()).mode is Mode.DISARMED
            async with client.statuses() as statuses:
                assert (await anext(statuses)).mode is Mode.DISARMED
        async with AsyncClient(address) as stranger:
            with pytest.raises(RefusedError, match="token: no token, or not the right one"):
                await stranger.stop()
            with pytest.raises(RefusedError) as refused:
                async with stranger.lease():
                    pass
            assert (refused.value.where, refused.value.status_code) == ("token", 401)


@pytest.mark.parametrize("address", ["http://", "ftp://x", "http://localhost:8431/v1"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(ValueError, match="the daemon speaks http://HOST:PORT"):
        Client(address)


async def test_nobody_there(tmp_path: Path) -> None:
    path = tmp_path / "none.sock"
    for make in (Client(path).status, Client(path).stop, lambda: Client(path).lease().__enter__()):
        with pytest.raises(NoDaemonError, match="no daemon serves this socket") as error:
            await in_thread(make)
        assert not error.value.may_be_done
    async with AsyncClient(path) as client:
        for call in (client.status, client.stop, lambda: client.lease().__aenter__()):
            with pytest.raises(NoDaemonError, match="no daemon serves this socket") as error:
                await call()
            assert not error.value.may_be_done


@contextmanager
def hanging_up(path: Path) -> Iterator[list[bytes]]:
    """A daemon that reads each request and hangs up; what it read."""
    read: list[bytes] = []

    def serve(listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection:
                request = connection.recv(65536)
                if not request:
                    return
                read.append(request)

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        try:
            yield read
        finally:
            with socket.socket(socket.AF_UNIX) as last:
                last.connect(str(path))
            thread.join(5)


COMMANDS: dict[str, dict[str, Any]] = {
    "arm": {},
    "auto": {},
    "manual": {},
    "reset": {"stop_n": 1},
    "disarm": {},
    "jog": {"axis": "rotate", "value": 1.0},
    "preset": {"name": "transport"},
    "renew": {},
}


@pytest.mark.parametrize("command", COMMANDS)
async def test_what_may_move_is_never_sent_twice(tmp_path: Path, command: str) -> None:
    path = tmp_path / "api.sock"
    with hanging_up(path) as read:
        with pytest.raises(NoDaemonError) as error:
            await in_thread(lambda: Client(path).command(command, **COMMANDS[command]))
        assert error.value.may_be_done
        assert len(read) == 1
        async with AsyncClient(path) as client:
            with pytest.raises(NoDaemonError) as error:
                await client.command(command, **COMMANDS[command])
        assert error.value.may_be_done
        assert len(read) == 2


async def test_nor_is_a_service_but_a_question_and_a_stop_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graderd.client.BUSY_RETRY_S", 0.2)
    path = tmp_path / "api.sock"
    with hanging_up(path) as read:

        async def sent_n(work: Callable[[], Any]) -> int:
            read.clear()
            with pytest.raises(ClientError):
                await work()
            return len(read)

        waiting, client = Client(path), AsyncClient(path)
        async with client:
            assert await sent_n(lambda: in_thread(lambda: waiting.service("rotation.reboot", consent=True))) == 1
            assert await sent_n(lambda: client.service("rotation.reboot", consent=True)) == 1
            assert await sent_n(lambda: in_thread(waiting.stop)) > 1
            assert await sent_n(client.stop) > 1
            assert await sent_n(lambda: in_thread(waiting.status)) > 1
            assert await sent_n(client.status) > 1


async def test_a_full_queue_is_waited_for_and_then_used_once(tmp_path: Path) -> None:
    """A connection that was never taken carried nothing: what may move is sent when there is room."""
    path = tmp_path / "api.sock"
    with socket.socket(socket.AF_UNIX) as full, socket.socket(socket.AF_UNIX) as first:
        full.bind(str(path))
        full.listen(0)
        first.connect(str(path))
        async with AsyncClient(path, timeout_s=0.1) as client:
            command = asyncio.create_task(client.command("arm"), name="arm")
            await asyncio.sleep(0.5)  # several times told that the queue is full
            assert not command.done()
            taken = full.accept()[0]  # makes room
            with full.accept()[0] as connection:
                assert connection.recv(65536).count(b"POST /v1/commands") == 1
            with pytest.raises(NoDaemonError) as error:
                await command
            assert error.value.may_be_done
            taken.close()
            full.setblocking(False)
            with pytest.raises(BlockingIOError):
                full.accept()


async def test_a_queue_that_stays_full_carries_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graderd.client.BUSY_RETRY_S", 0.2)
    path = tmp_path / "api.sock"
    with socket.socket(socket.AF_UNIX) as full, socket.socket(socket.AF_UNIX) as first:
        full.bind(str(path))
        full.listen(0)
        first.connect(str(path))
        with pytest.raises(NoDaemonError, match="did not answer in time") as error:
            await AsyncClient(path, timeout_s=0.1).command("arm")
        assert not error.value.may_be_done


async def test_a_call_that_is_given_up_keeps_nobody_waiting(tmp_path: Path) -> None:
    """Neither another call nor the end of the program: a stop comes through beside requests that hang."""
    async with serving(tmp_path) as (daemon, path), AsyncClient(path) as client:
        slow = [asyncio.create_task(client.service("slow", seconds=60.0), name=f"slow {n}") for n in range(40)]
        await asyncio.sleep(0)
        assert (await client.stop()).accepted
        assert daemon.state.mode is Mode.STOPPED
        for task in slow:
            task.cancel()
        await asyncio.gather(*slow, return_exceptions=True)


def test_the_module_loads_the_standard_library_alone() -> None:
    code = (
        "import sys; before = set(sys.modules); import graderd.client\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "sys.exit(str(new - sys.stdlib_module_names - {'graderd'} or '') or 0)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
