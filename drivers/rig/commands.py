"""What can be asked of the rig on its control socket: one JSON object a line, checked before anything happens."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from drivers.rig.look import BladeMaterial, GroundKind, Share, SoilKind
from drivers.rig.piles import SceneZone
from drivers.rig.soil import BED_LENGTH_M, BED_WIDTH_M
from drivers.rig.world import MAX_SPEED_M_PER_S

Number = Annotated[float, Field(allow_inf_nan=False)]
Params = dict[str, Number]


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Scene(_Command):
    """Empty the bed and lay soil in front of the blade where it stands."""

    cmd: Literal["scene"]
    zone: SceneZone
    seed: int = Field(0, ge=0, le=2**32 - 1)


class Place(_Command):
    """Pour one more heap; ``x_m`` and ``y_m`` are its centre, from the blade's axis (ahead, left)."""

    cmd: Literal["place"]
    x_m: Number = Field(ge=-BED_LENGTH_M, le=BED_LENGTH_M)
    y_m: Number = Field(ge=-BED_WIDTH_M / 2, le=BED_WIDTH_M / 2)
    length_m: Number = Field(1.0, gt=0.02, le=BED_LENGTH_M)
    width_m: Number = Field(0.5, gt=0.02, le=BED_WIDTH_M)
    height_m: Number = Field(0.3, gt=0.0, le=0.45)
    seed: int = Field(0, ge=0, le=2**32 - 1)


class Drive(_Command):
    """Drive so far at such a speed (negative: back); ends by itself, at the bed's end at the latest."""

    cmd: Literal["drive"]
    speed_m_per_s: Number = Field(ge=-MAX_SPEED_M_PER_S, le=MAX_SPEED_M_PER_S)
    distance_m: Number = Field(gt=0, le=BED_LENGTH_M)


class Halt(_Command):
    """Brake."""

    cmd: Literal["halt"]


class ResetVehicle(_Command):
    """Put the machine back to the start of the bed."""

    cmd: Literal["reset_vehicle"]


class Light(_Command):
    """Change light, soil, blade or camera noise; what is not named stays."""

    cmd: Literal["light"]
    sun_azimuth_deg: Number | None = None
    sun_elevation_deg: Number | None = None
    sun_strength: Number | None = None
    ambient: Number | None = None
    red_cast: Number | None = None
    exposure: Number | None = None
    shadows: bool | None = None
    machine_shadow: Share | None = None
    soil: SoilKind | None = None
    wetness: Share | None = None
    blade: BladeMaterial | None = None
    ground: GroundKind | None = None
    color_noise: Number | None = None
    disparity_noise_px: Number | None = None
    hole_share: Share | None = None


class CameraFault(_Command):
    """Make the camera misbehave until ``clear_faults``."""

    cmd: Literal["camera_fault"]
    name: str
    params: Params = {}


class ServoFault(_Command):
    """A fault of the virtual servo or its bus."""

    cmd: Literal["servo_fault"]
    name: str
    params: Params = {}


class ActuatorFault(_Command):
    """A fault of one virtual actuator (``device``; none: all three) or of their bus."""

    cmd: Literal["actuator_fault"]
    name: str
    device: Literal["lift_left", "lift_right", "tilt"] | None = None
    params: Params = {}


class TurnBlade(_Command):
    """Somebody turns the unpowered blade by hand."""

    cmd: Literal["turn_blade"]
    angle_deg: Number = Field(ge=-90, le=90)


class CanFrame(_Command):
    """Put a message of some other node on the actuators' bus."""

    cmd: Literal["can_frame"]
    can_id: int = Field(ge=0, lt=1 << 29)
    data_hex: str = Field(pattern=r"^([0-9a-f]{2}){0,8}$")


class StopLoopState(_Command):
    """The stop loop: ``closed`` permits, ``open`` is a pressed button, ``shorted`` reads closed whatever happens,
    ``silent`` does not answer, ``gone`` is a pulled plug."""

    cmd: Literal["stop_loop"]
    state: Literal["closed", "open", "shorted", "silent", "gone"]


class ClearFaults(_Command):
    """End faults: of one part, or all."""

    cmd: Literal["clear_faults"]
    part: Literal["camera", "servo", "actuators", "stop_loop"] | None = None


class Faults(_Command):
    """List what can be injected, and what is."""

    cmd: Literal["faults"]


class State(_Command):
    """What is true of the machine and the soil, as no sensor sees it."""

    cmd: Literal["state"]


class TopView(_Command):
    """Write a colour picture of the bed from above (PNG): up is forward, left is the operator's left."""

    cmd: Literal["topview"]
    path: str = Field(min_length=1)


class TopDepth(_Command):
    """Write a depth picture of the bed from above (16-bit PNG, millimetres from the camera), oriented as topview."""

    cmd: Literal["topdepth"]
    path: str = Field(min_length=1)


class Quit(_Command):
    """End the rig."""

    cmd: Literal["quit"]


Command = Annotated[
    Scene
    | Place
    | Drive
    | Halt
    | ResetVehicle
    | Light
    | CameraFault
    | ServoFault
    | ActuatorFault
    | TurnBlade
    | CanFrame
    | StopLoopState
    | ClearFaults
    | Faults
    | State
    | TopView
    | TopDepth
    | Quit,
    Field(discriminator="cmd"),
]

COMMAND: TypeAdapter[Command] = TypeAdapter(Command)
"""Parses one line into one of the commands above."""
