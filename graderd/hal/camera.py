"""Contract of the camera that looks at the blade. Synchronous on purpose: it lives in an expendable child process."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

ColorImage = npt.NDArray[np.uint8]
DepthImage = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pin-hole intrinsics of one stream: pixels, pixel centres at integers; ``coeffs`` are OpenCV k1 k2 p1 p2 k3."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coeffs: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def scaled(self, width: int, height: int) -> Intrinsics:
        """The same lens read out at another size (pixel centres at integers)."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.coeffs,
        )


@dataclass(frozen=True, slots=True)
class StreamPose:
    """Where a stream's optical frame sits in the vehicle frame.

    Vehicle frame: x forward, y left, z up, metres, origin = blade rotation axis on the ground. Optical frame
    (OpenCV): X image right, Y image down, Z along the view. ``p_vehicle = rotation @ p_optical + position_m``;
    ``rotation`` is row-major, 3x3, its columns the optical axes in the vehicle frame.
    """

    position_m: tuple[float, float, float]
    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture: colour, and depth where the camera has it, taken together.

    ``color_bgr``: H x W x 3, uint8, BGR. ``depth_mm``: h x w, uint16, millimetres along the optical axis (Z, not
    range), 0 = no value; None where the source has no depth. ``capture_s``: monotonic seconds of exposure, or of
    arrival where the device gives no usable time. ``color_number`` and ``depth_number``: the device's own frame
    counters, -1 where unknown. ``metadata``: exposure, gain and the like, units in the names.
    """

    color_bgr: ColorImage
    depth_mm: DepthImage | None
    color_intrinsics: Intrinsics | None
    depth_intrinsics: Intrinsics | None
    capture_s: float
    color_number: int = -1
    depth_number: int = -1
    name: str = ""
    metadata: dict[str, float] = field(default_factory=dict)


class EndOfFrames(Exception):  # noqa: N818  (it is not an error: a recording or folder came to its end)
    """The source is a recording or folder and has no further frame."""


class Camera(Protocol):
    """A source of frames. One owner, one thread."""

    @property
    def description(self) -> str:
        """What it is, for people: model and serial number, or the path."""
        ...

    def open(self) -> None:
        """Open the source. Does not block for more than a second where no camera is present.

        Raises:
            DeviceMissingError: no such camera, file or folder.
            WrongDeviceError: it cannot give the streams asked for.
        """
        ...

    def read(self, timeout_s: float) -> Frame:
        """The newest frame that was not handed out yet.

        Raises:
            DeviceTimeoutError: none came within ``timeout_s``.
            DeviceLostError: the source is gone.
            EndOfFrames: a recording or folder came to its end.
        """
        ...

    def settings_read_back(self) -> dict[str, float]:
        """What is set on the device, as read back: ``exposure_us``, ``gain``, ``white_balance_k`` and so on."""
        ...

    def reset_hardware(self) -> None:
        """Restart the device itself (a USB reset). No effect on file sources."""
        ...

    def close(self) -> None:
        """Let go of the source; idempotent."""
        ...
