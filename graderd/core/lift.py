"""The lift pair as one axis for the control loop: coordination of the two sides, and the attitude they give."""

from __future__ import annotations

from graderd.core.attitude import AttitudeGeometry, lift_attitude, pitch_deg
from graderd.core.machine import Goals, Pose


class LiftCoordinator:
    """Splits lift goals into per-side goals and speed shares so that the sides keep together."""

    def __init__(self, geometry: AttitudeGeometry) -> None:
        self._geometry = geometry

    def step(self, goals: Goals, pose: Pose) -> tuple[Goals, dict[str, float]]:
        """Goals for this tick and the speed share of each axis (1 where not named).

        A side that is not measured stops the other: both hold.
        """
        if goals.lift_left_mm is None or goals.lift_right_mm is None:
            return goals, {}
        if pose.lift_left_mm is None or pose.lift_right_mm is None:
            return Goals(rotation_deg=goals.rotation_deg, tilt_mm=goals.tilt_mm), {}
        return goals, {}

    def height_mm(self, pose: Pose) -> float | None:
        """Height of the cutting edge's centre, None while a lift is not measured."""
        if pose.lift_left_mm is None or pose.lift_right_mm is None:
            return None
        return lift_attitude(self._geometry, pose.lift_left_mm, pose.lift_right_mm).height_mm


def attitude_of(geometry: AttitudeGeometry, pose: Pose) -> dict[str, float | None]:
    """Height, slope and pitch by name, None where an extension is not known."""
    found: dict[str, float | None] = {"height_mm": None, "slope_deg": None, "pitch_deg": None}
    if pose.lift_left_mm is not None and pose.lift_right_mm is not None:
        attitude = lift_attitude(geometry, pose.lift_left_mm, pose.lift_right_mm)
        found |= {"height_mm": attitude.height_mm, "slope_deg": attitude.slope_deg}
    if pose.tilt_mm is not None:
        found["pitch_deg"] = pitch_deg(geometry, pose.tilt_mm)
    return found
