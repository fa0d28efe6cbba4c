"""Legs, foliage and pipes before the blade, on empty and loaded beds: what depth makes of them.

    python -m benchmarks.perception_things                # 240 placements
    python -m benchmarks.perception_things --each 5       # fewer

Every placement is judged on an empty bed, or with a heap in another third. Bars: no thing alone is called a pile, and
no heap on one side is answered with the other because of it.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

import cv2
import numpy as np

from graderd.core.attitude import MeasuredAttitude
from graderd.core.blade import BladeGeometry
from graderd.core.soil import SoilObservation, Zone
from graderd.hal.camera import Frame
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.classifier import Classifier, make_classifier
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.camera.shapes import Solid, rotation
from graderd.simulator.grader.blade import BladePose, Plough
from graderd.simulator.grader.piles import SceneZone, lay_scene
from graderd.simulator.grader.soil import SoilField

VEHICLE_X_M = 3.0
KINDS = ("legs", "foliage", "pipe")
OPPOSITE = {Zone.LEFT: SceneZone.RIGHT, Zone.RIGHT: SceneZone.LEFT}
SIDES = {Zone.LEFT: 1.0, Zone.CENTER: 0.0, Zone.RIGHT: -1.0}
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
    leaves = []
    for _ in range(70):
        s, d = s_m + float(rng.normal(0, 0.08)), d_m + float(rng.normal(0, 0.06))
        tall = float(rng.uniform(0.03, 0.11))
        half = float(rng.uniform(0.006, 0.018))
        leaves.append(
            Solid("box", at(s, d, tall / 2), (half, half, tall / 2), (50, 110, 60), float(rng.uniform(0, 90)))
        )
    return tuple(leaves)


def photograph(
    renderer: Renderer, kind: str, side: Zone, loaded: SceneZone, angle_deg: float, number: int
) -> tuple[Frame, SceneZone]:
    """A frame with the thing in ``side`` and soil as ``loaded`` says."""
    rng = np.random.default_rng((number, KINDS.index(kind)))
    pose = BladePose(angle_deg)
    field = SoilField()
    if loaded is not SceneZone.NONE:
        lay_scene(field, loaded, VEHICLE_X_M, pose, seed=number)
        Plough(field).settle(VEHICLE_X_M, pose)
    s_m = SIDES[side] * 0.33 + float(rng.uniform(-0.08, 0.08))
    d_m = float(rng.uniform(0.14, 0.45 if kind == "legs" else 0.27))
    props = things(kind, s_m, d_m, angle_deg, rng)
    state = SceneState(field.heights_m.astype(np.float32), field.cell_m, VEHICLE_X_M, pose, props)
    noise_px = float(rng.uniform(0.09, 0.2))
    color, depth = renderer.render(state, Appearance(ground="earth", disparity_noise_px=noise_px))
    return Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0), loaded


def sweep(each_n: int) -> list[tuple[str, Zone, SceneZone, float, SoilObservation]]:
    """Judge ``each_n`` placements of every thing in every third, every other one on a loaded bed."""
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, seed=7)
    judge: Classifier = make_classifier(
        PerceptionSettings(method="depth"), CameraCalibration(), BladeGeometry(), live=False
    )
    found = []
    for kind in KINDS:
        for side in SIDES:
            for number in range(each_n):
                loaded = SceneZone.NONE
                if number % 2:
                    loaded = OPPOSITE.get(side, SceneZone.LEFT if number % 4 == 1 else SceneZone.RIGHT)
                angle_deg = (-30.0, 0.0, 15.0, 45.0)[number // 2 % 4]
                frame, _ = photograph(renderer, kind, side, loaded, angle_deg, number)
                observation = judge.classify(frame, angle_deg, 0.0, MeasuredAttitude(2.0, 0.0, 0.0))
                found.append((kind, side, loaded, angle_deg, observation))
    return found


def wrong(side: Zone, loaded: SceneZone, observation: SoilObservation) -> str:
    """What is wrong about an answer; empty where nothing is."""
    if observation.zone is Zone.UNKNOWN:
        return ""
    if loaded is SceneZone.NONE:
        return "" if observation.zone is Zone.NONE else "ghost"
    if observation.zone is side:
        return "swap"
    return ""


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--each", type=int, default=27, help="placements of each thing in each third")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    counts: Counter[tuple[str, str, str]] = Counter()
    bad = 0
    for kind, side, loaded, angle_deg, observation in sweep(options.each):
        counts[kind, "loaded" if loaded is not SceneZone.NONE else "empty", str(observation.zone)] += 1
        if problem := wrong(side, loaded, observation):
            bad += 1
            print(f"{problem}: {kind} {side} at {angle_deg:+.0f} deg, soil {loaded}: {observation.zone} "
                  f"{observation.confidence * 100:.0f} %, {observation.reason}")  # fmt: skip
    for (kind, bed, zone), count in sorted(counts.items()):
        print(f"{kind:<8} {bed:<7} {zone:<8} {count}")
    print(f"{sum(counts.values())} placements, {bad} wrong")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
