"""``python -m graderd.simulator.dataset --out DIR``: write a labelled frame set of random scenes.

A frame set is a folder of ``NNN.color.jpg|png``, ``NNN.depth.png`` (16-bit, millimetres along the optical axis, 0 = no
value), ``manifest.csv`` and ``camera.json``. The camera data are nominal; each picture is taken from a pose that
differs from it by up to 2 cm and 2 degrees, as the manifest says.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import multiprocessing
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from graderd.hal.camera import ColorImage, DepthImage
from graderd.simulator.camera.ground import SceneState
from graderd.simulator.camera.materials import Materials
from graderd.simulator.camera.optics import COLOR_INTRINSICS, DEPTH_INTRINSICS, camera_json, knocked
from graderd.simulator.camera.renderer import Renderer
from graderd.simulator.scenes import RandomScene, random_scene

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
_TEXTURE_VARIANTS = 4
_ANGLE_ERROR_DEG = 0.2
"""Standard deviation of the blade angle given with a frame: what a servo's reading is off by."""


class _Studio:
    """Makes the frames of one set, any of them in any order: a frame depends on the seed and its number alone."""

    def __init__(
        self,
        out: Path,
        digits: int,
        seed: int,
        color_format: str,
        color_size: tuple[int, int],
        depth_size: tuple[int, int],
    ) -> None:
        self._out = out
        self._digits = digits
        self._seed = seed
        self._color_format = color_format
        self._color_size = color_size
        self._depth_size = depth_size
        self._materials: dict[int, Materials] = {}

    def make(self, number: int) -> dict[str, Any]:
        """Write frame ``number``; returns its line of the manifest."""
        scene = random_scene(self._seed, number)
        color, depth = self._photograph(scene, number)
        name = f"{number:0{self._digits}d}"
        _write(self._out / f"{name}.color.{self._color_format}", color)
        _write(self._out / f"{name}.depth.png", depth)
        return _row(name, scene, (self._seed, number))

    def _photograph(self, scene: RandomScene, number: int) -> tuple[ColorImage, DepthImage]:
        variant = number % _TEXTURE_VARIANTS
        if variant not in self._materials:
            self._materials[variant] = Materials(self._seed + variant)
        color_pose, depth_pose = knocked(scene.shift_m, scene.turn_deg)
        renderer = Renderer(
            self._color_size,
            self._depth_size,
            seed=int(np.random.default_rng((self._seed, number, 1)).integers(2**31)),
            color_pose=color_pose,
            depth_pose=depth_pose,
            materials=self._materials[variant],
        )
        heights_m = scene.field.heights_m.astype(np.float32)
        state = SceneState(heights_m, scene.field.cell_m, scene.vehicle_x_m, scene.blade, scene.props)
        color, depth = renderer.render(state, scene.appearance)
        assert depth is not None
        return color, depth


def export(
    out: Path,
    scenes: int,
    seed: int,
    *,
    color_format: str = "jpg",
    color_size: tuple[int, int] = (1280, 800),
    depth_size: tuple[int, int] = (848, 480),
    jobs: int = 1,
    progress: bool = True,
) -> None:
    """Write ``scenes`` random scenes of ``seed`` as a frame set into ``out`` (made if missing).

    ``jobs`` processes share the work; the frames do not depend on how many. A run that is stopped leaves a valid,
    shorter set: the manifest's line is written after the frame's pictures.

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
    studio = _Studio(out, max(3, len(str(scenes - 1))), seed, color_format, color_size, depth_size)
    start_s = time.monotonic()
    with manifest_path.open("w", newline="", encoding="utf-8") as file, contextlib.ExitStack() as stack:
        manifest = csv.DictWriter(file, [*COLUMNS, *EXTRA_COLUMNS])
        manifest.writeheader()
        rows: Iterable[dict[str, Any]] = map(studio.make, range(scenes))
        if jobs > 1:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(jobs, context, initializer=_enter, initargs=(studio,))
            stack.callback(pool.shutdown, cancel_futures=True)
            rows = pool.map(_make, range(scenes))
        for done, row in enumerate(rows, start=1):
            manifest.writerow(row)
            file.flush()
            if progress:
                _show(done, scenes, time.monotonic() - start_s)
    if progress:
        sys.stderr.write("\n")


_studio: _Studio | None = None
"""In a worker process: the studio it works in, so that its textures are made once."""


def _enter(studio: _Studio) -> None:
    global _studio  # a pool's initializer has no other place to leave what its workers need
    cv2.setNumThreads(1)
    _studio = studio


def _make(number: int) -> dict[str, Any]:
    assert _studio is not None
    return _studio.make(number)


def _row(name: str, scene: RandomScene, seeds: tuple[int, int]) -> dict[str, Any]:
    error_deg = float(np.random.default_rng((*seeds, 2)).normal(0.0, _ANGLE_ERROR_DEG))
    appearance = {key: _short(value) for key, value in asdict(scene.appearance).items()}
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
        **appearance,
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
        prog="python -m graderd.simulator.dataset",
        description="Write a labelled frame set of random scenes: soil, light, blade, camera pose, noise, occluders.",
        epilog="Example: python -m graderd.simulator.dataset --out frames --scenes 300 --seed 42",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write (must not hold a set yet)")
    parser.add_argument("--scenes", type=int, default=300, help="how many (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="which set; the same seed gives the same frames")
    parser.add_argument("--format", choices=("jpg", "png"), default="jpg", help="of the colour pictures (default jpg)")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the work (default 1)")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = parser.parse_args(arguments)
    if options.scenes < 1 or options.seed < 0 or options.jobs < 1:
        parser.error("--scenes and --jobs must be at least 1 and --seed not negative")
    cv2.setNumThreads(1)
    try:
        export(
            options.out,
            options.scenes,
            options.seed,
            color_format=options.format,
            jobs=options.jobs,
            progress=not options.quiet,
        )
    except OSError as error:
        sys.stderr.write(f"dataset: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\ndataset: stopped; the frames written so far are a valid set\n")
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
