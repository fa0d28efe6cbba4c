"""Where the rig's D455 stands and how it sees: nominal poses and intrinsics of its two streams.

The camera stands between the front wheels and looks back and 35 degrees down at the blade. Focal lengths follow from
the fields of view of the data sheet (RealSense D455: colour 90 x 65 degrees, global shutter, 1280 x 800; depth
87 x 58 degrees); a factory calibration of one unit read 629.6 px for colour and 424 to 427 px for depth.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from graderd.hal.camera import Intrinsics, StreamPose
from graderd.simulator.grader.blade import CURVATURE_RADIUS_M, EDGE_GAP_M, FACE_HEIGHT_M, LENGTH_M, REACH_M

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


def knocked(shift_m: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> tuple[StreamPose, StreamPose]:
    """Poses of colour and depth after the housing was moved by ``shift_m`` (vehicle frame) and turned.

    ``turn_deg``: about the colour imager's own X (positive: looks further up), Y (positive: looks further to image
    right) and Z (roll); the depth imager goes along as one body.
    """
    rx, ry, rz = (math.radians(angle) for angle in turn_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(rx), -math.sin(rx)], [0, math.sin(rx), math.cos(rx)]])
    about_y = np.array([[math.cos(ry), 0, math.sin(ry)], [0, 1, 0], [-math.sin(ry), 0, math.cos(ry)]])
    about_z = np.array([[math.cos(rz), -math.sin(rz), 0], [math.sin(rz), math.cos(rz), 0], [0, 0, 1]])
    before = np.array(COLOR_POSE.rotation)
    after = before @ about_y @ about_x @ about_z
    color_m = np.array(COLOR_POSE.position_m) + np.array(shift_m)
    offset_m = np.array(DEPTH_POSE.position_m) - np.array(COLOR_POSE.position_m)
    return _as_pose(color_m, after), _as_pose(color_m + after @ before.T @ offset_m, after)


def _as_pose(position_m: FloatArray, rotation: FloatArray) -> StreamPose:
    rows = [(float(row[0]), float(row[1]), float(row[2])) for row in rotation]
    x, y, z = (float(value) for value in position_m)
    return StreamPose((x, y, z), (rows[0], rows[1], rows[2]))


def camera_json(color: Intrinsics, depth: Intrinsics) -> dict[str, Any]:
    """Nominal lenses and poses as a frame set's ``camera.json`` has them, with the blade's geometry."""
    shift = [depth_m - color_m for depth_m, color_m in zip(DEPTH_POSE.position_m, COLOR_POSE.position_m, strict=True)]
    in_optical = np.array(COLOR_POSE.rotation).T @ np.array(shift)
    return {
        "convention": (
            "Vehicle frame: x forward, y left, z up, metres, origin = blade rotation axis on the ground. Optical frame "
            "(OpenCV): X image right, Y image down, Z along the view. p_vehicle = rotation_vehicle_from_optical @ "
            "p_optical + position_m; the columns of the rotation are the optical axes in the vehicle frame. Pixel "
            "centres at integer (u, v); depth values are Z (not range), millimetres, 0 = invalid. The camera faces "
            "back: image right is vehicle +y, the operator's left."
        ),
        "color": _stream_json(color, COLOR_POSE),
        "depth": {**_stream_json(depth, DEPTH_POSE), "scale_m": 0.001, "clamp_max_m": MAX_DEPTH_M},
        "depth_to_color": {
            "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "translation_m": [round(float(value), 9) for value in in_optical],
            "meaning": "p_color = rotation @ p_depth + translation_m (librealsense convention)",
        },
        "pitch_down_deg": PITCH_DOWN_DEG,
        "blade": {
            "length_m": LENGTH_M,
            "height_m": FACE_HEIGHT_M,
            "bottom_z_m": EDGE_GAP_M,
            "x_offset_m": 0.0,
            "curvature_radius_m": CURVATURE_RADIUS_M,
        },
        "zones": {
            "left": "s > 1/6 m",
            "center": "|s| <= 1/6 m",
            "right": "s < -1/6 m",
            "s": "-x*sin(a) + y*cos(a)",
            "d": f"x*cos(a) + y*sin(a), volumes counted from the blade face to d = {REACH_M} m",
        },
    }


def _stream_json(lens: Intrinsics, pose: StreamPose) -> dict[str, Any]:
    return {
        "width": lens.width,
        "height": lens.height,
        "fx": lens.fx,
        "fy": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        "distortion": "none",
        "coeffs": list(lens.coeffs),
        "position_m": list(pose.position_m),
        "rotation_vehicle_from_optical": [list(row) for row in pose.rotation],
    }
