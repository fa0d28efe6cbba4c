"""The live view for Foxglove, by a viewer that speaks its protocol, beside the unmodified daemon with its rig."""

from __future__ import annotations

import asyncio
import base64
import json
import math
import struct
from pathlib import Path
from typing import Any

import jsonschema
import psutil
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from graderd.simulator.control_client import RigControl
from harness.api_daemon import free_port
from tests.machine import PATIENT, Machine, machine

pytestmark = pytest.mark.whole_machine

PROTOCOLS = [Subprotocol("foxglove.sdk.v1")]
WITHIN_S = 60.0
TURNED_DEG = 12.0
DATA = 1
"""The first byte of a message's binary frame; its subscription and time follow (little-endian)."""


class Viewer:
    """One connection: what is advertised, and the newest message of every channel."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self.channels: dict[str, dict[str, Any]] = {}

    async def advertised(self, topics: set[str]) -> None:
        """Wait until these are there, and subscribe to them."""
        while not topics <= self.channels.keys():
            said = await self._connection.recv()
            if isinstance(said, str) and (told := json.loads(said))["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in told["channels"]}
        wanted = [
            {"id": number, "channelId": self.channels[topic]["id"]} for number, topic in enumerate(sorted(topics))
        ]
        await self._connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    async def messages(self, topics: set[str]) -> dict[str, bytes]:
        """One of each."""
        found: dict[str, bytes] = {}
        while topics - found.keys():
            said = await self._connection.recv()
            if isinstance(said, bytes) and said[0] == DATA:
                number, _ = struct.unpack_from("<IQ", said, 1)
                found[sorted(topics)[number]] = said[13:]
        return found


async def viewed(port_n: int, topics: set[str]) -> tuple[dict[str, dict[str, Any]], dict[str, bytes]]:
    """The channels, and one message of each of ``topics``."""
    while True:
        try:
            async with connect(f"ws://127.0.0.1:{port_n}", subprotocols=PROTOCOLS, proxy=None) as connection:
                viewer = Viewer(connection)
                await viewer.advertised(topics)
                return viewer.channels, await viewer.messages(topics)
        except (OSError, ConnectionClosed, InvalidHandshake):
            await asyncio.sleep(0.1)  # it is not there yet, or going


def view_process(grader: Machine) -> psutil.Process:
    (found,) = [
        child
        for child in psutil.Process(grader.daemon.pid).children()
        if "live_view_child" in " ".join(child.cmdline())
    ]
    return found


async def test_a_viewer_sees_picture_thirds_blade_and_plots(tmp_path: Path) -> None:
    port_n = free_port()
    topics = {"/status", "/tf", "/camera/preview", "/soil/thirds"}
    async with machine(tmp_path, f"{PATIENT}\n[foxglove]\nport_n = {port_n}\n") as grader:
        await grader.until(lambda s: s.soil.ahead is not None and s.axes["rotation"].measured is not None)
        async with RigControl(tmp_path / "control.sock") as rig:
            await rig.request("turn_blade", angle_deg=TURNED_DEG)
        await grader.until(lambda s: (s.axes["rotation"].measured or 0.0) > TURNED_DEG - 1.0)
        async with asyncio.timeout(WITHIN_S):
            channels, said = await viewed(port_n, topics)
        for topic in ("/status", "/tf", "/camera/preview"):
            schema = json.loads(channels[topic]["schema"])
            jsonschema.validate(json.loads(said[topic]), schema)
            assert channels[topic]["encoding"] == "json"
        assert channels["/camera/preview"]["schemaName"] == "foxglove.CompressedImage"
        assert channels["/soil/thirds"]["schemaName"] == "foxglove.SceneUpdate"
        angle_deg = json.loads(said["/status"])["axes"]["rotation"]["measured"]
        half = json.loads(said["/tf"])["rotation"]["z"]
        assert angle_deg == pytest.approx(TURNED_DEG, abs=1.0)
        assert math.degrees(2.0 * math.asin(half)) == pytest.approx(angle_deg, abs=0.1)
        assert base64.b64decode(json.loads(said["/camera/preview"])["data"])[:2] == b"\xff\xd8"
        assert b"thirds" in said["/soil/thirds"]

        # Its death is no fault of control's, and it comes back.
        first = view_process(grader)
        first.kill()
        async with asyncio.timeout(WITHIN_S):
            await viewed(port_n, topics)
        assert view_process(grader).pid != first.pid
        before = (await grader.status()).tick.ticks_n
        status = await grader.until(lambda s: s.tick.ticks_n > before)
        assert [fault.name for fault in status.faults if fault.name.startswith("daemon.") and fault.present] == []
        view = view_process(grader)
    psutil.wait_procs([view], timeout=WITHIN_S)
    assert not view.is_running(), "it ends with its daemon, however that ends"
