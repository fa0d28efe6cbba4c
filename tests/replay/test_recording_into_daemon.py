"""A RealSense recording, made by librealsense's own recorder, played through the ordinary pipeline into the daemon."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from graderd.drivers.simulated.camera import RigCamera
from graderd.hal.settings import CameraSettings
from graderd.simulator.control_client import RigControl
from harness.realsense_devices import SoftD455, record
from tests.machine import machine, start_rig

pytestmark = [pytest.mark.whole_machine, pytest.mark.timeout(240)]
FRAMES_N = 30


async def record_scene(directory: Path, zone: str, path: Path) -> None:
    """What the rig's camera sees of a scene, as a .db3 with a D455's lenses."""
    rig = await start_rig(directory)
    try:
        async with RigControl(directory / "control.sock") as control:
            await control.request("scene", zone=zone)
        await asyncio.sleep(0.5)
        await asyncio.to_thread(_record, directory, path)
    finally:
        rig.terminate()
        await rig.wait()


def _record(directory: Path, path: Path) -> None:
    camera = RigCamera(
        CameraSettings(
            source="rig",
            path=str(directory / "camera.sock"),
            color_width_px=640,
            color_height_px=400,
            depth_width_px=424,
            depth_height_px=240,
        )
    )
    camera.open()
    frames = [camera.read(5.0) for _ in range(FRAMES_N)]
    camera.close()
    soft = SoftD455((640, 400), (424, 240))
    record(path, [(frame.color_bgr, frame.depth_mm) for frame in frames], soft)


async def test_a_recording_drives_the_daemon(tmp_path: Path) -> None:
    path = tmp_path / "left.db3"
    (tmp_path / "first").mkdir()
    await record_scene(tmp_path / "first", "left", path)
    assert path.stat().st_size > 100_000
    camera = f'[camera]\nsource = "recording"\npath = "{path}"\nrepeat = true\ncolor_width_px = 640\n'
    camera += "color_height_px = 400\ndepth_width_px = 424\ndepth_height_px = 240\n"
    async with machine(tmp_path, camera) as whole:
        seen = await whole.until(lambda s: s.soil.zone == "left")
        assert "left.db3" in seen.camera.description
        assert (seen.soil.share_left or 0.0) > 0.5
        assert seen.mode == "disarmed"
        await whole.until(lambda s: all(r.met for r in s.readiness if r.mandatory))
        await whole.command("arm")
        await whole.until(lambda s: s.mode == "manual")
        await whole.command("auto")
        decided = await whole.until(lambda s: s.decision.zone is not None)
        assert decided.decision.zone == "left"
        await whole.until(lambda s: (s.axes["rotation"].measured or 0.0) > 3.0)
        # The real blade turns, the recorded one does not: the picture is not believed any more, and the blade holds.
        ended = await whole.until(lambda s: s.mode != "auto")
        assert "camera." in ended.reason
