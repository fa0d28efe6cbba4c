"""Where the rig's D455 stands and how it sees: nominal poses and intrinsics of its two streams.

The camera stands between the front wheels and looks back and 35 degrees down at the blade. Focal lengths follow from
the fields of view of the data sheet (RealSense D455: colour 90 x 65 degrees, global shutter, 1280 x 800; depth
87 x 58 degrees); a factory calibration of one unit read 629.6 px for colour and 424 to 427 px for depth.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from graderd.hal.camera import Intrinsics, StreamPose

FloatArray = npt.NDArray[np.float64]

PITCH_DOWN_DEG = 35.0
BASELINE_M = 0.095
"""Between the two infrared imagers."""
MIN_DEPTH_M = 0.34
"""Nearest distance at 848 x 480."""
MAX_DEPTH_M = 1.7
"""The machine's camera clamps there; nothing of the blade's surroundings is farther away."""

COLOR_INTRINSICS = Intrinsics(1280, 800, 629.085, 629.085, 639.5, 399.5)
DEPTH_INTRINSICS = Intrinsics(848, 480, 427.675, 427.675, 423.5, 239.5)


def backward_rotation(pitch_down_deg: float) -> tuple[tuple[float, float, float], ...]:
    """Vehicle-from-optical rotation of a camera that looks straight back and ``pitch_down_deg`` down.

    Its columns are the optical axes in the vehicle frame: image right is vehicle +y, the operator's left.
    """
    pitch = math.radians(pitch_down_deg)
    cos, sin = math.cos(pitch), math.sin(pitch)
    return ((0.0, sin, -cos), (1.0, 0.0, 0.0), (0.0, -cos, -sin))


def _pose(y_m: float) -> StreamPose:
    first, second, third = backward_rotation(PITCH_DOWN_DEG)
    return StreamPose((0.8, y_m, 0.55), (first, second, third))


COLOR_POSE = _pose(0.0295)
DEPTH_POSE = _pose(-0.0295)


def knocked(pose: StreamPose, shift_m: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> StreamPose:
    """``pose`` moved by ``shift_m`` in the vehicle frame and turned by ``turn_deg`` about its own optical axes.

    ``turn_deg``: about X (positive: looks further up), Y (positive: looks further to image right), Z (roll).
    """
    rx, ry, rz = (math.radians(angle) for angle in turn_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(rx), -math.sin(rx)], [0, math.sin(rx), math.cos(rx)]])
    about_y = np.array([[math.cos(ry), 0, math.sin(ry)], [0, 1, 0], [-math.sin(ry), 0, math.cos(ry)]])
    about_z = np.array([[math.cos(rz), -math.sin(rz), 0], [math.sin(rz), math.cos(rz), 0], [0, 0, 1]])
    rotation = np.array(pose.rotation) @ about_y @ about_x @ about_z
    rows = [(float(row[0]), float(row[1]), float(row[2])) for row in rotation]
    x, y, z = (float(here + shift) for here, shift in zip(pose.position_m, shift_m, strict=True))
    return StreamPose((x, y, z), (rows[0], rows[1], rows[2]))
