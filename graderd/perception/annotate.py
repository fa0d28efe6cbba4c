"""Pictures for people: thirds on the blade, LEFT and RIGHT where the operator's are, numbers and the decision."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Mounting, SoilObservation, Zone
from graderd.perception.calibration import CalibrationResult
from graderd.perception.geometry import (
    CENTER,
    F64,
    LEFT,
    RIGHT,
    U8,
    View,
    blade_points_m,
    face_setback_m,
    third_outlines_px,
    top_edge_m,
)

Bgr = tuple[int, int, int]
COLORS: dict[int, Bgr] = {LEFT: (80, 200, 80), CENTER: (230, 170, 60), RIGHT: (60, 120, 240)}
NAMES = {LEFT: "LEFT", CENTER: "CENTER", RIGHT: "RIGHT"}
ZONES = {LEFT: Zone.LEFT, CENTER: Zone.CENTER, RIGHT: Zone.RIGHT}
FONT: Any = cv2.FontFace("sans")
"""OpenCV's own (Rubik, in its library), with the degree sign and other scripts."""
TALL_PX, LEAST_PX, WEIGHT = 30.0, 15, 500
"""Bolder, or smaller, letters run together; lighter ones fall apart."""
WHITE: Bgr = (255, 255, 255)
DARK: Bgr = (30, 30, 30)


def image_right_is_left(mounting: Mounting) -> bool:
    """Whether the picture's right is the operator's left: so for every camera that faces the blade from the front."""
    return mounting == "facing_blade_from_front"


def annotate(
    image_bgr: U8,
    observation: SoilObservation,
    view: View | None,
    blade: BladeGeometry,
    mirrored: bool,
    *,
    labels: bool = True,
) -> U8:
    """A copy of the picture with the observation drawn into it; without ``view`` the thirds are the picture's own.
    Without ``labels`` there is no text in it: whoever shows it may mirror it, and writes beside it."""
    picture = image_bgr.copy()
    height, width = picture.shape[:2]
    scale = max(width / 1280, 0.35)
    outlines = _outlines(view, blade, observation.blade_angle_deg, width, height, mirrored)
    shade = picture.copy()
    for third, outline in enumerate(outlines):
        if np.isfinite(outline).all():
            strong = observation.zone is ZONES[third] or observation.zone is Zone.EVEN
            if strong:
                cv2.fillPoly(shade, [np.round(outline).astype(np.int32)], COLORS[third])
    picture = np.asarray(cv2.addWeighted(shade, 0.28, picture, 0.72, 0), dtype=np.uint8)
    line = max(1, round(2 * scale))
    for third, outline in enumerate(outlines):
        if np.isfinite(outline).all():
            cv2.polylines(picture, [np.round(outline).astype(np.int32)], True, COLORS[third], line, cv2.LINE_AA)
    for third, outline in enumerate(outlines):
        if labels and np.isfinite(outline).all():
            _label(picture, outline, third, observation, scale)
    if view is not None:
        edge = view.project(top_edge_m(blade, observation.blade_angle_deg))
        if np.isfinite(edge).all():
            cv2.polylines(picture, [np.round(edge).astype(np.int32)], False, WHITE, line, cv2.LINE_AA)
    if labels:
        _banner(picture, observation, scale)
    return picture


def _outlines(
    view: View | None, blade: BladeGeometry, angle_deg: float, width: int, height: int, mirrored: bool
) -> tuple[F64, F64, F64]:
    if view is not None:
        return third_outlines_px(view, blade, angle_deg)
    border = [0, width / 3, 2 * width / 3, width - 1]
    strips = [np.array([[a, 0.0], [b, 0.0], [b, height - 1.0], [a, height - 1.0]]) for a, b in pairwise(border)]
    if not mirrored:
        strips.reverse()
    return strips[0], strips[1], strips[2]


def _label(picture: U8, outline: F64, third: int, observation: SoilObservation, scale: float) -> None:
    share = observation.share_of(ZONES[third])
    volume = {
        LEFT: observation.volume_left_l,
        CENTER: observation.volume_center_l,
        RIGHT: observation.volume_right_l,
    }[third]
    below = f"{share * 100:.0f} %" + (f"  {volume:.1f} l" if volume is not None else "")
    middle = np.clip(outline, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1)).mean(axis=0)
    for row, text in enumerate((NAMES[third], below)):
        size = scale * (0.9 if row == 0 else 0.7)
        w, h = _extent(text, size)
        at = (int(middle[0] - w / 2), int(middle[1] + row * (h + 14 * scale)))
        text_on(picture, text, at, size, COLORS[third] if row == 0 else WHITE)


def text_on(picture: U8, text: str, at: tuple[int, int], size: float, color: Bgr = WHITE) -> None:
    """Text with a dark rim, readable on any ground. ``at``: where its base line begins; ``size``: of `TALL_PX`."""
    tall_px = _tall_px(size)
    rim = max(1, round(tall_px / 16))
    for dx, dy in ((-rim, 0), (rim, 0), (0, -rim), (0, rim), (-rim, rim), (rim, rim), (-rim, -rim), (rim, -rim)):
        cv2.putText(picture, text, (at[0] + dx, at[1] + dy), DARK, FONT, tall_px, WEIGHT)
    cv2.putText(picture, text, at, color, FONT, tall_px, WEIGHT)


def _tall_px(size: float) -> int:
    return max(LEAST_PX, round(TALL_PX * size))


def _extent(text: str, size: float) -> tuple[int, int]:
    """Width and height, in pixels."""
    _, _, width, height = cv2.getTextSize((0, 0), text, (0, 0), FONT, _tall_px(size), WEIGHT)
    return width, height


def _banner(picture: U8, observation: SoilObservation, scale: float) -> None:
    tall, margin, width = max(36, round(74 * scale)), round(14 * scale), picture.shape[1]
    picture[:tall] = (picture[:tall] * 0.35).astype(np.uint8)
    first, second = round(0.46 * tall), round(0.88 * tall)
    head = f"{observation.zone.upper()}  {observation.confidence * 100:.0f} %"
    color = WHITE if observation.zone is not Zone.UNKNOWN else (80, 160, 255)
    text_on(picture, head, (margin, first), 1.0 * scale, color)
    tail = f"{observation.method}  blade {observation.blade_angle_deg:+.1f}°  {observation.cpu_ms:.1f} ms"
    tail_px = _extent(tail, 0.7 * scale)[0]
    if _extent(head, 1.0 * scale)[0] + tail_px + 4 * margin < width:
        text_on(picture, tail, (width - tail_px - margin, first), 0.7 * scale)
    wide = _extent(observation.reason, 0.6 * scale)[0]
    most = int(len(observation.reason) * min(1.0, (width - 2 * margin) / max(wide, 1)))
    text_on(picture, observation.reason[:most], (margin, second), 0.6 * scale)


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
            w, h = _extent(NAMES[third], scale)
            text_on(picture, NAMES[third], (int(middle[0] - w / 2), int(middle[1] + h / 2)), scale, COLORS[third])
    outline = view.project(face_outline_m(result, angle_deg))
    if np.isfinite(outline).all():
        cv2.polylines(picture, [np.round(outline).astype(np.int32)], True, WHITE, line, cv2.LINE_AA)
    fits = [f"{result.residual_mm:.1f} mm"] if result.residual_mm is not None else []
    fits += [f"{result.residual_px:.2f} px"] if result.residual_px is not None else []
    text = f"blade {angle_deg:+.1f}°   fits to {' and '.join(fits) or 'nothing'}   left and right: operator's"
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
