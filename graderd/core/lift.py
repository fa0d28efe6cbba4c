"""The lift pair as one axis for the control loop: coordination of the two sides, and the attitude they give."""

from __future__ import annotations

from dataclasses import replace

from graderd.core.attitude import AttitudeGeometry, lift_attitude, pitch_deg
from graderd.core.lift_pair import LiftPair, LiftPairSettings, PairCommand, SideReading
from graderd.core.machine import Goals, Pose
from graderd.hal.fault import DeviceFault

NEW_TARGET_MM = 0.05


class LiftCoordinator:
    """Turns the two lifts' goals into what each side shall do this tick, so that they keep together."""

    def __init__(self, settings: LiftPairSettings) -> None:
        self._pair = LiftPair(settings)
        self._targets: tuple[float, float] | None = None
        self._last: PairCommand | None = None
        self._since_s: float | None = None

    @property
    def stopped(self) -> str:
        """Why both sides hold although a goal is set; empty where they do not. A new goal starts anew."""
        return self._last.stopped if self._last is not None else ""

    def step(
        self, goals: Goals, now_s: float, left: SideReading | None, right: SideReading | None
    ) -> tuple[Goals, dict[str, float]]:
        """Goals for this tick and the speed share of each lift (1 where not named)."""
        if goals.lift_left_mm is None or goals.lift_right_mm is None:
            if self._targets is not None:
                self._pair.release()
            self._targets = self._last = None
            return replace(goals, lift_left_mm=None, lift_right_mm=None), {}
        targets = (goals.lift_left_mm, goals.lift_right_mm)
        if self._targets is not None and self.stopped and _differ(targets, self._targets):
            self._pair.release()
        self._targets = targets
        command = self._last = self._pair.step(now_s, left, right, *targets)
        self._since_s = (self._since_s or now_s) if command.condition or command.stopped else None
        return (
            replace(goals, lift_left_mm=command.left.target_mm, lift_right_mm=command.right.target_mm),
            {"lift_left": command.left.speed_share, "lift_right": command.right.speed_share},
        )

    def faults(self) -> tuple[DeviceFault, ...]:
        """``sides_apart`` while the sides are further apart than allowed, or one stopped the other."""
        if self._last is None or self._since_s is None:
            return ()
        detail = self._last.stopped or f"{self._last.apart_mm:.1f} mm apart on their way"
        return (DeviceFault("lift_left", "sides_apart", detail, self._since_s),)


def height_mm(geometry: AttitudeGeometry, pose: Pose) -> float | None:
    """Height of the cutting edge's centre, None while a lift is not measured."""
    return attitude_of(geometry, pose)["height_mm"]


def attitude_of(geometry: AttitudeGeometry, pose: Pose) -> dict[str, float | None]:
    """Height, slope and pitch by name, None where an extension is not known."""
    found: dict[str, float | None] = {"height_mm": None, "slope_deg": None, "pitch_deg": None}
    if pose.lift_left_mm is not None and pose.lift_right_mm is not None:
        attitude = lift_attitude(geometry, pose.lift_left_mm, pose.lift_right_mm)
        found |= {"height_mm": attitude.height_mm, "slope_deg": attitude.slope_deg}
    if pose.tilt_mm is not None:
        found["pitch_deg"] = pitch_deg(geometry, pose.tilt_mm)
    return found


def _differ(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return any(abs(a - b) > NEW_TARGET_MM for a, b in zip(one, other, strict=True))
