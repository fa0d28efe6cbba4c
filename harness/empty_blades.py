"""Pictures of the empty blade for calibration, as the rig takes them: the edge raised, the blade leaning."""

from __future__ import annotations

import numpy as np

from graderd.core.attitude import MeasuredAttitude
from graderd.hal.camera import Frame
from graderd.perception.calibration import EmptyBlade
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.optics import knocked
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.blade import EDGE_GAP_M, BladePose
from graderd.simulator.grader.soil import SoilField

ANGLES_DEG = (-40.0, 0.0, 40.0)
VEHICLE_X_M = 2.0


def empty_blades(up_mm: float, lean_deg: float, *, seed: int = 5) -> list[EmptyBlade]:
    """Frames at three angles by a camera 1 cm and 1 degree off its place, with what lifts and tilt measure."""
    color_pose, depth_pose = knocked((0.01, -0.01, 0.01), (1.0, -1.0, 0.5))
    renderer = Renderer((640, 400), (848, 480), seed=seed, color_pose=color_pose, depth_pose=depth_pose)
    field = SoilField()
    attitude = MeasuredAttitude(up_mm + EDGE_GAP_M * 1000.0, 0.0, lean_deg)
    views = []
    for angle_deg in ANGLES_DEG:
        pose = BladePose(angle_deg, height_m=up_mm / 1000.0, pitch_deg=lean_deg)
        state = SceneState(field.heights_m.astype(np.float32), field.cell_m, VEHICLE_X_M, pose)
        color, depth = renderer.render(state, Appearance(ground="earth", disparity_noise_px=0.12))
        frame = Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0)
        views.append(EmptyBlade(frame, angle_deg, attitude))
    return views
