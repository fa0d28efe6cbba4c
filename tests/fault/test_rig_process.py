"""The rig as a process: everything of it dies with it, whatever ends it."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from graderd.drivers.simulated.camera import RigCamera
from graderd.hal.errors import DeviceLostError, DeviceMissingError
from graderd.hal.settings import CameraSettings
from graderd.simulator.control_client import rig_request
from tests.rig_process import running_rig

pytestmark = pytest.mark.whole_machine


def alive(pid: int) -> bool:
    """Whether a process still runs (a zombie whose new parent has not looked yet does not)."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def gone_within(pid: int, seconds: float) -> bool:
    deadline_s = time.monotonic() + seconds
    while alive(pid):
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.01)
    return True


def camera_at(path: str) -> RigCamera:
    settings = CameraSettings(
        source="rig", path=path, color_width_px=320, color_height_px=200, depth_width_px=424, depth_height_px=240
    )
    return RigCamera(settings)


def test_rig_announces_everything_at_once(tmp_path: Path) -> None:
    with running_rig(tmp_path / "rig", "--seed", "7") as (process, where):
        assert where["pid"] == process.pid
        assert Path(where["servo"]).is_symlink()
        assert where["can"] == {"interface": "slcan", "channel": str(tmp_path / "rig" / "can")}
        assert os.path.exists(os.path.realpath(where["can"]["channel"]))
        assert rig_request(where["control"], "state")["ok"]
        camera = camera_at(where["camera"])
        camera.open()
        assert camera.read(10.0).depth_mm is not None
        camera.close()


def test_a_killed_rigs_links_never_lead_to_somebody_elses_terminal(tmp_path: Path) -> None:
    """A daemon whose rig died tries its wires again and again; the kernel gives a terminal's number away at once."""
    with running_rig(tmp_path / "rig") as (process, where):
        links = [Path(where["servo"]), Path(where["can"]["channel"])]
        process.send_signal(signal.SIGKILL)
        process.wait()
        others: list[int] = []
        try:
            deadline_s = time.monotonic() + 10.0
            while any(link.is_symlink() for link in links):
                assert time.monotonic() < deadline_s, "the links stay"
                others += os.openpty()
                for link in links:
                    assert not link.exists() or not link.samefile(os.ttyname(others[-1]))
                if len(others) > 64:
                    time.sleep(0.01)
                    for other in (others.pop(), others.pop()):
                        os.close(other)
        finally:
            for other in others:
                os.close(other)


def test_rig_killed_takes_its_camera_along_and_clients_know_at_once(tmp_path: Path) -> None:
    with running_rig(tmp_path / "rig") as (process, where):
        camera_pid = rig_request(where["control"], "state")["camera_pid"]
        camera = camera_at(where["camera"])
        camera.open()
        camera.read(10.0)
        servo_pty = os.path.realpath(where["servo"])
        process.kill()
        process.wait()
        killed_s = time.monotonic()
        lost = None
        while lost is None:
            try:
                camera.read(1.0)
            except DeviceLostError as error:
                lost = error
        assert "hung up" in str(lost)
        assert time.monotonic() - killed_s < 2.0
        assert gone_within(camera_pid, 1.0)
        assert not os.path.exists(servo_pty)
        with pytest.raises(DeviceMissingError):
            rig_request(where["control"], "state")
    # what a killed rig left in its folder does not keep the next one from starting there
    with running_rig(tmp_path / "rig") as (_, where):
        assert rig_request(where["control"], "state")["ok"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_rig_ends_cleanly_on_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    with running_rig(tmp_path / "rig") as (process, where):
        camera_pid = rig_request(where["control"], "state")["camera_pid"]
        process.send_signal(number)
        assert process.wait(timeout=5.0) == 0
        assert gone_within(camera_pid, 1.0)
        assert list((tmp_path / "rig").iterdir()) == []


def test_rig_whose_camera_dies_says_so_and_ends(tmp_path: Path) -> None:
    directory = tmp_path / "rig"
    process = subprocess.Popen(
        [sys.executable, "-m", "graderd.simulator", "--dir", str(directory)], stderr=subprocess.PIPE, text=True
    )
    try:
        deadline_s = time.monotonic() + 40.0
        while not (directory / "rig.json").exists():
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        os.kill(rig_request(directory / "control.sock", "state")["camera_pid"], signal.SIGKILL)
        _, errors = process.communicate(timeout=5.0)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 1
    assert "rig camera: its process ended" in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--can", "vcan0"], "give the interface too"),
        (["--seed", "-4"], "must be from 0"),
        ([], "--dir"),
    ],
)
def test_rig_bad_arguments(tmp_path: Path, arguments: list[str], message: str) -> None:
    directory = ["--dir", str(tmp_path / "rig")] if arguments else []
    result = subprocess.run(
        [sys.executable, "-m", "graderd.simulator", *directory, *arguments], capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 2
    assert message in result.stderr


async def test_the_rig_quits_when_the_program_that_started_it_is_gone(tmp_path: Path) -> None:
    rig = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd.simulator", "--dir", str(tmp_path), "--linger-s", "0.2"),
        stdin=asyncio.subprocess.PIPE,
    )
    assert rig.stdin is not None
    async with asyncio.timeout(60):
        while not (tmp_path / "rig.json").exists():
            await asyncio.sleep(0.05)
        rig.stdin.close()
        assert await rig.wait() == 0
    assert not (tmp_path / "control.sock").exists()
