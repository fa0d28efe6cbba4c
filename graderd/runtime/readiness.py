"""What must be true before the machine may be armed, each with its remedy. ``arm`` refuses while one is unmet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from graderd.core.faults.monitor import ActiveFault, Clear, Reaction
from graderd.core.machine import Mode, Unmet
from graderd.hal.lifecycle import Lifecycle

if TYPE_CHECKING:
    from graderd.runtime.control import ControlLoop


@dataclass(frozen=True, slots=True)
class Requirement:
    """One line of the readiness list."""

    name: str
    met: bool
    mandatory: bool
    reason: str
    remedy: str

    def unmet(self) -> Unmet:
        """As the state machine takes it."""
        return Unmet(self.name, self.reason, self.remedy)


def requirements(loop: ControlLoop, now_s: float) -> tuple[Requirement, ...]:
    """The readiness list at this moment."""
    found = [_not_stopped(loop)]
    pose = loop.pose(now_s)
    measured = {
        "rotation": pose.rotation_deg,
        "lift_left": pose.lift_left_mm,
        "lift_right": pose.lift_right_mm,
        "tilt": pose.tilt_mm,
    }
    for name in loop.devices.all():
        found.append(_connected(loop, name))
        found.append(_inside_limits(loop, name, measured[name]))
    blocking = [f for f in loop.faults.active if f.present and _blocks(f)]
    found += [Requirement(f.name, False, True, f.detail or f.row.reads, f.row.remedy) for f in blocking]
    camera = [f for f in loop.faults.active if f.name.startswith("camera.") and f.present]
    found.append(
        Requirement(
            "camera",
            not camera,
            False,
            camera[0].detail if camera else "pictures arrive",
            camera[0].row.remedy if camera else "",
        )
    )
    return tuple(found)


def _blocks(fault: ActiveFault) -> bool:
    """An arm while it is present would be refused by the device, or would not end the latch it is meant to end."""
    row = fault.row
    return row.reaction >= Reaction.DISARM or (row.reaction is Reaction.HOLD and row.clear is Clear.ON_REARM)


def _not_stopped(loop: ControlLoop) -> Requirement:
    stopped = loop.state.mode is Mode.STOPPED
    reason = f"stopped: {loop.state.reason}" if stopped else "no stop is latched"
    return Requirement("stop", not stopped, True, reason, "graderd reset" if stopped else "")


def _connected(loop: ControlLoop, name: str) -> Requirement:
    lifecycle = loop.lifecycle(name)
    ready = lifecycle in (Lifecycle.STANDBY, Lifecycle.ACTIVE)
    if ready:
        return Requirement(name, True, True, f"{lifecycle}", "")
    why = loop.connection_problems.get(name) or next(
        (f.detail for f in loop.faults.active if f.name.startswith(f"{name}.")), ""
    )
    if not why and name != "rotation":
        why = loop.connection_problems.get("can", "")
    return Requirement(
        name, False, True, f"{lifecycle}{': ' + why if why else ''}", f"check power, cable and the [{name}] section"
    )


def _inside_limits(loop: ControlLoop, name: str, measured: float | None) -> Requirement:
    limits = loop.config.gate.limits()[name]
    unit = "deg" if name == "rotation" else "mm"
    if measured is None:
        return Requirement(f"{name} position", False, True, "no fresh measurement", "wait for the device, or check it")
    if limits.low <= measured <= limits.high:
        return Requirement(f"{name} position", True, True, f"{measured:.1f} {unit}", "")
    return Requirement(
        f"{name} position",
        False,
        True,
        f"{measured:.1f} {unit} is outside {limits.low:g} to {limits.high:g} {unit}",
        "bring it back by hand, or correct the calibration or the gate's limits",
    )
