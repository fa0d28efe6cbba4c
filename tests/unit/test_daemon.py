"""The daemon's helpers may fail: control goes on, and each is started again."""

from __future__ import annotations

import asyncio
import errno
import logging
import signal

import pytest

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.hal.clock import SystemClock
from graderd.runtime.app import daemon as daemon_module
from graderd.runtime.app.daemon import ENDING_SIGNALS, Daemon, keep_running
from graderd.runtime.health import HealthWatch
from graderd.runtime.perception_supervisor import PerceptionSupervisor


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon_module, "RESTART_S", 0.0)


async def test_a_camera_child_that_cannot_be_started_for_want_of_files_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tries_n, enough = 0, asyncio.Event()

    async def refuse(*_: object, **__: object) -> None:
        nonlocal tries_n
        tries_n += 1
        if tries_n >= 3:
            enough.set()
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    config = Config()
    eyes = PerceptionSupervisor(
        config.camera, config.camera.calibration, config.perception, config.blade, SystemClock()
    )
    task = asyncio.create_task(keep_running("perception", eyes.run))
    async with asyncio.timeout(5):
        await enough.wait()
    assert not task.done()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert "perception failed and is started again: [Errno 24] Too many open files" in caplog.text


async def test_a_proc_that_cannot_be_read_ends_nothing() -> None:
    looks_n, enough = 0, asyncio.Event()

    def unreadable() -> float:
        nonlocal looks_n
        looks_n += 1
        if looks_n >= 3:
            enough.set()
        raise PermissionError(errno.EACCES, "Permission denied", "/proc/self/statm")

    task = asyncio.create_task(keep_running("health", HealthWatch(Config(), unreadable).run))
    async with asyncio.timeout(5):
        await enough.wait()
    assert not task.done()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_what_is_told_after_a_tick_may_fail(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    daemon = Daemon(Config(), None)

    def fail(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    fed: list[str] = []
    monkeypatch.setattr(daemon._notifier, "feed_watchdog", lambda: fed.append("watchdog"))
    monkeypatch.setattr(daemon._notifier, "status", lambda _: fed.append("status"))
    for helper, method in ((daemon._port, "published"), (daemon._hang_watch, "ticked")):
        monkeypatch.setattr(helper, method, fail)
    daemon._after_tick()
    assert fed == ["watchdog", "status"]
    assert sum(record.levelno == logging.ERROR for record in caplog.records) == 2


async def test_a_recorder_that_fails_ends_neither_a_tick_nor_a_stop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    daemon = Daemon(Config(), None)

    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(daemon._recorder, "take", fail)
    daemon._loop.run_tick()
    assert daemon._loop.stop_now(cmd.Stop(reason="enough")).accepted
    assert daemon._loop.tick.state.mode is Mode.STOPPED
    assert [record.message for record in caplog.records].count("recording a step failed") == 2


async def test_a_control_loop_that_fails_holds_every_axis_first(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon(Config(), None)
    held: list[str] = []
    for name, axis in daemon._devices.all().items():
        monkeypatch.setattr(axis, "hold", lambda name=name: held.append(name))

    async def fail() -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(daemon._loop, "run", fail)
    with pytest.raises(RuntimeError):
        await daemon._tick()
    assert held == ["rotation", "lift_left", "lift_right", "tilt"]


def test_a_terminal_that_hangs_up_ends_the_daemon_in_order() -> None:
    assert signal.SIGHUP in ENDING_SIGNALS
