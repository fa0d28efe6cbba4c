"""The small parts of the runtime: state file, systemd notifier, recorder, health watch, angle history."""

from __future__ import annotations

import itertools
import json
import os
import socket
import time
from pathlib import Path

import pytest

from graderd.config import Config, parse
from graderd.core.machine import Mode
from graderd.core.soil import Zone
from graderd.core.status import CameraStatus, FaultStatus, Status
from graderd.runtime.app.perception_child import AngleHistory, settings_not_kept
from graderd.runtime.health import HealthWatch
from graderd.runtime.recorder import Recorder
from graderd.runtime.sd_notify import SystemdNotifier
from graderd.runtime.state_file import StateFile
from graderd.runtime.status import build_status
from tests.unit.test_runtime_control import Bench

STATUS = Status(
    time_s=1.0, wall_time="2026-01-01T00:00:00Z", version="0", simulated=True, mode=Mode.DISARMED, reason="t"
)


def test_the_last_stop_survives_a_restart(tmp_path: Path) -> None:
    state = StateFile(str(tmp_path / "new"))
    state.save("dog on the site")
    assert state.settle()
    found = StateFile(str(tmp_path / "new")).load()
    assert found is not None
    assert found.reason == "dog on the site"
    assert "dog on the site (" in str(found)


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"reason": 1}', b"\xff", b'{"reason": "x", "wall_time": "y", "z": 1}']
)
def test_a_damaged_state_file_is_set_aside_and_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "last_stop.json"
    path.write_bytes(content)
    state = StateFile(str(tmp_path))
    assert state.load() is None
    assert "last_stop.json" in state.problem
    assert (tmp_path / "last_stop.damaged").read_bytes() == content
    assert not path.exists()
    state.save("next")
    assert state.settle()
    assert state.problem == ""


def test_a_state_directory_that_cannot_be_written_is_told_and_raises_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    state = StateFile(str(tmp_path / "file" / "state"))
    assert state.save("x").reason == "x"
    assert state.settle()
    assert state.problem


def test_a_state_directory_that_stalls_is_not_waited_for_and_told(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "last_stop.new")  # a file whose opening hangs, as on a disk that does not answer
    state = StateFile(str(tmp_path))
    began_s = time.monotonic()
    for reason in ("one", "two", "three"):
        assert state.save(reason).reason == reason
    assert time.monotonic() - began_s < 0.1
    assert not state.settle(0.05)
    assert "takes long" in state.problem
    with (tmp_path / "last_stop.new").open("rb"):  # the disk is back
        assert state.settle()
    assert state.problem == ""
    state.save("four")
    assert state.settle()
    last = state.load()
    assert last is not None
    assert last.reason == "four"


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


def recording(directory: Path, **settings: object) -> tuple[Config, Recorder]:
    config = parse({"recording": {"directory": str(directory), **settings}})
    return config, Recorder(config)


def test_a_recording_begins_with_versions_and_the_resolved_configuration(tmp_path: Path) -> None:
    config, recorder = recording(tmp_path, min_free_mb=0)
    for index in range(100):
        recorder.take(1000.0 + index * 0.02, lambda: STATUS)
    recorder._write_guarded()
    assert recorder.path is not None
    lines = [json.loads(line) for line in recorder.path.read_text(encoding="utf-8").splitlines()]
    assert lines[0]["event"] == "recording"
    assert Config.model_validate(lines[0]["config"]) == config
    assert len(lines) - 1 == pytest.approx(20, abs=1)
    assert lines[1]["mode"] == "disarmed"


def test_a_full_disk_costs_records_and_is_told(tmp_path: Path) -> None:
    _, recorder = recording(tmp_path, min_free_mb=1e12)
    recorder.take(1000.0, lambda: STATUS)
    recorder._write_guarded()
    (fault,) = recorder.faults(1000.1)
    assert (fault.device, fault.condition) == ("daemon", "disk_full")
    assert recorder.path is None


def test_a_directory_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    _, recorder = recording(tmp_path / "file" / "sub", min_free_mb=0)
    recorder.take(1000.0, lambda: STATUS)
    recorder._write_guarded()
    assert recorder.faults(1000.1)[0].condition == "recorder_failed"


def test_the_oldest_recordings_make_room(tmp_path: Path) -> None:
    for index in range(5):
        (tmp_path / f"graderd-2020010{index}T000000Z.jsonl").write_bytes(b"x" * 1_000_000)
    _, recorder = recording(tmp_path, min_free_mb=0, max_mb=2.5)
    recorder.take(1000.0, lambda: STATUS)
    recorder._write_guarded()
    assert len(list(tmp_path.glob("graderd-2020*.jsonl"))) == 2


class Recorded:
    """A recorder that is given statuses one after the other, and writes each at once."""

    def __init__(self, directory: Path, max_mb: float) -> None:
        _, self.recorder = recording(directory, min_free_mb=0, max_mb=max_mb)
        self.directory = directory
        self._now_s = 1000.0
        self.most_n = 0

    def take(self, status: Status, times_n: int = 1) -> None:
        for _ in range(times_n):
            self._now_s += 0.2
            self.recorder.take(self._now_s, lambda: status.model_copy(update={"time_s": self._now_s}))
            self.recorder._write_guarded()
            self.most_n = max(self.most_n, sum(path.stat().st_size for path in self.parts()))

    def parts(self) -> list[Path]:
        return sorted(self.directory.glob("graderd-*.jsonl"), key=lambda path: (path.stat().st_mtime_ns, path.name))

    def marked(self) -> list[Path]:
        return [path for path in self.parts() if path.name.endswith(".incident.jsonl")]

    def times_s(self) -> list[float]:
        lines = [json.loads(line) for path in self.parts() for line in path.read_text("utf-8").splitlines()]
        return sorted(line["time_s"] for line in lines if "time_s" in line)


LONG = STATUS.model_copy(update={"reason": "x" * 20_000})
ARMED_LONG = LONG.model_copy(update={"mode": Mode.MANUAL})
STOPPED_LONG = LONG.model_copy(update={"mode": Mode.STOPPED})
HELD = FaultStatus(
    name="rotation.no_reply", reads="", detail="", remedy="", reaction="hold", clears="when gone", age_s=0, present=True
)


def test_the_limit_is_kept_while_running_and_the_newest_records_stay(tmp_path: Path) -> None:
    run = Recorded(tmp_path, max_mb=1.0)
    run.take(LONG, 300)
    assert run.most_n <= 1_000_000
    assert run.most_n > 800_000, "the room that is given is used"
    times_s = run.times_s()
    assert times_s[-1] == pytest.approx(1060.0)
    assert [b - a for a, b in itertools.pairwise(times_s)] == pytest.approx([0.2] * (len(times_s) - 1))
    for path in run.parts():
        assert json.loads(path.read_text("utf-8").splitlines()[0])["event"] == "recording"
    assert run.recorder.faults(1060.0) == ()


@pytest.mark.parametrize(
    "incident", [STOPPED_LONG, ARMED_LONG.model_copy(update={"faults": (HELD,)})], ids=["stop", "fault"]
)
def test_what_led_to_an_incident_goes_last(tmp_path: Path, incident: Status) -> None:
    run = Recorded(tmp_path, max_mb=1.0)
    run.take(ARMED_LONG, 6)
    run.take(incident)
    incident_s = run.times_s()[-1]
    run.take(LONG, 300)
    assert run.most_n <= 1_000_000
    assert len(run.marked()) == 2
    kept_s = [at_s for at_s in run.times_s() if at_s <= incident_s]
    assert kept_s == pytest.approx([1000.2 + 0.2 * index for index in range(7)]), "and the part before it"


def test_incidents_go_too_when_nothing_else_is_left_oldest_first(tmp_path: Path) -> None:
    run = Recorded(tmp_path, max_mb=1.0)
    for _ in range(60):
        run.take(ARMED_LONG, 4)
        run.take(STOPPED_LONG)
    assert run.most_n <= 1_000_000
    times_s = run.times_s()
    assert times_s[-1] == pytest.approx(1060.0)
    assert [b - a for a, b in itertools.pairwise(times_s)] == pytest.approx([0.2] * (len(times_s) - 1))


def test_an_ordinary_day_marks_nothing(tmp_path: Path) -> None:
    run = Recorded(tmp_path, max_mb=1.0)
    warned = HELD.model_copy(update={"reaction": "warn"})
    run.take(LONG.model_copy(update={"faults": (HELD,)}), 3)  # nothing plugged in yet
    run.take(ARMED_LONG.model_copy(update={"faults": (warned,)}), 3)
    run.take(LONG, 3)
    run.recorder.expect_stop()
    run.take(STOPPED_LONG, 3)
    assert run.marked() == []


def test_a_limit_that_holds_nothing_is_told(tmp_path: Path) -> None:
    run = Recorded(tmp_path, max_mb=0.005)
    run.take(LONG)
    (fault,) = run.recorder.faults(1000.3)
    assert fault.condition == "disk_full"
    assert "recording.max_mb (0.005) is full" in fault.detail
    assert run.parts() == []


def test_a_part_that_somebody_took_away_is_begun_anew(tmp_path: Path) -> None:
    run = Recorded(tmp_path, max_mb=10.0)
    run.take(LONG)
    assert run.recorder.path is not None
    run.recorder.path.unlink()
    run.take(LONG)
    assert json.loads(run.parts()[0].read_text("utf-8").splitlines()[0])["event"] == "recording"


def test_without_a_directory_nothing_is_recorded() -> None:
    recorder = Recorder(Config())
    recorder.take(1.0, lambda: pytest.fail("no status is wanted"))
    assert recorder.faults(1.0) == ()


def test_a_stepped_clock_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = HealthWatch(Config())
    watch.measure()
    assert watch.faults(time.monotonic()) == ()
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3600.0)
    watch.measure()
    (fault,) = watch.faults(time.monotonic())
    assert fault.condition == "clock_stepped"
    assert "+3600 s" in fault.detail
    assert watch.faults(time.monotonic() + 60.0) == ()


def test_high_memory_is_told() -> None:
    watch = HealthWatch(parse({"control": {"memory_warn_mb": 1.0}}))
    watch.measure()
    assert [fault.condition for fault in watch.faults(time.monotonic())] == ["memory_high"]


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
    await bench.ticks(5, zone=Zone.LEFT, share_left=1.0, volume_left_l=3.0)
    told = build_status(Config(), bench.loop, _Eyes())  # type: ignore[arg-type]  # all that is asked of it
    assert (told.soil.zone, told.soil.share_left, told.soil.volume_left_l) == (Zone.LEFT, 1.0, 3.0)
    assert told.axes["rotation"].measured is not None
    bench.machine.rotation.lose()
    await bench.ticks(200)
    told = build_status(Config(), bench.loop, _Eyes())  # type: ignore[arg-type]  # as above
    assert (told.soil.zone, told.soil.confidence, told.soil.share_left, told.soil.volume_left_l) == (
        Zone.UNKNOWN, 0.0, 0.0, None
    )  # fmt: skip
    assert told.soil.age_s is not None
    assert told.soil.age_s > 3.0
    lost = told.axes["rotation"]
    assert (lost.measured, lost.velocity_per_s, lost.moving) == (None, None, None)
    assert lost.measured_age_s is not None
    assert lost.measured_age_s > 3.0
