"""Whatever is sent: an answer in the right form, no crash, and no motion."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graderd.api.app import make_app
from graderd.api.settings import ApiLimits
from graderd.core.machine import Mode, Unmet
from harness.api_daemon import FakeDaemon, serving

pytestmark = pytest.mark.live

NO_LIMITS = ApiLimits(rate_hz=1e4, burst_n=10**6, stop_rate_hz=1e4, accept_rate_hz=1e4, command_timeout_s=10.0)
MANY = settings(
    max_examples=200,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
STATUS_CODES = {200, 404, 405, 409, 413, 422, 426}
NEVER = Unmet("never", "this test does not arm", "none")

Request = tuple[str, str, bytes, str]

scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=120)
json_values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=12), inner, max_size=3),
    max_leaves=8,
)
COMMANDS = ("arm", "disarm", "stop", "reset", "auto", "manual", "jog", "preset", "renew", "release")
nearly_commands = st.fixed_dictionaries(
    {},
    optional={
        "command": st.sampled_from(COMMANDS) | scalars,
        "client": scalars,
        "axis": st.sampled_from(("rotate", "lift", "tilt", "height", "slope", "pitch")) | scalars,
        "value": scalars,
        "relative": scalars,
        "name": scalars,
        "reason": scalars,
        "extra": json_values,
    },
)


class Bench:
    """The application over a daemon that cannot be armed, so that nothing sent may ever move it."""

    def __init__(self) -> None:
        self.daemon = FakeDaemon(unmet=(NEVER,))
        self._runner = asyncio.Runner()
        self._transport = httpx.ASGITransport(app=make_app(self.daemon, NO_LIMITS), raise_app_exceptions=True)
        self._now_s = 0.0

    def send(self, requests: list[Request]) -> None:
        """Send the requests and judge every answer."""
        before = dict(self.daemon.positions)
        self._runner.run(self._send(requests))
        assert self.daemon.positions == before
        assert self.daemon.state.mode in (Mode.DISARMED, Mode.STOPPED)

    def close(self) -> None:
        self._runner.close()

    async def _send(self, requests: list[Request]) -> None:
        tick = asyncio.create_task(self._tick(), name="fast tick")
        async with httpx.AsyncClient(transport=self._transport, base_url="http://localhost") as client:
            for method, path, body, content_type in requests:
                answer = await client.request(method, path, content=body, headers={"content-type": content_type})
                assert answer.status_code in STATUS_CODES, (answer.status_code, method, path, body)
                if answer.status_code != 200:
                    assert set(answer.json()) == {"error", "where", "remedy"}
                    assert answer.json()["error"]
                    assert len(answer.content) < 2_000
        tick.cancel()
        await asyncio.gather(tick, return_exceptions=True)

    async def _tick(self) -> None:
        """Ticks as fast as there are commands: this test is about contents, not times."""
        while True:
            self._now_s += 0.02
            self.daemon._tick(self._now_s)
            await asyncio.sleep(0)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


def encoded(value: Any) -> bytes:
    """As JSON, including what JSON does not know (NaN), which Python writes all the same."""
    return json.dumps(value).encode("utf-8", "surrogatepass")


@MANY
@given(values=st.lists(nearly_commands | json_values, min_size=1, max_size=5))
def test_commands(bench: Bench, values: list[Any]) -> None:
    bench.send([("POST", "/v1/commands", encoded(value), "application/json") for value in values])


@MANY
@given(bodies=st.lists(st.binary(max_size=300), min_size=1, max_size=5))
def test_raw_bodies(bench: Bench, bodies: list[bytes]) -> None:
    paths = ("/v1/commands", "/v1/stop", "/v1/services/rotation.reboot", "/v1/services/nothing")
    kinds = ("application/json", "text/plain", "application/x-www-form-urlencoded")
    bench.send([("POST", paths[i % 4], body, kinds[len(body) % 3]) for i, body in enumerate(bodies)])


@MANY
@given(
    arguments=st.dictionaries(st.text(max_size=10), json_values, max_size=3),
    name=st.text(st.characters(exclude_categories=["Cs"]), max_size=30),
)
def test_services(bench: Bench, arguments: dict[str, Any], name: str) -> None:
    body = encoded(arguments)
    paths = ("/v1/services/" + quote(name, safe=""), "/v1/services/x")
    bench.send([("POST", path, body, "application/json") for path in paths])


PIECES = st.sampled_from(
    [
        *(b"GET ", b"POST ", b"\r\n", b" HTTP/1.1", b" HTTP/9", b"/v1/status", b"/v1/jog", b"/v1/commands", b"Host: x"),
        *(b"Content-Length: 5", b"Content-Length: -1", b"Content-Length: 99999999999999999999", b"\x00", b"\xff\xfe"),
        *(b"Transfer-Encoding: chunked", b"0\r\n\r\n", b"Upgrade: websocket", b"Connection: upgrade", b"x" * 3000),
        *(b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", b"Sec-WebSocket-Version: 13", b"\r\n\r\n", b"{}", b"%00"),
    ]
)


@settings(max_examples=25, deadline=None, suppress_health_check=list(MANY.suppress_health_check))
@given(attempts=st.lists(st.lists(PIECES, max_size=14), min_size=5, max_size=15))
def test_raw_bytes_on_the_socket(tmp_path: Path, attempts: list[list[bytes]]) -> None:
    asyncio.run(_attack(tmp_path, attempts))


async def _attack(directory: Path, attempts: list[list[bytes]]) -> None:
    async with serving(directory, limits=NO_LIMITS) as (daemon, path):
        for pieces in attempts:
            reader, writer = await asyncio.open_unix_connection(str(path))
            writer.write(b"".join(pieces))
            writer.write_eof()
            try:
                async with asyncio.timeout(0.02):
                    await reader.read()
            except (TimeoutError, ConnectionError):
                pass  # it waits for the rest, or has hung up: both are right
            writer.close()
        transport = httpx.AsyncHTTPTransport(uds=str(path))
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            assert (await client.get("/v1/status")).status_code == 200
        assert daemon.positions["rotation"] == 0.0
        assert daemon.state.mode is Mode.DISARMED
