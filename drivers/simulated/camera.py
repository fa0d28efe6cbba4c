"""The rig's camera as the daemon uses it: the camera contract over the rig's unix socket."""

from __future__ import annotations

import json
import socket
import time
from typing import Any

import numpy as np

from graderd.hal.camera import Frame, Intrinsics
from graderd.hal.errors import (
    DeviceLostError,
    DeviceMissingError,
    DeviceTimeoutError,
    LifecycleError,
    ProtocolError,
    WrongDeviceError,
)
from graderd.hal.settings import CameraSettings

_OPEN_TIMEOUT_S = 0.8


class RigCamera:
    """A client of the rig's camera socket; one owner, one thread (see :class:`graderd.hal.camera.Camera`).

    ``capture_s`` is the monotonic time at which the rig's state was taken for the picture. A rig that ends makes
    the next or the present :meth:`read` raise ``DeviceLostError`` at once.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None
        self._received = bytearray()
        self._asked = False
        self._last_number = -1
        self._description = f"rig camera at {settings.path}"
        self._read_back: dict[str, float] = {}

    @property
    def description(self) -> str:
        """What it is and where."""
        return self._description

    def open(self) -> None:
        """Connect and say which pictures are wanted.

        Raises:
            DeviceMissingError: no rig serves that socket.
            WrongDeviceError: the rig cannot make such pictures.
        """
        self.close()
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.settimeout(_OPEN_TIMEOUT_S)
        try:
            connection.connect(self._settings.path)
        except OSError as error:
            connection.close()
            raise DeviceMissingError(
                self._description, f"no rig answers there ({error})", "Start it with: graderd rig"
            ) from error
        self._socket = connection
        s = self._settings
        mode = {
            "color": [s.color_width_px, s.color_height_px],
            "depth": [s.depth_width_px, s.depth_height_px] if s.depth_width_px else [0, 0],
            "rate_hz": s.rate_hz,
        }
        self._send({"open": mode})
        try:
            answer = self._read_line(time.monotonic() + _OPEN_TIMEOUT_S)
        except DeviceTimeoutError:
            self.close()
            raise
        if "error" in answer:
            self.close()
            raise WrongDeviceError(
                self._description, str(answer["error"]), "Change the sizes or the rate of the camera"
            )
        self._description = f"{answer['description']} at {s.path}"
        self._read_back = {name: float(value) for name, value in answer["settings"].items()}

    def read(self, timeout_s: float) -> Frame:
        """The newest frame that was not handed out yet.

        Raises:
            DeviceTimeoutError: none came within ``timeout_s``.
            DeviceLostError: the rig is gone, or its camera is unplugged.
        """
        deadline_s = time.monotonic() + timeout_s
        if not self._asked:
            self._send({"next": self._last_number})
            self._asked = True
        header = self._read_line(deadline_s, keep=True)
        if "error" in header:
            self._asked = False
            raise ProtocolError(self._description, f"the rig's camera refused: {header['error']}")
        color_lens = _lens(header["color"])
        depth_lens = _lens(header["depth"]) if header["depth"] else None
        start = self._received.index(b"\n") + 1
        color_end = start + color_lens.width * color_lens.height * 3
        end = color_end + (depth_lens.width * depth_lens.height * 2 if depth_lens else 0)
        self._fill(end, deadline_s)
        color = np.frombuffer(bytes(self._received[start:color_end]), np.uint8)
        depth = None
        if depth_lens is not None:
            flat = np.frombuffer(bytes(self._received[color_end:end]), np.dtype("<u2"))
            depth = flat.reshape(depth_lens.height, depth_lens.width)
        del self._received[:end]
        self._asked = False
        self._last_number = int(header["color_number"])
        return Frame(
            color_bgr=color.reshape(color_lens.height, color_lens.width, 3),
            depth_mm=depth,
            color_intrinsics=color_lens,
            depth_intrinsics=depth_lens,
            capture_s=float(header["capture_s"]),
            color_number=self._last_number,
            depth_number=int(header["depth_number"]),
            name=f"{self._last_number:06d}",
            metadata=header["metadata"],
        )

    def settings_read_back(self) -> dict[str, float]:
        """What the rig's camera says it is set to."""
        return dict(self._read_back)

    def reset_hardware(self) -> None:
        """Connect anew; the rig's camera has nothing more to reset."""
        self.open()

    def close(self) -> None:
        """Hang up; idempotent."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()
        self._received.clear()
        self._asked = False
        self._last_number = -1

    # -- inside -----------------------------------------------------------------------------------------------------

    def _send(self, message: dict[str, Any]) -> None:
        if self._socket is None:
            raise LifecycleError(self._description, "the camera is not open", "Call open() first")
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            raise self._lost(error) from error

    def _read_line(self, deadline_s: float, keep: bool = False) -> dict[str, Any]:
        """The next JSON line; ``keep`` leaves it in the buffer, so that a read cut short can be taken up again."""
        while b"\n" not in self._received:
            self._fill(len(self._received) + 1, deadline_s)
        end = self._received.index(b"\n")
        line: dict[str, Any] = json.loads(bytes(self._received[:end]))
        if not keep or "error" in line:
            del self._received[: end + 1]
        return line

    def _fill(self, count: int, deadline_s: float) -> None:
        """Receive until ``count`` bytes are there."""
        if self._socket is None:
            raise LifecycleError(self._description, "the camera is not open", "Call open() first")
        while len(self._received) < count:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                raise DeviceTimeoutError(self._description, "no frame within the time allowed")
            self._socket.settimeout(left_s)
            try:
                piece = self._socket.recv(max(count - len(self._received), 65_536))
            except TimeoutError:
                continue
            except OSError as error:
                raise self._lost(error) from error
            if not piece:
                raise self._lost(None)
            self._received += piece

    def _lost(self, error: OSError | None) -> DeviceLostError:
        self.close()
        cause = f"the rig hung up ({error})" if error else "the rig hung up"
        return DeviceLostError(self._description, cause, "Start the rig again")


def _lens(values: list[float]) -> Intrinsics:
    width, height, fx, fy, cx, cy = values
    return Intrinsics(int(width), int(height), fx, fy, cx, cy)
