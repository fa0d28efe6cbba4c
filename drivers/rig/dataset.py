"""``python -m drivers.rig.dataset --out DIR``: write a labelled frame set of random scenes.

A frame set is a folder of ``NNN.color.jpg|png``, ``NNN.depth.png`` (16-bit, millimetres along the optical axis, 0 = no
value), ``manifest.csv`` and ``camera.json``. The camera data are nominal; each picture is taken from a pose that
differs from it by up to 2 cm and 2 degrees, as the manifest says.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drivers.rig.ground import SceneState
from drivers.rig.materials import Materials
from drivers.rig.optics import COLOR_INTRINSICS, DEPTH_INTRINSICS, camera_json, knocked
from drivers.rig.renderer import Renderer
from drivers.rig.scenes import RandomScene, random_scene

COLUMNS = ("id", "label", "blade_angle_deg", "vol_left_l", "vol_center_l", "vol_right_l")
EXTRA_COLUMNS = (
    "ambiguous",
    "intended",
    "true_angle_deg",
    "blade_height_mm",
    "blade_slope_deg",
    "blade_pitch_deg",
    "soil",
    "wetness",
    "blade",
    "ground",
    "sun_azimuth_deg",
    "sun_elevation_deg",
    "sun_strength",
    "ambient",
    "exposure",
    "red_cast",
    "shadows",
    "machine_shadow",
    "color_noise",
    "disparity_noise_px",
    "hole_share",
    "occluders",
    "shift_x_mm",
    "shift_y_mm",
    "shift_z_mm",
    "turn_x_deg",
    "turn_y_deg",
    "turn_z_deg",
)
_ANGLE_ERROR_DEG = 0.2
"""Standard deviation of the blade angle given with a frame: what a servo's reading is off by."""


def export(
    out: Path,
    scenes: int,
    seed: int,
    *,
    color_format: str = "jpg",
    color_size: tuple[int, int] = (1280, 800),
    depth_size: tuple[int, int] = (848, 480),
    progress: bool = True,
) -> None:
    """Write ``scenes`` random scenes of ``seed`` as a frame set into ``out`` (made if missing).

    A run that is stopped leaves a valid, shorter set: the manifest's line is written after the frame's pictures.

    Raises:
        FileExistsError: ``out`` holds a frame set already.
        OSError: it cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    manifest_path = out / "manifest.csv"
    if manifest_path.exists():
        raise FileExistsError(f"{out} holds a frame set already; choose another folder or remove it")
    color_lens, depth_lens = COLOR_INTRINSICS.scaled(*color_size), DEPTH_INTRINSICS.scaled(*depth_size)
    (out / "camera.json").write_text(json.dumps(camera_json(color_lens, depth_lens), indent=1) + "\n", encoding="utf-8")
    digits = max(3, len(str(scenes - 1)))
    start_s = time.monotonic()
    materials = [Materials(seed + variant) for variant in range(4)]
    with manifest_path.open("w", newline="", encoding="utf-8") as file:
        manifest = csv.DictWriter(file, [*COLUMNS, *EXTRA_COLUMNS])
        manifest.writeheader()
        for number in range(scenes):
            scene = random_scene(seed, number)
            color, depth = _photograph(scene, materials[number % 4], (seed, number), color_size, depth_size)
            name = f"{number:0{digits}d}"
            _write(out / f"{name}.color.{color_format}", color)
            _write(out / f"{name}.depth.png", depth)
            manifest.writerow(_row(name, scene, (seed, number)))
            file.flush()
            if progress:
                _show(number + 1, scenes, time.monotonic() - start_s)
    if progress:
        sys.stderr.write("\n")


def _photograph(
    scene: RandomScene,
    materials: Materials,
    seeds: tuple[int, int],
    color_size: tuple[int, int],
    depth_size: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    color_pose, depth_pose = knocked(scene.shift_m, scene.turn_deg)
    noise_seed = int(np.random.default_rng((*seeds, 1)).integers(2**31))
    renderer = Renderer(
        color_size, depth_size, seed=noise_seed, color_pose=color_pose, depth_pose=depth_pose, materials=materials
    )
    state = SceneState(
        scene.field.heights_m.astype(np.float32), scene.field.cell_m, scene.vehicle_x_m, scene.blade, scene.props
    )
    color, depth = renderer.render(state, scene.look)
    assert depth is not None
    return color, depth


def _row(name: str, scene: RandomScene, seeds: tuple[int, int]) -> dict[str, Any]:
    error_deg = float(np.random.default_rng((*seeds, 2)).normal(0.0, _ANGLE_ERROR_DEG))
    look = {key: _short(value) for key, value in scene.look.model_dump().items()}
    left, center, right = scene.volumes_l
    return {
        "id": name,
        "label": scene.label,
        "blade_angle_deg": f"{scene.blade.angle_deg + error_deg:.2f}",
        "vol_left_l": f"{left:.3f}",
        "vol_center_l": f"{center:.3f}",
        "vol_right_l": f"{right:.3f}",
        "ambiguous": str(scene.ambiguous).lower(),
        "intended": scene.intended,
        "true_angle_deg": f"{scene.blade.angle_deg:.2f}",
        "blade_height_mm": f"{scene.blade.height_m * 1000.0:.1f}",
        "blade_slope_deg": f"{scene.blade.slope_deg:.2f}",
        "blade_pitch_deg": f"{scene.blade.pitch_deg:.2f}",
        **look,
        "occluders": scene.occluders,
        **{f"shift_{axis}_mm": f"{value * 1000.0:.1f}" for axis, value in zip("xyz", scene.shift_m, strict=True)},
        **{f"turn_{axis}_deg": f"{value:.2f}" for axis, value in zip("xyz", scene.turn_deg, strict=True)},
    }


def _short(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _write(path: Path, picture: np.ndarray) -> None:
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 92]
    ok, data = cv2.imencode(path.suffix, picture, options)
    if not ok:
        raise OSError(f"{path}: cannot be encoded")
    path.write_bytes(data.tobytes())


def _show(done: int, scenes: int, elapsed_s: float) -> None:
    rate = done / max(elapsed_s, 1e-6)
    left_s = (scenes - done) / rate
    if sys.stderr.isatty():
        bar = "#" * round(30 * done / scenes)
        sys.stderr.write(f"\r[{bar:<30}] {done}/{scenes}  {rate:.1f} scenes/s  {left_s:.0f} s left ")
    elif done % 50 == 0 or done == scenes:
        sys.stderr.write(f"{done}/{scenes} scenes, {rate:.1f} a second, {left_s:.0f} s left\n")
    sys.stderr.flush()


def main(arguments: list[str] | None = None) -> int:
    """Command line of the exporter."""
    parser = argparse.ArgumentParser(
        prog="python -m drivers.rig.dataset",
        description="Write a labelled frame set of random scenes: soil, light, blade, camera pose, noise, occluders.",
        epilog="Example: python -m drivers.rig.dataset --out /tmp/set --scenes 300 --seed 42",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write (must not hold a set yet)")
    parser.add_argument("--scenes", type=int, default=300, help="how many (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="which set; the same seed gives the same frames")
    parser.add_argument("--format", choices=("jpg", "png"), default="jpg", help="of the colour pictures (default jpg)")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = parser.parse_args(arguments)
    if options.scenes < 1 or options.seed < 0:
        parser.error("--scenes must be at least 1 and --seed not negative")
    cv2.setNumThreads(1)
    try:
        export(options.out, options.scenes, options.seed, color_format=options.format, progress=not options.quiet)
    except OSError as error:
        sys.stderr.write(f"dataset: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\ndataset: stopped; the frames written so far are a valid set\n")
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
