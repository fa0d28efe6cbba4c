"""The small parts of the runtime: state file, systemd notifier, health watch, angle history, opening of devices."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from graderd.config import Config, parse
from graderd.core.machine import Mode
from graderd.core.soil import PictureFault, SoilAhead, Thirds, Zone
from graderd.core.status import CameraStatus, Status
from graderd.hal.clock import ManualClock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceMissingError
from graderd.runtime import devices as devices_module
from graderd.runtime import state_file
from graderd.runtime.app.perception_child import AngleHistory, settings_not_kept
from graderd.runtime.devices import Devices, open_devices
from graderd.runtime.health import HealthWatch, SleepWatch, resident_mb, slept_s
from graderd.runtime.sd_notify import SystemdNotifier
from graderd.runtime.state_file import StateFile
from graderd.runtime.status import build_status
from harness.fakes import FakeActuator, FakeLink, FakeRotator
from tests.unit.test_runtime_control import Bench

STATUS = Status(
    time_s=1.0, wall_time="2026-01-01T00:00:00Z", version="0", simulated=True, mode=Mode.DISARMED, reason="t"
)


def test_the_last_stop_survives_a_restart(tmp_path: Path) -> None:
    state = StateFile(str(tmp_path / "new"))
    state.save("dog on the site", 1)
    assert state.settle()
    found = StateFile(str(tmp_path / "new")).load()
    assert found is not None
    assert found.reason == "dog on the site"
    assert "dog on the site (" in str(found)


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"reason": 1}', b"\xff", b'{"reason": "x", "wall_time": "y", "z": 1}']
)
def test_a_damaged_state_file_is_kept_and_told_and_counts_as_a_stop_until_reset(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "last_stop.json").write_bytes(content)
    for _ in range(2):  # a second start is no reset
        state = StateFile(str(tmp_path))
        last = state.load()
        assert last is not None
        assert not last.reset
        assert "last_stop.json" in state.problem
    assert last is not None
    assert (tmp_path / "last_stop.damaged").read_bytes() == content
    state.save_reset(last, 1)
    assert state.settle()
    assert state.problem == ""
    found = StateFile(str(tmp_path)).load()
    assert found is not None
    assert found.reset


def test_a_state_file_that_may_not_be_read_counts_as_a_stop(tmp_path: Path) -> None:
    (tmp_path / "last_stop.json").mkdir()
    state = StateFile(str(tmp_path))
    last = state.load()
    assert last is not None
    assert not last.reset
    assert "last_stop.json" in state.problem


def test_a_state_directory_that_cannot_be_written_is_told_and_raises_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    state = StateFile(str(tmp_path / "file" / "state"))
    assert state.save("x", 1).reason == "x"
    assert state.settle()
    assert state.problem


def test_a_state_directory_that_stalls_is_not_waited_for_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "last_stop.new")  # a file whose opening hangs, as on a disk that does not answer
    state = StateFile(str(tmp_path))
    began_s = time.monotonic()
    for number, reason in enumerate(("one", "two", "three")):
        assert state.save(reason, number).reason == reason
    assert time.monotonic() - began_s < 5.0  # who waits for the disk waits for ever
    assert not state.settle(0.05)
    assert state.problem == ""  # two stops within a moment are no fault of the disk
    monkeypatch.setattr(state_file, "STALLED_S", 0.0)
    assert "takes long" in state.problem
    with (tmp_path / "last_stop.new").open("rb"):  # the disk is back
        assert state.settle()
    assert state.problem == ""
    state.save("four", 4)
    assert state.settle()
    last = state.load()
    assert last is not None
    assert last.reason == "four"


def test_a_stop_is_on_the_disk_before_it_takes_the_place_of_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing was written through: a power cut could leave an empty file, or the stop before the last."""
    done: list[str] = []
    fsync, replace_file = os.fsync, os.replace

    def through(fd: int) -> None:
        path = Path(f"/proc/self/fd/{fd}").resolve()
        done.append(f"{path.name}: {path.read_text() and 'whole' if path.is_file() else 'directory'}")
        fsync(fd)

    def put(self: Path, target: Path) -> Path:
        done.append("replaced")
        replace_file(self, target)
        return target

    monkeypatch.setattr(os, "fsync", through)
    monkeypatch.setattr(Path, "replace", put)
    state = StateFile(str(tmp_path))
    state.save("enough", 1)
    assert state.settle()
    assert done == ["last_stop.new: whole", "replaced", f"{tmp_path.name}: directory"]
    assert state.problem == ""


def test_a_disk_that_fails_to_take_a_stop_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    state = StateFile(str(tmp_path))
    state.save("enough", 1)
    assert state.settle()
    assert "Input/output error" in state.problem
    monkeypatch.undo()
    state.save("again", 2)
    assert state.settle()
    assert state.problem == ""


@pytest.mark.live
def test_systemd_is_told_ready_status_watchdog_and_stopping(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        listener.settimeout(5.0)
        notifier = SystemdNotifier(str(path))
        notifier.ready("disarmed")
        notifier.feed_watchdog()
        notifier.status("auto")
        notifier.stopping()
        said = [listener.recv(200).decode() for _ in range(4)]
        notifier.close()
    assert said == ["READY=1\nSTATUS=disarmed", "WATCHDOG=1", "STATUS=auto", "STOPPING=1"]


def test_without_systemd_or_with_its_socket_gone_nothing_happens(tmp_path: Path) -> None:
    SystemdNotifier("").ready("x")
    notifier = SystemdNotifier(str(tmp_path / "gone"))
    notifier.feed_watchdog()
    notifier.close()


def test_a_stepped_clock_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = HealthWatch(Config(), resident_mb=lambda: 100.0)  # not the tests' own: it grows with every test
    watch.measure()
    assert watch.faults(time.monotonic()) == ()
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3600.0)
    watch.measure()
    (fault,) = watch.faults(time.monotonic())
    assert fault.condition == "clock_stepped"
    assert "+3600 s" in fault.detail
    assert watch.faults(time.monotonic() + 60.0) == ()


def test_a_sleep_of_the_computer_is_told_once_and_is_no_step_of_its_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    asleep_s = 5.0
    watch = SleepWatch(lambda: asleep_s)
    assert watch.faults(1.0) == ()
    asleep_s = 4.9  # a pause between the two readings: less than there is, never more
    assert watch.faults(2.0) == ()
    asleep_s = 5.0
    assert watch.faults(3.0) == ()
    asleep_s = 7.5
    (fault,) = watch.faults(4.0)
    assert (fault.name, fault.detail) == ("daemon.suspended", "it slept for 2.5 s")
    assert len(watch.faults(4.9)) == 1
    assert watch.faults(5.1) == ()
    health, boot, real = HealthWatch(Config()), time.clock_gettime, time.time
    monkeypatch.setattr(time, "clock_gettime", lambda clock: boot(clock) + 3600.0)
    monkeypatch.setattr(time, "time", lambda: real() + 3600.0)
    health.measure()
    assert "clock_stepped" not in {fault.condition for fault in health.faults(time.monotonic())}


def test_this_computer_tells_how_long_it_slept() -> None:
    before_s = slept_s()
    watch = SleepWatch()
    assert all(watch.faults(number * 0.001) == () for number in range(20000)), "it slept, or the clocks differ by more"
    assert slept_s() - before_s < 0.001


def test_high_memory_is_told() -> None:
    assert resident_mb() == pytest.approx(psutil.Process().memory_info().rss / 1e6, rel=0.05)
    readings_mb = iter((200.0, 201.0, 199.0))
    watch = HealthWatch(parse({"control": {"memory_warn_mb": 200.0}}), resident_mb=lambda: next(readings_mb))
    for told in ([], ["memory_high"], []):
        watch.measure()
        assert [fault.condition for fault in watch.faults(time.monotonic())] == told


def test_the_angle_at_the_moment_of_exposure() -> None:
    history = AngleHistory()
    assert history.at(5.0)[1] == float("inf")
    for index in range(10):
        history.add(float(index), 10.0 * index)
    history.add(3.0, 999.0)
    angle_deg, age_s = history.at(4.25)
    assert angle_deg == pytest.approx(42.5)
    assert age_s == pytest.approx(0.25)
    assert history.at(9.5) == (90.0, 0.5)
    assert history.at(-1.0) == (0.0, 1.0)


def test_settings_the_camera_did_not_take_are_named() -> None:
    camera = parse({"camera": {"exposure_us": 8000.0, "white_balance_k": 4600.0}}).camera
    assert settings_not_kept(camera, {"exposure_us": 8000.0, "white_balance_k": 4600.0}) == ()
    (wrong,) = settings_not_kept(camera, {"exposure_us": 8000.0, "white_balance_k": 5500.0})
    assert "white_balance_k" in wrong
    assert settings_not_kept(camera, {}) == ()


class _Eyes:
    """Its camera gives nothing any more."""

    frames_per_s = 0.0

    def status(self) -> CameraStatus:
        return CameraStatus()


async def test_what_is_past_its_age_is_told_as_unknown(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    profile_mm = (12.5, None) * 12
    await bench.ticks(5, zone=Zone.LEFT, share_left=1.0, volume_left_l=3.0, profile_mm=profile_mm)
    told = build_status(Config(), bench.loop, _Eyes())  # type: ignore[arg-type]  # all that is asked of it
    assert (told.soil.zone, told.soil.share_left, told.soil.volume_left_l) == (Zone.LEFT, 1.0, 3.0)
    assert told.soil.profile_mm == profile_mm
    rotation = told.axes["rotation"]
    assert rotation.measured is not None
    assert "measured" in rotation.ages_s
    assert all(0.0 <= age_s <= 0.2 for name, age_s in rotation.ages_s.items() if name != "sent")
    assert told.attitude.height_mm is not None
    assert told.attitude.lifts_age_s is not None
    assert told.axes["tilt"].flags is not None
    bench.machine.rotation.lose()
    await bench.ticks(200)
    told = build_status(Config(), bench.loop, _Eyes())  # type: ignore[arg-type]  # as above
    assert (told.soil.zone, told.soil.confidence, told.soil.share_left, told.soil.volume_left_l) == (
        Zone.UNKNOWN, 0.0, None, None
    )  # fmt: skip
    assert told.soil.profile_mm is None
    assert told.soil.age_s is not None
    assert told.soil.age_s > 3.0
    lost = told.axes["rotation"]
    assert (lost.measured, lost.velocity_per_s, lost.moving) == (None, None, None)
    assert lost.measured_age_s is not None
    assert lost.measured_age_s > 3.0
    assert "measured" not in lost.ages_s
    bench.machine.lift_left.lose()
    bench.machine.tilt.lose()
    await bench.ticks(300)
    told = build_status(Config(), bench.loop, _Eyes())  # type: ignore[arg-type]  # as above
    attitude, tilt = told.attitude, told.axes["tilt"]
    assert (attitude.height_mm, attitude.lifts_age_s, attitude.pitch_deg, attitude.pitch_age_s) == (None,) * 4
    assert (tilt.flags, tilt.thermal_load) == (None, None)


@pytest.mark.parametrize("doubt", ["none", "picture", "angle"])
async def test_where_how_much_lies_is_told_only_by_a_good_picture_at_a_known_angle(tmp_path: Path, doubt: str) -> None:
    """The observation keeps its numbers, not believed; for people they are none."""
    thirds = Thirds(3.0, 2.0, 1.0)
    doubts: dict[str, dict[str, Any]] = {
        "picture": {"faults": (PictureFault("obstructed", "a post"),)},
        "angle": {"blade_angle_age_s": 5.1},
        "none": {},
    }
    bench = Bench(tmp_path)
    await bench.ticks(
        3,
        zone=Zone.UNKNOWN,
        volume_left_l=3.0,
        ahead=SoilAhead(Zone.UNKNOWN, 0.0, "no clear zone", thirds),
        carried=thirds,
        profile_mm=(12.5,) * 24,
        **doubts[doubt],
    )
    told = build_status(Config(), bench.loop, _Eyes()).soil  # type: ignore[arg-type]  # all that is asked of it
    assert told.zone is Zone.UNKNOWN
    numbers = (told.volume_left_l, told.ahead, told.carried, told.profile_mm)
    assert (numbers == (None,) * 4) == (doubt != "none")
    assert (None in numbers) == (doubt != "none")


class NoBus(FakeLink):
    """A bus that is not there yet."""

    gone = True

    async def open(self) -> None:
        if self.gone:
            raise DeviceMissingError("CAN socketcan can0", "no such interface", "Set it up")


class OnTheBus(FakeActuator):
    """An actuator that opens the bus it is on, as the contract of the link asks."""

    link: NoBus

    async def open(self) -> None:
        await self.link.open()
        await super().open()


async def test_who_has_a_wire_of_its_own_does_not_wait_for_a_bus_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(devices_module, "RETRY_S", 0.0)
    clock, link, log = ManualClock(), NoBus(), list[str]()
    rotator = FakeRotator("rotation", clock, 0.0, log)
    lift, tilt = OnTheBus("lift_left", clock, 100.0, log), FakeActuator("tilt", clock, 50.0, log)
    lift.link = link
    for device in (rotator, lift, tilt):
        device.lifecycle = Lifecycle.CLOSED
    devices = Devices(rotator, link, {"lift_left": lift, "tilt": tilt})
    opening = asyncio.create_task(open_devices(devices))
    for _ in range(20):
        await asyncio.sleep(0)
    assert (tilt.lifecycle, devices.problem_of("tilt")) == (Lifecycle.STANDBY, "")
    assert rotator.lifecycle is Lifecycle.STANDBY
    assert lift.lifecycle is Lifecycle.CLOSED
    assert "no such interface" in devices.problem_of("lift_left")
    told = [record.getMessage() for record in caplog.records if "cannot be opened" in record.getMessage()]
    assert told, "the bus's absence is told"
    assert all(line.startswith("can: ") for line in told), "by the bus alone, not by each device on it"
    link.gone = False
    await opening
    assert (lift.lifecycle, devices.problems) == (Lifecycle.STANDBY, {})
