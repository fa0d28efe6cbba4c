"""Pictures of things that are no soil: legs, foliage, a pipe, boxes and stones before the rig's blade."""

from __future__ import annotations

import numpy as np

from graderd.core.soil import Zone
from graderd.hal.camera import Frame
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.camera.shapes import Solid, rotation
from graderd.simulator.grader.blade import BladePose, Plough
from graderd.simulator.grader.piles import SceneZone, lay_scene
from graderd.simulator.grader.soil import SoilField

VEHICLE_X_M = 3.0
KINDS = ("legs", "foliage", "pipe", "box", "crate", "stone")
LARGE = ("boulder", "chest")
"""As large as a third of the blade: the picture's edge or a heap may hide most of how they end."""
SIDES = {Zone.LEFT: 1.0, Zone.CENTER: 0.0, Zone.RIGHT: -1.0}
DISTANCE_M = {"legs": (0.14, 0.45), "boulder": (0.24, 0.42), "chest": (0.22, 0.42)}
"""How far ahead of the face: what is large lies further off, so as not to stand in the blade."""
DEPTH_SIZE, COLOR_SIZE = (848, 480), (320, 200)


def things(kind: str, s_m: float, d_m: float, angle_deg: float, rng: np.random.Generator) -> tuple[Solid, ...]:
    """One thing at a place in blade coordinates, standing or lying on the ground."""
    turn = rotation(angle_deg)

    def at(s: float, d: float, z: float) -> tuple[float, float, float]:
        x, y, z = (float(value) for value in turn @ np.array([d, s, z]))
        return x, y, z

    azimuth = angle_deg + float(rng.uniform(-30, 30))
    if kind == "legs":
        solids = []
        for aside in (-0.11, 0.11):
            solids.append(Solid("box", at(s_m + aside, d_m, 0.4), (0.055, 0.05, 0.4), (60, 70, 90), azimuth))
            solids.append(Solid("box", at(s_m + aside, d_m + 0.06, 0.04), (0.13, 0.05, 0.04), (40, 40, 40), azimuth))
        return tuple(solids)
    if kind == "pipe":
        return (Solid("box", at(s_m, d_m, 0.05), (0.05, 0.225, 0.05), (90, 80, 60), azimuth),)
    if kind == "box":
        return (Solid("box", at(s_m, d_m, 0.05), (0.10, 0.10, 0.05), (90, 80, 70), azimuth),)
    if kind == "crate":
        return (Solid("box", at(s_m, d_m, 0.10), (0.15, 0.15, 0.10), (90, 80, 70), azimuth),)
    if kind == "stone":
        return (Solid("ellipsoid", at(s_m, d_m, 0.05), (0.12, 0.15, 0.08), (120, 120, 120), azimuth),)
    if kind == "boulder":
        return (Solid("ellipsoid", at(s_m, d_m, 0.07), (0.17, 0.21, 0.11), (120, 120, 120), azimuth),)
    if kind == "chest":  # lower than what stands upright
        return (Solid("box", at(s_m, d_m, 0.075), (0.15, 0.12, 0.075), (90, 80, 70), azimuth),)
    leaves = []
    for _ in range(70):
        s, d = s_m + float(rng.normal(0, 0.08)), d_m + float(rng.normal(0, 0.06))
        tall = float(rng.uniform(0.03, 0.11))
        half = float(rng.uniform(0.006, 0.018))
        leaves.append(
            Solid("box", at(s, d, tall / 2), (half, half, tall / 2), (50, 110, 60), float(rng.uniform(0, 90)))
        )
    return tuple(leaves)


def photograph(renderer: Renderer, kind: str, side: Zone, loaded: SceneZone, angle_deg: float, number: int) -> Frame:
    """A frame with the thing in ``side`` and soil as ``loaded`` says."""
    rng = np.random.default_rng((number, (*KINDS, *LARGE).index(kind)))
    pose = BladePose(angle_deg)
    field = SoilField()
    if loaded is not SceneZone.NONE:
        lay_scene(field, loaded, VEHICLE_X_M, pose, seed=number)
        Plough(field).settle(VEHICLE_X_M, pose)
    s_m = SIDES[side] * 0.33 + float(rng.uniform(-0.08, 0.08))
    d_m = float(rng.uniform(*DISTANCE_M.get(kind, (0.14, 0.27))))
    props = things(kind, s_m, d_m, angle_deg, rng)
    state = SceneState(field.heights_m.astype(np.float32), field.cell_m, VEHICLE_X_M, pose, props)
    noise_px = float(rng.uniform(0.09, 0.2))
    color, depth = renderer.render(state, Appearance(ground="earth", disparity_noise_px=noise_px))
    return Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0)
