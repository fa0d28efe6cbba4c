"""What must be true before the machine may be armed, each with its remedy. ``arm`` refuses while one is unmet.

One is asked for automatic operation alone (``AUTOMATIC``): ``auto`` refuses while it is unmet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from graderd.core.axes import UNITS, AxisFigures, Pose
from graderd.core.faults.monitor import ActiveFault, Clear, Reaction
from graderd.core.machine import Mode, State, Unmet
from graderd.hal.device import Lifecycle

AUTOMATIC = "automatic"
NO_AUTO_REMEDY = 'set method = "depth" in [perception], or measure it: graderd calibrate color --from FRAME_SET'


class Requirement(NamedTuple):
    """One line of the readiness list."""

    name: str
    met: bool
    mandatory: bool
    reason: str
    remedy: str

    def unmet(self) -> Unmet:
        """As the state machine takes it."""
        return Unmet(self.name, self.reason, self.remedy)


class AxisDevice(Protocol):
    """What readiness asks of one axis's device: its lifecycle, and why it is not open (empty where it is)."""

    @property
    def lifecycle(self) -> Lifecycle: ...

    @property
    def problem(self) -> str: ...


def requirements(
    state: State,
    axes: Mapping[str, AxisDevice],
    pose: Pose,
    figures: Mapping[str, AxisFigures],
    faults: Sequence[ActiveFault],
    no_auto: str = "",
) -> tuple[Requirement, ...]:
    """The readiness list at this moment; ``no_auto``: why what sees the soil may not drive, empty where it may."""
    found = [_not_stopped(state)]
    for name, position in pose.items():
        found.append(_connected(name, axes[name], faults))
        found.append(_inside_limits(name, position, figures[name]))
    blocking = [f for f in faults if f.present and _blocks(f)]
    found += [Requirement(f.name, False, True, f.detail or f.row.reads, f.row.remedy) for f in blocking]
    camera = [f for f in faults if f.name.startswith("camera.") and f.present]
    found.append(
        Requirement(
            "camera",
            not camera,
            False,
            camera[0].detail if camera else "pictures arrive",
            camera[0].row.remedy if camera else "",
        )
    )
    by_soil = no_auto or "what sees the soil may drive"
    found.append(Requirement(AUTOMATIC, not no_auto, False, by_soil, NO_AUTO_REMEDY if no_auto else ""))
    return tuple(found)


def _blocks(fault: ActiveFault) -> bool:
    """An arm while it is present would be refused by the device, or would not end the latch it is meant to end."""
    row = fault.row
    return row.reaction >= Reaction.DISARM or (row.reaction is Reaction.HOLD and row.clear is Clear.ON_REARM)


def _not_stopped(state: State) -> Requirement:
    stopped = state.mode is Mode.STOPPED
    reason = f"stopped: {state.reason}" if stopped else "no stop is latched"
    return Requirement("stop", not stopped, True, reason, "graderd reset" if stopped else "")


def _connected(name: str, axis: AxisDevice, faults: Sequence[ActiveFault]) -> Requirement:
    if axis.lifecycle in (Lifecycle.STANDBY, Lifecycle.ACTIVE):
        return Requirement(name, True, True, axis.lifecycle.value, "")
    why = axis.problem or next((f.detail for f in faults if f.name.startswith(f"{name}.")), "")
    return Requirement(
        name,
        False,
        True,
        f"{axis.lifecycle.value}{': ' + why if why else ''}",
        f"check power, cable and the [{name}] section",
    )


def _inside_limits(name: str, position: float | None, figures: AxisFigures) -> Requirement:
    unit = UNITS[name]
    if position is None:
        return Requirement(f"{name} position", False, True, "no fresh measurement", "wait for the device, or check it")
    if figures.low <= position <= figures.high:
        return Requirement(f"{name} position", True, True, f"{position:.1f} {unit}", "")
    return Requirement(
        f"{name} position",
        False,
        True,
        f"{position:.1f} {unit} is outside {figures.low:g} to {figures.high:g} {unit}",
        "bring it back by hand, or correct the calibration or the axis's limits",
    )
