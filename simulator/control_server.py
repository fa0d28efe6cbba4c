"""The rig's control socket: takes commands, has them done, answers each with one line."""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from graderd.hal.errors import DeviceError
from graderd.simulator.camera import faults as camera_faults
from graderd.simulator.camera.appearance import Appearance, BladeMaterial, GroundKind, SoilKind
from graderd.simulator.camera.child import CameraChild
from graderd.simulator.camera.renderer import CAMERA_HEIGHT_M, top_depth, top_view
from graderd.simulator.grader.machine import Machine
from graderd.simulator.grader.piles import SceneZone, heap
from graderd.simulator.grader.soil import BED_LENGTH_M, BED_WIDTH_M, FloatArray, SoilField
from graderd.simulator.grader.world import MAX_SPEED_M_PER_S, scene_heights
from graderd.simulator.stop_loop import StopLoop

MAX_LINE = 1 << 16


class ControlServer:
    """Serves the control socket of one rig. ``quit_rig``: called when a client asks the rig to end."""

    def __init__(
        self, machine: Machine, camera: CameraChild, stop_loop: StopLoop, quit_rig: Callable[[], None]
    ) -> None:
        self._machine = machine
        self._camera = camera
        self._stop_loop = stop_loop
        self._quit = quit_rig
        self._appearance = Appearance()
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
            return await self._do(COMMAND.validate_json(line))
        except ValidationError as error:
            return {"error": _explain(error)}
        except (ValueError, OSError, DeviceError) as error:
            return {"error": str(error)}

    async def _do(self, command: Command) -> dict[str, Any]:
        machine, world = self._machine, self._machine.world
        match command:
            case Scene():
                async with self._soil_lock:
                    heights = await asyncio.to_thread(
                        scene_heights, command.zone, world.vehicle.x_m, world.blade, command.seed
                    )
                    world.lay(heights)
            case Place():
                async with self._soil_lock:
                    added = await asyncio.to_thread(self._settled_heap, command)
                    world.lay(world.field.heights_m + added)
            case Drive():
                if command.speed_m_per_s == 0.0:
                    raise ValueError("speed_m_per_s is 0; use halt to stop")
                return {"ok": True, "distance_m": world.vehicle.drive(command.speed_m_per_s, command.distance_m)}
            case Halt():
                world.vehicle.halt()
            case ResetVehicle():
                world.reset_vehicle()
            case Light():
                changes = command.model_dump(exclude={"cmd"}, exclude_none=True)
                appearance = replace(self._appearance, **changes)
                await self._camera.tell({"appearance": asdict(appearance)})
                self._appearance = appearance
                return {"ok": True, "light": asdict(appearance)}
            case CameraFault():
                params = camera_faults.parameters(command.name, command.params)
                await self._camera.tell({"fault": command.name, "params": params})
                self._camera_faults[command.name] = params
            case ServoFault():
                machine.inject_servo_fault(command.name, command.params)
            case ActuatorFault():
                machine.inject_actuator_fault(command.name, command.device, command.params)
            case TurnBlade():
                machine.turn_blade(command.angle_deg)
            case CanFrame():
                machine.send_frame(command.can_id, bytes.fromhex(command.data_hex))
            case StopLoopState():
                await self._stop_loop.become(command.state)
            case ClearFaults():
                await self._clear_faults(command.part)
            case Faults():
                known = {"camera": list(camera_faults.CAMERA_FAULTS), **machine.fault_names()}
                present = {
                    "camera": self._camera_faults,
                    "servo": machine.servo_faults,
                    "actuators": machine.actuator_faults,
                }
                return {"ok": True, "known": known, "present": present}
            case State():
                return {"ok": True, **machine.state(), "camera_pid": self._camera.pid}
            case VehicleState():
                vehicle = world.vehicle
                told = {"speed_m_per_s": vehicle.speed_m_per_s, "travelled_m": vehicle.travelled_m}
                return {"ok": True, "time_s": time.monotonic(), **told}
            case TopView():
                view = top_view(
                    world.field.heights_m, world.field.cell_m, world.vehicle.x_m, world.blade, self._appearance
                )
                await asyncio.to_thread(_write_png, command.path, view)
            case TopDepth():
                await asyncio.to_thread(_write_png, command.path, top_depth(world.field.heights_m))
                return {"ok": True, "camera_height_m": CAMERA_HEIGHT_M, "pixel_m": world.field.cell_m}
            case Quit():
                return {"ok": True, "quitting": True}
        return {"ok": True}

    def _settled_heap(self, command: Place) -> FloatArray:
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


Number = Annotated[float, Field(allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Params = dict[str, Number]


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Scene(_Command):
    """Empty the bed and lay soil in front of the blade where it stands."""

    cmd: Literal["scene"]
    zone: SceneZone
    seed: int = Field(0, ge=0, le=2**32 - 1)


class Place(_Command):
    """Pour one more heap; ``x_m`` and ``y_m`` are its centre, from the blade's axis (ahead, left)."""

    cmd: Literal["place"]
    x_m: Number = Field(ge=-BED_LENGTH_M, le=BED_LENGTH_M)
    y_m: Number = Field(ge=-BED_WIDTH_M / 2, le=BED_WIDTH_M / 2)
    length_m: Number = Field(1.0, gt=0.02, le=BED_LENGTH_M)
    width_m: Number = Field(0.5, gt=0.02, le=BED_WIDTH_M)
    height_m: Number = Field(0.3, gt=0.0, le=0.45)
    seed: int = Field(0, ge=0, le=2**32 - 1)


class Drive(_Command):
    """Drive so far at such a speed (negative: back); ends by itself, at the bed's end at the latest."""

    cmd: Literal["drive"]
    speed_m_per_s: Number = Field(ge=-MAX_SPEED_M_PER_S, le=MAX_SPEED_M_PER_S)
    distance_m: Number = Field(gt=0, le=BED_LENGTH_M)


class Halt(_Command):
    """Brake."""

    cmd: Literal["halt"]


class ResetVehicle(_Command):
    """Put the machine back to the start of the bed."""

    cmd: Literal["reset_vehicle"]


class Light(_Command):
    """Change light, soil, blade or camera noise; what is not named stays."""

    cmd: Literal["light"]
    sun_azimuth_deg: Number | None = Field(None, ge=-360, le=360)
    sun_elevation_deg: Number | None = Field(None, ge=5, le=90)
    sun_strength: Number | None = Field(None, ge=0, le=4)
    ambient: Number | None = Field(None, ge=0, le=2)
    red_cast: Number | None = Field(None, ge=-0.5, le=0.5)
    exposure: Number | None = Field(None, gt=0, le=8)
    shadows: bool | None = None
    machine_shadow: Share | None = None
    soil: SoilKind | None = None
    wetness: Share | None = None
    blade: BladeMaterial | None = None
    ground: GroundKind | None = None
    color_noise: Number | None = Field(None, ge=0, le=30)
    disparity_noise_px: Number | None = Field(None, ge=0, le=1)
    hole_share: Share | None = None


class CameraFault(_Command):
    """Make the camera misbehave until ``clear_faults``."""

    cmd: Literal["camera_fault"]
    name: str
    params: Params = {}


class ServoFault(_Command):
    """A fault of the virtual servo or its bus."""

    cmd: Literal["servo_fault"]
    name: str
    params: Params = {}


class ActuatorFault(_Command):
    """A fault of one virtual actuator (``device``; none: all three) or of their bus."""

    cmd: Literal["actuator_fault"]
    name: str
    device: Literal["lift_left", "lift_right", "tilt"] | None = None
    params: Params = {}


class TurnBlade(_Command):
    """Somebody turns the unpowered blade by hand."""

    cmd: Literal["turn_blade"]
    angle_deg: Number = Field(ge=-90, le=90)


class CanFrame(_Command):
    """Put a message of some other node on the actuators' bus."""

    cmd: Literal["can_frame"]
    can_id: int = Field(ge=0, lt=1 << 29)
    data_hex: str = Field(pattern=r"^([0-9a-f]{2}){0,8}$")


class StopLoopState(_Command):
    """The stop loop: ``closed`` permits, ``open`` is a pressed button, ``shorted`` reads closed whatever happens,
    ``silent`` does not answer, ``gone`` is a pulled plug."""

    cmd: Literal["stop_loop"]
    state: Literal["closed", "open", "shorted", "silent", "gone"]


class ClearFaults(_Command):
    """End faults: of one part, or all."""

    cmd: Literal["clear_faults"]
    part: Literal["camera", "servo", "actuators", "stop_loop"] | None = None


class Faults(_Command):
    """List what can be injected, and what is."""

    cmd: Literal["faults"]


class State(_Command):
    """What is true of the machine and the soil, as no sensor sees it."""

    cmd: Literal["state"]


class VehicleState(_Command):
    """What the machine's own wheels tell: speed, and distance rolled, backwards counted off."""

    cmd: Literal["vehicle"]


class TopView(_Command):
    """Write a colour picture of the bed from above (PNG): up is forward, left is the operator's left."""

    cmd: Literal["topview"]
    path: str = Field(min_length=1)


class TopDepth(_Command):
    """Write a depth picture of the bed from above (16-bit PNG, millimetres from the camera), oriented as topview."""

    cmd: Literal["topdepth"]
    path: str = Field(min_length=1)


class Quit(_Command):
    """End the rig."""

    cmd: Literal["quit"]


Command = Annotated[
    Scene
    | Place
    | Drive
    | Halt
    | ResetVehicle
    | Light
    | CameraFault
    | ServoFault
    | ActuatorFault
    | TurnBlade
    | CanFrame
    | StopLoopState
    | ClearFaults
    | Faults
    | State
    | VehicleState
    | TopView
    | TopDepth
    | Quit,
    Field(discriminator="cmd"),
]

COMMAND: TypeAdapter[Command] = TypeAdapter(Command)
"""Parses one line into one of the commands above."""
