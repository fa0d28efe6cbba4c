"""Geometry of the blade in the vehicle frame: x forward, y left, z up, metres, origin = rotation axis on the ground."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

Array = npt.NDArray[np.float64]


class BladeGeometry(BaseModel):
    """The moldboard: a hollow face of ``length_m`` by ``height_m`` that turns about the vertical axis.

    At angle 0 the cutting edge's front face lies on x = ``x_offset_m``; the face is hollow with
    ``curvature_radius_m`` (up to 34 mm further back at mid height with the 1/4-scale blade).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    length_m: Annotated[float, Field(gt=0)] = 1.0
    height_m: Annotated[float, Field(gt=0)] = 0.25
    bottom_z_m: float = 0.002
    x_offset_m: float = 0.0
    curvature_radius_m: Annotated[float, Field(gt=0)] = 0.25
    reach_m: Annotated[float, Field(gt=0)] = 0.35
    """Soil counts from the blade face to this distance in front of it (d)."""


def blade_coordinates(x: Array, y: Array, angle_deg: float) -> tuple[Array, Array]:
    """Vehicle x, y (m) to blade coordinates ``(s, d)``: s along the blade, left positive; d ahead of the blade.

    ``angle_deg`` is counter-clockwise seen from above: ``s = -x sin a + y cos a``, ``d = x cos a + y sin a``.
    """
    angle = np.deg2rad(angle_deg)
    cos, sin = np.cos(angle), np.sin(angle)
    return -x * sin + y * cos, x * cos + y * sin


STEEPEST_MEETING_DEG = 75.0
"""Turned further than this a blade meets hardly anything: where soil would meet it is no longer asked."""


def meeting_point(s: Array, d: Array, angle_deg: float) -> tuple[Array, Array]:
    """Where along a blade that travels straight ahead soil at ``(s, d)`` will meet it, and after how much travel (m).

    Soil keeps its y while the blade comes nearer along x. With d counted from the face, which the blade carries round
    its axis, soil lies at ``y = (d + x_offset) sin a + s cos a`` and meets the face, d = 0, at the same y:
    ``s_met cos a = s cos a + d sin a``, so ``s_met = s + d tan a``. The travel is the difference in x:
    ``d cos a + (s_met - s) sin a = d / cos a``. Both grow without bound as the blade turns along the travel; looking
    ahead by a fixed travel keeps them bounded, since ``s_met - s = travel sin a``.

    Raises:
        ValueError: the blade is turned by more than :data:`STEEPEST_MEETING_DEG`.
    """
    if abs(angle_deg) > STEEPEST_MEETING_DEG:
        raise ValueError(f"a blade turned by {angle_deg:.0f} degrees has no soil ahead of it")
    angle = np.deg2rad(angle_deg)
    return s + d * np.tan(angle), d / np.cos(angle)


def third_bounds_m(length_m: float) -> tuple[float, float]:
    """s of the two borders between the thirds: right|center and center|left."""
    return -length_m / 6.0, length_m / 6.0
