"""The rig's control socket: takes commands, has them done, answers each with one line."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import ValidationError

from drivers.rig import camera_faults, commands
from drivers.rig.camera_child import CameraChild
from drivers.rig.look import Look
from drivers.rig.machine import Machine
from drivers.rig.piles import heap
from drivers.rig.soil import FloatArray, SoilField
from drivers.rig.topview import CAMERA_HEIGHT_M, top_depth, top_view
from drivers.rig.world import scene_heights
from drivers.stop_input import StopLoop
from graderd.hal.errors import DeviceError

MAX_LINE = 1 << 16


class Desk:
    """Serves the control socket of one rig. ``quit_rig``: called when a client asks the rig to end."""

    def __init__(
        self, machine: Machine, camera: CameraChild, stop_loop: StopLoop, quit_rig: Callable[[], None]
    ) -> None:
        self._machine = machine
        self._camera = camera
        self._stop_loop = stop_loop
        self._quit = quit_rig
        self._look = Look()
        self._camera_faults: dict[str, dict[str, float]] = {}
        self._clients: set[asyncio.Task[None]] = set()
        self._soil_lock = asyncio.Lock()

    async def close(self) -> None:
        """Hang up on every client."""
        clients = list(self._clients)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client's connection: answer its lines until it hangs up."""
        task = asyncio.current_task()
        assert task is not None
        task.set_name("rig-control-client")
        self._clients.add(task)
        try:
            while True:
                try:
                    line = await reader.readline()
                except ValueError:
                    answer: dict[str, Any] = {"error": f"a line has at most {MAX_LINE} bytes"}
                    writer.write(json.dumps(answer).encode() + b"\n")
                    break
                if not line:
                    break
                answer = await self._answer(line)
                writer.write(json.dumps(answer).encode() + b"\n")
                await writer.drain()
                if answer.get("quitting"):
                    self._quit()
                    break
        except (ConnectionError, asyncio.CancelledError):
            pass  # gone, or the rig ends: asyncio's own callback would print a cancelled client as an error
        finally:
            self._clients.discard(task)
            writer.close()

    async def _answer(self, line: bytes) -> dict[str, Any]:
        """Do what one line asks; whatever is wrong with it comes back as ``{"error": ...}`` and nothing happens."""
        try:
            return await self._do(commands.COMMAND.validate_json(line))
        except ValidationError as error:
            return {"error": _explain(error)}
        except (ValueError, OSError, DeviceError) as error:
            return {"error": str(error)}

    async def _do(self, command: commands.Command) -> dict[str, Any]:
        machine, world = self._machine, self._machine.world
        match command:
            case commands.Scene():
                async with self._soil_lock:
                    heights = await asyncio.to_thread(
                        scene_heights, command.zone, world.vehicle.x_m, world.blade, command.seed
                    )
                    world.lay(heights)
            case commands.Place():
                async with self._soil_lock:
                    added = await asyncio.to_thread(self._settled_heap, command)
                    world.lay(world.field.heights_m + added)
            case commands.Drive():
                if command.speed_m_per_s == 0.0:
                    raise ValueError("speed_m_per_s is 0; use halt to stop")
                return {"ok": True, "distance_m": world.vehicle.drive(command.speed_m_per_s, command.distance_m)}
            case commands.Halt():
                world.vehicle.halt()
            case commands.ResetVehicle():
                world.reset_vehicle()
            case commands.Light():
                changes = command.model_dump(exclude={"cmd"}, exclude_none=True)
                look = Look(**{**self._look.model_dump(), **changes})
                await self._camera.tell({"look": look.model_dump()})
                self._look = look
                return {"ok": True, "light": look.model_dump()}
            case commands.CameraFault():
                params = camera_faults.parameters(command.name, command.params)
                await self._camera.tell({"fault": command.name, "params": params})
                self._camera_faults[command.name] = params
            case commands.ServoFault():
                machine.inject_servo_fault(command.name, command.params)
            case commands.ActuatorFault():
                machine.inject_actuator_fault(command.name, command.device, command.params)
            case commands.TurnBlade():
                machine.turn_blade(command.angle_deg)
            case commands.CanFrame():
                machine.send_frame(command.can_id, bytes.fromhex(command.data_hex))
            case commands.StopLoopState():
                await self._stop_loop.become(command.state)
            case commands.ClearFaults():
                await self._clear_faults(command.part)
            case commands.Faults():
                known = {"camera": list(camera_faults.CAMERA_FAULTS), **machine.fault_names()}
                present = {
                    "camera": self._camera_faults,
                    "servo": machine.servo_faults,
                    "actuators": machine.actuator_faults,
                }
                return {"ok": True, "known": known, "present": present}
            case commands.State():
                return {"ok": True, **machine.state(), "camera_pid": self._camera.pid}
            case commands.TopView():
                view = top_view(world.field.heights_m, world.field.cell_m, world.vehicle.x_m, world.blade, self._look)
                await asyncio.to_thread(_write_png, command.path, view)
            case commands.TopDepth():
                await asyncio.to_thread(_write_png, command.path, top_depth(world.field.heights_m))
                return {"ok": True, "camera_height_m": CAMERA_HEIGHT_M, "pixel_m": world.field.cell_m}
            case commands.Quit():
                return {"ok": True, "quitting": True}
        return {"ok": True}

    def _settled_heap(self, command: commands.Place) -> FloatArray:
        """What a new heap adds to the bed, settled by itself (it settles onto what is there in the next steps)."""
        field = SoilField()
        x_m = self._machine.world.vehicle.x_m + command.x_m
        if not 0.0 <= x_m <= field.length_m:
            raise ValueError(
                f"x_m {command.x_m} is outside the bed: the blade stands at {self._machine.world.vehicle.x_m:.2f} m"
            )
        poured = heap(field, x_m, command.y_m, command.length_m, command.width_m, command.height_m, command.seed)
        field.add(poured)
        return field.heights_m

    async def _clear_faults(self, part: str | None) -> None:
        if part in (None, "camera"):
            await self._camera.tell({"clear": True})
            self._camera_faults = {}
        if part in (None, "servo"):
            self._machine.clear_servo_faults()
        if part in (None, "actuators"):
            self._machine.clear_actuator_faults()
        if part in (None, "stop_loop"):
            await self._stop_loop.become("closed")


def _explain(error: ValidationError) -> str:
    """One line from pydantic's report."""
    parts = []
    for item in error.errors()[:4]:
        where = ".".join(str(part) for part in item["loc"])
        parts.append(f"{where}: {item['msg']}" if where else item["msg"])
    return "; ".join(parts)


def _write_png(path: str, picture: np.ndarray) -> None:
    """Write a PNG, complete or not at all.

    Raises:
        OSError: the folder is missing or cannot be written.
    """
    target = Path(path)
    ok, data = cv2.imencode(".png", picture)
    if not ok:
        raise OSError(f"{path}: the picture cannot be encoded")
    partial = target.with_name(f".{target.name}.{os.getpid()}")
    partial.write_bytes(data.tobytes())
    partial.replace(target)
