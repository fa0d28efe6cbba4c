"""The live view for Foxglove: a client of the daemon, as ``python -m graderd.runtime.app.live_view_child SOCKET
PORT RATE_HZ PICTURES_HZ``; it ends with its standard input.

What it serves are the channels of a recording as far as a client knows them (``graderd.record.layout``), the status for
plots, and the thirds as a scene.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Any

from graderd.client import AsyncClient, ClientError
from graderd.core.status import Status, ThirdsStatus
from graderd.record.layout import PREVIEW, TRANSFORM, blade_message, image_message, plain_schema, schema_of

STATUS = "/status"
THIRDS = "/soil/thirds"
LOOPBACK = "127.0.0.1"
"""Its protocol knows neither tokens nor whose page asks: nobody else gets to it."""
BACKLOG_N = 32
"""Messages that wait for a slow viewer; it loses older ones."""
AGAIN_S = 0.5
HIGH_M_PER_L = 0.02
DEEP_M = 0.1


class View:
    """The process's side: the server, its channels, and what is put on them."""

    def __init__(self, port_n: int, length_m: float) -> None:
        import foxglove  # an extra, and this process's alone
        from foxglove import channels, messages

        self._messages: Any = messages
        self._length_m = length_m
        self._server = foxglove.start_server(name="graderd", host=LOOPBACK, port=port_n, message_backlog_size=BACKLOG_N)

        def channel(topic: str, name: str, schema: bytes) -> foxglove.Channel:
            wanted = foxglove.Schema(name=name, encoding="jsonschema", data=schema)
            return foxglove.Channel(topic, schema=wanted, message_encoding="json")

        self._status = channel(STATUS, "graderd.Status", _status_schema())
        self._blade = channel(TRANSFORM, *schema_of(TRANSFORM))
        self._picture = channel(PREVIEW, *schema_of(PREVIEW))
        self._thirds = channels.SceneUpdateChannel(THIRDS)

    @property
    def wants_pictures(self) -> bool:
        """Whether anybody looks at them."""
        return self._picture.has_sinks()

    def show(self, status: Status) -> None:
        """Put a status on the channels."""
        at_ns = time.time_ns()
        self._status.log(status.model_dump_json(exclude_none=True).encode(), log_time=at_ns)
        angle_deg = status.axes["rotation"].measured
        if angle_deg is not None:
            message = blade_message(at_ns, angle_deg, status.attitude.height_mm)
            self._blade.log(message.data, log_time=at_ns)
        self._thirds.log(self._scene(status.soil.ahead, at_ns), log_time=at_ns)

    def show_picture(self, jpeg: bytes) -> None:
        """Put a picture on its channel."""
        at_ns = time.time_ns()
        self._picture.log(image_message(PREVIEW, at_ns, base64.b64encode(jpeg).decode(), "jpeg").data, log_time=at_ns)

    def _scene(self, ahead: ThirdsStatus | None, at_ns: int) -> Any:
        """A box in front of each third, as high as there is soil; none where it is not known."""
        of, third_m = self._messages, self._length_m / 3.0
        litres = (ahead.left_l, ahead.center_l, ahead.right_l) if ahead is not None else ()
        cubes = [
            of.CubePrimitive(
                pose=of.Pose(
                    position=of.Vector3(x=DEEP_M, y=third_m * (1 - number), z=HIGH_M_PER_L * each_l / 2.0),
                    orientation=of.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
                ),
                size=of.Vector3(x=DEEP_M, y=0.95 * third_m, z=max(HIGH_M_PER_L * each_l, 1e-3)),
                color=of.Color(r=0.6, g=0.4, b=0.2, a=0.9),
            )
            for number, each_l in enumerate(litres)
        ]
        stamp = of.Timestamp(sec=at_ns // 1_000_000_000, nsec=at_ns % 1_000_000_000)
        entity = of.SceneEntity(timestamp=stamp, frame_id="blade", id="thirds", frame_locked=True, cubes=cubes)
        return of.SceneUpdate(entities=[entity])


def _status_schema() -> bytes:
    whole = Status.model_json_schema(mode="serialization")
    return json.dumps(plain_schema(whole, whole["$defs"])).encode()


async def serve(socket: Path, port_n: int, rate_hz: float, pictures_hz: float) -> None:
    """Show what the daemon tells, until cancelled."""
    async with AsyncClient(socket, name="live view") as client:
        blade = (await client.config())["blade"]
        view = View(port_n, blade["length_m"])
        async with asyncio.TaskGroup() as group:
            group.create_task(_statuses(client, view, rate_hz))
            if pictures_hz > 0.0:
                group.create_task(_pictures(client, view, pictures_hz))


async def _statuses(client: AsyncClient, view: View, rate_hz: float) -> None:
    while True:
        with contextlib.suppress(ClientError):
            async with client.statuses(rate_hz) as statuses:
                async for status in statuses:
                    view.show(status)
        await asyncio.sleep(AGAIN_S)


async def _pictures(client: AsyncClient, view: View, pictures_hz: float) -> None:
    while True:
        await asyncio.sleep(1.0 / pictures_hz)
        if view.wants_pictures:
            with contextlib.suppress(ClientError):
                view.show_picture(await client.preview_jpeg())


async def _main(words: list[str]) -> None:
    socket, port_n, rate_hz, pictures_hz = words
    serving = asyncio.create_task(serve(Path(socket), int(port_n), float(rate_hz), float(pictures_hz)))
    parent = asyncio.create_task(_parent_gone())
    await asyncio.wait((serving, parent), return_when=asyncio.FIRST_COMPLETED)
    if serving.done():
        serving.result()
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)


async def _parent_gone() -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    await reader.read()


if __name__ == "__main__":
    asyncio.run(_main(sys.argv[1:]))
