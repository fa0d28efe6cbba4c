"""Loading pyrealsense2 where the system has no libusb, and turning its objects into the project's own.

The wheel needs ``libusb-1.0.so.0``; a bare Debian has none. The PyPI package ``libusb-package`` carries one with the
same SONAME: loaded first, the dynamic linker is content with it.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from graderd.hal.camera import ColorImage, DepthImage, Intrinsics
from graderd.hal.errors import DeviceMissingError, ProtocolError

Rs = Any
"""The pyrealsense2 module or one of its objects; it carries no types."""


@functools.cache
def load() -> Rs:
    """The pyrealsense2 module.

    Raises:
        DeviceMissingError: it is not installed, or no libusb is found.
    """
    with contextlib.suppress(ImportError, OSError):
        libusb = importlib.import_module("libusb_package")
        path = libusb.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise DeviceMissingError(
            "camera", f"pyrealsense2 cannot be loaded ({error})", "Install the extra: pip install 'graderd[camera]'"
        ) from error


def intrinsics(profile: Rs) -> Intrinsics:
    """Lens data of a video stream profile in OpenCV's convention.

    librealsense's *inverse* Brown-Conrady model maps the other way round (pixel to ray); where its coefficients are
    not zero, OpenCV coefficients are fitted to it over the whole picture.
    """
    rs = load()
    raw = profile.as_video_stream_profile().get_intrinsics()
    coeffs = [float(value) for value in raw.coeffs]
    lens = Intrinsics(raw.width, raw.height, raw.fx, raw.fy, raw.ppx, raw.ppy)
    if not any(coeffs) or raw.model == rs.distortion.none:
        return lens
    if raw.model != rs.distortion.inverse_brown_conrady:
        return Intrinsics(raw.width, raw.height, raw.fx, raw.fy, raw.ppx, raw.ppy, _five(coeffs))
    return Intrinsics(
        raw.width, raw.height, raw.fx, raw.fy, raw.ppx, raw.ppy, _five(forward_coefficients(lens, coeffs))
    )


def _five(values: list[float]) -> tuple[float, float, float, float, float]:
    return values[0], values[1], values[2], values[3], values[4]


def forward_coefficients(lens: Intrinsics, inverse: list[float]) -> list[float]:
    """OpenCV k1 k2 p1 p2 k3 that undo librealsense's inverse Brown-Conrady coefficients (least squares)."""
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, 41), np.linspace(0, lens.height - 1, 31))
    xd, yd = (u.ravel() - lens.cx) / lens.fx, (v.ravel() - lens.cy) / lens.fy
    k1, k2, p1, p2, k3 = inverse[:5]
    r2 = xd * xd + yd * yd
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x = xd * radial + 2 * p1 * xd * yd + p2 * (r2 + 2 * xd * xd)
    y = yd * radial + 2 * p2 * xd * yd + p1 * (r2 + 2 * yd * yd)
    r2 = x * x + y * y
    rows_x = np.column_stack((x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3))
    rows_y = np.column_stack((y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3))
    solution = np.linalg.lstsq(np.vstack((rows_x, rows_y)), np.concatenate((xd - x, yd - y)), rcond=None)[0]
    return [float(value) for value in solution]


def color_bgr(frame: Rs) -> ColorImage:
    """A colour frame as a BGR picture of our own memory.

    Raises:
        ProtocolError: a pixel format this function does not know.
    """
    rs = load()
    data = np.asanyarray(frame.get_data())
    codes = {
        rs.format.rgb8: cv2.COLOR_RGB2BGR,
        rs.format.rgba8: cv2.COLOR_RGBA2BGR,
        rs.format.bgra8: cv2.COLOR_BGRA2BGR,
        rs.format.y8: cv2.COLOR_GRAY2BGR,
    }
    pixel_format = frame.get_profile().format()
    if pixel_format == rs.format.bgr8:
        return np.array(data, dtype=np.uint8)
    if pixel_format == rs.format.yuyv:
        packed = data.view(np.uint8).reshape(data.shape[0], -1, 2)
        return np.asarray(cv2.cvtColor(packed, cv2.COLOR_YUV2BGR_YUYV), dtype=np.uint8)
    if pixel_format not in codes:
        raise ProtocolError("camera", f"colour frames come as {pixel_format}", "Record or stream rgb8 or bgr8")
    return np.asarray(cv2.cvtColor(data, codes[pixel_format]), dtype=np.uint8)


def depth_mm(frame: Rs, units_m: float) -> DepthImage:
    """A depth frame in millimetres, in our own memory; ``units_m`` is the device's depth unit (0.001 by default)."""
    data: npt.NDArray[np.uint16] = np.asanyarray(frame.get_data())
    if abs(units_m - 0.001) < 1e-7:
        return np.array(data, dtype=np.uint16)
    return np.clip(np.round(data.astype(np.float32) * (units_m * 1000.0)), 0, 65535).astype(np.uint16)


def depth_units_m(frame: Rs) -> float:
    """Metres per count of a depth frame."""
    units = float(frame.as_depth_frame().get_units())
    return units if units > 0 else 0.001
