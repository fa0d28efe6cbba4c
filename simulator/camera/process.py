"""The rig's camera: a process of its own that renders when a client asks and never holds up the wires.

``python -m graderd.simulator.camera.process --memory FD --socket PATH`` is started by the rig with its shared memory as
an inherited descriptor and a pipe on standard input. JSON lines on that pipe change light and faults, each answered by
``changed`` and its number on standard output once it holds; the pipe's end, or the rig's death, ends this process.

Wire format of the socket: the client writes one JSON object a line, ``{"open": {...}}`` first, then ``{"next": n}`` for
the newest frame with a number above ``n``. Each answer is one JSON line, followed after a frame's header by the
bytes of colour (BGR) and depth (little-endian uint16).
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import signal
import socket
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from graderd.hal.camera import ColorImage, DepthImage, Intrinsics
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.faults import spoil
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.materials import Materials
from graderd.simulator.camera.optics import COLOR_POSE, DEPTH_POSE, knocked
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.camera.shared_scene import SharedScene

_PR_SET_PDEATHSIG = 1
_MAX_LINE = 4096
_MAX_PIXELS = 1920 * 1200
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Mode:
    """What a client asked for: sizes in pixels (depth 0 x 0: colour only) and frames a second."""

    color: tuple[int, int]
    depth: tuple[int, int] | None
    rate_hz: float

    @classmethod
    def parse(cls, request: dict[str, Any]) -> Mode:
        """From the client's open request.

        Raises:
            ValueError: nonsense.
        """
        color, depth = _size(request["color"]), _size(request["depth"])
        rate_hz = float(request["rate_hz"])
        if color is None or not 0.0 < rate_hz <= 120.0:
            raise ValueError("colour size and rate must be positive, the rate at most 120 Hz")
        return cls(color, depth, rate_hz)


def _size(value: Any) -> tuple[int, int] | None:
    width, height = (int(part) for part in value)
    if width == 0 and height == 0:
        return None
    if not (64 <= width <= 2048 and 48 <= height <= 2048 and width * height <= _MAX_PIXELS):
        raise ValueError(f"a picture of {width} x {height} pixels cannot be made")
    return width, height


class CameraProcess:
    """State shared by the threads that serve clients."""

    def __init__(self, scene: SharedScene, path: Path, seed: int) -> None:
        self._scene = scene
        self._path = path
        self._seed = seed
        self._lock = threading.Lock()
        self._appearance = Appearance()
        self._faults: dict[str, dict[str, float]] = {}
        self._renderers: dict[tuple[Any, ...], Renderer] = {}
        self._materials = Materials(seed)
        self._clients: set[socket.socket] = set()
        self._listener: socket.socket | None = None
        self._start_s = time.monotonic()

    # -- life -------------------------------------------------------------------------------------------------------

    def plug(self) -> None:
        """Listen for clients."""
        partial = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        with contextlib.suppress(FileNotFoundError):
            partial.unlink()
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(str(partial))
        listener.listen(4)
        partial.replace(self._path)
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), name="camera-accept", daemon=True).start()

    def unplug(self) -> None:
        """Vanish: the socket's name goes, every client is cut off."""
        listener, self._listener = self._listener, None
        if listener is not None:
            with contextlib.suppress(FileNotFoundError):
                self._path.unlink()
            # Waking the thread in accept() takes a shutdown; closing alone would leave it there.
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        for client in tuple(self._clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def change(self, message: dict[str, Any]) -> None:
        """A change that the rig asks for: ``look``, ``fault`` with ``params``, or ``clear``."""
        if "appearance" in message:
            self._appearance = Appearance(**message["appearance"])
        if "fault" in message:
            self._faults = {**self._faults, message["fault"]: message["params"]}
        if message.get("clear"):
            self._faults = {}
        if "unplug" in self._faults:
            self.unplug()
        elif self._listener is None:
            self.plug()

    # -- clients ----------------------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            self._clients.add(client)
            threading.Thread(target=self._serve, args=(client,), name="camera-client", daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        try:
            with client, client.makefile("rb") as lines:
                mode: Mode | None = None
                session: _Session | None = None
                while line := lines.readline(_MAX_LINE):
                    try:
                        request = json.loads(line)
                        if "open" in request:
                            mode = Mode.parse(request["open"])
                            session = _Session(mode)
                            client.sendall(_line(self._describe(mode)))
                        elif session is not None and "next" in request:
                            self._send_frame(client, session, int(request["next"]))
                        else:
                            raise ValueError("say open first, then next")
                    except (ValueError, TypeError, KeyError) as error:
                        client.sendall(_line({"error": f"{error}"}))
        except OSError:
            return
        finally:
            self._clients.discard(client)

    def _describe(self, mode: Mode) -> dict[str, Any]:
        settings = {"auto_exposure": 0.0, "exposure_us": 6000.0, "gain": 64.0, "white_balance_k": 4600.0}
        if "settings_lost" in self._faults:
            settings = {"auto_exposure": 1.0, "exposure_us": 15600.0, "gain": 16.0, "white_balance_k": 6500.0}
        return {
            "description": "rig camera (D455 between the front wheels)",
            "settings": settings,
            "rate_hz": mode.rate_hz,
        }

    def _send_frame(self, client: socket.socket, session: _Session, after: int) -> None:
        while True:
            if "stall" in self._faults:
                _check_connected(client)
                time.sleep(_POLL_S)
                continue
            now_s = time.monotonic()
            number = int((now_s - self._start_s) * session.mode.rate_hz)
            if number > max(after, session.last_number):
                break
            wait_s = (max(after, session.last_number) + 1) / session.mode.rate_hz + self._start_s - now_s
            time.sleep(min(max(wait_s, 0.0005), _POLL_S))
        session.last_number = number
        with self._lock:
            header, color, depth = self._expose(session, number)
        client.sendall(_line(header))
        client.sendall(color.data)
        if depth is not None:
            client.sendall(depth.data)

    # -- pictures ---------------------------------------------------------------------------------------------------

    def _expose(self, session: _Session, number: int) -> tuple[dict[str, Any], ColorImage, DepthImage | None]:
        faults, appearance = self._faults, self._appearance
        renderer = self._renderer(session.mode, faults.get("knocked"))
        snapshot = self._scene.read()
        capture_s = time.monotonic()
        if "freeze" in faults and session.last_picture is not None:
            color, depth = session.last_picture
        else:
            state = SceneState(snapshot.heights_m, snapshot.cell_m, snapshot.vehicle_x_m, snapshot.blade)
            color, depth = renderer.render(state, appearance)
            session.last_picture = color, depth
        depth_number = number
        session.depths.append((number, depth))
        del session.depths[: -1 - int(faults.get("torn", {}).get("frames_n", 3))]
        if "torn" in faults:
            depth_number, depth = session.depths[0]
        color, depth = spoil(color, depth, faults)
        header = {
            "capture_s": capture_s,
            "color_number": number,
            "depth_number": depth_number if depth is not None else -1,
            "color": _intrinsics(renderer.color_intrinsics.scaled(color.shape[1], color.shape[0])),
            "depth": None,
            "metadata": {"exposure_us": 6000.0, "gain": 64.0, "white_balance_k": 4600.0},
        }
        if depth is not None and renderer.depth_intrinsics is not None:
            header["depth"] = _intrinsics(renderer.depth_intrinsics.scaled(depth.shape[1], depth.shape[0]))
        return header, np.ascontiguousarray(color), None if depth is None else np.ascontiguousarray(depth)

    def _renderer(self, mode: Mode, knock: dict[str, float] | None) -> Renderer:
        key = (mode.color, mode.depth, None if knock is None else tuple(sorted(knock.items())))
        if key not in self._renderers:
            color_pose, depth_pose = COLOR_POSE, DEPTH_POSE
            if knock is not None:
                shift = knock["x_m"], knock["y_m"], knock["z_m"]
                turn = knock["turn_x_deg"], knock["turn_y_deg"], knock["turn_z_deg"]
                color_pose, depth_pose = knocked(shift, turn)
            while len(self._renderers) >= 3:
                self._renderers.pop(next(iter(self._renderers)))
            self._renderers[key] = Renderer(
                mode.color,
                mode.depth,
                seed=self._seed,
                color_pose=color_pose,
                depth_pose=depth_pose,
                materials=self._materials,
            )
        return self._renderers[key]


class _Session:
    """One client's stream."""

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self.last_number = -1
        self.last_picture: tuple[ColorImage, DepthImage | None] | None = None
        self.depths: list[tuple[int, DepthImage | None]] = []


def _check_connected(client: socket.socket) -> None:
    """Notice a client that hung up while it was kept waiting.

    Raises:
        ConnectionError: it did.
    """
    with contextlib.suppress(BlockingIOError):
        if not client.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
            raise ConnectionResetError("the client hung up")


def _intrinsics(lens: Intrinsics) -> list[float]:
    return [lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy]


def _line(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode() + b"\n"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> int:
    """Serve until the rig's pipe ends."""
    parser = argparse.ArgumentParser(description="the rig's camera; started by the rig itself")
    parser.add_argument("--memory", type=int, required=True, help="descriptor of the shared scene")
    parser.add_argument("--socket", type=Path, required=True, help="where to listen for clients")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    # Whatever ends the rig ends its camera; the pipe's end alone would not if something else held the pipe.
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the rig ends us in its own order
    cv2.setNumThreads(1)
    camera = CameraProcess(SharedScene.open(arguments.memory), arguments.socket, arguments.seed)
    camera.plug()
    _say("ready")
    for line in sys.stdin:
        message = json.loads(line)
        camera.change(message)
        _say(f"changed {message['number']}")
    camera.unplug()
    # Threads may still sit in a client's socket; nothing of theirs is worth waiting for.
    os._exit(0)


if __name__ == "__main__":
    raise SystemExit(main())
