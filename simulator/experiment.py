"""``graderd rig experiment``: the study's field experiment on the virtual bed, with the whole daemon in the loop.

Each trial lays a heap, lets automatic operation look at it, decide and turn the blade to the angle under test, drives
through it, and has a depth camera over the bed scan it before and after. What comes of it is an experiment like any
other: scans, loads and an experiment file in one folder, which ``graderd evaluate`` measures. Trials that are there
already are not driven again.
"""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from graderd.client import ClientError
from graderd.hal.errors import DeviceError
from graderd.runtime.app.sim import new_rig_directory
from graderd.simulator.camera.top import F64, Surface, TopCamera, save
from graderd.simulator.control_client import RigControl
from graderd.simulator.grader.world import START_X_M
from graderd.simulator.operator import Mound, Operator, Pass, PassFailedError, Way, ended_by_sigterm, whole_machine
from graderd.simulator.show import LineShow, Show

ANGLES_DEG = (15.0, 30.0, 45.0)
FLAT = "even"
ZONES = ("left", "center", "right", FLAT)
"""Where the soil lies: heaps to scatter, and a low mound wider than the blade, to flatten."""
TARGET_MM = 20.0
"""Flattening: the plane that the blade is held at."""
MOUND = Mound({"x_m": 1.0, "y_m": 0.0, "length_m": 1.8, "width_m": 1.4, "height_m": 0.06}, TARGET_MM)
SWATH = "{ x_mm = [-1000, 0], y_mm = [-250, 250] }"
"""What of it the blade has gone over at every angle up to 60 degrees, as the camera counts."""
TRIALS_N = 5
WAY = Way(distance_m=2.0, speed_m_per_s=1.0)
SCANS_N = 5
"""Of each state."""
CAMERA_X_M = START_X_M + 1.4
CAMERA_HEIGHT_M = 2.0
"""Where the camera hangs, its long side along the bed: it sees 4 m of it, from 0.6 m behind the start on, and 2.2 m
across."""
NOISE_PX = (0.09, 0.37)
TILT_MOST_DEG = 2.0
HOLE_SHARE = 0.05
"""Noise as of real D455; hung with a spirit level; what of a picture has no value over soil."""
STILL_S = 0.2
EXPERIMENT = "experiment.toml"


@dataclass(frozen=True, slots=True)
class Trial:
    """One pass to drive. ``angle_deg``: of the blade; its left end trails where it is positive."""

    zone: str
    angle_deg: float
    number: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.zone}-{abs(self.angle_deg):g}-{self.number}"

    @property
    def seed(self) -> int:
        """Of its heap: the same for all angles, so that they are compared on the same soil."""
        return 100 * ZONES.index(self.zone) + self.number

    @property
    def mound(self) -> Mound | None:
        """What is to be flattened in it."""
        return MOUND if self.zone == FLAT else None


def trials(angles_deg: Sequence[float], zones: Sequence[str], count: int) -> list[Trial]:
    """All of them, angle by angle. Soil on the right is met by the mirrored blade, as the rule does."""
    return [
        Trial(zone, -angle_deg if zone == "right" else angle_deg, number)
        for angle_deg in angles_deg
        for number in range(1, count + 1)
        for zone in zones
    ]


def rule_for(angle_deg: float) -> str:
    """The rule that turns to this angle wherever the soil lies."""
    goals = {"left": angle_deg, "center": angle_deg, "right": -angle_deg, FLAT: angle_deg}
    return "".join(f"{zone}_deg = {goal_deg:g}\n" for zone, goal_deg in goals.items())


class Folder:
    """The experiment's folder: what of each trial is there, and the file that names it all."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def done(self, trial: Trial) -> dict[str, Any] | None:
        """What a trial came to; None: it was not driven to its end."""
        path = self.path / f"{trial.name}.json"
        try:
            told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):
            return None
        return told

    def finish(self, trial: Trial, driven: Pass) -> None:
        """Its loads, and last the file that says it is whole."""
        with (self.path / f"{trial.name}.csv").open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(("time_s", "vehicle_x_m", "load_n"))
            rows.writerows((s["time_s"], s["vehicle_x_m"], s["load_force_n"]) for s in driven.states if s["driving"])
        told = {**driven.told(), "blade_x_mm": round((driven.states[-1]["vehicle_x_m"] - CAMERA_X_M) * 1e3, 1)}
        partial = self.path / f".{trial.name}.json.{os.getpid()}"
        partial.write_text(json.dumps(told) + "\n", encoding="utf-8")
        partial.replace(self.path / f"{trial.name}.json")

    def write_experiment(self, wanted: Sequence[Trial]) -> Path:
        """The experiment file of the trials."""
        lines = [
            'name = "Three angles on the virtual bed"',
            'spread = ["extreme", "mass_95", "second_moment"]',
            'travel = "left"',
        ]
        by_zone = sorted(wanted, key=lambda trial: (ZONES.index(trial.zone), abs(trial.angle_deg), trial.number))
        for zone, group in groupby(by_zone, key=lambda trial: trial.zone):
            if zone == FLAT:
                lines += ["", "[[case]]", 'name = "Flattening work"', 'work = "flattening"']
                lines += [f"target_height_mm = {TARGET_MM:g}", f"layer = {SWATH}"]
            else:
                lines += ["", "[[case]]", f'name = "Scattering work (soil {zone})"', 'work = "scattering"']
            for trial in group:
                told = self.done(trial)
                assert told is not None
                lines += [
                    "",
                    "[[case.trial]]",
                    f"angle_deg = {trial.angle_deg:g}",
                    f'before = ["{trial.name}-before-*.depth.png"]',
                    f'after = ["{trial.name}-after-*.depth.png"]',
                    f'load_csv = "{trial.name}.csv"',
                    f"blade_x_mm = {told['blade_x_mm']:g}",
                ]
        path = self.path / EXPERIMENT
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path


def seen_from_above(heights_m: F64, cell_m: float) -> Surface:
    """The bed as the camera has it that hangs across: its picture's left edge is forward."""
    n_y = heights_m.shape[1]

    def surface(x: F64, y: F64) -> F64:
        along = (CAMERA_X_M + y / 1e3) / cell_m - 0.5
        across = (n_y * cell_m / 2.0 - x / 1e3) / cell_m - 0.5
        bed = heights_m.astype(np.float32)
        found = cv2.remap(bed, across.astype(np.float32), along.astype(np.float32), cv2.INTER_LINEAR, borderValue=0.0)
        return np.asarray(found, dtype=np.float64) * 1e3

    return surface


def camera_of(trial: Trial) -> TopCamera:
    """Hung anew for each trial."""
    rng = np.random.default_rng((trial.seed, round(abs(trial.angle_deg))))
    pitch_deg, roll_deg = rng.uniform(-TILT_MOST_DEG, TILT_MOST_DEG, 2)
    return TopCamera(
        height_mm=CAMERA_HEIGHT_M * 1e3,
        pitch_deg=float(pitch_deg),
        roll_deg=float(roll_deg),
        noise_px=float(rng.uniform(*NOISE_PX)),
        hole_share=HOLE_SHARE,
        seed=int(rng.integers(2**31)),
    )


class Bed:
    """The rig's bed under the camera."""

    def __init__(self, rig: RigControl, scratch: Path) -> None:
        self._rig = rig
        self._picture = scratch / "bed.png"

    async def heights(self) -> tuple[F64, float]:
        """Heights in metres once the soil is at rest, and the side of a cell."""
        before: F64 | None = None
        while True:
            told = await self._rig.request("topdepth", path=str(self._picture))
            depth = cv2.imread(str(self._picture), cv2.IMREAD_UNCHANGED)
            assert depth is not None
            heights = told["camera_height_m"] - depth[::-1, ::-1].astype(np.float64) / 1e3
            if before is not None and np.array_equal(before, heights):
                return heights, told["pixel_m"]
            before = heights
            await asyncio.sleep(STILL_S)


async def drive(wanted: Sequence[Trial], folder: Folder, show: Show) -> None:
    """Drive what is not there yet, a rig and a daemon for each angle.

    Raises:
        PassFailedError, ClientError, DeviceError, OSError: why it could not go on; what is there stays.
    """
    missing = [trial for trial in wanted if folder.done(trial) is None]
    show.event("experiment", trials_n=len(wanted), there_n=len(wanted) - len(missing), folder=str(folder.path))
    done_n = len(wanted) - len(missing)
    for angle_deg, group in groupby(missing, key=lambda trial: abs(trial.angle_deg)):
        directory = new_rig_directory()
        try:
            async with (
                whole_machine(directory, show, rule_for(angle_deg)) as client,
                RigControl(directory / "control.sock") as control,
            ):
                operator, bed = Operator(client, control, show, WAY), Bed(control, directory)
                for trial in group:
                    driven = await _one(operator, bed, trial, folder)
                    done_n += 1
                    show.event(
                        "trial_driven", trial=trial.name, decided=driven.decided, done_n=done_n, trials_n=len(wanted)
                    )
                await client.command("disarm")
        finally:
            shutil.rmtree(directory, ignore_errors=True)


async def _one(operator: Operator, bed: Bed, trial: Trial, folder: Folder) -> Pass:
    camera = camera_of(trial)

    async def scan(state: str) -> None:
        surface = seen_from_above(*await bed.heights())
        await asyncio.to_thread(_save, camera, surface, folder.path, f"{trial.name}-{state}")

    driven = await operator.drive_pass(trial.zone, trial.seed, lambda: scan("before"), trial.mound)
    await scan("after")
    folder.finish(trial, driven)
    return driven


def _save(camera: TopCamera, surface: Surface, folder: Path, name: str) -> None:
    save(folder, name, camera.scans_mm(surface, SCANS_N), camera.lens)


def run(wanted: Sequence[Trial], out: Path, as_json: bool) -> int:
    """Drive the trials and become the command that evaluates them. Returns the exit status where that cannot be."""
    show = LineShow(as_json=as_json)
    folder = Folder(out)

    async def driven() -> None:
        async with ended_by_sigterm():
            await drive(wanted, folder, show)

    try:
        out.mkdir(parents=True, exist_ok=True)
        asyncio.run(driven())
        experiment = folder.write_experiment(wanted)
    except KeyboardInterrupt:
        sys.stderr.write("graderd: rig experiment: stopped; the same command goes on where it ended\n")
        return 130
    except (PassFailedError, ClientError, DeviceError, OSError) as error:
        sys.stderr.write(f"graderd: rig experiment: {error}. The same command goes on where it ended\n")
        return 1
    sys.stdout.flush()
    words = ("evaluate", str(experiment), "--save", str(out / "results"), *(("--json",) if as_json else ()))
    return os.execv(sys.executable, [sys.executable, "-P", "-m", "graderd", *words])


def main(arguments: list[str] | None = None) -> int:
    """Command line of the experiment."""
    parser = argparse.ArgumentParser(
        prog="graderd rig experiment",
        description="Drive the study's field experiment on the virtual bed, the daemon in the loop, and measure it.",
        epilog="Example: graderd rig experiment --out experiment",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder; trials that are there are not driven again")
    parser.add_argument("--trials", type=int, default=TRIALS_N, help=f"at each angle (default {TRIALS_N})")
    parser.add_argument("--angles", type=_angles, default=ANGLES_DEG, metavar="DEG,...", help="default 15,30,45")
    parser.add_argument(
        "--zones", type=_zones, default=ZONES, metavar="ZONE,...", help="default left,center,right,even"
    )
    parser.add_argument("--quick", action="store_true", help="one trial at each angle, soil on the left")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    options = parser.parse_args(arguments)
    if options.trials < 1:
        parser.error("--trials must be at least 1")
    zones, count = (("left",), 1) if options.quick else (options.zones, options.trials)
    return run(trials(options.angles, zones, count), options.out, options.json)


def _angles(text: str) -> tuple[float, ...]:
    found = tuple(dict.fromkeys(float(part) for part in text.split(",")))
    if not all(0.0 <= angle_deg <= 60.0 for angle_deg in found):
        raise argparse.ArgumentTypeError("angles are from 0 to 60 degrees")
    return found


def _zones(text: str) -> tuple[str, ...]:
    found = tuple(dict.fromkeys(text.split(",")))
    if not set(found) <= set(ZONES):
        raise argparse.ArgumentTypeError(f"zones are {', '.join(ZONES)}")
    return found


if __name__ == "__main__":
    raise SystemExit(main())
