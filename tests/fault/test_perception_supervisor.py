"""The perception ladder, with children that misbehave as camera libraries do. Real processes, short times."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from graderd.core.blade import BladeGeometry
from graderd.core.soil import Zone
from graderd.hal.clock import SystemClock
from graderd.hal.device import Lifecycle
from graderd.hal.settings import CameraSettings
from graderd.perception.settings import CameraCalibration, PerceptionSettings
from graderd.runtime.perception_supervisor import PerceptionSupervisor

CAMERA = CameraSettings(source="rig", path="nowhere", stale_s=0.3, restart_s=0.8)
DEADLINE_S = 20.0

PRELUDE = """
import json, os, signal, sys, time
start = json.loads(sys.stdin.readline())
log = open(LOG, "a"); log.write(json.dumps({"pid": os.getpid(), "reset": start["reset_first"]}) + "\\n"); log.close()
starts = len(open(LOG).readlines())
def say(**message):
    sys.stdout.write(json.dumps(message) + "\\n"); sys.stdout.flush()
def opened():
    say(kind="opened", description="fake camera", settings_read_back={"gain": 1.0}, not_kept=[])
def frame(n=0, faults=(), old_s=0.0):
    say(kind="observed", observation={"capture_s": time.monotonic() - old_s, "zone": "left", "confidence": 0.9,
        "reason": "", "frame_number": n, "faults": list(faults)})
"""


@asynccontextmanager
async def worker(tmp_path: Path, body: str, camera: CameraSettings = CAMERA) -> AsyncIterator[PerceptionSupervisor]:
    """A supervised child that runs ``body`` after the prelude."""
    script = tmp_path / "child.py"
    script.write_text(f"LOG = {str(tmp_path / 'starts')!r}\n" + PRELUDE + body, encoding="utf-8")
    eyes = PerceptionSupervisor(
        camera,
        CameraCalibration(),
        PerceptionSettings(),
        BladeGeometry(),
        SystemClock(),
        command=(sys.executable, str(script)),
        start_grace_s=10.0,
        back_off_s=(0.05,),
    )
    task = asyncio.create_task(eyes.run(), name="perception")
    try:
        yield eyes
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while not condition():
            await asyncio.sleep(0.01)


def conditions(eyes: PerceptionSupervisor) -> set[str]:
    return {fault.condition for fault in eyes.faults()}


def starts(tmp_path: Path) -> list[str]:
    path = tmp_path / "starts"
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


async def test_frames_flow_and_each_is_taken_once(tmp_path: Path) -> None:
    async with worker(tmp_path, "opened()\nn = 0\nwhile True:\n    frame(n); n += 1; time.sleep(0.03)\n") as eyes:
        await until(lambda: eyes.newest is not None and eyes.newest.frame_number > 3)
        first = eyes.take_observation()
        assert first is not None
        assert first.zone is Zone.LEFT
        assert eyes.take_observation() is None or eyes.newest is not first
        await until(lambda: not conditions(eyes))
        assert eyes.status().lifecycle is Lifecycle.ACTIVE
        assert eyes.status().description == "fake camera"
        assert eyes.frames_per_s > 1


async def test_a_frame_that_has_grown_old_decides_nothing(tmp_path: Path) -> None:
    """It waited where it was not taken: by now the machine has driven on."""
    patient = CAMERA.model_copy(update={"stale_s": 60.0, "restart_s": 120.0})
    async with worker(tmp_path, "opened()\nframe()\ntime.sleep(600)\n", patient) as eyes:
        await until(lambda: eyes.newest is not None)
        newest, clock = eyes.newest, SystemClock()
        assert newest is not None
        assert newest.zone is Zone.LEFT
        await until(lambda: clock.now_s() - newest.capture_s > PerceptionSettings().decision.max_frame_age_s)
        taken = eyes.take_observation()
        assert taken is not None
        assert taken.zone is Zone.UNKNOWN
        assert "old by now" in taken.reason


async def test_a_picture_that_a_dead_child_was_asked_for_comes_from_the_next(tmp_path: Path) -> None:
    """Else nobody would see that picture again: all who ask for the same wait for the same."""
    body = (
        "opened()\nframe()\n"
        "request = next(r for r in map(json.loads, sys.stdin) if r['kind'] == 'preview')\n"
        "if starts == 1:\n    sys.exit(1)\n"
        "say(kind='preview', format=request['format'], capture_s=time.monotonic(), jpeg_base64='aGk=')\n"
        "while True:\n    frame(); time.sleep(0.03)\n"
    )
    async with worker(tmp_path, body) as eyes:
        await until(lambda: eyes.newest is not None)
        assert (await eyes.preview_jpeg(timeout_s=DEADLINE_S)).value == b"hi"
    assert len(starts(tmp_path)) == 2


async def test_a_picture_that_never_came_is_asked_for_anew(tmp_path: Path) -> None:
    body = (
        "opened()\nframe()\n"
        "requests = (r for r in map(json.loads, sys.stdin) if r['kind'] == 'preview')\n"
        "next(requests)\n"
        "say(kind='preview', format=next(requests)['format'], capture_s=time.monotonic(), jpeg_base64='aGk=')\n"
        "time.sleep(600)\n"
    )
    async with worker(tmp_path, body, CAMERA.model_copy(update={"stale_s": 60.0, "restart_s": 120.0})) as eyes:
        await until(lambda: eyes.newest is not None)
        with pytest.raises(TimeoutError):
            await eyes.preview_jpeg(timeout_s=0.05)
        assert (await eyes.preview_jpeg(timeout_s=DEADLINE_S)).value == b"hi"


async def test_a_picture_counts_once_and_not_after_a_newer_one(tmp_path: Path) -> None:
    """What waited in a child, or is sent again by it, is no further vote for what was seen."""
    body = (
        'def at(n, capture_s):\n    say(kind="observed", observation={"capture_s": capture_s, "zone": "left", '
        '"confidence": 0.9, "reason": "", "frame_number": n})\n'
        "now = time.monotonic()\nopened()\nfor n in (3, 3, 2, 1, 3, 3):\n    at(n, now - 0.01 * (3 - n))\n"
        'say(kind="opened", description="all sent", settings_read_back={}, not_kept=[])\nsignal.pause()\n'
    )
    patient = CAMERA.model_copy(update={"stale_s": 60.0, "restart_s": 120.0})
    async with worker(tmp_path, body, patient) as eyes:
        await until(lambda: eyes.status().description == "all sent")
        assert eyes.newest is not None
        assert (eyes.newest.frame_number, eyes.status().frames_n) == (3, 1)
        assert eyes.take_observation() is not None
        assert eyes.take_observation() is None


async def test_a_child_that_sends_only_old_pictures_sends_none(tmp_path: Path) -> None:
    """It is alive and talks, and nobody sees anything: the blade must not go on by what it was told before."""
    body = "opened()\nframe()\nwhile True:\n    frame(old_s=1.0); time.sleep(0.03)\n"
    async with worker(tmp_path, body) as eyes:
        await until(lambda: eyes.newest is not None)
        await until(lambda: "stale" in conditions(eyes))
        assert eyes.take_observation() is None
        await until(lambda: len(starts(tmp_path)) >= 2)


async def test_a_child_that_talks_without_a_pause_leaves_the_others_their_turn(tmp_path: Path) -> None:
    body = (
        "opened()\nnow = time.monotonic()\n"
        'line = \'{"kind": "observed", "observation": {"capture_s": %f, "zone": "none", "confidence": 0.9, '
        '"reason": ""}}\\n\'\n'
        'sys.stdout.write("".join(line % (now + n * 1e-6) for n in range(20000)))\n'
        "sys.stdout.flush()\nsignal.pause()\n"
    )
    patient = CAMERA.model_copy(update={"stale_s": 60.0, "restart_s": 120.0})
    async with worker(tmp_path, body, patient) as eyes:
        most_n = before_n = 0
        async with asyncio.timeout(DEADLINE_S):
            while before_n < 20000:
                await asyncio.sleep(0)
                now_n = eyes.status().frames_n
                most_n, before_n = max(most_n, now_n - before_n), now_n
        assert most_n <= 2, "in one turn of the event loop: a tick that is due waits for all of them"


@pytest.mark.parametrize(
    "said",
    [
        'kind="problem", condition="stale", message="x" * 200_000',
        'kind="observed", observation={"capture_s": time.monotonic(), "zone": "left", "confidence": 0.9, "reason": "", '
        '"faults": [{"condition": "dark", "detail": ""}] * 5000}',
        'kind="observed", observation={"capture_s": time.monotonic(), "zone": "left", "confidence": 0.9, "reason": "", '
        '"volume_left_l": float("nan")}',
        'kind="preview", format={}, capture_s=float("inf"), jpeg_base64=""',
    ],
    ids=["long text", "many faults", "no number", "infinite"],
)
async def test_what_no_child_of_ours_says_ends_it_and_is_not_handed_on(tmp_path: Path, said: str) -> None:
    """It would be told to every client, at every tick."""
    async with worker(tmp_path, f"opened()\nsay({said})\nsignal.pause()\n") as eyes:
        await until(lambda: "perception_nonsense" in conditions(eyes))
        assert eyes.newest is None
        assert all(len(fault.detail) < 1000 for fault in eyes.faults())


async def test_frames_that_stop_are_unknown_at_once_and_the_child_is_replaced(tmp_path: Path) -> None:
    body = "opened()\nfor n in range(5):\n    frame(n); time.sleep(0.03)\nsignal.pause()\n"
    async with worker(tmp_path, body) as eyes:
        await until(lambda: eyes.newest is not None)
        await until(lambda: "stale" in conditions(eyes))
        assert eyes.take_observation() is None
        await until(lambda: len(starts(tmp_path)) >= 2)
        await until(lambda: conditions(eyes) & {"worker_hung"} == {"worker_hung"})
        assert eyes.status().restarts_n >= 1


async def test_a_library_call_that_never_returns_at_the_start(tmp_path: Path) -> None:
    camera = CAMERA.model_copy(update={"restart_s": 0.5})
    async with worker(tmp_path, "opened()\nsignal.pause()\n", camera) as eyes:
        await until(lambda: len(starts(tmp_path)) >= 3)
        assert "stale" in conditions(eyes)
        assert eyes.newest is None


async def test_the_hardware_is_reset_before_the_third_open_and_told(tmp_path: Path) -> None:
    body = 'say(kind="problem", condition="missing", message="no RealSense camera", final=True)\nsys.exit(4)\n'
    async with worker(tmp_path, body) as eyes:
        await until(lambda: len(starts(tmp_path)) >= 4)
        assert ['"reset": true' in line for line in starts(tmp_path)[:4]] == [False, False, True, False]
        await until(lambda: "camera reset" in eyes.status().recovery)
        (missing,) = [fault for fault in eyes.faults() if fault.condition == "missing"]
        assert missing.detail == "no RealSense camera"


async def test_alive_but_without_frames_goes_up_the_ladder_too(tmp_path: Path) -> None:
    body = 'opened()\nwhile True:\n    say(kind="problem", condition="stale", message="no frame"); time.sleep(0.1)\n'
    async with worker(tmp_path, body) as eyes:
        await until(lambda: len(starts(tmp_path)) >= 2)
        assert "stale" in conditions(eyes)


async def test_it_comes_back_when_the_camera_does(tmp_path: Path) -> None:
    body = "if starts < 3:\n    sys.exit(1)\nopened()\nn = 0\nwhile True:\n    frame(n); n += 1; time.sleep(0.03)\n"
    async with worker(tmp_path, body) as eyes:
        await until(lambda: eyes.newest is not None)
        assert len(starts(tmp_path)) == 3
        assert "stale" not in conditions(eyes)


async def test_nonsense_from_the_child_ends_it(tmp_path: Path) -> None:
    async with worker(tmp_path, 'opened()\nsys.stdout.write("hello\\n"); sys.stdout.flush()\nsignal.pause()\n') as eyes:
        await until(lambda: len(starts(tmp_path)) >= 2)
        assert eyes.newest is None


async def test_faults_of_the_picture_are_passed_on(tmp_path: Path) -> None:
    body = 'opened()\nwhile True:\n    frame(0, [{"condition": "black", "detail": "2 %"}]); time.sleep(0.03)\n'
    async with worker(tmp_path, body) as eyes:
        await until(lambda: "black" in conditions(eyes))


async def test_cancelling_leaves_no_child(tmp_path: Path) -> None:
    async with worker(tmp_path, "opened()\nwhile True:\n    frame(); time.sleep(0.03)\n") as eyes:
        await until(lambda: eyes.newest is not None)
        pid = int(starts(tmp_path)[-1].split('"pid": ')[1].split(",")[0])
    assert not Path(f"/proc/{pid}").exists()


async def test_ctrl_c_in_a_terminal_is_not_the_childs(tmp_path: Path) -> None:
    """It reaches every process of the terminal's group; the daemon alone answers it, and ends the child in order."""
    async with worker(tmp_path, "opened()\nwhile True:\n    frame(); time.sleep(0.03)\n") as eyes:
        await until(lambda: eyes.newest is not None)
        pid = int(starts(tmp_path)[-1].split('"pid": ')[1].split(",")[0])
        assert os.getpgid(pid) == pid


async def test_what_a_failing_child_prints_goes_through_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    body = 'sys.stderr.write("a torrent\\n" * 20_000); sys.stderr.flush(); raise RuntimeError("no camera")'
    async with worker(tmp_path, body):
        await until(lambda: any("RuntimeError: no camera" in record.getMessage() for record in caplog.records))
    said = [record for record in caplog.records if "worker: a torrent" in record.getMessage()]
    assert 0 < len(said) < 10_000, "of a torrent not all is told"
    assert {record.__dict__["device"] for record in said} == {"camera"}
    assert "a torrent" not in capfd.readouterr().err
