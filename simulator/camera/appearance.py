"""Everything about the rig's pictures that can be changed: light, soil, blade, camera. Data only."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
SoilKind = Literal["loam", "sand", "clay", "gravel", "peat", "laterite"]
BladeMaterial = Literal["steel", "rusty", "painted"]
GroundKind = Literal["plywood", "earth", "concrete"]


class Appearance(BaseModel):
    """How the scene is lit and what it is made of."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

    sun_azimuth_deg: Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)] = 35.0
    """Where the light comes from, seen from the blade: 0 = from ahead, 90 = from the left."""
    sun_elevation_deg: Annotated[float, Field(ge=5, le=90, allow_inf_nan=False)] = 50.0
    sun_strength: Annotated[float, Field(ge=0, le=4, allow_inf_nan=False)] = 1.0
    ambient: Annotated[float, Field(ge=0, le=2, allow_inf_nan=False)] = 0.45
    red_cast: Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False)] = 0.0
    """Gain of red over green, as the D455's colour imager shows in sunlight; negative: bluish."""
    exposure: Annotated[float, Field(gt=0, le=8, allow_inf_nan=False)] = 1.0
    shadows: bool = True
    machine_shadow: Share = 0.0
    """How far the machine's own shadow reaches over the soil, from its left side."""
    soil: SoilKind = "loam"
    wetness: Share = 0.2
    blade: BladeMaterial = "steel"
    ground: GroundKind = "plywood"
    color_noise: Annotated[float, Field(ge=0, le=30, allow_inf_nan=False)] = 2.0
    """Standard deviation in grey levels."""
    disparity_noise_px: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.12
    """Standard deviation of the disparity: D4xx units measure 0.09 to 0.37 px, neighbours erring together."""
    hole_share: Share = 0.04
    """Share of depth pixels without a value, in blobs."""
