"""Everything about the rig's pictures that can be changed: light, soil, blade, camera. Data only.

What a client may ask for, and how much of it, is judged where it asks (``Light`` of the control server).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SoilKind = Literal["loam", "sand", "clay", "gravel", "peat", "laterite"]
BladeMaterial = Literal["steel", "rusty", "painted"]
GroundKind = Literal["plywood", "earth", "concrete"]


@dataclass(frozen=True, slots=True)
class Appearance:
    """How the scene is lit and what it is made of. Plain data: with pydantic for it, the camera's process takes three
    quarters longer to import what it needs."""

    sun_azimuth_deg: float = 35.0
    """Where the light comes from, seen from the blade: 0 = from ahead, 90 = from the left."""
    sun_elevation_deg: float = 50.0
    sun_strength: float = 1.0
    ambient: float = 0.45
    red_cast: float = 0.0
    """Gain of red over green, as the D455's colour imager shows in sunlight; negative: bluish."""
    exposure: float = 1.0
    shadows: bool = True
    machine_shadow: float = 0.0
    """How far the machine's own shadow reaches over the soil, from its left side (0 to 1)."""
    soil: SoilKind = "loam"
    wetness: float = 0.2
    """0 to 1."""
    blade: BladeMaterial = "steel"
    ground: GroundKind = "plywood"
    color_noise: float = 2.0
    """Standard deviation in grey levels."""
    disparity_noise_px: float = 0.12
    """Standard deviation of the disparity: D4xx units measure 0.09 to 0.37 px, neighbours erring together."""
    hole_share: float = 0.04
    """Share of depth pixels without a value, in blobs."""
