"""Services outside the control loop: those of the drivers, step response, camera calibration."""

from __future__ import annotations

import asyncio
import atexit
import base64
import os
import shutil
import tempfile
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from graderd.config import Config
from graderd.core.commands import ClientText
from graderd.hal.device import DeviceService, NoArguments
from graderd.hal.errors import CommandRangeError, DeviceMissingError, DeviceRefusedError
from graderd.hal.rotator import Rotator
from graderd.hal.settings import Finite, Positive, Settings
from graderd.record.recorder import Recorder
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import Devices
from graderd.runtime.maneuver import Maneuver
from graderd.runtime.perception_supervisor import PerceptionSupervisor
from graderd.runtime.step_response import analyse, render, step_samples

SETTLE_S = 0.5
_PREFIX = "calibration-"
NO_DIRECTORY = (
    "Make a configuration with 'graderd config init', whose recording.directory is set, or set it with 'graderd config "
    "set recording.directory FOLDER'; then restart the daemon"
)


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


class CalibrationFrames:
    """Pictures of the empty blade on their way to the client: they travel over the interface, not through the file
    system, so that the rights of the socket decide who gets them, whoever asks and wherever the daemon may write.

    At most one frame set, in the daemon's own directory; each file goes when it was fetched, the rest with the next set
    or with the daemon. ``configured``: ``state.directory``.
    """

    def __init__(self, configured: str = "") -> None:
        self._base = os.environ.get("STATE_DIRECTORY") or configured or None
        self._folder: Path | None = None
        atexit.register(self.discard)
        if self._base is not None:  # what a killed daemon left
            for left in Path(self._base).glob(f"{_PREFIX}*"):
                shutil.rmtree(left, ignore_errors=True)

    def begin(self) -> Path:
        """An empty folder for a new set; a former one goes.

        Raises:
            OSError: it cannot be made.
        """
        self.discard()
        if self._base is not None:
            Path(self._base).mkdir(parents=True, exist_ok=True)
        self._folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=self._base))
        return self._folder

    def names(self) -> list[str]:
        """The files that were not fetched yet."""
        return sorted(os.listdir(self._folder)) if self._folder is not None else []

    def take(self, name: str) -> bytes:
        """The content of one file, which then goes.

        Raises:
            CommandRangeError: there is no such file.
        """
        names = self.names()
        if self._folder is None or name not in names:
            raise CommandRangeError("file", f"no file {name!r} waits", "Calibrate again")
        path = self._folder / name
        data = path.read_bytes()
        path.unlink()
        if names == [name]:
            self.discard()
        return data

    def discard(self) -> None:
        """Remove what is there; idempotent."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


class MarkArguments(Settings):
    """Arguments of ``recording.mark``."""

    text: ClientText = Field(max_length=200)
    client: ClientText = Field("", max_length=80)


class StartArguments(Settings):
    """Arguments of ``recording.start``."""

    raw: Literal["off", "reduced", "full"] = "off"


def build_services(
    config: Config, devices: Devices, loop: ControlLoop, eyes: PerceptionSupervisor, recorder: Recorder
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
        **_recording(config, recorder),
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


def _recording(config: Config, recorder: Recorder) -> dict[str, DeviceService]:
    """What clients may ask of the recorder; none of it touches the machine."""

    def directory() -> str:
        if recorder.directory is None:
            raise DeviceMissingError("recording", "the daemon has no directory for it", NO_DIRECTORY)
        return str(recorder.directory)

    async def mark(wanted: MarkArguments) -> dict[str, Any]:
        found = directory()
        recorder.mark(wanted.text, wanted.client)
        return {"marked": True, "directory": found}

    async def start(wanted: StartArguments) -> dict[str, Any]:
        found = directory()
        recorder.start({"off": 0, "reduced": config.recording.raw_every_n, "full": 1}[wanted.raw])
        return {"recording": True, "raw": wanted.raw, "directory": found}

    async def stop(_: NoArguments) -> dict[str, Any]:
        found = directory()
        recorder.stop()
        return {"recording": False, "directory": found}

    return {
        "recording.mark": DeviceService(
            mark,
            only_reads=True,
            arguments=MarkArguments,
            summary="Put a word into the recording and keep what is around",
        ),
        "recording.start": DeviceService(
            start, only_reads=True, arguments=StartArguments, summary="Record the run from now on"
        ),
        "recording.stop": DeviceService(stop, only_reads=True, summary="Record runs no more; the black box stays on"),
    }


async def _step_response(config: Config, rotator: Rotator, loop: ControlLoop, wanted: StepArguments) -> dict[str, Any]:
    """Steps, analysed, with the settings in force and a page to keep."""
    samples = await step_samples(loop, rotator, wanted.step_deg, wanted.dwell_s)
    settings = {name: str(value) for name, value in config.rotation.model_dump().items()}
    settings["simulated"] = "yes" if config.simulated else "no"
    recording = analyse(samples, config.rotation.tolerance_deg, settings)
    return {
        "steps": [asdict(step) for step in recording.steps],
        "backlash_deg": recording.backlash_deg,
        "backlash_from": recording.backlash_from,
        "settings": settings,
        "report_html": render(recording, when=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
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
