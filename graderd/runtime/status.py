"""Builds the status model from what the last tick knew and decided."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from typing import Any

from graderd.config import Config
from graderd.core.attitude import MeasuredAttitude
from graderd.core.axes import LIFTS, UNITS
from graderd.core.readiness import Requirement
from graderd.core.soil import SoilAhead, SoilObservation, Thirds, Zone
from graderd.core.status import (
    AheadStatus,
    AttitudeStatus,
    AxisStatus,
    DecisionStatus,
    FaultStatus,
    LeaseStatus,
    RecordingStatus,
    RequirementStatus,
    SoilStatus,
    Status,
    ThirdsStatus,
    TickStatus,
    VehicleStatus,
)
from graderd.core.tick import AxisSensed, AxisTick, Sensed
from graderd.hal.linear_actuator import ActuatorTelemetry
from graderd.hal.reading import Reading
from graderd.hal.rotator import RotatorTelemetry
from graderd.hal.vehicle import VehicleTelemetry
from graderd.perception.settings import DecisionSettings
from graderd.runtime.control import ControlLoop
from graderd.runtime.perception_supervisor import PerceptionSupervisor

VEHICLE_MAX_AGE_S = 1.0
"""How the machine drives is unknown when nobody has told it for so long."""
VERSION = version("graderd")
KNOWN_FOR_S = 5.0
NOT_RECORDED = RecordingStatus()


def build_status(
    config: Config, loop: ControlLoop, eyes: PerceptionSupervisor, recording: RecordingStatus = NOT_RECORDED
) -> Status:
    """The state at the last tick."""
    tick, sensed = loop.tick, loop.sensed
    now_s, state, decision = tick.now_s, tick.state, tick.state.decision
    lateness = sorted(loop.lateness_s)
    return Status(
        time_s=now_s,
        wall_time=datetime.now(UTC).isoformat(timespec="milliseconds"),
        version=VERSION,
        simulated=config.simulated,
        mode=state.mode,
        reason=state.reason,
        arming=state.arming_since_s is not None,
        holding=state.holding,
        last_stop=str(loop.last_stop) if loop.last_stop else "",
        stop_n=state.stop_n,
        soil=_soil(tick.soil, eyes.frames_per_s, now_s, config.perception.decision),
        decision=DecisionStatus(
            zone=decision.zone,
            angle_deg=decision.angle_deg,
            age_s=now_s - decision.decided_s if decision.zone is not None else None,
            kept=decision.kept,
            since_m=None if decision.told is None else decision.since_m,
            reason=decision.reason(now_s),
            decisions_n=loop.decisions_n,
        ),
        vehicle=_vehicle(sensed.vehicle, now_s),
        axes={
            name: _axis(name, told, tick.axes[name], now_s, loop.figures[name].max_age_s)
            for name, told in sensed.axes.items()
        },
        attitude=_attitude(tick.attitude, sensed, now_s),
        faults=tuple(
            FaultStatus(
                name=f.name,
                reads=f.row.reads,
                detail=f.detail,
                remedy=f.row.remedy,
                reaction=f.row.reaction.name.lower(),
                clears=f.row.clear,
                age_s=max(0.0, now_s - f.since_s),
                present=f.present,
            )
            for f in tick.faults
        ),
        readiness=tuple(_requirement(r) for r in tick.readiness),
        lease=LeaseStatus(client=state.lease.client, remaining_s=max(0.0, state.lease.expires_s - now_s))
        if state.lease
        else None,
        camera=eyes.status(),
        tick=TickStatus(
            rate_hz=config.control.tick_hz,
            ticks_n=loop.ticks_n,
            overruns_n=tick.overruns_n,
            lateness_p99_ms=lateness[int(0.99 * (len(lateness) - 1))] * 1e3 if lateness else 0.0,
        ),
        recording=recording,
        presets=tuple(config.presets),
    )


@lru_cache(maxsize=64)
def _requirement(told: Requirement) -> RequirementStatus:
    """Most are the same from tick to tick."""
    return RequirementStatus(**told._asdict())


def _soil(newest: SoilObservation | None, frames_per_s: float, now_s: float, settings: DecisionSettings) -> SoilStatus:
    """How much lies where is told as long as picture and blade angle are good, also where it is no clear zone."""
    if newest is None:
        return SoilStatus()
    if newest.faults or newest.blade_angle_age_s > settings.max_angle_age_s:
        newest = replace(
            newest,
            volume_left_l=None,
            volume_center_l=None,
            volume_right_l=None,
            ahead=None,
            carried=None,
            profile_mm=None,
        )
    return SoilStatus(
        zone=newest.zone,
        confidence=newest.confidence,
        reason=newest.reason,
        age_s=max(0.0, now_s - newest.capture_s),
        **({} if newest.zone is Zone.UNKNOWN else _shares(newest)),
        volume_left_l=newest.volume_left_l,
        volume_center_l=newest.volume_center_l,
        volume_right_l=newest.volume_right_l,
        ahead=newest.ahead and _ahead(newest.ahead),
        carried=newest.carried and ThirdsStatus(**_litres(newest.carried)),
        profile_mm=newest.profile_mm,
        blade_angle_deg=newest.blade_angle_deg,
        frame_number_n=newest.frame_number,
        frames_per_s=frames_per_s,
        method=newest.method,
    )


def _shares(newest: SoilObservation) -> dict[str, Any]:
    return {
        "share_left": newest.share_left,
        "share_center": newest.share_center,
        "share_right": newest.share_right,
    }


def _ahead(ahead: SoilAhead) -> AheadStatus:
    return AheadStatus(zone=ahead.zone, confidence=ahead.confidence, reason=ahead.reason, **_litres(ahead.litres))


def _litres(thirds: Thirds) -> dict[str, float]:
    return {"left_l": thirds.left, "center_l": thirds.center, "right_l": thirds.right}


def _vehicle(told: VehicleTelemetry, now_s: float) -> VehicleStatus:
    return VehicleStatus(
        speed_m_per_s=_moving(told.speed_m_per_s, now_s),
        age_s=told.speed_m_per_s.age_s(now_s) if told.speed_m_per_s else None,
        travelled_m=_moving(told.travelled_m, now_s),
        travelled_age_s=told.travelled_m.age_s(now_s) if told.travelled_m else None,
    )


def _attitude(attitude: MeasuredAttitude, sensed: Sensed, now_s: float) -> AttitudeStatus:
    ages_s = {
        axis: told.telemetry.position.age_s(now_s) for axis, told in sensed.axes.items() if told.telemetry.position
    }
    return AttitudeStatus(
        height_mm=attitude.height_mm,
        slope_deg=attitude.slope_deg,
        lifts_age_s=None if attitude.height_mm is None else max(ages_s[axis] for axis in LIFTS),
        pitch_deg=attitude.pitch_deg,
        pitch_age_s=None if attitude.pitch_deg is None else ages_s["tilt"],
    )


def _moving(reading: Reading[float] | None, now_s: float) -> float | None:
    return reading.value if reading is not None and reading.is_fresh(now_s, VEHICLE_MAX_AGE_S) else None


def _axis(name: str, axis: AxisSensed, decided: AxisTick, now_s: float, max_age_s: float) -> AxisStatus:
    told = axis.telemetry
    values: dict[str, Any] = {}
    ages_s: dict[str, float] = {}
    for field, reading, valid_for_s in _readings(told, max_age_s):
        if reading is not None and (age_s := reading.age_if_fresh_s(now_s, valid_for_s)) is not None:
            values[field], ages_s[field] = reading.value, age_s
    return AxisStatus(
        name=name,
        unit=UNITS[name],
        lifecycle=axis.lifecycle,
        requested=decided.requested,
        limited=decided.limited,
        limited_because=decided.because,
        arrived=decided.arrived,
        measured_age_s=told.position.age_s(now_s) if told.position else None,
        ages_s=ages_s,
        counters=told.counters,
        **values,
    )


def _readings(
    told: RotatorTelemetry | ActuatorTelemetry, max_age_s: float
) -> tuple[tuple[str, Reading[Any] | None, float], ...]:
    """Each field of the status, its reading, and for how long that is told: what control acts on, no longer than
    control would; what changes slowly and is asked for seldom, longer; what its driver was told last stays so."""
    of_both = (
        ("measured", told.position, max_age_s),
        ("velocity_per_s", told.velocity, max_age_s),
        ("current_a", told.current_a, max_age_s),
        ("moving", told.moving, max_age_s),
    )
    if isinstance(told, RotatorTelemetry):
        return (
            *of_both,
            ("sent", told.goal_sent_deg, math.inf),
            ("torque_nm", told.torque_nm, max_age_s),
            ("in_position", told.in_position, max_age_s),
            ("voltage_v", told.voltage_v, KNOWN_FOR_S),
            ("temperature_c", told.temperature_c, KNOWN_FOR_S),
            ("torque_on", told.torque_on, KNOWN_FOR_S),
        )
    of_actuators = (
        *of_both,
        ("sent", told.target_sent_mm, math.inf),
        ("duty_percent", told.duty_percent, max_age_s),
    )
    flags = told.flags
    if flags is None:
        return of_actuators
    return (
        *of_actuators,
        ("flags", Reading(tuple(sorted(flags.value)), flags.time_s, flags.valid), KNOWN_FOR_S),
        # it is reckoned anew with every feedback
        ("thermal_load", Reading(told.thermal_load, flags.time_s, flags.valid), KNOWN_FOR_S),
    )
