"""The rig's process: physics and wires on one event loop, the camera in a child, all under one folder."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graderd.drivers.j1939.python_can import can
from graderd.hal.errors import DeviceMissingError
from graderd.simulator.camera.child import CameraChild
from graderd.simulator.camera.shared_scene import SharedScene
from graderd.simulator.control_server import MAX_LINE, ControlServer
from graderd.simulator.grader.machine import Machine
from graderd.simulator.stop_loop import StopLoop

_TICK_S = 0.01


@dataclass(frozen=True, slots=True)
class RigPaths:
    """What a rig puts into its folder."""

    directory: Path

    @property
    def servo(self) -> Path:
        """Symlink to the virtual servo's pseudo-terminal."""
        return self.directory / "servo"

    @property
    def can(self) -> Path:
        """Symlink to the slcan adapter's pseudo-terminal."""
        return self.directory / "can"

    @property
    def camera(self) -> Path:
        """Unix socket of the camera."""
        return self.directory / "camera.sock"

    @property
    def control(self) -> Path:
        """Unix socket for scenes, driving and faults."""
        return self.directory / "control.sock"

    @property
    def stop_input(self) -> Path:
        """Unix socket of the stop loop."""
        return self.directory / "stop.sock"

    @property
    def ready(self) -> Path:
        """JSON file that appears when everything above is there."""
        return self.directory / "rig.json"


class Rig:
    """The virtual grader. ``can_channel``: ``interface:channel`` of a python-can bus to join; None: an slcan pty.

    Use :meth:`run`; it returns when asked to quit or when :meth:`stop` is called.
    """

    def __init__(self, directory: Path, *, can_channel: str | None = None, seed: int = 0) -> None:
        self.paths = RigPaths(directory.absolute())
        self._can_channel = can_channel
        self._can_bus = self._open_can()
        self.machine = Machine(self.paths.servo, self.paths.can, self._can_bus, seed)
        heights_m = self.machine.world.field.heights_m
        self._scene = SharedScene.create((heights_m.shape[0], heights_m.shape[1]))
        self.camera = CameraChild(self._scene.descriptor, self.paths.camera, seed)
        self.stop_loop = StopLoop(self.paths.stop_input)
        self._control_server = ControlServer(self.machine, self.camera, self.stop_loop, self.stop)
        self._stop = asyncio.Event()

    # -- life -------------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Ask :meth:`run` to return; may be called from a signal handler of the loop."""
        self._stop.set()

    async def run(self) -> None:
        """Serve until stopped, then take everything down again.

        Raises:
            DeviceMissingError: the folder or the CAN channel cannot be used.
            DeviceLostError: the camera process ended by itself.
        """
        paths = self.paths
        async with contextlib.AsyncExitStack() as stack:
            if self._can_bus is not None:
                stack.callback(self._can_bus.shutdown)
            stack.callback(self._scene.close)
            self._make_folder()
            self._publish()
            stack.push_async_callback(self.camera.end)
            await self.camera.start()
            stack.push_async_callback(self.machine.close)
            await self.machine.start()
            stack.push_async_callback(self.stop_loop.close)
            await self.stop_loop.start()
            server = await asyncio.start_unix_server(self._control_server.serve, str(paths.control), limit=MAX_LINE)
            stack.push_async_callback(self._end_server, server)
            stack.callback(paths.ready.unlink, missing_ok=True)
            tasks = [
                asyncio.create_task(self._live(), name="rig-physics"),
                asyncio.create_task(self._stop.wait(), name="rig-stop"),
                asyncio.create_task(self.camera.watch(), name="rig-camera-watch"),
            ]
            stack.push_async_callback(_end_tasks, tasks)
            self._announce()
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()

    def _make_folder(self) -> None:
        try:
            self.paths.directory.mkdir(parents=True, exist_ok=True)
            self.paths.ready.unlink(missing_ok=True)
            self.paths.control.unlink(missing_ok=True)
        except OSError as error:
            where = str(self.paths.directory)
            raise DeviceMissingError(where, f"cannot be used as the rig's folder: {error}") from error

    def _open_can(self) -> can.BusABC | None:
        if self._can_channel is None:
            return None
        interface, _, channel = self._can_channel.partition(":")
        try:
            return can.Bus(interface=interface, channel=channel, receive_own_messages=False)
        except (can.CanError, OSError, ValueError) as error:
            raise DeviceMissingError(
                f"CAN channel {self._can_channel}",
                str(error),
                "Create it (ip link add dev vcan0 type vcan; ip link set vcan0 up), or leave --can out",
            ) from error

    def _announce(self) -> None:
        """Write ``rig.json``: complete or not at all."""
        where = {"interface": "slcan", "channel": str(self.paths.can)}
        if self._can_channel is not None:
            interface, _, channel = self._can_channel.partition(":")
            where = {"interface": interface, "channel": channel}
        content = {
            "pid": os.getpid(),
            "servo": str(self.paths.servo),
            "can": where,
            "camera": str(self.paths.camera),
            "control": str(self.paths.control),
            "stop_input": str(self.paths.stop_input),
        }
        partial = self.paths.ready.with_name(f".rig.json.{os.getpid()}")
        partial.write_text(json.dumps(content) + "\n", encoding="utf-8")
        partial.replace(self.paths.ready)

    async def _end_server(self, server: asyncio.Server) -> None:
        server.close()
        await self._control_server.close()
        self.paths.control.unlink(missing_ok=True)

    async def _live(self) -> None:
        before_s = time.monotonic()
        while True:
            await asyncio.sleep(_TICK_S)
            now_s = time.monotonic()
            self.machine.step(now_s - before_s)
            before_s = now_s
            self._publish()

    def _publish(self) -> None:
        world = self.machine.world
        self._scene.write(time.monotonic(), world.vehicle.x_m, world.blade, world.field.heights_m, world.field.cell_m)


async def _end_tasks(tasks: list[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
