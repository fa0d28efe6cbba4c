"""One hour of frames at 30 Hz through camera source and classifier, time-compressed: memory flat, no old frame used.

    python -m benchmarks.perception_soak                    # 108,000 frames, as fast as the machine goes
    python -m benchmarks.perception_soak --frames 20000 --file pass.db3

Frames come from a RealSense recording where one is given, else from generated pictures with fresh noise in each. Every
hundredth frame is handed over late, as after a stall: none of those may give a zone. Bars: resident memory within 5 %
between the first tenth of the run and its end; no frame older than 100 ms ever judged.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import psutil

from drivers.realsense import RecordingCamera
from drivers.rig.dataset import export
from graderd.core.blade import BladeGeometry
from graderd.core.zones import Zone
from graderd.hal.camera import Frame
from graderd.hal.settings import CameraSettings
from graderd.perception import CameraCalibration, PerceptionSettings, make_classifier
from graderd.perception.frame_set import FrameSet
from graderd.perception.pipeline import judge_frame

HOUR_N = 108_000
LATE_EVERY_N = 100
LATE_S = 0.25
RATE_HZ = 30.0


def from_recording(path: Path) -> Iterator[Frame]:
    """The recording over and over, unpaced."""
    camera = RecordingCamera(CameraSettings(source="recording", path=str(path), repeat=True), real_time=False)
    camera.open()
    try:
        while True:
            yield camera.read(5.0)
    finally:
        camera.close()


def generated(folder: Path) -> Iterator[Frame]:
    """Generated scenes over and over, each picture with noise of its own, so that none is frozen."""
    export(folder, 12, 5, progress=False)
    frames = [frame for _, frame in FrameSet(folder).frames()]
    number = 0
    while True:
        frame = frames[number // 30 % len(frames)]
        number += 1
        color = frame.color_bgr.copy()
        color[number % 8 :: 8, number % 16 :: 16] ^= 1
        yield replace(frame, color_bgr=color, color_number=number, depth_number=number)


def soak(frames: Iterator[Frame], count: int) -> bool:
    """Run ``count`` frames; print what became of memory and ages; whether the bars are met."""
    classifier = make_classifier(PerceptionSettings(), CameraCalibration(), BladeGeometry())
    settings = PerceptionSettings().decision
    process = psutil.Process()
    memory_mb: list[float] = []
    zones = dict.fromkeys(Zone, 0)
    oldest_judged_s = 0.0
    late_judged = 0
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    for number in range(count):
        now_s = number / RATE_HZ  # the run's own clock: an hour passes in minutes
        late = number % LATE_EVERY_N == LATE_EVERY_N - 1
        age_s = LATE_S if late else 0.02
        frame = replace(next(frames), capture_s=now_s - age_s)
        angle_deg = frame.metadata.get("blade_angle_deg", 0.0)
        said = judge_frame(classifier, frame, angle_deg, 0.01, now_s, settings)
        zones[said.zone] += 1
        if said.method:
            oldest_judged_s = max(oldest_judged_s, age_s)
        late_judged += late and said.zone is not Zone.UNKNOWN
        if number % 500 == 0:
            memory_mb.append(process.memory_info().rss / 1e6)
    wall_s, cpu_s = time.monotonic() - start_s, time.process_time() - start_cpu_s
    tenth = max(1, len(memory_mb) // 10)
    early, end = float(np.median(memory_mb[tenth : 2 * tenth + 1])), float(np.median(memory_mb[-tenth:]))
    growth = (end / early - 1) * 100
    minutes, each_ms = count / RATE_HZ / 60, cpu_s / count * 1000
    print(f"{count} frames ({minutes:.0f} min at 30 Hz) in {wall_s:.0f} s, {each_ms:.2f} ms CPU each with making them")
    print("zones: " + ", ".join(f"{zone} {n}" for zone, n in zones.items() if n))
    print(f"memory: {early:.1f} MB early, {end:.1f} MB at the end ({growth:+.1f} %), at most {max(memory_mb):.1f}")
    print(f"oldest frame judged: {oldest_judged_s * 1000:.0f} ms; late frames that gave a zone: {late_judged}")
    bars = {"memory within 5 %": abs(growth) <= 5.0, "no frame older than 100 ms used": oldest_judged_s <= 0.1}
    bars["late frames never give a zone"] = late_judged == 0
    for bar, met in bars.items():
        print(f"{'met ' if met else 'MISSED'}  {bar}")
    return all(bars.values())


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=HOUR_N)
    parser.add_argument("--file", type=Path, help="a RealSense recording (.db3)")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.file is not None:
        return 0 if soak(from_recording(options.file), options.frames) else 1
    with tempfile.TemporaryDirectory() as folder:
        return 0 if soak(generated(Path(folder)), options.frames) else 1


if __name__ == "__main__":
    sys.exit(main())
