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


def third_bounds_m(length_m: float) -> tuple[float, float]:
    """s of the two borders between the thirds: right|center and center|left."""
    return -length_m / 6.0, length_m / 6.0
