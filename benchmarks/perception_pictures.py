"""Draws the pictures of README and docs/operators/perception.md: ``python -m benchmarks.perception_pictures``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from graderd.core.blade import BladeGeometry
from graderd.hal.camera import Frame
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.annotate import text_on
from graderd.perception.classifier import SoilClassifier
from graderd.perception.color import paper_steps
from graderd.perception.geometry import U8
from graderd.perception.registration import Stance
from graderd.runtime.app.perception_child import no_wider
from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.renderer import Renderer, top_view
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.soil import SoilField
from graderd.simulator.grader.world import scene_heights
from harness.perception_scenes import ON_GROUND

OUT = Path("docs/pictures")
ANGLE_DEG, WORK_DEG = 20.0, 30.0
SIZE = (480, 300)


def photograph(look: Appearance) -> Frame:
    """A left heap before a turned blade."""
    return photographed(heap_before(ANGLE_DEG), look)


def heap_before(angle_deg: float) -> SceneState:
    """Soil at the left of a blade at this angle."""
    pose = BladePose(angle_deg)
    heights = scene_heights(SceneZone.LEFT, 3.0, pose, 7).astype(np.float32)
    return SceneState(heights, SoilField().cell_m, 3.0, pose)


def photographed(scene: SceneState, look: Appearance) -> Frame:
    """What the camera sees of it."""
    renderer = Renderer((1280, 800), (848, 480), seed=7)
    color, depth = renderer.render(scene, look)
    return Frame(color, depth, renderer.color_intrinsics, renderer.depth_intrinsics, 0.0, 1, 1)


def titled(picture: U8, title: str) -> U8:
    """Scaled to one size, with a title."""
    small = cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA)
    if small.ndim == 2:
        small = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    drawn = np.asarray(small, dtype=np.uint8)
    text_on(drawn, title, (10, SIZE[1] - 12), 0.5)
    return drawn


def save(name: str, pictures: list[U8]) -> None:
    """Side by side."""
    cv2.imwrite(str(OUT / name), np.hstack(pictures), [cv2.IMWRITE_JPEG_QUALITY, 82])


def main() -> None:
    """Write all pictures."""
    blade, calibration = BladeGeometry(), CameraCalibration()
    brown = photograph(Appearance(soil="loam", ground="concrete", blade="steel"))
    paper = SoilClassifier(PerceptionSettings(method="paper"), calibration, blade, live=False)
    filtered, mask, contour = paper_steps(brown.color_bgr, PerceptionSettings().color)
    said = paper.classify(brown, ANGLE_DEG, 0.0, ON_GROUND)
    save(
        "perception-paper.jpg",
        [
            titled(filtered, "brightness, bilateral filter"),
            titled(np.asarray(cv2.bitwise_and(filtered, filtered, mask=mask), dtype=np.uint8), "hue window, Otsu"),
            titled(contour, "largest contour"),
            titled(paper.annotate(no_wider(brown, SIZE[0]), said), "area per third"),
        ],
    )
    hard = photograph(Appearance(soil="gravel", ground="plywood", blade="rusty", red_cast=0.25))
    judge = SoilClassifier(PerceptionSettings(), calibration, blade, live=False)
    soil = judge.height_map(hard, Stance(ANGLE_DEG, ON_GROUND))
    assert soil is not None
    assert hard.depth_mm is not None
    shade = np.clip(hard.depth_mm / 1700 * 255, 0, 255).astype(np.uint8)
    depth = np.asarray(cv2.applyColorMap(shade, cv2.COLORMAP_TURBO), dtype=np.uint8)
    depth[hard.depth_mm == 0] = 0
    map_mm = np.clip(soil.height_m.T * 1000, 0, 250)  # the operator's right at the left, as in the picture
    tall = cv2.resize((map_mm / 250 * 255).astype(np.uint8), SIZE, interpolation=cv2.INTER_NEAREST)
    hidden = cv2.resize((~soil.seen.T).astype(np.uint8), SIZE, interpolation=cv2.INTER_NEAREST)
    plan = np.asarray(cv2.applyColorMap(tall, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    plan[(hidden > 0) & (np.indices(hidden.shape).sum(axis=0) % 6 < 2)] = 255
    said, small = judge.classify(hard, ANGLE_DEG, 0.0, ON_GROUND), no_wider(hard, SIZE[0])
    wrong = SoilClassifier(PerceptionSettings(method="fast_color"), calibration, blade, live=False)
    save(
        "perception-depth.jpg",
        [
            titled(depth, "depth picture"),
            titled(plan, "height map from above; hatched: filled in"),
            titled(judge.annotate(small, said), "depth, the default"),
            titled(
                wrong.annotate(small, wrong.classify(hard, ANGLE_DEG, 0.0, ON_GROUND)), "fast_color on the same frame"
            ),
        ],
    )
    at_work()


def at_work() -> None:
    """The camera's view of a left heap, and the bed from above."""
    scene, look, pose = heap_before(WORK_DEG), Appearance(), BladePose(WORK_DEG)
    frame = photographed(scene, look)
    judge = SoilClassifier(PerceptionSettings(), CameraCalibration(), BladeGeometry(), live=False)
    view = judge.annotate(no_wider(frame, 640), judge.classify(frame, WORK_DEG, 0.0, ON_GROUND))
    bed = top_view(scene.heights_m.astype(np.float64), scene.cell_m, scene.vehicle_x_m, pose, look)
    middle = bed.shape[0] // 2
    bed = np.asarray(cv2.resize(bed, None, fx=(f := 250 / bed.shape[1]), fy=f, interpolation=cv2.INTER_AREA), np.uint8)
    middle = round(middle * f)
    bed = bed[max(0, middle - 200) : max(0, middle - 200) + 400]
    gap = np.full((400, 6, 3), 255, np.uint8)
    save("at-work.jpg", [view, gap, bed])


if __name__ == "__main__":
    main()
