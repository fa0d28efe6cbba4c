"""One hour of frames at 30 Hz through the perception worker process, time-compressed: memory flat, no old frame used.

    python -m benchmarks.perception_soak                    # 108,000 frames, as fast as the machine goes
    python -m benchmarks.perception_soak --frames 20000 --file pass.db3

The daemon's own supervisor starts the daemon's own worker; only the camera differs: a RealSense recording played over
and over without its pace (made here, 640x400 colour with 424x240 depth, where none is given), of which every hundredth
frame is handed over with an age of 0.25 s, as after a stall. The supervisor is asked at the control rate, as by the
tick. Bars: resident memory of worker and supervisor within 5 % between the second tenth of the run and its end; no
observation of a frame older than 100 ms taken as anything but unknown; the worker never restarted.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil

from graderd.core.attitude import UNMEASURED
from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.camera import Camera, EndOfFrames, Frame
from graderd.hal.clock import SystemClock
from graderd.hal.settings import CameraSettings
from graderd.perception import CameraCalibration, PerceptionSettings
from graderd.runtime.app import perception_child as worker_process
from graderd.runtime.app.frame_sources import open_camera
from graderd.runtime.perception_supervisor import PerceptionSupervisor
from harness.perception_scenes import Scene, render
from harness.realsense_devices import Color, Depth, SoftD455, record

HOUR_N = 108_000
RATE_HZ = 30.0
LATE_EVERY_N = 100
LATE_S = 0.25
TICK_S = 0.02
OLDEST_S = 0.1
SAMPLE_S = 1.0
RECORDED_N = 300
COLOR_SIZE, DEPTH_SIZE = (640, 400), (424, 240)


class CompressedCamera:
    """A recording without its pace, now and then with a late frame, for so many frames."""

    def __init__(self, camera: Camera, count: int) -> None:
        self._camera = camera
        self._left_n = count

    @property
    def description(self) -> str:
        """What it is."""
        return self._camera.description

    def open(self) -> None:
        """Open the recording."""
        self._camera.open()

    def settings_read_back(self) -> dict[str, float]:
        """What the recording says of itself."""
        return self._camera.settings_read_back()

    def reset_hardware(self) -> None:
        """As the recording does."""
        self._camera.reset_hardware()

    def close(self) -> None:
        """Close the recording."""
        self._camera.close()

    def read(self, timeout_s: float) -> Frame:
        """The next frame; `EndOfFrames` after the last."""
        if self._left_n == 0:
            raise EndOfFrames("the soak's last frame")
        self._left_n -= 1
        frame = self._camera.read(timeout_s)
        is_late = self._left_n % LATE_EVERY_N == 0
        return replace(frame, capture_s=frame.capture_s - LATE_S) if is_late else frame


def make_recording(path: Path) -> None:
    """Soil left, center, right, even and none before the blade, a few pictures with noise of their own of each."""
    rng = np.random.default_rng(5)
    pictures: list[tuple[Color, Depth | None]] = []
    zones = (Zone.LEFT, Zone.CENTER, Zone.RIGHT, Zone.EVEN, Zone.NONE)
    for seed, zone in enumerate(zones):
        frame = render(Scene(zone=zone, seed=seed), color_size=COLOR_SIZE, depth_size=DEPTH_SIZE)
        assert frame.depth_mm is not None  # the renderer makes both
        for _ in range(RECORDED_N // len(zones)):
            color = frame.color_bgr.copy()
            color[rng.integers(8) :: 8, rng.integers(16) :: 16] ^= 1
            depth = frame.depth_mm + (frame.depth_mm > 0) * rng.integers(0, 2, frame.depth_mm.shape).astype(np.uint16)
            pictures.append((color, depth.astype(np.uint16)))
    record(path, pictures, SoftD455(COLOR_SIZE, DEPTH_SIZE))


def settings_for(path: Path) -> CameraSettings:
    """The recording over and over, with the sizes it has."""
    settings = CameraSettings(source="recording", path=str(path), repeat=True)
    camera = open_camera(settings, real_time=False)
    camera.open()
    frame = camera.read(5.0)
    camera.close()
    sizes = {"color_width_px": frame.color_bgr.shape[1], "color_height_px": frame.color_bgr.shape[0]}
    if frame.depth_mm is not None:
        sizes |= {"depth_width_px": frame.depth_mm.shape[1], "depth_height_px": frame.depth_mm.shape[0]}
    return settings.model_copy(update=sizes)


async def soak(path: Path, count: int) -> bool:
    """Run ``count`` frames through a worker process; print memory and ages; whether the bars are met."""
    settings = settings_for(path)
    command = (sys.executable, "-m", __spec__.name, "--worker", "--frames", str(count))
    clock = SystemClock()
    worker = PerceptionSupervisor(
        settings, CameraCalibration(), PerceptionSettings(), BladeGeometry(), clock, command=command
    )
    me = psutil.Process()
    memory_mb: list[tuple[float, float]] = []
    zones = dict.fromkeys(Zone, 0)
    oldest_used_s, late_taken_n, next_sample_s = 0.0, 0, 0.0
    started_s = time.monotonic()
    running = asyncio.create_task(worker.run(), name="worker")
    child_cpu_s = 0.0
    try:
        while not worker.status().restarts_n:
            now_s = clock.now_s()
            worker.send_angle(0.0, now_s, UNMEASURED)
            observation = worker.take_observation()
            if observation is not None:
                zones[observation.zone] += 1
                age_s = now_s - observation.capture_s
                late_taken_n += age_s > OLDEST_S
                if observation.zone is not Zone.UNKNOWN:
                    oldest_used_s = max(oldest_used_s, age_s)
            children = me.children()
            if children and worker.newest is not None and now_s >= next_sample_s:
                next_sample_s = now_s + SAMPLE_S
                times = children[0].cpu_times()
                child_cpu_s = times.user + times.system
                memory_mb.append((children[0].memory_info().rss / 1e6, me.memory_info().rss / 1e6))
                if len(memory_mb) % 30 == 0:
                    print(f"{now_s - started_s:5.0f} s: worker {memory_mb[-1][0]:.1f} MB", file=sys.stderr, flush=True)
            await asyncio.sleep(TICK_S)
    finally:
        await asyncio.sleep(settings.stale_s + TICK_S)  # then its last word counts as the fault it is
        ended_as_asked = any("came to its end" in fault.detail for fault in worker.faults())
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    wall_s = time.monotonic() - started_s
    minutes = count / RATE_HZ / 60
    print(f"{count} frames ({minutes:.0f} min at {RATE_HZ:g} Hz) in {wall_s:.0f} s: {count / wall_s:.0f} frames/s")
    print(f"worker: {child_cpu_s / count * 1000:.2f} ms CPU a frame, with decoding the recording")
    print("observations taken: " + ", ".join(f"{zone} {n}" for zone, n in zones.items() if n))
    growths = [
        _growth(process, each)
        for process, each in zip(("worker", "supervisor"), zip(*memory_mb, strict=True), strict=True)
    ]
    print(f"oldest frame used: {oldest_used_s * 1000:.0f} ms; late ones taken, as unknown: {late_taken_n}")
    bars = {
        "memory within 5 %": all(abs(growth) <= 0.05 for growth in growths),
        "no frame older than 100 ms used": oldest_used_s <= OLDEST_S,
        "late frames were there": late_taken_n > 0,
        "decisions were there": sum(n for zone, n in zones.items() if zone is not Zone.UNKNOWN) > count // 1000,
        "the worker ended with the last frame": ended_as_asked,
    }
    for bar, met in bars.items():
        print(f"{'met   ' if met else 'MISSED'}  {bar}")
    return all(bars.values())


def _growth(process: str, memory_mb: tuple[float, ...]) -> float:
    tenth = max(1, len(memory_mb) // 10)
    early, end = float(np.median(memory_mb[tenth : 2 * tenth + 1])), float(np.median(memory_mb[-tenth:]))
    growth = end / early - 1
    print(f"{process}: {early:.1f} MB early, {end:.1f} MB at the end ({growth:+.1%}), at most {max(memory_mb):.1f}")
    return growth


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=HOUR_N)
    parser.add_argument("--file", type=Path, help="a RealSense recording (.db3)")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return worker_process.main(
            lambda settings: CompressedCamera(open_camera(settings, real_time=False), options.frames)
        )
    if options.file is not None:
        return 0 if asyncio.run(soak(options.file, options.frames)) else 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "soak.db3"
        make_recording(path)
        print(f"recording: {RECORDED_N} frame sets, {path.stat().st_size / 1e6:.0f} MB", file=sys.stderr)
        return 0 if asyncio.run(soak(path, options.frames)) else 1


if __name__ == "__main__":
    sys.exit(main())
