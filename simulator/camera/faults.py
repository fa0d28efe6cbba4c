"""What can go wrong with the rig's camera, and what it does to a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from graderd.hal.camera import ColorImage, DepthImage


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of a fault: what it is by default, and what makes sense."""

    default: float
    least: float
    most: float


_SHIFT = Parameter(0.0, -0.3, 0.3)

CAMERA_FAULTS: dict[str, tuple[str, dict[str, Parameter]]] = {
    "freeze": ("the same picture again and again under new numbers", {}),
    "black": ("no light in the colour picture", {}),
    "blown_out": ("the colour picture overexposed", {}),
    "blocked": ("something covers this share of both lenses", {"share": Parameter(1.0, 0.0, 1.0)}),
    "blurred": ("out of focus, by so many pixels at 640 wide", {"sigma_px": Parameter(7.0, 0.3, 60.0)}),
    "torn": ("depth from so many frames earlier than colour", {"frames_n": Parameter(3, 1, 30)}),
    "knocked": (
        "both imagers moved (vehicle frame) and turned (about their own X, Y, Z)",
        {
            "x_m": replace(_SHIFT, default=0.02),
            "y_m": replace(_SHIFT, default=0.03),
            "z_m": _SHIFT,
            "turn_x_deg": Parameter(4.0, -30.0, 30.0),
            "turn_y_deg": Parameter(-3.0, -30.0, 30.0),
            "turn_z_deg": Parameter(2.0, -30.0, 30.0),
        },
    ),
    "wrong_resolution": ("pictures at half the size asked for", {}),
    "no_depth": ("the depth stream stops, colour goes on", {}),
    "stall": ("no further frame, the connection stays", {}),
    "unplug": ("the camera is gone", {}),
    "settings_lost": ("exposure and white balance are not what was set", {}),
}
"""Name: what it is, and its parameters."""


def parameters(fault: str, given: Mapping[str, float]) -> dict[str, float]:
    """The parameters of ``fault`` with defaults filled in.

    Raises:
        ValueError: no such fault or parameter, or a value that makes no sense.
    """
    if fault not in CAMERA_FAULTS:
        raise ValueError(f"no camera fault {fault!r}; known: {', '.join(CAMERA_FAULTS)}")
    known = CAMERA_FAULTS[fault][1]
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"camera fault {fault!r} has no {name}; it has {sorted(known)}")
        if not known[name].least <= value <= known[name].most:
            raise ValueError(f"{name} of {fault!r} is {value}, it goes from {known[name].least} to {known[name].most}")
    return {name: given.get(name, parameter.default) for name, parameter in known.items()}


def spoil(
    color: ColorImage, depth: DepthImage | None, faults: Mapping[str, Mapping[str, float]]
) -> tuple[ColorImage, DepthImage | None]:
    """The picture as the faults that act on single pictures leave it."""
    if "blurred" in faults:
        sigma = faults["blurred"]["sigma_px"] * color.shape[1] / 640.0
        color = np.asarray(cv2.GaussianBlur(color, (0, 0), sigma), np.uint8)
    if "black" in faults:
        color = (color // 64).astype(np.uint8)
    if "blown_out" in faults:
        color = np.maximum(color, 250).astype(np.uint8)
    if "blocked" in faults:
        color, depth = _cover(color, depth, faults["blocked"]["share"])
    if "wrong_resolution" in faults:
        color = np.ascontiguousarray(color[::2, ::2])
        depth = None if depth is None else np.ascontiguousarray(depth[::2, ::2])
    if "no_depth" in faults:
        depth = None
    return color, depth


def _cover(color: ColorImage, depth: DepthImage | None, share: float) -> tuple[ColorImage, DepthImage | None]:
    """Mud or a glove before the lens: a dark, even, blurred patch that grows from image left."""
    color = color.copy()
    edge = round(color.shape[1] * min(max(share, 0.0), 1.0))
    if edge:
        patch = np.full_like(color[:, :edge], (26, 32, 40))
        patch += (np.linspace(0, 10, color.shape[0]).astype(np.uint8))[:, None, None]
        color[:, :edge] = patch
    if depth is not None:
        depth = depth.copy()
        depth[:, : round(depth.shape[1] * min(max(share, 0.0), 1.0))] = 0
    return color, depth
