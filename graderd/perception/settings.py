"""Settings of perception: how a picture is judged, and where the camera sits.

Both are sections of the configuration file. Every number carries its unit in its name.
"""

from __future__ import annotations

import hashlib
import math
from typing import Annotated, get_args

import numpy as np
from pydantic import Field, model_validator

from graderd.core.blade import BladeGeometry
from graderd.core.soil import ColorMethod, Method, Mounting
from graderd.hal.camera import Intrinsics, StreamPose
from graderd.hal.settings import Finite, NotNegative, Positive, Settings

METHODS: tuple[Method, ...] = get_args(Method)
COLOR_METHODS: tuple[ColorMethod, ...] = get_args(ColorMethod)
"""Those that look at the colour picture alone."""

Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Percent = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
HueDegrees = Annotated[float, Field(ge=0, le=360, allow_inf_nan=False)]
HueHalfDegrees = Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)]

LABELS = ("left", "center", "right", "even", "none")
RIGHT_LEAST_PERCENT = 98.0
"""What depth is held to as well: of a hundred answers two may be wrong."""
ANSWERED_LEAST_PERCENT = 95.0
FALSE_PILES_MOST_PERCENT = 1.0
FRAMES_LEAST_N = 20
"""Labelled frames of each of the five beds: with fewer a method that guesses may seem right."""


class SiteFigure(Settings):
    """What a colour method was worth on labelled frames of this site, as ``graderd calibrate color`` found it."""

    method: ColorMethod
    settings_mark: str = Field(description="of the colour and decision settings it was measured with")
    measured_at: str = ""
    frames_least_n: int = Field(ge=0, description="labelled frames of the bed that has fewest of them")
    right_percent: Percent = Field(description="of the answers")
    answered_percent: Percent = Field(description="of the frames")
    sides_swapped_n: int = Field(ge=0, description="frames in which one side was taken for the other")
    false_piles_percent: Percent = Field(description="of the empty beds")

    def falls_short(self) -> str:
        """Why the method may not drive by this figure; empty where it may."""
        if self.frames_least_n < FRAMES_LEAST_N:
            beds = ", ".join(LABELS)
            return f"{self.frames_least_n} frames of one of the beds {beds}, {FRAMES_LEAST_N} of each are asked"
        if self.right_percent < RIGHT_LEAST_PERCENT:
            return f"{self.right_percent:.1f} % of the answers were right, {RIGHT_LEAST_PERCENT:g} % are asked"
        if self.answered_percent < ANSWERED_LEAST_PERCENT:
            return f"{self.answered_percent:.1f} % of the frames were answered, {ANSWERED_LEAST_PERCENT:g} % are asked"
        if self.sides_swapped_n:
            return f"left and right were taken for each other {self.sides_swapped_n} times"
        if self.false_piles_percent >= FALSE_PILES_MOST_PERCENT:
            return f"{self.false_piles_percent:.1f} % of the empty beds were called a pile"
        return ""


class ColorSettings(Settings):
    """The colour rule of the paper (section 3.2) and of its fast form.

    The paper gives the hue window as 0 to 12 without a unit, next to saturation and value in percent. Exactly one of
    the three readings is set; only the reading in percent (0 to 43 degrees) holds brown soil.
    """

    hue_window_percent: tuple[Percent, Percent] | None = Field(
        default=(0.0, 12.0), description="percent of the full circle"
    )
    hue_window_deg: tuple[HueDegrees, HueDegrees] | None = Field(
        default=None, description="degrees of the colour circle"
    )
    hue_window_half_deg: tuple[HueHalfDegrees, HueHalfDegrees] | None = Field(
        default=None, description="OpenCV's own 0 to 180"
    )
    saturation_window_percent: tuple[Percent, Percent] = (0.0, 100.0)
    value_window_percent: tuple[Percent, Percent] = (0.0, 100.0)
    brightness_target_percent: Percent = Field(default=45.0, description="mean brightness the picture is scaled to")
    brightness_gain_max_ratio: Positive = Field(default=2.0, description="the picture is scaled by no more than this")
    bilateral_diameter_px: int = Field(default=9, ge=3, le=25)
    bilateral_sigma_n: Positive = Field(default=75.0, description="grey levels and pixels that count as near")
    contour_tolerance_percent: NotNegative = Field(
        default=0.5, description="of the contour's length, for the approximation"
    )
    none_area_percent: Percent = Field(default=6.0, description="soil on less of the blade's region than this: none")
    site_figure: SiteFigure | None = Field(
        default=None, description="written by `graderd calibrate color`; without it colour does not drive"
    )

    @model_validator(mode="after")
    def _one_reading(self) -> ColorSettings:
        readings = (self.hue_window_percent, self.hue_window_deg, self.hue_window_half_deg)
        if sum(reading is not None for reading in readings) != 1:
            raise ValueError(
                "set exactly one of hue_window_percent, hue_window_deg and hue_window_half_deg, and the others to none"
            )
        for window in (*readings, self.saturation_window_percent, self.value_window_percent):
            if window is not None and window[0] > window[1]:
                raise ValueError(f"a window runs from low to high, not from {window[0]} to {window[1]}")
        return self

    def opencv_window(self) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        """Lower and upper bound for ``cv2.inRange`` on an 8-bit HSV picture (H 0-180, S and V 0-255), inclusive."""
        if self.hue_window_percent is not None:
            hue = tuple(share * 1.8 for share in self.hue_window_percent)
        elif self.hue_window_deg is not None:
            hue = tuple(angle / 2.0 for angle in self.hue_window_deg)
        else:
            assert self.hue_window_half_deg is not None  # the validator's word
            hue = self.hue_window_half_deg
        sat = [share * 2.55 for share in self.saturation_window_percent]
        val = [share * 2.55 for share in self.value_window_percent]
        low = (math.ceil(hue[0]), math.ceil(sat[0]), math.ceil(val[0]))
        high = (math.floor(hue[1]), math.floor(sat[1] + 1e-9), math.floor(val[1] + 1e-9))
        return low, high


class FormSettings(Settings):
    """What has the form of soil, and what does not."""

    steepest_deg: Annotated[float, Field(gt=0, lt=89)] = Field(
        default=60.0, description="what rises steeper out of what lies beside it is no soil"
    )
    steep_spread_m: Positive = Field(
        default=0.0105, description="heights in cells in a row spread more than this: steep (soil at 45 deg: 6 mm)"
    )
    thing_core_percent: Percent = Field(
        default=20.0, description="a lump with less than this clear of steep cells is no soil"
    )
    thing_steps_percent: Percent = Field(
        default=40.0, description="a lump that ends in steps on more than this of its seen border is no soil"
    )
    thing_largest_l: Positive = Field(
        default=7.0,
        description="more than this without the form of soil is soil seen badly, or a heap of things: unknown",
    )
    doubtful_most_percent: Percent = Field(
        default=50.0, description="soil of which more than this lies beside something steep is dust, or buried: unknown"
    )
    lowest_m: Positive = Field(default=0.006, description="what is lower than this is ground")


class DepthSettings(Settings):
    """The depth rule: soil height above a ground that is fitted anew in every frame."""

    stride_px: int = Field(default=5, ge=1, le=16, description="every n-th row and column is used, at 848 across")
    cell_m: Positive = Field(default=0.02, le=0.1, description="size of a cell of the height map in blade coordinates")
    noise_factor_ratio: Positive = Field(
        default=4.0, description="soil must stand out by this many times the ground's unevenness and noise"
    )
    min_height_m: Positive = Field(default=0.012, description="and by at least this")
    max_height_m: Positive = Field(default=0.34, description="what is higher than this is no part of a heap")
    repose_deg: Annotated[float, Field(gt=0, lt=80)] = Field(
        default=30.0, description="slope given to hidden back faces"
    )
    ground_offset_limit_m: Positive = Field(
        default=0.055, description="ground is looked for so far above and below the calibrated one"
    )
    ground_slope_limit_deg: Positive = Field(
        default=8.0, description="ground tilted more than this is not judged (14 %)"
    )
    form: FormSettings = Field(default_factory=FormSettings)
    min_valid_percent: Percent = Field(
        default=40.0,
        description="less depth than this before a third: unknown (500 scenes without mud have 53 and more)",
    )
    none_volume_l: Positive = Field(default=1.2, description="less soil than this in front of the whole blade: none")
    ahead_min_percent: Percent = Field(
        default=20.0,
        description="soil ahead of less than this part of what is carried may be the heap's own roughness or its foot: "
        "unknown",
    )


class DecisionSettings(Settings):
    """From shares per third to a zone; the same for all methods."""

    margin_ratio: Annotated[float, Field(ge=1)] = Field(
        default=1.25, description="the fullest third leads by at least this"
    )
    even_share_min_percent: Percent = Field(default=20.0, description="even: no third holds less of the soil than this")
    even_share_max_percent: Percent = Field(default=48.0, description="even: no third holds more of the soil than this")
    max_frame_age_s: Positive = Field(default=0.1, le=1.0, description="a frame older than this is not judged: unknown")
    max_angle_age_s: Positive = Field(
        default=0.25, le=1.0, description="a blade angle older than this at capture: unknown"
    )


class HealthSettings(Settings):
    """When a picture is not to be trusted. A fault is named, and the zone is unknown while it lasts."""

    black_percent: Percent = Field(default=6.0, description="brightness below which a picture is black")
    blown_out_percent: Percent = Field(
        default=70.0, description="share of clipped pixels from which a picture is blown out"
    )
    blocked_flat_percent: Percent = Field(default=70.0, description="share of the picture without any texture: blocked")
    frozen_frames_n: int = Field(default=3, ge=0, description="so many identical pictures in a row: frozen; 0: never")
    blurred_ratio: NotNegative = Field(
        default=0.11, description="fine over coarse contrast below which a picture is blurred"
    )
    torn_s: Positive = Field(default=0.02, le=0.5, description="colour and depth taken further apart than this: torn")
    knocked_mm: Positive = Field(
        default=75.0, description="blade found further than this from where it should be: knocked"
    )
    knocked_deg: Positive = Field(default=4.0, description="blade found turned by more than this: knocked")
    knocked_axis_mm: Positive = Field(
        default=30.0, description="the blade's axis or edge further than this from its place: not the blade moved alone"
    )
    knocked_ground_mm: Positive = Field(
        default=55.0, description="ground further than this off the calibrated one, and the blade with it: knocked"
    )
    knocked_ground_deg: Positive = Field(
        default=3.4, description="ground tilted by more than this, and the blade with it: knocked"
    )
    knocked_missing_percent: Percent = Field(
        default=30.0, description="so much of the blade's face is not there: knocked"
    )
    depth_valid_percent: Percent = Field(
        25.0, description="less valid depth than this in the whole picture: depth_missing"
    )


class PerceptionSettings(Settings):
    """Section ``[perception]`` of the configuration file."""

    method: Method = "depth"
    color: ColorSettings = Field(default_factory=ColorSettings)
    depth: DepthSettings = Field(default_factory=DepthSettings)
    decision: DecisionSettings = Field(default_factory=DecisionSettings)
    health: HealthSettings = Field(default_factory=HealthSettings)

    def color_mark(self) -> str:
        """Changes with whatever a colour method's answer depends on."""
        text = self.color.model_dump_json(exclude={"site_figure"}) + self.decision.model_dump_json()
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def why_not_to_drive(self) -> str:
        """Why automatic operation may not go by this method's answers; empty where it may.

        Colour takes rust, plywood and shade for soil: it drives only where frames of the site have shown its worth.
        """
        if self.method not in COLOR_METHODS:
            return ""
        figure = self.color.site_figure
        if figure is None or figure.method != self.method:
            return f"perception goes by {self.method}, whose worth on this site nobody has measured"
        if figure.settings_mark != self.color_mark():
            return f"the settings of {self.method} are not those that were measured on this site"
        short = figure.falls_short()
        return f"{self.method} is not good enough on this site: {short}" if short else ""


class StreamCalibration(Settings):
    """One stream's lens and its place in the vehicle frame.

    Pose in words a person can measure: position in the vehicle frame; ``pitch_down_deg`` below the horizon;
    ``yaw_deg`` counter-clockwise seen from above, away from looking straight along the machine; ``roll_deg`` about the
    line of sight, clockwise as seen in the picture's own direction of view. Lens: pixels, centres at integers.
    """

    width_px: int = Field(gt=0)
    height_px: int = Field(gt=0)
    fx_px: Positive
    fy_px: Positive
    cx_px: Finite
    cy_px: Finite
    distortion_n: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position_x_m: Finite
    position_y_m: Finite
    position_z_m: Finite
    pitch_down_deg: Annotated[float, Field(gt=-89, lt=89)]
    yaw_deg: Finite = 0.0
    roll_deg: Finite = 0.0

    def intrinsics(self) -> Intrinsics:
        """The lens as the camera contract has it."""
        return Intrinsics(
            self.width_px, self.height_px, self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.distortion_n
        )

    def pose(self, mounting: Mounting) -> StreamPose:
        """The pose as position and rotation matrix (columns: optical axes in the vehicle frame)."""
        rotation = rotation_from_angles(mounting, self.pitch_down_deg, self.yaw_deg, self.roll_deg)
        rows = tuple((float(row[0]), float(row[1]), float(row[2])) for row in rotation)
        return StreamPose((self.position_x_m, self.position_y_m, self.position_z_m), (rows[0], rows[1], rows[2]))

    @classmethod
    def from_pose(cls, lens: Intrinsics, pose: StreamPose, mounting: Mounting) -> StreamCalibration:
        """The calibration of a stream with this lens and pose."""
        pitch, yaw, roll = angles_from_rotation(mounting, np.asarray(pose.rotation, dtype=np.float64))
        return cls(
            width_px=lens.width,
            height_px=lens.height,
            fx_px=lens.fx,
            fy_px=lens.fy,
            cx_px=lens.cx,
            cy_px=lens.cy,
            distortion_n=lens.coeffs,
            position_x_m=pose.position_m[0],
            position_y_m=pose.position_m[1],
            position_z_m=pose.position_m[2],
            pitch_down_deg=pitch,
            yaw_deg=yaw,
            roll_deg=roll,
        )


def rotation_from_angles(
    mounting: Mounting, pitch_down_deg: float, yaw_deg: float, roll_deg: float
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Rotation (3x3, optical to vehicle) of a camera that is rolled, then pitched, then yawed."""
    heading = 180.0 if mounting == "facing_blade_from_front" else 0.0
    pitch, yaw, roll = (math.radians(angle) for angle in (pitch_down_deg, yaw_deg + heading, roll_deg))
    cp, sp, c, s = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    # Columns: right (0, -1, 0) and down (-sp, 0, -cp), rolled about the line of sight, which is the third.
    unturned = np.array([[-sp * s, -sp * c, cp], [-c, s, 0.0], [-cp * s, -cp * c, -sp]])
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turn @ unturned, dtype=np.float64)


def angles_from_rotation(
    mounting: Mounting, rotation: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> tuple[float, float, float]:
    """Inverse of :func:`rotation_from_angles`: pitch down, yaw and roll in degrees."""
    heading = 180.0 if mounting == "facing_blade_from_front" else 0.0
    ahead = rotation[:, 2]
    pitch = math.degrees(math.asin(float(np.clip(-ahead[2], -1.0, 1.0))))
    yaw = math.degrees(math.atan2(ahead[1], ahead[0])) - heading
    yaw = (yaw + 180.0) % 360.0 - 180.0
    level = rotation_from_angles(mounting, pitch, yaw, 0.0)
    roll = math.degrees(math.atan2(float(level[:, 1] @ rotation[:, 0]), float(level[:, 0] @ rotation[:, 0])))
    return pitch, yaw, roll


def _nominal_color() -> StreamCalibration:
    return StreamCalibration(
        width_px=1280,
        height_px=800,
        fx_px=629.085,
        fy_px=629.085,
        cx_px=639.5,
        cy_px=399.5,
        position_x_m=0.8,
        position_y_m=0.0295,
        position_z_m=0.55,
        pitch_down_deg=35.0,
    )


def _nominal_depth() -> StreamCalibration:
    return StreamCalibration(
        width_px=848,
        height_px=480,
        fx_px=427.675,
        fy_px=427.675,
        cx_px=423.5,
        cy_px=239.5,
        position_x_m=0.8,
        position_y_m=-0.0295,
        position_z_m=0.55,
        pitch_down_deg=35.0,
    )


class CameraCalibration(Settings):
    """Section ``[camera.calibration]``: where both streams sit and which way the camera faces.

    ``mounting`` decides what left means: a camera ahead of the blade looks back at it, so the picture's left is the
    machine's right. The defaults are the nominal pose of the quarter-scale machine with a D455.
    """

    mounting: Mounting = "facing_blade_from_front"
    color: StreamCalibration = Field(default_factory=_nominal_color)
    depth: StreamCalibration = Field(default_factory=_nominal_depth)
    calibrated_at: str = Field(
        default="", description="when `graderd calibrate camera` wrote this; empty: nominal values"
    )
    residual_mm: NotNegative = Field(default=0.0, description="rms distance of the blade's points after calibration")
    residual_px: NotNegative = Field(default=0.0, description="rms distance of the blade's edge in the colour picture")


__all__ = [
    "METHODS",
    "BladeGeometry",
    "CameraCalibration",
    "ColorSettings",
    "DecisionSettings",
    "DepthSettings",
    "HealthSettings",
    "Method",
    "PerceptionSettings",
    "SiteFigure",
    "StreamCalibration",
    "angles_from_rotation",
    "rotation_from_angles",
]
