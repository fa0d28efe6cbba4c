"""How fast the rig is: pictures, physics and generated sets on one core. ``python -m benchmarks.rig [--json]``.

The bar: at least 15 colour and depth frames a second at 640 x 400 on one core. Times are CPU seconds of this process,
so that a busy machine spoils them less; wall times stand beside them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from graderd.simulator.camera.appearance import Appearance
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.materials import Materials
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.dataset import export
from graderd.simulator.grader.blade import BladePose
from graderd.simulator.grader.piles import SceneZone
from graderd.simulator.grader.world import World, scene_heights

BAR_FPS = 15.0
SIZES = (
    ((640, 400), (424, 240)),
    ((640, 400), (640, 400)),
    ((640, 400), (848, 480)),
    ((1280, 800), (848, 480)),
    ((640, 400), None),
)


def timed(function: Callable[[], object], count: int) -> tuple[float, float]:
    """CPU and wall seconds of one call, over ``count`` calls."""
    cpu_s, wall_s = time.process_time(), time.monotonic()
    for _ in range(count):
        function()
    return (time.process_time() - cpu_s) / count, (time.monotonic() - wall_s) / count


def pictures() -> list[dict[str, Any]]:
    """Frames a second while the blade turns in front of a heap."""
    world = World()
    world.lay(scene_heights(SceneZone.LEFT, world.vehicle.x_m, BladePose(), 0))
    materials = Materials(0)
    rows = []
    for color, depth in SIZES:
        renderer = Renderer(color, depth, materials=materials)
        angle_deg = 0.0

        def frame(renderer: Renderer = renderer) -> None:
            nonlocal angle_deg
            angle_deg = (angle_deg + 1.0) % 45.0
            soil = world.field.heights_m.astype(np.float32)
            blade = BladePose(angle_deg)
            renderer.render(SceneState(soil, world.field.cell_m, world.vehicle.x_m, blade), Appearance())

        frame()
        cpu_s, wall_s = timed(frame, 40)
        rows.append(
            {
                "color": "x".join(map(str, color)),
                "depth": "x".join(map(str, depth)) if depth else "none",
                "cpu_ms": cpu_s * 1e3,
                "wall_ms": wall_s * 1e3,
                "fps_per_core": 1.0 / cpu_s,
            }
        )
    return rows


def physics() -> list[dict[str, Any]]:
    """Cost of one 10 ms tick of the world, at rest, turning in place and driving at 1 m/s through a heap."""
    rows = []
    for name, speed, turn in (("at rest", 0.0, 0.0), ("turning at 30 deg/s", 0.0, 0.3), ("driving at 1 m/s", 1.0, 0.0)):
        world = World()
        world.lay(scene_heights(SceneZone.CENTER, world.vehicle.x_m, BladePose(), 0))
        for _ in range(200):
            world.step(0.01, BladePose())
        if speed:
            world.vehicle.drive(speed, 3.0)
        angle_deg = 0.0

        def tick(world: World = world, turn: float = turn) -> None:
            nonlocal angle_deg
            angle_deg += turn
            world.step(0.01, BladePose(angle_deg))

        cpu_s, wall_s = timed(tick, 150)
        rows.append({"case": name, "cpu_ms": cpu_s * 1e3, "wall_ms": wall_s * 1e3, "core_percent": cpu_s * 1e4})
    return rows


def sets(count: int) -> dict[str, Any]:
    """Cost of one scene of a generated frame set (1280x800 JPEG, 848x480 PNG), textures included."""
    with tempfile.TemporaryDirectory() as folder:
        cpu_s, wall_s = timed(lambda: export(Path(folder) / "set", count, 0, progress=False), 1)
    return {
        "scenes": count,
        "cpu_s": cpu_s / count,
        "wall_s": wall_s / count,
        "per_minute_of_cpu": 60.0 * count / cpu_s,
    }


def main() -> int:
    """Measure and print; status 1 where the bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--scenes", type=int, default=20, help="scenes of the generated set (default 20)")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    result: dict[str, Any] = {"pictures": pictures(), "physics": physics(), "set": sets(options.scenes)}
    slowest = min(row["fps_per_core"] for row in result["pictures"] if row["color"] == "640x400")
    result["bar"] = {"fps_at_640x400": slowest, "wanted_fps": BAR_FPS, "met": slowest >= BAR_FPS}
    if options.json:
        print(json.dumps(result))
        return 0 if result["bar"]["met"] else 1
    print(f"{'colour':>10} {'depth':>9} {'cpu ms':>8} {'wall ms':>8} {'frames/s of one core':>21}")
    for row in result["pictures"]:
        times = f"{row['cpu_ms']:8.1f} {row['wall_ms']:8.1f} {row['fps_per_core']:21.1f}"
        print(f"{row['color']:>10} {row['depth']:>9} {times}")
    print(f"\n{'physics, one 10 ms tick':<26} {'cpu ms':>8} {'share of a core':>16}")
    for row in result["physics"]:
        print(f"{row['case']:<26} {row['cpu_ms']:8.2f} {row['core_percent']:15.1f}%")
    made = result["set"]
    print(
        f"\ngenerated set: {made['cpu_s']:.2f} s of CPU a scene, {made['per_minute_of_cpu']:.0f} scenes a minute of CPU"
    )
    verdict = "met" if result["bar"]["met"] else "MISSED"
    print(f"bar: {BAR_FPS:.0f} colour+depth frames/s at 640x400 on one core: {slowest:.1f}, {verdict}")
    return 0 if result["bar"]["met"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
