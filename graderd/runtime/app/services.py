"""Services outside the control loop: those of the drivers, step response, camera calibration."""

from __future__ import annotations

import asyncio
import base64
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from typing import Any

from pydantic import Field

from graderd.config import Config
from graderd.drivers.dynamixel.step import StepSample, analyse, render
from graderd.hal.errors import CommandRangeError, DeviceMissingError, DeviceRefusedError
from graderd.hal.rotator import Rotator
from graderd.hal.service import DeviceService
from graderd.hal.settings import Finite, Ph54Settings, Positive, RotatorSettings, Settings
from graderd.runtime.app.calibration_frames import CalibrationFrames
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import Devices
from graderd.runtime.maneuver import Maneuver
from graderd.runtime.perception_supervisor import PerceptionSupervisor

STEP_SHARES = (1.0, 0.5, 0.0, 0.5, 0.0)
"""Up, half-way down, down, half-way up, back: the half-way goal is reached from both sides, which shows backlash."""
SETTLE_S = 0.5


class StepArguments(Settings):
    """Arguments of ``rotation.step_response``."""

    step_deg: Finite = 10.0
    dwell_s: Positive = Field(2.5, le=20.0)


class CalibrateArguments(Settings):
    """Arguments of ``camera.calibrate``."""

    angles_deg: tuple[Finite, ...] = Field((-40.0, -20.0, 0.0, 20.0, 40.0), min_length=2, max_length=20)


class FileArguments(Settings):
    """Arguments of ``camera.calibration_file``."""

    file: str


def build_services(
    config: Config, devices: Devices, loop: ControlLoop, eyes: PerceptionSupervisor
) -> dict[str, DeviceService]:
    """The services by name."""
    frames = CalibrationFrames(config.state.directory)

    async def step_response(wanted: StepArguments) -> dict[str, Any]:
        return await _step_response(config, devices.rotation, loop, wanted)

    async def calibrate(wanted: CalibrateArguments) -> dict[str, Any]:
        return await _collect_frames(config, loop, eyes, frames, wanted)

    async def calibration_file(wanted: FileArguments) -> dict[str, Any]:
        # One file a request, encoded in a thread: the tick shares this loop.
        return {"base64": await asyncio.to_thread(lambda: base64.b64encode(frames.take(wanted.file)).decode())}

    return {
        **devices.services,
        "rotation.step_response": DeviceService(
            step_response, moves=True, arguments=StepArguments, summary="Turn the blade by a step and back, and report"
        ),
        "camera.calibrate": DeviceService(
            calibrate,
            moves=True,
            arguments=CalibrateArguments,
            summary="Turn the empty blade to each angle and save one frame there",
        ),
        "camera.calibration_file": DeviceService(
            calibration_file,
            only_reads=True,
            arguments=FileArguments,
            summary="A picture of the last calibration, once",
        ),
    }


async def _step_response(config: Config, rotator: Rotator, loop: ControlLoop, wanted: StepArguments) -> dict[str, Any]:
    """Steps through machine and gate: what is measured is what the blade does in operation."""
    samples: list[StepSample] = []
    async with Maneuver(loop) as blade:
        start_deg = loop.tick.pose.rotation_deg
        if start_deg is None:
            raise DeviceMissingError("rotation", "no fresh measurement to start from")
        began_s = loop.tick.now_s

        def sample(goal_deg: float) -> None:
            told = rotator.telemetry()
            if told.angle_deg and told.velocity_deg_per_s:
                samples.append(
                    StepSample(
                        told.angle_deg.time_s - began_s,
                        goal_deg,
                        told.angle_deg.value,
                        told.velocity_deg_per_s.value,
                        told.current_a.value if told.current_a else None,
                    )
                )

        for share in (0.0, *STEP_SHARES):
            goal_deg = start_deg + share * wanted.step_deg
            await blade.rotate_to(goal_deg, wanted.dwell_s, partial(sample, goal_deg))
    rotation = config.rotation
    settings = {
        "goal's speed": f"{rotation.speed_deg_per_s:g} deg/s",
        "goal's acceleration": f"{rotation.acceleration_deg_per_s2:g} deg/s²",
        "driver": rotation.backend,
        **_own_figures(rotation),
        "simulated": "yes" if config.simulated else "no",
    }
    recording = analyse(samples, rotation.tolerance_deg, settings)
    return {
        "steps": [asdict(step) for step in recording.steps],
        "backlash_deg": recording.backlash_deg,
        "backlash_from": recording.backlash_from,
        "settings": settings,
        "report_html": render(recording, when=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
    }


def _own_figures(rotation: RotatorSettings) -> dict[str, str]:
    """What the driver itself holds to, where it is one that has such settings."""
    if not isinstance(rotation, Ph54Settings):
        return {}
    return {
        "profile velocity": f"{rotation.profile_velocity_deg_per_s:g} deg/s",
        "profile acceleration": f"{rotation.profile_acceleration_deg_per_s2:g} deg/s²",
        "current limit": f"{rotation.current_limit_a:g} A" if rotation.current_limit_a else "the servo's rating",
    }


async def _collect_frames(
    config: Config, loop: ControlLoop, eyes: PerceptionSupervisor, frames: CalibrationFrames, wanted: CalibrateArguments
) -> dict[str, Any]:
    """Turn the empty blade to each angle and save one frame there, as a frame set for the client to fetch."""
    limits = config.figures()["rotation"]
    for angle_deg in wanted.angles_deg:
        if not limits.low <= angle_deg <= limits.high:
            raise CommandRangeError("angles_deg", f"{angle_deg:g} is outside {limits.low:g} to {limits.high:g} deg")
    try:
        folder = frames.begin()
    except OSError as error:
        cause = f"no room for the pictures ({error.strerror})"
        raise DeviceRefusedError("camera", cause, "Make room where the daemon keeps its state") from None
    turn_s = max(abs(b - a) for a, b in zip((0.0, *wanted.angles_deg), wanted.angles_deg, strict=False))
    dwell_s = turn_s / limits.speed + limits.speed / limits.acceleration + 3 * SETTLE_S
    try:
        async with Maneuver(loop) as blade:
            for number, angle_deg in enumerate(wanted.angles_deg):
                await blade.rotate_to(angle_deg, dwell_s)
                measured_deg = loop.tick.pose.rotation_deg
                if measured_deg is None:
                    raise DeviceMissingError("rotation", "no fresh measurement while calibrating")
                await eyes.save_frame(folder, f"{number:03d}", measured_deg)
    except BaseException:
        frames.discard()
        raise
    return {"frame_set": folder.name, "frames_n": len(wanted.angles_deg), "files": frames.names()}
