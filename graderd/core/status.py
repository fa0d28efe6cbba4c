"""What the daemon tells its clients: one model for HTTP, WebSocket, CLI, page and records. Units are in the names.

What was measured is null where it is not known, or no more, and its age stands beside it; everything else is of the
tick at ``time_s``.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from graderd.core.machine import Mode
from graderd.core.soil import Profile, Zone
from graderd.hal.device import Lifecycle


class _Status(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class AxisStatus(_Status):
    """One axis, in degrees (rotation) or millimetres: requested, limited, sent and measured are all visible.

    ``arrived``: it stands where it was asked to go, within its tolerance. What was measured is None once it is older
    than control would act on; what changes slowly (voltage, temperature, torque, flags, thermal load), once it is older
    than 5 s. ``ages_s``: how old each measured value is, and what was ``sent``, by its name; none for what is None.
    ``measured_age_s`` goes on telling how old the last position is. ``flags``: the device's own that are set."""

    name: str
    unit: str
    lifecycle: Lifecycle
    requested: float | None = None
    limited: float | None = None
    limited_because: str = ""
    arrived: bool = False
    sent: float | None = None
    measured: float | None = None
    measured_age_s: float | None = None
    velocity_per_s: float | None = None
    current_a: float | None = None
    torque_nm: float | None = None
    voltage_v: float | None = None
    temperature_c: float | None = None
    duty_percent: float | None = None
    moving: bool | None = None
    in_position: bool | None = None
    torque_on: bool | None = None
    thermal_load: float | None = None
    flags: tuple[str, ...] | None = None
    ages_s: dict[str, float] = {}
    counters: dict[str, int] = {}


class AttitudeStatus(_Status):
    """Blade attitude from the actuators' extensions; None where an extension is not known. ``lifts_age_s``: of the
    older of the two that height and slope come from."""

    height_mm: float | None = None
    slope_deg: float | None = None
    lifts_age_s: float | None = None
    pitch_deg: float | None = None
    pitch_age_s: float | None = None


class ThirdsStatus(_Status):
    """Litres by the third of the blade."""

    left_l: float
    center_l: float
    right_l: float


class AheadStatus(ThirdsStatus):
    """The soil that the blade will meet, by the third that will meet it; a decision is taken from this."""

    zone: Zone
    confidence: float
    reason: str


class SoilStatus(_Status):
    """The newest observation of the soil: all that lies in front of the blade, and told apart what lies ahead and what
    it carries; these two, and the litres, are null where the method has no depth. Once its picture is too old, ``zone``
    is unknown, and so is the rest: where ``zone`` is unknown no share is told. ``age_s`` is of the picture that all of
    it is from. ``profile_mm``: how high the soil stands above the ground along the blade, at its highest before each of
    24 equal parts from the left end to the right; null for a part that was not seen, and as a whole where the method
    has no depth."""

    zone: Zone = Zone.UNKNOWN
    confidence: float = 0.0
    reason: str = "no picture yet"
    age_s: float | None = None
    share_left: float | None = None
    share_center: float | None = None
    share_right: float | None = None
    volume_left_l: float | None = None
    volume_center_l: float | None = None
    volume_right_l: float | None = None
    ahead: AheadStatus | None = None
    carried: ThirdsStatus | None = None
    profile_mm: Profile | None = None
    blade_angle_deg: float | None = None
    frame_number_n: int = -1
    frames_per_s: float = 0.0
    method: str = ""


class DecisionStatus(_Status):
    """What automatic operation decided last. ``kept``: it stands for a pass that is not over, for ``since_m`` so far,
    with what the machine may have driven while it did not tell (null where it never did). ``angle_deg`` null with a
    zone: a hold took it away in mid-pass. ``decisions_n``: since the daemon's start."""

    zone: Zone | None = None
    angle_deg: float | None = None
    age_s: float | None = None
    kept: bool = False
    since_m: float | None = None
    reason: str = ""
    decisions_n: int = 0


class VehicleStatus(_Status):
    """How the machine drives, as far as it says; ``age_s``: of the speed."""

    speed_m_per_s: float | None = None
    age_s: float | None = None
    travelled_m: float | None = None
    travelled_age_s: float | None = None


class FaultStatus(_Status):
    """One active fault, with what to do about it."""

    name: str
    reads: str
    detail: str
    remedy: str
    reaction: str
    clears: str
    age_s: float
    present: bool


class RequirementStatus(_Status):
    """One requirement for arming."""

    name: str
    met: bool
    mandatory: bool
    reason: str
    remedy: str


class LeaseStatus(_Status):
    """Who may move the blade now."""

    client: str
    remaining_s: float


class CameraStatus(_Status):
    """The perception worker and its camera. ``settings_read_back``: what the camera itself said it was set to, when it
    was opened last, ``settings_age_s`` ago. ``frames_n``: observations since the daemon's start."""

    lifecycle: Lifecycle = Lifecycle.CLOSED
    description: str = ""
    frames_n: int = 0
    restarts_n: int = 0
    recovery: str = ""
    settings_read_back: dict[str, float] = {}
    settings_age_s: float | None = None


class TickStatus(_Status):
    """Health of the control tick; ``ticks_n``: since the daemon's start, ``lateness_p99_ms``: of the last 500."""

    rate_hz: float = 0.0
    ticks_n: int = 0
    overruns_n: int = 0
    lateness_p99_ms: float = 0.0


class RecordingStatus(_Status):
    """The recorder. ``run``, ``incident``: such a file is open; ``waiting_n``: what is not in it yet; ``lost_n``: ticks
    that disk or processor were too slow for, since the daemon's start."""

    run: bool = False
    incident: bool = False
    waiting_n: int = 0
    lost_n: int = 0


class Status(_Status):
    """Everything at one moment. ``time_s`` is monotonic, ``wall_time`` ISO 8601 UTC."""

    time_s: float
    wall_time: str
    version: str
    simulated: bool
    mode: Mode
    reason: str
    arming: bool = False
    holding: tuple[str, ...] = ()
    last_stop: str = ""
    stop_n: int = 0
    soil: SoilStatus = SoilStatus()
    decision: DecisionStatus = DecisionStatus()
    vehicle: VehicleStatus = VehicleStatus()
    axes: dict[str, AxisStatus] = {}
    attitude: AttitudeStatus = AttitudeStatus()
    faults: tuple[FaultStatus, ...] = ()
    readiness: tuple[RequirementStatus, ...] = ()
    lease: LeaseStatus | None = None
    camera: CameraStatus = CameraStatus()
    tick: TickStatus = TickStatus()
    recording: RecordingStatus = RecordingStatus()
    presets: tuple[str, ...] = ()
