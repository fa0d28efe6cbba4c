"""The rig's process: physics and wires on one event loop, the camera in a child, all under one folder."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import cv2
import numpy as np
from pydantic import ValidationError

from drivers.dynamixel.virtual import VirtualServo, VirtualServoBus
from drivers.electrak.virtual import VirtualActuatorBus, VirtualElectrak
from drivers.rig import camera_faults, commands
from drivers.rig.blade import GROUND_LIFT_MM, LEVEL_TILT_MM, BladePose
from drivers.rig.look import Look
from drivers.rig.piles import heap
from drivers.rig.shared import SharedScene
from drivers.rig.soil import FloatArray, SoilField
from drivers.rig.topview import CAMERA_HEIGHT_M, top_depth, top_view
from drivers.rig.world import World, scene_heights
from graderd.hal.errors import DeviceError, DeviceLostError, DeviceMissingError

_TICK_S = 0.01
_LONGEST_STEP_S = 0.05
"""A process that was stopped for longer lets the machine miss that time instead of jumping."""
_MAX_LINE = 1 << 16
_CAMERA_START_S = 15.0
_ADDRESSES = {"lift_left": 19, "lift_right": 20, "tilt": 27}
_UNLOADED_LIFT_N = 150.0
"""Half the weight of blade and circle on each lift, against extension."""


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
        self._seed = seed
        self.world = World()
        self.servo = VirtualServo(servo_id=1, seed=seed)
        self.servo_bus = VirtualServoBus([self.servo], self.paths.servo)
        self.lift_left = VirtualElectrak("electrak_hd_b017", _ADDRESSES["lift_left"], GROUND_LIFT_MM, seed)
        self.lift_right = VirtualElectrak("electrak_hd_b017", _ADDRESSES["lift_right"], GROUND_LIFT_MM, seed + 1)
        self.tilt = VirtualElectrak("electrak_md_a050", _ADDRESSES["tilt"], LEVEL_TILT_MM, seed + 2)
        self._look = Look()
        self._faults: dict[str, dict[str, dict[str, float]]] = {"camera": {}, "servo": {}, "actuators": {}}
        self._stop = asyncio.Event()
        self._scene = SharedScene.create((self.world.field.heights_m.shape[0], self.world.field.heights_m.shape[1]))
        self._camera: asyncio.subprocess.Process | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._soil_lock = asyncio.Lock()

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
        try:
            paths.directory.mkdir(parents=True, exist_ok=True)
            paths.ready.unlink(missing_ok=True)
            paths.control.unlink(missing_ok=True)
        except OSError as error:
            raise DeviceMissingError(str(paths.directory), f"cannot be used as the rig's folder: {error}") from error
        async with contextlib.AsyncExitStack() as stack:
            external = self._open_can()
            if external is not None:
                stack.callback(external.shutdown)
            actuators = VirtualActuatorBus(
                [self.lift_left, self.lift_right, self.tilt],
                link=None if external is not None else paths.can,
                bus=external,
            )
            self.actuator_bus = actuators
            self._publish()
            stack.push_async_callback(self._end_camera)
            await self._start_camera()
            stack.push_async_callback(self.servo_bus.close)
            await self.servo_bus.start()
            stack.push_async_callback(actuators.close)
            await actuators.start()
            server = await asyncio.start_unix_server(self._on_client, str(paths.control), limit=_MAX_LINE)
            stack.push_async_callback(self._end_server, server)
            stack.callback(paths.ready.unlink, missing_ok=True)
            tasks = [
                asyncio.create_task(self._live(), name="rig-physics"),
                asyncio.create_task(self._stop.wait(), name="rig-stop"),
                asyncio.create_task(self._watch_camera(), name="rig-camera-watch"),
            ]
            stack.push_async_callback(_end_tasks, tasks)
            self._announce()
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()

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
        }
        partial = self.paths.ready.with_name(f".rig.json.{os.getpid()}")
        partial.write_text(json.dumps(content) + "\n", encoding="utf-8")
        partial.replace(self.paths.ready)

    async def _end_server(self, server: asyncio.Server) -> None:
        server.close()
        await _end_tasks(list(self._clients))
        self.paths.control.unlink(missing_ok=True)

    # -- camera process ---------------------------------------------------------------------------------------------

    async def _start_camera(self) -> None:
        descriptor = self._scene.descriptor
        self._camera = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "drivers.rig.camera_server",
            "--memory",
            str(descriptor),
            "--socket",
            str(self.paths.camera),
            "--seed",
            str(self._seed),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(descriptor,),
        )
        assert self._camera.stdout is not None
        try:
            async with asyncio.timeout(_CAMERA_START_S):
                line = await self._camera.stdout.readline()
        except TimeoutError:
            line = b""
        if line != b"ready\n":
            raise DeviceLostError("rig camera", "its process did not start", "See its message above")

    async def _watch_camera(self) -> None:
        assert self._camera is not None
        status = await self._camera.wait()
        raise DeviceLostError("rig camera", f"its process ended with status {status}", "Start the rig again")

    async def _end_camera(self) -> None:
        process = self._camera
        if process is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            async with asyncio.timeout(1.0):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()

    async def _tell_camera(self, message: dict[str, Any]) -> None:
        assert self._camera is not None
        assert self._camera.stdin is not None
        self._camera.stdin.write(json.dumps(message).encode() + b"\n")
        await self._camera.stdin.drain()

    # -- physics ----------------------------------------------------------------------------------------------------

    async def _live(self) -> None:
        before_s = time.monotonic()
        while True:
            await asyncio.sleep(_TICK_S)
            now_s = time.monotonic()
            step_s = min(now_s - before_s, _LONGEST_STEP_S)
            before_s = now_s
            if step_s > 0.0:
                self.world.step(step_s, self._pose())
                self._pass_loads()
                self._publish()

    def _pose(self) -> BladePose:
        return BladePose.from_actuators(
            self.servo.shaft_deg, self.lift_left.position_mm, self.lift_right.position_mm, self.tilt.position_mm
        )

    def _pass_loads(self) -> None:
        """Let servo and actuators feel the soil, except where an injected fault pushes them already."""
        load = self.world.load
        if "push" not in self._faults["servo"]:
            self.servo.load_torque_nm = load.servo_torque_nm(self.servo.torque_enabled)
        if "overload" in self._faults["actuators"]:
            return
        self.lift_left.load_n = _UNLOADED_LIFT_N + 0.3 * load.left_n
        self.lift_right.load_n = _UNLOADED_LIFT_N + 0.3 * load.right_n
        self.tilt.load_n = min(max(0.25 * load.force_n, -350.0), 350.0)

    def _publish(self) -> None:
        world = self.world
        self._scene.write(time.monotonic(), world.vehicle.x_m, world.blade, world.field.heights_m, world.field.cell_m)

    # -- control socket ---------------------------------------------------------------------------------------------

    async def _on_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        task.set_name("rig-control-client")
        self._clients.add(task)
        try:
            while True:
                try:
                    line = await reader.readline()
                except ValueError:
                    answer: dict[str, Any] = {"error": f"a line has at most {_MAX_LINE} bytes"}
                    writer.write(json.dumps(answer).encode() + b"\n")
                    break
                if not line:
                    break
                answer = await self._answer(line)
                writer.write(json.dumps(answer).encode() + b"\n")
                await writer.drain()
                if answer.get("quitting"):
                    self.stop()
                    break
        except ConnectionError:
            pass
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
        world = self.world
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
                await self._tell_camera({"look": look.model_dump()})
                self._look = look
                return {"ok": True, "light": look.model_dump()}
            case commands.CameraFault():
                params = camera_faults.parameters(command.name, command.params)
                await self._tell_camera({"fault": command.name, "params": params})
                self._faults["camera"][command.name] = params
            case commands.ServoFault():
                self.servo_bus.inject(command.name, **command.params)
                self._faults["servo"][command.name] = dict(command.params)
            case commands.ActuatorFault():
                self._inject_actuator_fault(command)
            case commands.ClearFaults():
                await self._clear_faults(command.part)
            case commands.Faults():
                return self._list_faults()
            case commands.State():
                return self._state()
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
        x_m = self.world.vehicle.x_m + command.x_m
        if not 0.0 <= x_m <= field.length_m:
            raise ValueError(
                f"x_m {command.x_m} is outside the bed: the blade stands at {self.world.vehicle.x_m:.2f} m"
            )
        poured = heap(field, x_m, command.y_m, command.length_m, command.width_m, command.height_m, command.seed)
        field.add(poured)
        return field.heights_m

    def _inject_actuator_fault(self, command: commands.ActuatorFault) -> None:
        if command.name == "unplug":
            if command.params or command.device:
                raise ValueError("unplug is a fault of the adapter: it has no device and no parameters")
            self.actuator_bus.unplug()
        else:
            if "address" in command.params:
                raise ValueError("name the unit by device, not by address")
            address = None if command.device is None else _ADDRESSES[command.device]
            params: dict[str, Any] = dict(command.params)
            self.actuator_bus.inject(command.name, address=address, **params)
        self._faults["actuators"][command.name] = dict(command.params)

    async def _clear_faults(self, part: str | None) -> None:
        if part in (None, "camera"):
            await self._tell_camera({"clear": True})
            self._faults["camera"] = {}
        if part in (None, "servo"):
            self.servo_bus.clear_faults()
            self._faults["servo"] = {}
        if part in (None, "actuators"):
            if "unplug" in self._faults["actuators"]:
                self.actuator_bus.replug()
            self.actuator_bus.clear_faults()
            self._faults["actuators"] = {}

    def _list_faults(self) -> dict[str, Any]:
        return {
            "ok": True,
            "known": {
                "camera": list(camera_faults.CAMERA_FAULTS),
                "servo": list(self.servo_bus.fault_names()),
                "actuators": [*self.actuator_bus.fault_names(), "unplug"],
            },
            "present": self._faults,
        }

    def _state(self) -> dict[str, Any]:
        world, load = self.world, self.world.load
        left, center, right = world.volumes_l()
        return {
            "ok": True,
            "time_s": time.monotonic(),
            "blade_deg": world.blade.angle_deg,
            "blade_velocity_deg_per_s": self.servo.shaft_velocity_deg_per_s,
            "blade_height_mm": world.blade.height_m * 1000.0,
            "blade_slope_deg": world.blade.slope_deg,
            "blade_pitch_deg": world.blade.pitch_deg,
            "lift_left_mm": self.lift_left.position_mm,
            "lift_right_mm": self.lift_right.position_mm,
            "tilt_mm": self.tilt.position_mm,
            "lift_left_velocity_mm_per_s": self.lift_left.velocity_mm_per_s,
            "lift_right_velocity_mm_per_s": self.lift_right.velocity_mm_per_s,
            "tilt_velocity_mm_per_s": self.tilt.velocity_mm_per_s,
            "vehicle_x_m": world.vehicle.x_m,
            "speed_m_per_s": world.vehicle.speed_m_per_s,
            "driving": world.vehicle.driving,
            "vol_left_l": left,
            "vol_center_l": center,
            "vol_right_l": right,
            "soil_mass_kg": world.soil_kg,
            "load_force_n": load.force_n,
            "load_torque_nm": load.torque_nm,
            "servo_torque_enabled": self.servo.torque_enabled,
            "servo_watchdog_tripped": self.servo.tripped,
            "servo_requests_n": self.servo_bus.requests_n,
            "lift_left_enabled": self.lift_left.motion_enabled,
            "lift_right_enabled": self.lift_right.motion_enabled,
            "tilt_enabled": self.tilt.motion_enabled,
            "camera_pid": self._camera.pid if self._camera else 0,
        }


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


async def _end_tasks(tasks: list[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
