"""The picture that lets a person see that a calibration is right: outline, thirds, LEFT and RIGHT on the blade."""

from __future__ import annotations

import cv2
import numpy as np

from graderd.perception.annotate import COLORS, NAMES, WHITE, text_on
from graderd.perception.calibration import CalibrationResult
from graderd.perception.geometry import F64, U8, View, blade_points_m, face_setback_m, third_outlines_px


def calibration_picture(color_bgr: U8, result: CalibrationResult, angle_deg: float) -> U8:
    """A copy of the picture with the blade drawn where the calibration puts it, and what it fits to."""
    picture = color_bgr.copy()
    height, width = picture.shape[:2]
    scale = max(width / 1280, 0.35)
    line = max(1, round(2 * scale))
    stream = result.calibration.color
    view = View(stream.intrinsics().scaled(width, height), stream.pose(result.calibration.mounting))
    for third, outline in enumerate(third_outlines_px(view, result.blade, angle_deg)):
        if np.isfinite(outline).all():
            cv2.polylines(picture, [np.round(outline).astype(np.int32)], True, COLORS[third], line, cv2.LINE_AA)
            middle = outline[[0, 1, 4, 5]].mean(axis=0)
            (w, h), _ = cv2.getTextSize(NAMES[third], cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
            text_on(picture, NAMES[third], (int(middle[0] - w / 2), int(middle[1] + h / 2)), scale, COLORS[third])
    outline = view.project(face_outline_m(result, angle_deg))
    if np.isfinite(outline).all():
        cv2.polylines(picture, [np.round(outline).astype(np.int32)], True, WHITE, line, cv2.LINE_AA)
    fits = [f"{result.residual_mm:.1f} mm"] if result.residual_mm is not None else []
    fits += [f"{result.residual_px:.2f} px"] if result.residual_px is not None else []
    text = f"blade {angle_deg:+.1f} deg   fits to {' and '.join(fits) or 'nothing'}   left and right: operator's"
    text_on(picture, text, (round(14 * scale), round(34 * scale)), 0.8 * scale)
    return picture


def face_outline_m(result: CalibrationResult, angle_deg: float) -> F64:
    """The face's outline as points in the vehicle frame, round from the lower right end."""
    blade = result.blade
    half, low = blade.length_m / 2, blade.bottom_z_m
    rise = np.linspace(low, low + blade.height_m, 9)
    s = np.concatenate((np.full(9, -half), np.full(9, half)))
    z = np.concatenate((rise, rise[::-1]))
    return blade_points_m(blade, angle_deg, s, -face_setback_m(blade, z), z)
