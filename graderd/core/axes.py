"""The axes of the blade: their names, units and figures, and values by axis. The one place that lists them.

Positions are degrees at the blade (``rotation``, counter-clockwise positive seen from above) or millimetres of
extension (the actuators).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, Self

LIFTS: Final = ("lift_left", "lift_right")
ACTUATORS: Final = (*LIFTS, "tilt")
AXES: Final = ("rotation", *ACTUATORS)
UNITS: Final = MappingProxyType({"rotation": "deg"} | dict.fromkeys(ACTUATORS, "mm"))
"""Unit of each axis's position."""

PARTS: Final = MappingProxyType({"rotation": "rotation", "lift_left": "lift", "lift_right": "lift", "tilt": "tilt"})
"""What of the blade an axis moves: a fault that holds one lift holds both."""

FIELDS: Final = MappingProxyType({"rotation": "rotation_deg"} | {name: f"{name}_mm" for name in ACTUATORS})
"""The field that holds an axis's value in :class:`Goals` and :class:`Pose`, and in what is written of them."""


@dataclass(frozen=True, slots=True)
class AxisFigures:
    """Everything that is told about one axis's motion, once: gate, arrival and plausibility go by it.

    In the axis's unit (see :data:`UNITS`) and seconds. ``low``, ``high``: absolute bounds. ``window``: largest distance
    from where the axis stood when it was armed. ``lead``: largest distance of the goal ahead of the measured position.
    ``tolerance``: so near the goal counts as arrived. ``max_age_s``: an older reading counts as unknown.
    ``profile_in_device``: the device itself moves with ``speed`` and ``acceleration``; the gate leads it to the goal.
    """

    low: float
    high: float
    window: float
    speed: float
    acceleration: float
    lead: float
    tolerance: float
    max_age_s: float
    profile_in_device: bool = False


@dataclass(frozen=True, slots=True)
class _ByAxis:
    rotation_deg: float | None = None
    lift_left_mm: float | None = None
    lift_right_mm: float | None = None
    tilt_mm: float | None = None

    def __getitem__(self, axis: str) -> float | None:
        value: float | None = getattr(self, FIELDS[axis])
        return value

    def items(self) -> tuple[tuple[str, float | None], ...]:
        """Axis and value, in the order of :data:`AXES`."""
        return (
            ("rotation", self.rotation_deg),
            ("lift_left", self.lift_left_mm),
            ("lift_right", self.lift_right_mm),
            ("tilt", self.tilt_mm),
        )

    @classmethod
    def of(cls, **values: float | None) -> Self:
        """From values by axis name: ``Goals.of(rotation=30.0)``."""
        return cls(**{FIELDS[axis]: value for axis, value in values.items()})


@dataclass(frozen=True, slots=True)
class Goals(_ByAxis):
    """Where each axis shall go; None: stay where it is."""

    @property
    def empty(self) -> bool:
        """Whether every axis stays."""
        return all(value is None for _, value in self.items())


@dataclass(frozen=True, slots=True)
class Pose(_ByAxis):
    """Measured positions that are fresh enough to act on; None where stale."""


@dataclass(frozen=True, slots=True)
class JogAxis:
    """What a person may move by hand: the unit of its value, and the axes that move."""

    unit: str
    moves: tuple[str, ...]


JogName = Literal["rotate", "lift", "tilt", "height", "slope", "pitch"]
JOG_AXES: Final[Mapping[JogName, JogAxis]] = MappingProxyType(
    {
        "rotate": JogAxis("deg", ("rotation",)),
        "lift": JogAxis("mm", LIFTS),
        "tilt": JogAxis("mm", ("tilt",)),
        "height": JogAxis("mm", LIFTS),
        "slope": JogAxis("deg", LIFTS),
        "pitch": JogAxis("deg", ("tilt",)),
    }
)
"""``lift``: extension of both; ``height``: of the blade's centre; ``slope``, ``pitch``: its attitude."""
