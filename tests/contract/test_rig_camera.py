"""The camera contract on the rig's camera, and each of its faults as a client sees it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graderd.drivers.simulated.camera import RigCamera
from graderd.hal.camera import Camera, Frame
from graderd.hal.errors import (
    DeviceLostError,
    DeviceMissingError,
    DeviceTimeoutError,
    LifecycleError,
    WrongDeviceError,
)
from graderd.hal.settings import CameraSettings
from graderd.simulator.control_client import RigControl
from graderd.simulator.process import Rig
from tests.rig_process import rig_here

READY_S = 30.0


def settings_for(path: Path, **changes: Any) -> CameraSettings:
    values: dict[str, Any] = {
        "source": "rig",
        "path": str(path),
        "color_width_px": 320,
        "color_height_px": 200,
        "depth_width_px": 424,
        "depth_height_px": 240,
        "rate_hz": 30.0,
    }
    return CameraSettings(**{**values, **changes})


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[tuple[Rig, RigControl]]:
    async with rig_here(tmp_path / "rig") as rig:
        yield rig


async def shot(camera: RigCamera, timeout_s: float = 5.0) -> Frame:
    return await asyncio.to_thread(camera.read, timeout_s)


async def fresh(camera: RigCamera) -> Frame:
    """A frame taken after now: the one under way may have been asked for before the last change."""
    await shot(camera)
    return await shot(camera)


async def test_rig_camera_keeps_the_contract(rig: tuple[Rig, RigControl]) -> None:
    machine, _ = rig
    rig_camera = RigCamera(settings_for(machine.paths.camera))
    camera: Camera = rig_camera
    with pytest.raises(LifecycleError, match="not open"):
        camera.read(0.1)
    await asyncio.to_thread(camera.open)
    assert "D455" in camera.description
    assert camera.settings_read_back()["auto_exposure"] == 0.0
    frames = []
    for _ in range(6):
        before_s = time.monotonic()
        frame = await shot(rig_camera)
        assert before_s - 0.2 < frame.capture_s <= time.monotonic()
        frames.append(frame)
    assert frames[0].color_bgr.shape == (200, 320, 3)
    assert frames[0].color_bgr.dtype == np.uint8
    assert frames[0].depth_mm is not None
    assert frames[0].depth_mm.shape == (240, 424)
    assert frames[0].depth_mm.dtype == np.uint16
    for lens, size in ((frames[0].color_intrinsics, (320, 200)), (frames[0].depth_intrinsics, (424, 240))):
        assert lens is not None
        assert (lens.width, lens.height) == size
    assert frames[0].color_intrinsics is not None
    assert frames[0].color_intrinsics.fx == pytest.approx(629.085 / 4)
    numbers = [frame.color_number for frame in frames]
    assert numbers == sorted(set(numbers))  # every frame is handed out once
    assert all(frame.depth_number == frame.color_number for frame in frames)
    times = [frame.capture_s for frame in frames]
    assert times == sorted(set(times))
    assert not np.array_equal(frames[0].color_bgr, frames[1].color_bgr)  # noise: no two pictures are the same
    await asyncio.to_thread(camera.reset_hardware)
    await shot(rig_camera)
    camera.close()
    camera.close()
    with pytest.raises(LifecycleError):
        camera.read(0.1)


async def test_rig_camera_gives_the_newest_frame_after_a_pause(rig: tuple[Rig, RigControl]) -> None:
    machine, _ = rig
    camera = RigCamera(settings_for(machine.paths.camera))
    await asyncio.to_thread(camera.open)
    await shot(camera)
    await asyncio.sleep(0.4)
    asked_s = time.monotonic()
    frame = await shot(camera)
    assert frame.capture_s >= asked_s - 0.01
    camera.close()


async def test_rig_camera_without_depth_and_at_other_sizes(rig: tuple[Rig, RigControl]) -> None:
    machine, _ = rig
    for color, depth in (((640, 400), (0, 0)), ((320, 200), (848, 480))):
        camera = RigCamera(
            settings_for(
                machine.paths.camera,
                color_width_px=color[0],
                color_height_px=color[1],
                depth_width_px=depth[0],
                depth_height_px=depth[1],
            )
        )
        await asyncio.to_thread(camera.open)
        frame = await shot(camera)
        assert frame.color_bgr.shape[:2] == color[::-1]
        if depth[0]:
            assert frame.depth_mm is not None
            assert frame.depth_mm.shape == depth[::-1]
        else:
            assert frame.depth_mm is None
            assert frame.depth_intrinsics is None
            assert frame.depth_number == -1
        camera.close()


async def test_rig_camera_open_errors(rig: tuple[Rig, RigControl], tmp_path: Path) -> None:
    machine, _ = rig
    with pytest.raises(DeviceMissingError, match="no rig answers"):
        await asyncio.to_thread(RigCamera(settings_for(tmp_path / "none.sock")).open)
    with pytest.raises(WrongDeviceError, match="cannot be made"):
        await asyncio.to_thread(RigCamera(settings_for(machine.paths.camera, color_width_px=9000)).open)


async def test_rig_camera_faults_of_the_picture(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    await control.scene("center")
    camera = RigCamera(settings_for(machine.paths.camera))
    await asyncio.to_thread(camera.open)
    healthy = await fresh(camera)

    async def under(name: str, **params: float) -> Frame:
        await control.request("clear_faults", part="camera")
        await fresh(camera)
        await control.request("camera_fault", name=name, params=params)
        return await fresh(camera)

    def sharpness(frame: Frame) -> float:
        grey = frame.color_bgr.astype(np.float64).mean(axis=2)
        return float(np.abs(np.diff(grey, axis=1)).mean())

    assert (await under("black")).color_bgr.mean() < 5
    assert (await under("blown_out")).color_bgr.mean() > 245
    assert sharpness(await under("blurred")) < 0.4 * sharpness(healthy)
    blocked = await under("blocked")
    assert blocked.depth_mm is not None
    assert blocked.depth_mm.max() == 0
    assert blocked.color_bgr.astype(float).std() < 12
    half = await under("blocked", share=0.5)
    assert half.depth_mm is not None
    assert half.depth_mm[:, :200].max() == 0
    assert half.depth_mm[:, 230:].max() > 0
    small = await under("wrong_resolution")
    assert small.color_bgr.shape == (100, 160, 3)
    torn = await under("torn")
    assert torn.depth_number < torn.color_number
    knocked = await under("knocked")
    assert knocked.depth_mm is not None
    assert healthy.depth_mm is not None
    both = (knocked.depth_mm > 0) & (healthy.depth_mm > 0)
    assert np.abs(knocked.depth_mm.astype(float) - healthy.depth_mm)[both].mean() > 20
    colour_only = await under("no_depth")
    assert colour_only.depth_mm is None
    frozen = await under("freeze")
    again = await shot(camera)
    assert np.array_equal(frozen.color_bgr, again.color_bgr)
    assert again.color_number > frozen.color_number

    await control.request("clear_faults")
    well = await fresh(camera)
    assert well.depth_mm is not None
    assert abs(well.color_bgr.mean() - healthy.color_bgr.mean()) < 2.0
    assert well.depth_number == well.color_number
    camera.close()


async def test_rig_camera_that_stalls_times_out_and_goes_on(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    camera = RigCamera(settings_for(machine.paths.camera))
    await asyncio.to_thread(camera.open)
    await shot(camera)
    await control.request("camera_fault", name="stall")
    with contextlib.suppress(DeviceTimeoutError):
        await shot(camera, 0.2)  # at most one frame was still under way
    for _ in range(2):
        started_s = time.monotonic()
        with pytest.raises(DeviceTimeoutError):
            await shot(camera, 0.2)
        assert time.monotonic() - started_s < 5.0
    await control.request("clear_faults")
    assert (await shot(camera)).color_bgr.shape == (200, 320, 3)
    camera.close()


async def test_rig_camera_unplugged_is_lost_at_once_and_can_come_back(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    camera = RigCamera(settings_for(machine.paths.camera))
    await asyncio.to_thread(camera.open)
    await shot(camera)
    await control.request("camera_fault", name="unplug")
    started_s = time.monotonic()
    with contextlib.suppress(DeviceLostError):
        await shot(camera)  # at most one frame was still under way
        await shot(camera)
    with pytest.raises((DeviceLostError, LifecycleError)):
        await shot(camera)
    assert time.monotonic() - started_s < 5.0, "before the deadline of a read"
    with pytest.raises(DeviceMissingError):
        await asyncio.to_thread(camera.open)
    await control.request("clear_faults")
    async with asyncio.timeout(5.0):
        while not machine.paths.camera.exists():
            await asyncio.sleep(0.02)
    await asyncio.to_thread(camera.open)
    await shot(camera)
    camera.close()


async def test_rig_camera_settings_that_did_not_keep_read_back_as_they_are(rig: tuple[Rig, RigControl]) -> None:
    machine, control = rig
    await control.request("camera_fault", name="settings_lost")
    camera = RigCamera(settings_for(machine.paths.camera))
    await asyncio.to_thread(camera.open)
    assert camera.settings_read_back()["auto_exposure"] == 1.0
    camera.close()


async def test_rig_wires_are_not_held_up_by_a_picture(rig: tuple[Rig, RigControl]) -> None:
    """The physics goes on at its pace while large pictures are made."""
    machine, control = rig
    camera = RigCamera(settings_for(machine.paths.camera, color_width_px=1280, color_height_px=800))
    await asyncio.to_thread(camera.open)
    reading = asyncio.create_task(asyncio.to_thread(camera.read, 20.0), name="read-large-picture")
    answers_n = 0
    while not reading.done():
        await control.state()
        answers_n += 1
        await asyncio.sleep(0.002)
    assert (await reading).color_bgr.shape == (800, 1280, 3)
    assert answers_n >= 5
    camera.close()
