"""Where the camera really sits: solved from a few frames of the empty blade at known angles.

What is solved: the colour stream's pose (six numbers), and of the blade its length, its height and how far its edge
lies ahead of the rotation axis. Height, cross slope and lean of the edge above the ground come from the measured lifts
and tilt. Where they are not measured, they are solved instead of the blade's height, which is the drawing's then: a
raised blade must not become a taller one. Nothing is accepted that is far off the drawing, or under which the empty
bed of these frames would not be found empty. The depth stream moves along with the colour stream: their relation is
the camera's own and stays. Evidence: the ground (it is z = 0), the hollow face, its ends and its upper edge in the
depth pictures; the blade's outline in the colour pictures. The rotation axis is found because the face is seen at
several angles.

Method: Gauss-Newton with a robust weight; after every step the evidence is looked for again, in a narrower band round
the blade as it is known by then (as in iterative closest point, Besl & McKay 1992, IEEE PAMI 14(2)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graderd.core.attitude import UNMEASURED, MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import Frame, StreamPose
from graderd.perception.calibration_evidence import TOP, ColorEvidence, DepthEvidence, collect_color, collect_depth
from graderd.perception.depth import DepthJudge
from graderd.perception.geometry import F64, View
from graderd.perception.health import HealthMonitor, obstructed
from graderd.perception.registration import Stance
from graderd.perception.settings import CameraCalibration, PerceptionSettings, StreamCalibration

POSE = ("position_x_m", "position_y_m", "position_z_m", "pitch_down_deg", "yaw_deg", "roll_deg")
GEOMETRY = ("x_offset_m", "length_m", "height_m")
STANCE = ("edge_height_m", "edge_slope_deg", "edge_pitch_deg")
"""How the blade stood in all frames, beyond what was measured."""
GEOMETRY_AT = slice(len(POSE), len(POSE) + len(GEOMETRY))
STANCE_AT = slice(GEOMETRY_AT.stop, None)
STEPS = np.array([1e-4, 1e-4, 1e-4, 5e-3, 5e-3, 5e-3, 1e-4, 1e-4, 1e-4, 1e-4, 5e-3, 5e-3])
"""Steps of the numerical derivatives: metres and degrees."""
BANDS_M = (0.14, 0.10, 0.07, 0.05, 0.035, 0.025, 0.02, 0.015, 0.012)
"""How far from the blade's place the evidence is looked for, round by round."""
COLOR_ONLY_BANDS_M = (0.05, 0.04, 0.03, 0.02, 0.015, 0.012, 0.012, 0.012)
"""Further away, any edge of a picture may pass for the blade's."""
DEPTH_SIGMA_M = 0.003
"""What a depth point is off: 0.1 to 0.2 px of disparity at 0.8 m."""
COLOR_SIGMA_PX = 1.0
"""What an edge's place in the picture is off."""
COLOR_TOP_SIGMA_PX = 6.0
"""From above, the plate's thickness shows behind the upper edge: where depth tells, colour has little say there."""
PRIOR_SIGMA = np.array([0.5, 0.5, 0.5, 30.0, 30.0, 30.0, 0.02, 0.03, 0.03, 0.1, 5.0, 15.0])
"""How far a number may plausibly be from where it starts: metres and degrees. Decides only what is not seen."""
AS_DRAWN_SIGMA_M = 0.0005
"""What is not solved is held to its drawing by this."""
AS_MEASURED_SIGMA = (0.0005, 0.05, 0.05)
"""Height (m), slope and pitch (deg) that the lifts and the tilt measure are held to by this."""
OFF_DRAWING_M = 0.02
"""A blade that differs from its drawing by more than this is another blade, or was not where it was said to be."""
COLOR_ONLY_SIGMA_M = 0.003
"""Without depth the picture tells only ratios: the blade's size must be known, and sets the scale."""
COLOR_FROM_BAND_M = 0.05
"""Where there is depth, colour has a say from this band on: further away any edge may pass for the blade's."""
EDGE_WORTH_N, MIN_EVIDENCE_N = 10, 100
"""An edge's point counts as ten of the face; a frame that gives less than a hundred in all does not show the blade."""
CORRELATED_N = 10.0
"""Neighbouring depth points err alike: so many of them tell as much as one that is free."""
INLIER_SHARE = 0.95
"""The rms leaves out the outermost: points on something else that passed the robust weight."""
MIN_FRAMES_N, MIN_SPAN_DEG = 3, 20.0
"""Frames, and blade angles between the outermost: with less, place and angle of the camera are not told apart."""
MAX_RESIDUAL_MM, MAX_RESIDUAL_PX = 12.0, 6.0
"""A fit worse than this fitted something else: a good mount gives 1 mm and 1 px."""
MIN_AGREEMENT = 0.5
"""Of the points near the face so many lie on it; fewer, and the angle of the frame is not the blade's."""
MAX_UNCERTAIN_MM, MAX_UNCERTAIN_DEG = 10.0, 1.0
"""A camera's place less sure than this would make soil of ground."""


class CalibrationError(Exception):
    """The frames do not give a calibration; the message says why and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class EmptyBlade:
    """One frame of the empty blade, and the angle and the attitude it was measured at."""

    frame: Frame
    blade_angle_deg: float
    attitude: MeasuredAttitude = UNMEASURED


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """The solved calibration and blade, how well they fit, and how sure each solved number is (1 sigma)."""

    calibration: CameraCalibration
    blade: BladeGeometry
    residual_mm: float | None
    residual_px: float | None
    uncertainty: dict[str, float]
    frames_n: int


def calibrate(
    views: Sequence[EmptyBlade], start: CameraCalibration, blade: BladeGeometry, when: str = ""
) -> CalibrationResult:
    """Solve camera pose and blade geometry, beginning at ``start``.

    It must be right within some 10 cm and 8 degrees, without depth within 1 cm and 1 degree.

    ``when`` is written into the calibration as ``calibrated_at``.

    Raises:
        CalibrationError: too few frames, angles too close together, blade not found, or a bad fit.
    """
    _check(views)
    solver = _Solver(views, start, blade)
    has_depth = any(view.frame.depth_mm is not None for view in views)
    for band_m in BANDS_M if has_depth else COLOR_ONLY_BANDS_M:
        solver.step(band_m)
    return solver.result(when)


def with_pose(start: CameraCalibration, color_pose: dict[str, float]) -> CameraCalibration:
    """``start`` with the colour stream moved to ``color_pose`` (keys of POSE); the depth stream moves along."""
    color = start.color.model_copy(update=color_pose)
    old, new = start.color.pose(start.mounting), color.pose(start.mounting)
    depth = start.depth.pose(start.mounting)
    old_r, new_r = np.asarray(old.rotation), np.asarray(new.rotation)
    rotation = new_r @ old_r.T @ np.asarray(depth.rotation)
    offset = old_r.T @ (np.asarray(depth.position_m) - np.asarray(old.position_m))
    position = np.asarray(new.position_m) + new_r @ offset
    rows = tuple((float(row[0]), float(row[1]), float(row[2])) for row in rotation)
    pose = StreamPose((float(position[0]), float(position[1]), float(position[2])), (rows[0], rows[1], rows[2]))
    moved = StreamCalibration.from_pose(start.depth.intrinsics(), pose, start.mounting)
    return start.model_copy(update={"color": color, "depth": moved})


def _check(views: Sequence[EmptyBlade]) -> None:
    if len(views) < MIN_FRAMES_N:
        raise CalibrationError(f"{len(views)} frames, at least {MIN_FRAMES_N} are needed; take more")
    angles = [view.blade_angle_deg for view in views]
    if max(angles) - min(angles) < MIN_SPAN_DEG:
        raise CalibrationError(
            f"the angles span {max(angles) - min(angles):.0f} deg, at least {MIN_SPAN_DEG:.0f} are needed to find the "
            "rotation axis; turn the blade further between the frames"
        )


class _Solver:
    def __init__(self, views: Sequence[EmptyBlade], start: CameraCalibration, blade: BladeGeometry) -> None:
        self._views = views
        self._start = start
        self._blade = blade
        pose = [float(getattr(start.color, name)) for name in POSE]
        geometry = [float(getattr(blade, name)) for name in GEOMETRY]
        self._first = np.array(pose + geometry + [0.0] * len(STANCE))
        self._p = self._first.copy()
        self._depth: list[DepthEvidence] = []
        self._color: list[ColorEvidence] = []
        self._information: F64 = np.eye(len(self._p))
        self._prior_sigma = PRIOR_SIGMA.copy()
        if not self._with_depth():
            self._prior_sigma[len(POSE) : -len(STANCE)] = COLOR_ONLY_SIGMA_M
        measured = [
            all(getattr(view.attitude, name) is not None for view in views)
            for name in ("height_mm", "slope_deg", "pitch_deg")
        ]
        for index, known in enumerate(measured):
            if known or not self._with_depth():
                self._prior_sigma[index - len(STANCE)] = AS_MEASURED_SIGMA[index]
        if not measured[0]:
            self._prior_sigma[len(POSE) + GEOMETRY.index("height_m")] = AS_DRAWN_SIGMA_M

    def _model(self, p: F64) -> tuple[CameraCalibration, BladeGeometry]:
        calibration = with_pose(self._start, dict(zip(POSE, map(float, p[: GEOMETRY_AT.start]), strict=True)))
        return calibration, self._blade.model_copy(update=dict(zip(GEOMETRY, map(float, p[GEOMETRY_AT]), strict=True)))

    def _stance(self, view: EmptyBlade, p: F64) -> Stance:
        height_m, slope_deg, pitch_deg = map(float, p[STANCE_AT])
        said = Stance(view.blade_angle_deg, view.attitude)
        attitude = MeasuredAttitude(
            (said.edge_m(self._blade) + height_m) * 1000.0,
            (view.attitude.slope_deg or 0.0) + slope_deg,
            (view.attitude.pitch_deg or 0.0) + pitch_deg,
        )
        return Stance(view.blade_angle_deg, attitude)

    def _views_of(self, frame: Frame, calibration: CameraCalibration) -> tuple[View, View]:
        color = frame.color_intrinsics or calibration.color.intrinsics().scaled(*frame.color_bgr.shape[1::-1])
        depth = calibration.depth.intrinsics()
        if frame.depth_mm is not None:
            depth = frame.depth_intrinsics or depth.scaled(*frame.depth_mm.shape[::-1])
        mounting = calibration.mounting
        return View(color, calibration.color.pose(mounting)), View(depth, calibration.depth.pose(mounting))

    def step(self, band_m: float) -> None:
        """Look for the evidence within ``band_m``, then two Gauss-Newton steps on it."""
        calibration, blade = self._model(self._p)
        self._depth, self._color = [], []
        for view in self._views:
            color_view, depth_view = self._views_of(view.frame, calibration)
            stance = self._stance(view, self._p)
            if view.frame.depth_mm is not None:
                self._depth.append(collect_depth(view.frame.depth_mm, depth_view, blade, stance, band_m))
            if band_m <= COLOR_FROM_BAND_M or view.frame.depth_mm is None:
                found = collect_color(view.frame.color_bgr, color_view, blade, stance, band_m)
                self._color.append(found)
        evidence_n = sum(len(e.face) for e in self._depth) + EDGE_WORTH_N * sum(len(e.at_px) for e in self._color)
        if evidence_n < MIN_EVIDENCE_N * len(self._views):
            raise CalibrationError(
                "the blade was not found where the starting pose says; clear the soil before the blade, "
                "or enter the measured pose with --pose"
            )
        for _ in range(2):
            self._gauss_newton()

    def _residuals(self, p: F64) -> F64:
        calibration, blade = self._model(p)
        parts: list[F64] = []
        for evidence, view in zip(self._depth, self._with_depth(), strict=True):
            depth_view = self._views_of(view.frame, calibration)[1]
            parts += [r / DEPTH_SIGMA_M for r in evidence.residuals_m(depth_view, blade, self._stance(view, p))]
        colored = self._views if len(self._color) == len(self._views) else self._without_depth()
        for found, view in zip(self._color, colored, strict=True):
            color_view = self._views_of(view.frame, calibration)[0]
            sigma = np.where((found.side == TOP) & bool(self._depth), COLOR_TOP_SIGMA_PX, COLOR_SIGMA_PX)
            parts.append(found.residuals_px(color_view, blade, self._stance(view, p)) / sigma)
        return np.concatenate(parts)

    def _with_depth(self) -> list[EmptyBlade]:
        return [view for view in self._views if view.frame.depth_mm is not None]

    def _without_depth(self) -> list[EmptyBlade]:
        return [view for view in self._views if view.frame.depth_mm is None]

    def _gauss_newton(self) -> None:
        r = self._residuals(self._p)
        jacobian = np.empty((r.size, self._p.size))
        for i, h in enumerate(STEPS):
            ahead, back = self._p.copy(), self._p.copy()
            ahead[i] += h
            back[i] -= h
            jacobian[:, i] = (self._residuals(ahead) - self._residuals(back)) / (2 * h)
        prior = np.diag(1.0 / self._prior_sigma**2)
        weight = 1.0 / (1.0 + (r / 3.0) ** 2)  # Cauchy: an edge of soil or a hose has little say
        data = jacobian.T @ (jacobian * weight[:, None])
        self._information = data / CORRELATED_N + prior
        pull = prior @ (self._first - self._p)
        self._p = self._p + np.linalg.solve(data + prior, -jacobian.T @ (weight * r) + pull)

    def result(self, when: str) -> CalibrationResult:
        """Residuals, uncertainties and the final judgement."""
        calibration, blade = self._model(self._p)
        parts_mm: list[F64] = []
        for evidence, view in zip(self._depth, self._with_depth(), strict=True):
            depth_view = self._views_of(view.frame, calibration)[1]
            parts_mm += [part * 1000 for part in evidence.residuals_m(depth_view, blade, self._stance(view, self._p))]
        parts_px = [
            found.residuals_px(self._views_of(view.frame, calibration)[0], blade, self._stance(view, self._p))
            for found, view in zip(self._color, self._views, strict=True)
        ]
        residual_mm = _robust_rms(np.concatenate(parts_mm)) if parts_mm else None
        edges = np.concatenate(parts_px) if parts_px else np.zeros(0)
        residual_px = _robust_rms(edges) if edges.size >= EDGE_WORTH_N * len(self._views) else None
        sigma = np.sqrt(np.diag(np.linalg.inv(self._information)))
        uncertainty = dict(zip((*POSE, *GEOMETRY), map(float, sigma[: STANCE_AT.start]), strict=True))
        self._judge(residual_mm, residual_px, uncertainty)
        self._compare_with_drawing(blade)
        self._check_empty_bed(calibration, blade)
        calibration = calibration.model_copy(
            update={
                "calibrated_at": when,
                "residual_mm": round(residual_mm or 0.0, 3),
                "residual_px": round(residual_px or 0.0, 3),
            }
        )
        return CalibrationResult(calibration, blade, residual_mm, residual_px, uncertainty, len(self._views))

    def _judge(self, residual_mm: float | None, residual_px: float | None, uncertainty: dict[str, float]) -> None:
        if residual_mm is not None and residual_mm > MAX_RESIDUAL_MM:
            raise CalibrationError(
                f"the blade fits to {residual_mm:.1f} mm only, {MAX_RESIDUAL_MM:.0f} mm is asked; is it empty, and are "
                "the angles those of the frames?"
            )
        if residual_mm is None and (residual_px is None or residual_px > MAX_RESIDUAL_PX):
            raise CalibrationError("the blade's outline does not fit the colour pictures; start nearer with --pose")
        for evidence, view in zip(self._depth, self._with_depth(), strict=True):
            if evidence.agreement < MIN_AGREEMENT:
                raise CalibrationError(
                    f"the frame at {view.blade_angle_deg:+.1f} deg does not show the empty blade at that angle "
                    f"({evidence.agreement * 100:.0f} % of what stands there lies on it)"
                )
        for name, value in uncertainty.items():
            limit = MAX_UNCERTAIN_DEG if name.endswith("_deg") else MAX_UNCERTAIN_MM / 1000
            if value > limit:
                raise CalibrationError(f"{name} stays uncertain by {value:.3f}; take frames at more angles")

    def _compare_with_drawing(self, blade: BladeGeometry) -> None:
        for name in GEOMETRY:
            drawn, found = float(getattr(self._blade, name)), float(getattr(blade, name))
            if abs(found - drawn) > OFF_DRAWING_M:
                raise CalibrationError(
                    f"blade.{name} comes out as {found:.3f} m, {abs(found - drawn) * 1000:.0f} mm off the "
                    f"{drawn:.3f} m configured; measure the blade and correct [blade], or the lifts' extension on the "
                    "ground in [attitude]"
                )

    def _check_empty_bed(self, calibration: CameraCalibration, blade: BladeGeometry) -> None:
        """Under what was solved, the bed of these very frames must be empty."""
        settings = PerceptionSettings()
        health = HealthMonitor(settings.health, blade, live=False)
        for view in self._with_depth():
            assert view.frame.depth_mm is not None  # those with depth
            stance = self._stance(view, self._p)
            judge = DepthJudge(self._views_of(view.frame, calibration)[1], blade, settings.depth, settings.decision)
            soil = judge.height_map(view.frame.depth_mm, stance)
            verdict = judge.verdict(soil)
            faults = health.misplaced(soil, stance) or obstructed(soil)
            if faults or verdict.zone is not Zone.NONE:
                said = faults[0].detail if faults else f"{verdict.zone} ({verdict.reason})"
                raise CalibrationError(
                    f"with it, the empty bed at {view.blade_angle_deg:+.1f} deg would not be found empty: {said}; "
                    "clear and level the ground before the blade"
                )


def _robust_rms(values: F64) -> float:
    """Root mean square without the outermost."""
    if values.size == 0:
        return 0.0
    kept = np.sort(np.abs(values))[: max(1, int(INLIER_SHARE * values.size))]
    return float(np.sqrt(np.mean(kept**2)))
