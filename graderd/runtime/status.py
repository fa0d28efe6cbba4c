"""Builds the status model from the control loop and its devices."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.metadata import version

from graderd.core.gate import AxisPass
from graderd.core.lift import attitude_of
from graderd.core.status import (
    AttitudeStatus,
    AxisStatus,
    DecisionStatus,
    FaultStatus,
    LeaseStatus,
    RequirementStatus,
    SoilStatus,
    Status,
    TickStatus,
)
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.reading import Reading
from graderd.hal.rotator import Rotator
from graderd.runtime.control import ControlLoop
from graderd.runtime.perception_supervisor import PerceptionSupervisor
from graderd.runtime.readiness import requirements

VERSION = version("graderd")


def build_status(loop: ControlLoop, eyes: PerceptionSupervisor) -> Status:
    """The state at the last tick."""
    now_s = loop.time_s
    state = loop.state
    axes = {"rotation": _rotation(loop.devices.rotation, loop.passed.get("rotation"), now_s)}
    for name, actuator in loop.devices.actuators.items():
        axes[name] = _actuator(name, actuator, loop.passed.get(name), now_s)
    decision = state.decision
    lateness = sorted(loop.lateness_s)
    return Status(
        time_s=now_s,
        wall_time=datetime.now(UTC).isoformat(timespec="milliseconds"),
        version=VERSION,
        simulated=loop.config.simulated,
        mode=state.mode,
        reason=state.reason,
        arming=state.arming_since_s is not None,
        holding=state.holding,
        last_stop=str(loop.last_stop) if loop.last_stop else "",
        soil=_soil(eyes, now_s),
        decision=DecisionStatus(
            zone=decision.zone,
            angle_deg=decision.angle_deg,
            age_s=now_s - decision.decided_s if decision.zone is not None else None,
            reason=decision.reason,
        ),
        axes=axes,
        attitude=AttitudeStatus.model_validate(attitude_of(loop.config.attitude, loop.pose(now_s))),
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
            for f in loop.faults.active
        ),
        readiness=tuple(
            RequirementStatus(name=r.name, met=r.met, mandatory=r.mandatory, reason=r.reason, remedy=r.remedy)
            for r in requirements(loop, now_s)
        ),
        lease=LeaseStatus(client=state.lease.client, remaining_s=max(0.0, state.lease.expires_s - now_s))
        if state.lease
        else None,
        camera=eyes.status(),
        tick=TickStatus(
            rate_hz=loop.config.control.tick_hz,
            overruns_n=loop.overruns_n,
            lateness_p99_ms=lateness[int(0.99 * (len(lateness) - 1))] * 1e3 if lateness else 0.0,
        ),
        presets=tuple(loop.config.presets),
    )


def _soil(eyes: PerceptionSupervisor, now_s: float) -> SoilStatus:
    newest = eyes.newest
    if newest is None:
        return SoilStatus()
    return SoilStatus(
        zone=newest.zone,
        confidence=newest.confidence,
        reason=newest.reason,
        age_s=max(0.0, now_s - newest.capture_s),
        share_left=newest.share_left,
        share_center=newest.share_center,
        share_right=newest.share_right,
        volume_left_l=newest.volume_left_l,
        volume_center_l=newest.volume_center_l,
        volume_right_l=newest.volume_right_l,
        blade_angle_deg=newest.blade_angle_deg,
        frame_number_n=newest.frame_number,
        frames_per_s=eyes.frames_per_s,
        method=newest.method,
    )


def _rotation(rotator: Rotator, passed: AxisPass | None, now_s: float) -> AxisStatus:
    told = rotator.telemetry()
    return AxisStatus(
        name="rotation",
        unit="deg",
        lifecycle=rotator.lifecycle,
        requested=passed.requested if passed else None,
        limited=passed.limited if passed else None,
        limited_because=passed.reason if passed else "",
        sent=_value(told.goal_sent_deg),
        measured=_value(told.angle_deg),
        measured_age_s=told.angle_deg.age_s(now_s) if told.angle_deg else None,
        velocity_per_s=_value(told.velocity_deg_per_s),
        current_a=_value(told.current_a),
        torque_nm=_value(told.torque_nm),
        voltage_v=_value(told.voltage_v),
        temperature_c=_value(told.temperature_c),
        moving=_flag(told.moving),
        in_position=_flag(told.in_position),
        torque_on=_flag(told.torque_on),
        counters=told.counters,
    )


def _actuator(name: str, actuator: LinearActuator, passed: AxisPass | None, now_s: float) -> AxisStatus:
    told = actuator.telemetry()
    return AxisStatus(
        name=name,
        unit="mm",
        lifecycle=actuator.lifecycle,
        requested=passed.requested if passed else None,
        limited=passed.limited if passed else None,
        limited_because=passed.reason if passed else "",
        sent=_value(told.target_sent_mm),
        measured=_value(told.position_mm),
        measured_age_s=told.position_mm.age_s(now_s) if told.position_mm else None,
        velocity_per_s=_value(told.velocity_mm_per_s),
        current_a=_value(told.current_a),
        duty_percent=_value(told.duty_percent),
        moving=_flag(told.moving),
        thermal_load=told.thermal_load,
        flags=tuple(sorted(told.flags.value)) if told.flags else (),
        counters=told.counters,
    )


def _value(reading: Reading[float] | None) -> float | None:
    """For show only, beside its age; control uses readings with a maximum age."""
    return reading.value if reading is not None and reading.valid else None


def _flag(reading: Reading[bool] | None) -> bool | None:
    return reading.value if reading is not None and reading.valid else None
