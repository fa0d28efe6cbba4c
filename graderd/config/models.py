"""The configuration file as one strict, frozen model. Sections carry the devices' names; numbers carry their units."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from graderd.api.settings import ApiLimits, TcpSettings
from graderd.core.attitude import Attitude, AttitudeGeometry, Preset, lift_extensions, tilt_extension
from graderd.core.axes import UNITS, AxisFigures
from graderd.core.blade import BladeGeometry
from graderd.core.gate import GateSettings
from graderd.core.lift_pair import LiftPairSettings
from graderd.core.machine import MachineSettings
from graderd.core.rule import RuleSettings
from graderd.hal.settings import (
    IN_TREE,
    PLUGIN,
    ActuatorSettings,
    AnyRotatorSettings,
    AnyStopInputSettings,
    CameraSettings,
    CanSettings,
    ElectrakSettings,
    NotNegative,
    Ph54Settings,
    PluginActuatorSettings,
    PluginCameraSettings,
    Positive,
    Settings,
    StopInputSettings,
    VehicleSettings,
    tag_of,
)
from graderd.perception.settings import CameraCalibration, PerceptionSettings


class ControlSettings(Settings):
    """The control tick, and how the daemon ends."""

    tick_hz: float = Field(50.0, ge=10, le=200, description="decisions a second; goals expire where it is too slow")
    overrun_s: Positive = Field(
        0.1,
        ge=0.02,
        le=2.0,
        description="a tick later than this is a fault; at 2 s the service's watchdog ends the daemon",
    )
    memory_warn_mb: Positive = Field(600.0, le=16_000, description="a daemon that takes more is told")
    shutdown_order: tuple[Literal["rotation", "actuators"], ...] = ("actuators", "rotation")
    shutdown_timeout_s: Positive = Field(
        1.5, le=10, description="for all devices together; then the wires are dropped; systemd waits longer"
    )

    @model_validator(mode="after")
    def _order(self) -> ControlSettings:
        if sorted(self.shutdown_order) != ["actuators", "rotation"]:
            raise ValueError("shutdown_order names rotation and actuators, each once")
        return self


class ApiSettings(Settings):
    """Where clients reach the daemon."""

    socket: str = Field("/run/graderd/graderd.sock", description="unix socket; its file rights decide who may use it")
    socket_mode: str = Field("0660", pattern=r"^0[0-7]{3}$")
    socket_group: str = Field("", description="group of the socket; empty: the daemon's own")
    tcp: TcpSettings | None = None
    limits: ApiLimits = Field(default_factory=ApiLimits)


class RecordingSettings(Settings):
    """What is recorded, and how much disk it may take. The black box (half a minute before and ten seconds after a
    stop, a disarm, a fault or a mark) is always on."""

    directory: str = Field(
        "", description="empty: recordings/ in $STATE_DIRECTORY as systemd gives it, else nothing is recorded"
    )
    runs: bool = Field(True, description="record every run; the black box goes on without")
    pictures_hz: NotNegative = Field(1.0, le=10, description="annotated pictures a second, black box included")
    raw: Literal["off", "reduced", "full"] = Field(
        "off", description="raw frames with a run, by which perception can be judged again; much disk"
    )
    raw_every_n: int = Field(10, ge=2, le=1000, description="raw = reduced: one frame of so many")
    max_mb: NotNegative = Field(2000.0, description="oldest runs go first, incidents last")
    min_free_mb: NotNegative = Field(200.0, description="recording pauses below this; control goes on")


class FoxgloveSettings(Settings):
    """A live view for Foxglove on a WebSocket of this machine alone: picture, thirds, blade, plots. Off without a port;
    wants the extra ``foxglove``."""

    port_n: int | None = Field(None, ge=1, le=65535, description="TCP port on 127.0.0.1, usually 8765; none: off")
    rate_hz: Positive = Field(20.0, le=20, description="statuses per second")
    pictures_hz: NotNegative = Field(5.0, le=15, description="pictures per second, while somebody looks at them")


class StateSettings(Settings):
    """What survives a restart: the reason of the last stop."""

    directory: str = Field("", description="empty: $STATE_DIRECTORY as systemd gives it, else nothing is kept")


class CameraSection(CameraSettings):
    """The camera with its calibration."""

    calibration: CameraCalibration = Field(default_factory=CameraCalibration)


UNSEEN_DEG = 20.0
"""As far as between two angles of the rule."""
LEAST_DUTY_PERCENT = 25
"""Below that an Electrak's motor may not break away."""
LIFT_SPEED = Field(
    50,
    ge=40,
    le=80,
    multiple_of=5,
    description="motor duty in full-speed moves; at 50 % one side that sticks is 6 mm behind before its feedback says "
    "so, at 80 % 9 mm",
)


class PluginCameraSection(PluginCameraSettings):
    """A camera by a driver from elsewhere, with its calibration."""

    calibration: CameraCalibration = Field(default_factory=CameraCalibration)


class LiftLeftSection(ElectrakSettings):
    """The left lift: an Electrak HD with no address pin wired."""

    speed_percent: int = LIFT_SPEED


class LiftRightSection(ElectrakSettings):
    """The right lift: the same unit with address select 1."""

    address_n: int = Field(20, ge=0, le=253)
    speed_percent: int = LIFT_SPEED


class TiltSection(ElectrakSettings):
    """The tilt: an Electrak MD of 500 N and 100 mm."""

    address_n: int = Field(27, ge=0, le=253)
    profile: str = "electrak_md_a050"
    min_mm: NotNegative = Field(3.0, le=1000)
    max_mm: Positive = Field(97.0, le=1000)
    window_mm: Positive = Field(94.0, le=1000)
    speed_mm_per_s: Positive = Field(25.0, le=100)
    acceleration_mm_per_s2: Positive = Field(100.0, le=1000)
    lead_mm: Positive = Field(15.0, ge=10, le=60)
    current_limit_a: Positive = Field(3.5, le=25.0)


def _presets() -> dict[str, Preset]:
    return {
        "cast_left": Preset(rotation_deg=30.0, height_mm=0.0, slope_deg=0.0),
        "cast_right": Preset(rotation_deg=-30.0, height_mm=0.0, slope_deg=0.0),
        "center": Preset(rotation_deg=0.0, height_mm=0.0, slope_deg=0.0, pitch_deg=0.0),
        "transport": Preset(rotation_deg=0.0, height_mm=150.0, slope_deg=0.0, lift_before_rotation=True),
        "ditch": Preset(rotation_deg=45.0, height_mm=20.0, slope_deg=6.0, lift_before_rotation=True),
    }


_Plugin = Annotated[PluginActuatorSettings, Tag(PLUGIN)]


class Config(Settings):
    """Everything. Sections that are absent take their defaults."""

    version: Literal[2] = 2
    simulated: bool = False
    camera: Annotated[
        Annotated[CameraSection, Tag(IN_TREE)] | Annotated[PluginCameraSection, Tag(PLUGIN)], Discriminator(tag_of)
    ] = Field(default_factory=CameraSection)
    perception: PerceptionSettings = Field(default_factory=PerceptionSettings)
    blade: BladeGeometry = Field(default_factory=BladeGeometry)
    rotation: AnyRotatorSettings = Field(default_factory=Ph54Settings)
    can: CanSettings = Field(default_factory=CanSettings)
    lift_left: Annotated[Annotated[LiftLeftSection, Tag(IN_TREE)] | _Plugin, Discriminator(tag_of)] = Field(
        default_factory=LiftLeftSection
    )
    lift_right: Annotated[Annotated[LiftRightSection, Tag(IN_TREE)] | _Plugin, Discriminator(tag_of)] = Field(
        default_factory=LiftRightSection
    )
    tilt: Annotated[Annotated[TiltSection, Tag(IN_TREE)] | _Plugin, Discriminator(tag_of)] = Field(
        default_factory=TiltSection
    )
    attitude: AttitudeGeometry = Field(default_factory=AttitudeGeometry)
    lift_pair: LiftPairSettings = Field(default_factory=LiftPairSettings)
    rule: RuleSettings = Field(default_factory=RuleSettings)
    gate: GateSettings = Field(default_factory=GateSettings)
    machine: MachineSettings = Field(default_factory=MachineSettings)
    control: ControlSettings = Field(default_factory=ControlSettings)
    api: ApiSettings = Field(default_factory=ApiSettings)
    recording: RecordingSettings = Field(default_factory=RecordingSettings)
    foxglove: FoxgloveSettings = Field(default_factory=FoxgloveSettings)
    state: StateSettings = Field(default_factory=StateSettings)
    stop_input: AnyStopInputSettings = Field(default_factory=StopInputSettings)
    vehicle: VehicleSettings = Field(default_factory=VehicleSettings)
    presets: dict[str, Preset] = Field(default_factory=_presets)

    def _beyond_presets(self) -> Iterator[str]:
        """Poses that cannot be taken up, of those that the file names: the built-in ones are told when they are asked
        for, so that narrow limits for first motions need no other poses."""
        if "presets" not in self.model_fields_set:
            return
        figures = self.figures()
        for name, preset in self.presets.items():
            goals: dict[str, float | None] = {"rotation": preset.rotation_deg}
            if preset.height_mm is not None:
                wanted = Attitude(preset.height_mm, preset.slope_deg or 0.0)
                goals["lift_left"], goals["lift_right"] = lift_extensions(self.attitude, wanted)
            if preset.pitch_deg is not None:
                goals["tilt"] = tilt_extension(self.attitude, preset.pitch_deg)
            for axis, value in goals.items():
                low, high = figures[axis].low, figures[axis].high
                if value is not None and not low <= value <= high:
                    unit = UNITS[axis]
                    yield f"presets.{name} needs {axis} at {value:.1f} {unit}, outside its {low:g} to {high:g} {unit}"

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        electraks = {name: axis for name, axis in self.actuators().items() if isinstance(axis, ElectrakSettings)}
        addresses = {name: axis.address_n for name, axis in electraks.items()} | {"can": self.can.source_address_n}
        if len(set(addresses.values())) != len(addresses):
            *some, last = addresses
            raise ValueError(
                f"{', '.join(some)} and {last} need {len(addresses)} different addresses, not "
                f"{list(addresses.values())}"
            )
        for zone, angle_deg in (
            ("left_deg", self.rule.left_deg),
            ("right_deg", self.rule.right_deg),
            ("center_deg", self.rule.center_deg),
            ("even_deg", self.rule.even_deg),
        ):
            if not self.rotation.min_deg <= angle_deg <= self.rotation.max_deg:
                raise ValueError(f"rule.{zone} ({angle_deg:g}) lies outside rotation.min_deg..max_deg")
        needed_n, age_s, rate_hz = self.rule.votes_needed_n, self.rule.vote_max_age_s, self.camera.rate_hz
        if rate_hz * age_s < needed_n - 1:
            raise ValueError(
                f"at camera.rate_hz ({rate_hz:g}) the rule.votes_needed_n ({needed_n}) pictures that must agree never "
                f"all lie within rule.vote_max_age_s ({age_s:g}): automatic operation could not decide anything. Raise "
                f"the one or the other until their product is {needed_n - 1} or more"
            )
        for problem in self._beyond_presets():
            raise ValueError(problem)
        for problem in self._unkept():
            raise ValueError(problem)
        return self

    def _unkept(self) -> Iterator[str]:
        """What a detector or a dead man needs of other settings and does not get: one line each, with its remedy."""
        tick_s = 1.0 / self.control.tick_hz
        rotation, pair = self.rotation, self.lift_pair
        ticks = ("control.tick_hz", tick_s)
        unseen_s = [rotation.max_age_s, rotation.goal_timeout_s]
        needs = [
            ("machine.lease_s", self.machine.lease_s, 2, ticks),
            ("rotation.goal_timeout_s", rotation.goal_timeout_s, 2, ticks),
            *((f"{axis}.target_timeout_s", own.target_timeout_s, 2, ticks) for axis, own in self.actuators().items()),
            ("control.overrun_s", self.control.overrun_s, 1, ticks),
            ("lift_pair.silent_s", pair.silent_s, 1, ticks),
            ("rotation.not_moving_s", rotation.not_moving_s, 3, ticks),
            *((f"{axis}.not_moving_s", own.not_moving_s, 3, ticks) for axis, own in self.actuators().items()),
        ]
        if isinstance(rotation, Ph54Settings):
            polls = ("rotation.poll_hz", 1.0 / rotation.poll_hz)
            needs += [
                ("rotation.max_age_s", rotation.max_age_s, 2, polls),
                ("rotation.reply_timeout_s", rotation.reply_timeout_s, 2, polls),
                ("rotation.watchdog_s", rotation.watchdog_s, 2, polls),
                ("rotation.not_moving_s", rotation.not_moving_s, 3, polls),
            ]
            unseen_s.append(rotation.watchdog_s)
        for name, value_s, periods_n, (rate, period_s) in needs:
            if value_s < periods_n * period_s - 1e-9:
                yield (
                    f"{name} ({value_s:g}) is shorter than {periods_n} periods of {rate} ({1.0 / period_s:g}): what it "
                    "watches could not come in time; raise the one or the other"
                )
        unseen_deg = rotation.speed_deg_per_s * max(unseen_s)
        if unseen_deg > UNSEEN_DEG:
            yield (
                f"rotation.speed_deg_per_s ({rotation.speed_deg_per_s:g}) with rotation.max_age_s, goal_timeout_s "
                f"and watchdog_s lets the blade turn {unseen_deg:.0f}° with nobody watching, "
                f"{UNSEEN_DEG:g}° at most: lower the one or the others"
            )
        for axis, section in self.lifts().items():
            if pair.reading_max_age_s > section.max_age_s:
                yield (
                    f"lift_pair.reading_max_age_s ({pair.reading_max_age_s:g}) is above {axis}.max_age_s "
                    f"({section.max_age_s:g}): the pair would never name the side that is lost; lower it"
                )
            if isinstance(section, ElectrakSettings) and pair.min_share * section.speed_percent < LEAST_DUTY_PERCENT:
                yield (
                    f"lift_pair.min_share ({pair.min_share:g}) of {axis}.speed_percent ({section.speed_percent}) is "
                    f"below the {LEAST_DUTY_PERCENT} % duty at which a lift moves; raise it"
                )

    def sha256(self) -> str:
        """Digest of the whole, defaults included: recordings and the commissioning record name it."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def lifts(self) -> dict[str, ActuatorSettings]:
        """The sections of the two lifts by axis."""
        return {"lift_left": self.lift_left, "lift_right": self.lift_right}

    def figures(self) -> dict[str, AxisFigures]:
        """The figures of every axis: the sections of the devices are their only source."""
        rotation = self.rotation
        return {
            "rotation": AxisFigures(
                low=rotation.min_deg,
                high=rotation.max_deg,
                window=rotation.window_deg,
                speed=rotation.speed_deg_per_s,
                acceleration=rotation.acceleration_deg_per_s2,
                lead=rotation.lead_deg,
                tolerance=rotation.tolerance_deg,
                max_age_s=rotation.max_age_s,
                profile_in_device=rotation.profile_in_device,
            ),
            **{name: _actuator_figures(section) for name, section in self.actuators().items()},
        }

    def actuators(self) -> dict[str, ActuatorSettings]:
        """The sections of the actuators by axis."""
        return {"lift_left": self.lift_left, "lift_right": self.lift_right, "tilt": self.tilt}


def _actuator_figures(section: ActuatorSettings) -> AxisFigures:
    return AxisFigures(
        low=section.min_mm,
        high=section.max_mm,
        window=section.window_mm,
        speed=section.speed_mm_per_s,
        acceleration=section.acceleration_mm_per_s2,
        lead=section.lead_mm,
        tolerance=section.tolerance_mm,
        max_age_s=section.max_age_s,
    )
