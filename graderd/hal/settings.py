"""Settings of the devices, as the drivers take them. ``graderd.config`` composes them into the configuration file.

Every number carries its unit in its name. Unknown keys are errors. Ranges are the device's where a manual gives them.

Each device names its driver: one of graderd's own by a word, or one that comes from elsewhere as
``package.module:NAME`` (docs/developers/add-a-device.md). What every driver of a device takes stands in the base class;
a driver from elsewhere has its own keys in the section's table ``driver`` and a model of its own that checks them.
"""

from __future__ import annotations

import difflib
import re
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, JsonValue, Tag, model_validator

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


PROFILE_MARGIN = 1.2
"""A driver follows a goal that the gate moves by so much faster: following it is no second regulator."""


class Settings(BaseModel):
    """Base of all settings: frozen, strict about unknown keys, defaults checked too. A section's own validator is built
    when that section is first made alone: none of a process that reads no configuration, and none twice."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, defer_build=True)


_PLUGIN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
PLUGIN: Literal["plugin"] = "plugin"
"""Tag of the models that take a driver from elsewhere."""
IN_TREE: Literal["in_tree"] = "in_tree"
"""Tag of the models of graderd's own drivers."""


def is_plugin(name: str) -> bool:
    """Whether ``name`` is a driver from elsewhere, ``package.module:NAME``."""
    return _PLUGIN.fullmatch(name) is not None


def _one_of(*own: str) -> AfterValidator:
    """A driver's name: one of graderd's own, or a plug-in."""

    def check(name: str) -> str:
        if name in own or is_plugin(name):
            return name
        near = difflib.get_close_matches(name, own, n=1)
        remedy = f"Did you mean {near[0]}?" if near else "Name another's driver as package.module:NAME"
        raise ValueError(f"no such driver; there is {', '.join(own)}. {remedy}")

    return AfterValidator(check)


def tag_of(section: Any) -> str:
    """The tag of a section's model, told by the driver that it names."""
    if isinstance(section, dict):
        name = section.get("backend", section.get("source"))
    else:
        name = getattr(section, "backend", getattr(section, "source", None))
    return PLUGIN if isinstance(name, str) and is_plugin(name) else IN_TREE


DriverTable = Annotated[
    dict[str, JsonValue], Field(default_factory=dict, description="the driver's own keys, checked by its own model")
]


class RotatorSettings(Settings):
    """Blade rotation, whatever turns it.

    ``profile_in_device``: speed and acceleration live in the device, which takes a far goal; else the gate moves the
    goal by them.
    """

    profile_in_device: ClassVar[bool] = False

    backend: Annotated[str, _one_of("ph54")] = Field("ph54", description="driver: ph54, or package.module:NAME")
    min_deg: Finite = Field(-60.0, ge=-180, le=180, description="limit at the blade, for gate and driver alike")
    max_deg: Finite = Field(60.0, ge=-180, le=180, description="limit at the blade, for gate and driver alike")
    window_deg: Positive = Field(
        120.0, le=360, description="largest distance from where the blade stood when it was armed; 360: no window"
    )
    speed_deg_per_s: Positive = Field(
        25.0, le=90, description="largest speed of the blade, half the servo's own at most"
    )
    acceleration_deg_per_s2: Positive = Field(
        50.0, ge=5, le=1000, description="largest change of that speed; the servo brakes with it, so not too little"
    )
    lead_deg: Positive = Field(
        10.0,
        le=20,
        description="how far the goal may be ahead of the blade: it moves on so far when freed; less than "
        "speed²/2·acceleration slows it down",
    )
    tolerance_deg: Positive = Field(0.5, le=3, description="so near the goal counts as arrived, and as no movement")
    max_age_s: Positive = Field(
        0.2,
        le=2.5,
        description="an older angle counts as unknown: the rotation holds; 2.5 s only where it turns slowly",
    )
    goal_timeout_s: Positive = Field(
        0.2,
        le=1.0,
        description="a goal not renewed for so long becomes a hold: the blade turns no longer after a dead tick",
    )
    not_moving_s: Positive = Field(
        0.7, ge=0.3, le=5.0, description="goal ahead and no movement for so long: the motor would heat up against a jam"
    )

    @model_validator(mode="after")
    def _limits(self) -> RotatorSettings:
        if self.min_deg >= self.max_deg:
            raise ValueError(f"min_deg ({self.min_deg}) must be below max_deg ({self.max_deg})")
        return self

    @property
    def profile_velocity_deg_per_s(self) -> float:
        """The driver's own profile; see :attr:`profile_in_device`."""
        return self.speed_deg_per_s * (1.0 if self.profile_in_device else PROFILE_MARGIN)

    @property
    def profile_acceleration_deg_per_s2(self) -> float:
        """See :attr:`profile_velocity_deg_per_s`; this is also how hard an ordinary stop brakes."""
        return self.acceleration_deg_per_s2 * (1.0 if self.profile_in_device else PROFILE_MARGIN)


class Ph54Settings(RotatorSettings):
    """Blade rotation: ROBOTIS PH54-200-S500-R on a serial port.

    Calibration: ``blade_deg = sign * servo_deg / gear_ratio - zero_deg`` with servo_deg from the device's own zero
    (Homing Offset stays 0).
    """

    profile_in_device: ClassVar[bool] = True

    port: str = Field("/dev/graderd/servo", description="serial port, or a udev symlink to it")
    usb_serial_number: str = Field("", description="find the port by the adapter's USB serial number; empty: use port")
    baud_n: int = Field(57_600, gt=0, description="bits per second; the factory setting of the PH54 is 57,600")
    servo_id_n: int = Field(1, ge=0, le=252)
    profile: str = Field(
        "ph54_200_s500",
        description="control table: its name in firmware_profiles, or path of one that 'graderd profile import' wrote",
    )
    zero_deg: Finite = Field(
        0.0, ge=-360, le=360, description="blade angle read at the servo's zero, subtracted; within one turn"
    )
    sign: Literal[1, -1] = Field(1, description="-1 where the servo turns the blade the other way round")
    gear_ratio: Positive = Field(
        1.0, ge=0.1, le=20, description="servo turns for one blade turn; beyond that its angle or its speed is none"
    )
    current_limit_a: Positive | None = Field(
        None, le=22.74, description="None: the servo's continuous rating, 9.3 A of the PH54-200"
    )
    watchdog_s: Positive = Field(0.2, le=2.54, description="the servo's own bus watchdog, steps of 20 ms")
    poll_hz: Positive = Field(50.0, le=200, description="telemetry reads a second")
    reply_timeout_s: Positive = Field(
        0.25, le=1.5, description="no valid reply for so long: the servo is lost; its own watchdog acts before"
    )
    voltage_warn_low_v: Positive = Field(20.0, le=30, description="below that a warning; the servo takes 24 V")
    voltage_warn_high_v: Positive = Field(30.0, le=35, description="above that a warning")
    temperature_warn_c: Positive = Field(70.0, le=80, description="a warning before the servo switches off at 80 °C")
    torque_at_disarm: Literal["off", "on"] = "off"
    torque_at_exit: Literal["off", "on"] = "off"


class PluginRotatorSettings(RotatorSettings):
    """Blade rotation by a driver from elsewhere."""

    driver: DriverTable


AnyRotatorSettings = Annotated[
    Annotated[Ph54Settings, Tag(IN_TREE)] | Annotated[PluginRotatorSettings, Tag(PLUGIN)], Discriminator(tag_of)
]


class CanSettings(Settings):
    """The J1939 bus, opened by python-can."""

    interface: Literal["socketcan", "slcan", "virtual"] = "socketcan"
    channel: str = Field("can0", description="network interface, or the port of an slcan adapter")
    bitrate_n: int = Field(250_000, gt=0, description="Electrak CNO: 250 kbit/s")
    source_address_n: int = Field(
        0xE7, ge=0, le=253, description="our preferred address: 231, land levelling supervisor"
    )
    name_manufacturer_n: int = Field(0, ge=0, le=2047, description="SAE manufacturer code; 0: none assigned to graderd")
    name_identity_n: int = Field(1, ge=0, le=0x1FFFFF)
    name_function_n: int = Field(132, ge=0, le=255, description="132: single land levelling system supervisor")
    name_function_instance_n: int = Field(0, ge=0, le=31)
    name_ecu_instance_n: int = Field(0, ge=0, le=7)
    name_vehicle_system_n: int = Field(0, ge=0, le=127)
    name_vehicle_system_instance_n: int = Field(0, ge=0, le=15)
    name_industry_group_n: int = Field(3, ge=0, le=7, description="3: construction equipment")
    name_arbitrary_address: bool = Field(True, description="take another address where ours is contested and lost")
    obey_commanded_address: bool = False
    stop_pgn_n: int | None = Field(None, ge=0, le=0x3FFFF, description="a PGN of your choice whose arrival means stop")
    stop_on_iso11783_all_stop: bool = Field(True, description="obey ISO 11783-7 'stop all implement operations'")


class ActuatorSettings(Settings):
    """One linear actuator, whatever it is. The three instances are ``lift_left``, ``lift_right`` and ``tilt``."""

    backend: Annotated[str, _one_of("electrak")] = Field(
        "electrak", description="driver: electrak, or package.module:NAME"
    )
    min_mm: NotNegative = Field(5.0, le=1000, description="limit of extension, for gate and driver alike")
    max_mm: Positive = Field(295.0, le=1000, description="limit of extension, for gate and driver alike")
    window_mm: Positive = Field(
        290.0, le=1000, description="largest distance from where the axis stood when it was armed"
    )
    speed_mm_per_s: Positive = Field(60.0, le=100, description="largest speed of the goal; no Electrak does 100")
    acceleration_mm_per_s2: Positive = Field(
        200.0, le=1000, description="largest change of that speed; the lifts start softly by themselves instead"
    )
    lead_mm: Positive = Field(
        30.0,
        ge=10,
        le=60,
        description="how far the goal may run ahead of an axis that is held back; it moves on so far at most",
    )
    tolerance_mm: Positive = Field(
        1.5, le=5, description="so near the goal counts as arrived; Electraks rest 1-2 mm short"
    )
    max_age_s: Positive = Field(
        0.4, ge=0.25, le=2.5, description="an older position counts as unknown; feedback comes every 105 ms"
    )
    target_timeout_s: Positive = Field(
        0.3,
        le=1.0,
        description="a target not renewed for so long becomes a hold: the axis moves no longer after a dead tick",
    )
    not_moving_s: Positive = Field(
        0.7,
        ge=0.3,
        le=5.0,
        description="target ahead and no movement for so long: a motor heats up against a jam",
    )
    reaction_s: Positive = Field(
        0.25,
        le=0.5,
        description="from a target to the first position that shows its effect, and from a hold likewise: "
        "an Electrak's control message, feedback and ramp; what moves on longer is told as uncommanded",
    )
    fastest_mm_per_s: Positive = Field(
        75.0, le=150, description="fastest that the device moves whatever it is told; an Electrak without load 71"
    )
    braking_mm_per_s2: Positive = Field(
        500.0, ge=50, le=10_000, description="how hard the device brakes at least; an Electrak's brake much harder"
    )

    @model_validator(mode="after")
    def _limits(self) -> ActuatorSettings:
        if self.min_mm >= self.max_mm:
            raise ValueError(f"min_mm ({self.min_mm}) must be below max_mm ({self.max_mm})")
        return self


class ElectrakSettings(ActuatorSettings):
    """One Electrak on the J1939 bus."""

    address_n: int = Field(19, ge=0, le=253, description="J1939 source address of the actuator")
    profile: str = Field("electrak_hd_b017", description="name of the layout in firmware_profiles")
    current_limit_a: Positive = Field(18.0, le=25.0)
    speed_percent: int = Field(80, ge=20, le=100, multiple_of=5, description="motor duty in full-speed moves")
    feedback_timeout_s: Positive = Field(
        0.35, ge=0.25, le=1.0, description="three missing feedback messages: the actuator is lost"
    )
    overload_retries_n: int = Field(0, ge=0, le=5, description="automatic retries after an overload before it latches")
    figures: dict[str, NotNegative] = Field(
        default_factory=dict,
        description="measured figures that replace the profile's, for example {speed_no_load_mm_per_s = 24.5}",
    )


class PluginActuatorSettings(ActuatorSettings):
    """One linear actuator by a driver from elsewhere; its stroke is not graderd's to guess."""

    min_mm: NotNegative = Field(le=1000, description="limit of extension, for gate and driver alike")
    max_mm: Positive = Field(le=1000, description="limit of extension, for gate and driver alike")
    driver: DriverTable


class StopInputSettings(Settings):
    """A normally closed loop whose opening stops the machine: buttons, gate switches, a contact of the safety relay."""

    backend: Annotated[str, _one_of("none", "serial", "gpio", "simulated")] = Field(
        "none",
        description="serial: modem lines of a serial port; gpio: two lines of a GPIO chip; or package.module:NAME",
    )
    port: str = Field("", description="serial port, GPIO chip (/dev/gpiochip0), or the simulated loop's socket")
    drive: Literal["rts", "dtr"] = Field("rts", description="serial: output that drives the loop")
    line: Literal["cts", "dsr", "cd"] = Field("cts", description="serial: input at the loop's end")
    gpio_drive_n: int = Field(0, ge=0, description="gpio: number of the line that drives the loop")
    gpio_sense_n: int = Field(1, ge=0, description="gpio: number of the line at the loop's end")
    gpio_pull_down: bool = Field(True, description="gpio: the chip pulls the input down; false: a resistor does")
    poll_hz: Positive = Field(100.0, ge=10, le=1000, description="looks at the loop a second")
    open_samples_n: int = Field(2, ge=1, le=10, description="open in so many looks: stop; three closed ones undo one")
    stale_s: Positive = Field(0.2, le=1.0, description="no look for so long: stop; a pressed button acts within that")
    test_every_s: NotNegative = Field(
        10.0,
        le=600,
        description="test pulse that finds a short circuit; 0: none; so long a short circuit may stay unseen",
    )

    @model_validator(mode="after")
    def _port(self) -> StopInputSettings:
        if self.backend in ("serial", "gpio") and not self.port:
            raise ValueError(f"backend {self.backend} needs a port")
        if self.backend == "gpio" and self.gpio_drive_n == self.gpio_sense_n:
            raise ValueError("gpio_drive_n and gpio_sense_n must be two lines")
        return self


class PluginStopInputSettings(StopInputSettings):
    """A stop input by a driver from elsewhere."""

    driver: DriverTable


AnyStopInputSettings = Annotated[
    Annotated[StopInputSettings, Tag(IN_TREE)] | Annotated[PluginStopInputSettings, Tag(PLUGIN)], Discriminator(tag_of)
]


DepthPreset = Literal["custom", "default", "hand", "high_accuracy", "high_density", "medium_density"]
DEPTH_PRESETS: tuple[str, ...] = get_args(DepthPreset)
"""In the order of their numbers (librealsense, ``rs2_rs400_visual_preset``)."""


class VehicleSettings(Settings):
    """Where the machine's speed comes from. Without it a decision is kept by time instead of travel."""

    source: Literal["none", "j1939", "simulated"] = Field(
        "none", description="j1939: wheel-based speed (PGN 65265, SPN 84) on the bus of the actuators"
    )
    address_n: int | None = Field(
        None, ge=0, le=253, description="j1939: believe this address alone; none: whichever sends it, one at a time"
    )
    path: str = Field("", description="simulated: the rig's control socket")
    max_age_s: Positive = Field(0.5, le=5, description="an older speed counts as unknown; J1939 sends it every 0.1 s")


class CameraSettings(Settings):
    """Where pictures come from and how the camera is set."""

    source: Annotated[str, _one_of("realsense", "recording", "rig", "folder", "video", "frame_set")] = Field(
        "realsense",
        description="realsense, recording, rig, folder, video, frame_set, or a driver's package.module:NAME",
    )
    path: str = Field("", description="recording, folder, video, frame set, or the rig's camera socket")
    serial_number: str = Field("", description="of the RealSense camera; empty: the only one attached")
    color_width_px: int = Field(1280, gt=0)
    color_height_px: int = Field(800, gt=0)
    depth_width_px: int = Field(848, ge=0, description="0: colour only")
    depth_height_px: int = Field(480, ge=0)
    rate_hz: Positive = Field(30.0, le=90, description="pictures a second; no camera of the family gives more")
    repeat: bool = Field(False, description="start a recording or folder over at its end")
    exposure_us: Positive | None = Field(None, description="None: automatic")
    gain: Positive | None = None
    white_balance_k: Positive | None = Field(4600.0, description="None: automatic (not advised: colour would drift)")
    depth_preset: DepthPreset | None = Field(
        "default", description="of a RealSense's depth sensor; None: left as it is"
    )
    depth_emitter: bool = Field(
        True, description="the infrared pattern: needed in the dark and on ground without texture"
    )
    depth_laser_mw: Positive | None = Field(150.0, description="of the pattern; None: as the preset has it")
    depth_exposure_us: Positive | None = Field(None, description="of the infrared imagers; None: automatic")
    depth_gain: Positive | None = None
    stale_s: Positive = Field(
        0.5, le=60, description="no frame for so long: unknown at once; a minute only with pictures that come as slowly"
    )
    restart_s: Positive = Field(2.0, le=600, description="no frame for so long: the worker process is restarted")


class PluginCameraSettings(CameraSettings):
    """A camera by a driver from elsewhere."""

    driver: DriverTable


AnyCameraSettings = Annotated[
    Annotated[CameraSettings, Tag(IN_TREE)] | Annotated[PluginCameraSettings, Tag(PLUGIN)], Discriminator(tag_of)
]
