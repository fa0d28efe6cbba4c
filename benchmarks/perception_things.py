"""Legs, foliage, pipes, boxes, stones and planks before the blade, on empty and loaded beds: what depth makes of them.

    python -m benchmarks.perception_things                # 27 placements of each in each third
    python -m benchmarks.perception_things --each 5       # fewer

Every placement is judged on an empty bed, or with a heap in another third: what lies before the blade, and what the
blade will meet. Bars: no thing alone is called a pile, and no heap on one side is answered with the thing's. Of things
as large as a third of the blade it is told, and no bar.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

import cv2

from graderd.core.blade import BladeGeometry
from graderd.core.soil import SoilObservation, Zone
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.perception.classifier import Classifier, make_classifier
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.grader.piles import SceneZone
from harness.perception_scenes import ON_GROUND
from harness.perception_things import COLOR_SIZE, DEPTH_SIZE, KINDS, LARGE, SIDES, photograph

OPPOSITE = {Zone.LEFT: SceneZone.RIGHT, Zone.RIGHT: SceneZone.LEFT}


def sweep(each_n: int) -> list[tuple[str, Zone, SceneZone, float, SoilObservation]]:
    """Judge ``each_n`` placements of every thing in every third, every other one on a loaded bed."""
    renderer = Renderer(COLOR_SIZE, DEPTH_SIZE, seed=7)
    judge: Classifier = make_classifier(
        PerceptionSettings(method="depth"), CameraCalibration(), BladeGeometry(), live=False
    )
    found = []
    for kind in (*KINDS, *LARGE):
        for side in SIDES:
            for number in range(each_n):
                loaded = SceneZone.NONE
                if number % 2:
                    loaded = OPPOSITE.get(side, SceneZone.LEFT if number % 4 == 1 else SceneZone.RIGHT)
                angle_deg = (-30.0, 0.0, 15.0, 45.0)[number // 2 % 4]
                frame = photograph(renderer, kind, side, loaded, angle_deg, number)
                observation = judge.classify(frame, angle_deg, 0.0, ON_GROUND)
                found.append((kind, side, loaded, angle_deg, observation))
    return found


def wrong(side: Zone, loaded: SceneZone, observation: SoilObservation) -> str:
    """What is wrong about an answer; empty where nothing is."""
    ahead = Zone.UNKNOWN if observation.ahead is None else observation.ahead.zone
    if loaded is SceneZone.NONE:
        return "" if {observation.zone, ahead} <= {Zone.UNKNOWN, Zone.NONE} else "ghost"
    if observation.zone is side:
        return "swap"
    # A heap is met by the third it is named after, whatever the blade's angle.
    return "" if ahead in (Zone(str(loaded)), Zone.NONE, Zone.UNKNOWN) else "swap ahead"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--each", type=int, default=27, help="placements of each thing in each third")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    counts: Counter[tuple[str, str, str]] = Counter()
    wrong_n = dict.fromkeys((KINDS, LARGE), 0)
    for kind, side, loaded, angle_deg, observation in sweep(options.each):
        counts[kind, "loaded" if loaded is not SceneZone.NONE else "empty", str(observation.zone)] += 1
        if problem := wrong(side, loaded, observation):
            wrong_n[LARGE if kind in LARGE else KINDS] += 1
            print(f"{problem}: {kind} {side} at {angle_deg:+.0f} deg, soil {loaded}: {observation.zone} "
                  f"{observation.confidence * 100:.0f} %, {observation.reason}; ahead {observation.ahead}")  # fmt: skip
    for (kind, bed, zone), count in sorted(counts.items()):
        print(f"{kind:<8} {bed:<7} {zone:<8} {count}")
    for kinds, what in ((KINDS, "placements"), (LARGE, "of large things")):
        placed_n = sum(count for (kind, _, _), count in counts.items() if kind in kinds)
        print(f"{placed_n} {what}, {wrong_n[kinds]} wrong")
    return 1 if wrong_n[KINDS] else 0


if __name__ == "__main__":
    sys.exit(main())
