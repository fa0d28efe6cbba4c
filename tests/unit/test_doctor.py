"""The doctor, on machines made of files: each fault is found, with its repair, and a healthy machine passes."""

from __future__ import annotations

import grp
import json
import os
import socket
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graderd.cli.app import run_app
from graderd.config import Config, load
from graderd.doctor import Finding, Machine, Verdict, as_dict, examine, without_secrets, worst

LINK = {
    "flags": ["UP"],
    "operstate": "UP",
    "txqlen": 128,
    "linkinfo": {"info_data": {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 250_000}}},
}
STATUS: dict[str, Any] = {
    "mode": "disarmed",
    "tick": {"rate_hz": 50.0, "lateness_p99_ms": 1.5},
    "axes": {
        "rotation": {"name": "rotation", "measured_age_s": 0.02, "counters": {"requests_n": 1000, "timeouts_n": 1}}
    },
    "faults": [],
    "camera": {"description": "Intel RealSense D455 0123, firmware 5.16.0.1"},
}
UNIT = "LoadState=loaded\nActiveState=active\nUnitFileState=enabled\nNRestarts=0\nResult=success\n"


class Bench:
    """A healthy machine below a directory; a test breaks one thing of it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.link: dict[str, Any] | None = json.loads(json.dumps(LINK))
        self.answers = {"systemctl": UNIT, "timedatectl": "NTPSynchronized=yes\nTimezone=UTC\n"}
        self.status: dict[str, Any] | None = json.loads(json.dumps(STATUS))
        self.differences: list[dict[str, str]] = []
        self.write("/sys/bus/usb/devices/2-1/idVendor", "8086")
        self.write("/sys/bus/usb/devices/2-1/product", "Intel(R) RealSense(TM) Depth Camera 455")
        self.write("/sys/bus/usb/devices/2-1/speed", "5000")
        self.write("/sys/bus/usb/devices/2-1/bcdDevice", "5015")
        self.write("/sys/bus/usb/devices/2-1/busnum", "2")
        self.write("/sys/bus/usb/devices/2-1/devnum", "7")
        self.write("/dev/bus/usb/002/007", "")
        self.user = ""
        self.write("/dev/ttyUSB0", "")
        self.write("/sys/class/tty/ttyUSB0/device/latency_timer", "1")
        self.write("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance")
        self.write("/proc/1/comm", "systemd")
        self.write("/run/systemd/system/.there", "")
        (root / "dev/graderd").mkdir()
        (root / "dev/graderd/servo").symlink_to(root / "dev/ttyUSB0")

    def write(self, path: str, text: str) -> None:
        there = self.root / path.lstrip("/")
        there.parent.mkdir(parents=True, exist_ok=True)
        there.write_text(text)

    def run(self, *command: str) -> str | None:
        if command[0] == "ip":
            return None if self.link is None else json.dumps([self.link])
        return self.answers.get(command[0])

    def findings(self, config: Config | None = None, refusals: list[str] | None = None) -> list[Finding]:
        machine = Machine(
            config or Config(),
            self.root,
            self.run,
            self.status,
            lambda _: {"differences": self.differences},
            self.user,
        )
        return examine(machine, refusals or [])

    def found(self, check: str, **given: Any) -> Finding:
        """The worst that was found of a check; what was not found is a pass."""
        mine = [finding for finding in self.findings(**given) if finding.check == check]
        mine.append(Finding(check, Verdict.PASS, ""))
        order = [Verdict.FAIL, Verdict.WARN, Verdict.NOTE, Verdict.PASS]
        return min(mine, key=lambda finding: order.index(finding.verdict))


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_healthy_machine_passes_everything(bench: Bench) -> None:
    findings = bench.findings()
    assert worst(findings) is Verdict.PASS, [f for f in findings if f.verdict is not Verdict.PASS]
    assert len({finding.check for finding in findings}) >= 13
    assert json.loads(json.dumps(as_dict(findings)))["verdict"] == "pass"


def users(bench: Bench) -> None:
    bench.write("/proc/77/cmdline", "minicom\0-D\0/dev/ttyUSB0")
    (bench.root / "proc/77/fd").mkdir()
    (bench.root / "proc/77/fd/5").symlink_to(bench.root / "dev/ttyUSB0")


def link(**data: Any) -> Callable[[Bench], None]:
    def change(bench: Bench) -> None:
        assert bench.link is not None
        bench.link["linkinfo"]["info_data"].update(data)

    return change


def status(path: str, value: Any) -> Callable[[Bench], None]:
    def change(bench: Bench) -> None:
        target: Any = bench.status
        *way, last = path.split(".")
        for step in way:
            target = target[step]
        target[last] = value

    return change


def rights(path: str, mode: int) -> Callable[[Bench], None]:
    """A device that the service's user, who is nobody here, may use no more than ``mode`` says."""

    def change(bench: Bench) -> None:
        bench.user = "nobody"
        (bench.root / path).chmod(mode)
        if os.geteuid() == 0:  # whose files else have a group that is nobody's to join
            os.chown(bench.root / path, 0, grp.getgrnam("daemon").gr_gid)

    return change


FAULT = {"name": "can.bus_off", "reads": "the bus is off", "reaction": "disarm", "remedy": "look at the cable"}
BROKEN: tuple[tuple[str, Callable[[Bench], object], str, Verdict, str], ...] = (
    ("USB 2", lambda b: b.write("/sys/bus/usb/devices/2-1/speed", "480"), "camera", Verdict.FAIL, "USB 3 cable"),
    ("no camera", lambda b: b.write("/sys/bus/usb/devices/2-1/product", "Mouse"), "camera", Verdict.FAIL, "lsusb"),
    ("no port", lambda b: (b.root / "dev/ttyUSB0").unlink(), "rotation port", Verdict.FAIL, "plug it in"),
    (
        "latency",
        lambda b: b.write("/sys/class/tty/ttyUSB0/device/latency_timer", "16"),
        "rotation latency",
        Verdict.FAIL,
        "echo 1 | sudo tee /sys/class/tty/ttyUSB0/device/latency_timer",
    ),
    ("second user", users, "rotation user", Verdict.FAIL, "kill 77"),
    ("ModemManager", lambda b: b.write("/proc/5/comm", "ModemManager"), "ModemManager", Verdict.WARN, "mask --now"),
    ("no link", lambda b: setattr(b, "link", None), "can", Verdict.FAIL, "systemctl start graderd-can@can0"),
    ("link down", lambda b: b.link and b.link.update(flags=[]), "can", Verdict.FAIL, "systemctl start"),
    ("bit rate", link(bittiming={"bitrate": 500_000}), "can", Verdict.FAIL, "systemctl restart graderd-can@can0"),
    ("queue", lambda b: b.link and b.link.update(txqlen=10), "can queue", Verdict.WARN, "txqueuelen 128"),
    ("termination", link(state="ERROR-PASSIVE"), "can", Verdict.FAIL, "60 Ω"),
    ("servo", lambda b: b.differences.append({"kind": "model"}), "servo", Verdict.FAIL, "graderd profile verify"),
    ("clock", lambda b: b.answers.update(timedatectl="NTPSynchronized=no"), "clock", Verdict.WARN, "set-ntp true"),
    (
        "governor",
        lambda b: b.write("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave"),
        "governor",
        Verdict.WARN,
        "echo performance",
    ),
    ("no unit", lambda b: b.answers.update(systemctl="LoadState=not-found"), "service", Verdict.WARN, "apt install"),
    (
        "failed unit",
        lambda b: b.answers.update(systemctl=UNIT.replace("=active", "=failed")),
        "service",
        Verdict.FAIL,
        "journalctl -u graderd",
    ),
    (
        "not at boot",
        lambda b: b.answers.update(systemctl=UNIT.replace("enabled", "disabled")),
        "service",
        Verdict.WARN,
        "systemctl enable",
    ),
    ("late tick", status("tick.lateness_p99_ms", 25.0), "daemon", Verdict.WARN, "governor"),
    ("lost replies", status("axes.rotation.counters.timeouts_n", 90), "dead times", Verdict.WARN, "termination"),
    ("never measured", status("axes.rotation.measured_age_s", None), "dead times", Verdict.WARN, "power it"),
    (
        "old firmware",
        status("camera.description", "Intel RealSense D455 0123, firmware 5.13.0.50, older than 5.16.0.1"),
        "camera firmware",
        Verdict.WARN,
        "rs-fw-update",
    ),
    ("group", rights("dev/ttyUSB0", 0o660), "rotation port", Verdict.FAIL, " nobody; sudo systemctl restart graderd"),
    ("no group", rights("dev/ttyUSB0", 0o600), "rotation port", Verdict.FAIL, "ls -lL /dev/graderd/servo"),
    ("USB", rights("dev/bus/usb/002/007", 0o660), "camera rights", Verdict.FAIL, "sudo usermod -aG "),
    ("a fault", status("faults", [FAULT]), "fault", Verdict.FAIL, "look at the cable"),
)


@pytest.mark.parametrize(("broken", "check", "verdict", "repair"), [b[1:] for b in BROKEN], ids=[b[0] for b in BROKEN])
def test_each_fault_is_found_with_its_repair(
    bench: Bench, broken: Callable[[Bench], object], check: str, verdict: Verdict, repair: str
) -> None:
    assert bench.found(check).verdict is Verdict.PASS, "healthy before"
    broken(bench)
    found = bench.found(check)
    assert found.verdict is verdict
    assert repair in found.repair


def test_two_actuators_on_one_address_are_found(bench: Bench) -> None:
    config = Config()
    lift = config.lift_right.model_copy(update={"address_n": 19})
    found = bench.found("addresses", config=config.model_copy(update={"lift_right": lift}))
    assert found.verdict is Verdict.FAIL
    assert "lift_left and lift_right have address 19" in found.seen


def test_a_disk_with_too_little_room_is_found(bench: Bench) -> None:
    recording = Config().recording.model_copy(update={"directory": "/var/lib/graderd/recordings", "min_free_mb": 1e9})
    found = bench.found("disk", config=Config().model_copy(update={"recording": recording}))
    assert found.verdict is Verdict.FAIL
    assert "du -xh /var/lib/graderd/recordings" in found.repair


@pytest.mark.live
@pytest.mark.parametrize("whose", ["the service's", "the user's own"])
def test_a_socket_that_a_killed_daemon_left_is_found(whose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="g-") as short:  # a socket's path has 107 bytes at most
        bench = Bench(Path(short))
        bench.status = None
        monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
        assert bench.found("socket").verdict is Verdict.PASS
        path = bench.root / ("run/graderd" if whose == "the service's" else "run/user/7/graderd") / "graderd.sock"
        path.parent.mkdir(parents=True)
        with socket.socket(socket.AF_UNIX) as gone:
            gone.bind(str(path))
        found = bench.found("socket")
        assert found.verdict is Verdict.WARN
        assert "nobody listens" in found.seen
        assert ("systemctl restart graderd" if whose == "the service's" else "graderd run") in found.repair


def test_what_the_configuration_check_refuses_is_told(bench: Bench) -> None:
    found = bench.found("configuration", refusals=["rotation.profile: there is no profile 'x'"])
    assert (found.verdict, found.repair) == (Verdict.FAIL, "graderd config check")


def test_without_a_daemon_it_says_what_it_could_not_ask(bench: Bench) -> None:
    machine = Machine(Config(), bench.root, bench.run)
    findings = {finding.check: finding for finding in examine(machine, [])}
    assert findings["daemon"].verdict is Verdict.NOTE
    assert findings["servo"].verdict is Verdict.NOTE


@pytest.mark.parametrize(
    "secret",
    [
        "Authorization: Bearer abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQ",
        'token = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQ"',
        "http://127.0.0.1:8431/#abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQ",
        "tablet command 2026-11-28T20:00:00Z " + "0123456789abcdef" * 4,
        "-----BEGIN PRIVATE KEY-----\nMIGHAgEAMBMG\n-----END PRIVATE KEY-----",
        "wifi password=hunter2",
    ],
)
def test_no_secret_is_left_in_a_bundle(secret: str) -> None:
    left = without_secrets(f"before {secret} after")
    assert "removed" in left
    for part in ("abcdefghijklmnopqrstuvwxyz", "0123456789abcdef" * 2, "MIGH", "hunter2"):
        assert part not in left
    assert left.startswith("before")
    assert left.endswith("after")


@pytest.mark.live
def test_a_bundle_has_what_a_report_needs_and_writes_over_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("graderd.doctor.run_command", lambda *_: "token=abcdefghijklmnopqrstuvwxyz0123456789")
    config = tmp_path / "graderd.toml"
    config.write_text("# a comment\n[machine]\nlease_s = 0.4\n")
    load(config)
    out = tmp_path / "report.tar.gz"
    by = ["--socket", str(tmp_path / "none.sock"), "bundle", "--config", str(config), "--out", str(out)]
    assert run_app(by) == 0
    with tarfile.open(out) as archive:
        texts = {member.name: archive.extractfile(member).read().decode() for member in archive}  # type: ignore[union-attr]
    assert {"graderd/doctor.json", "graderd/graderd.toml", "graderd/journal.txt"} <= set(texts)
    assert "lease_s = 0.4" in texts["graderd/graderd.toml"]
    assert not any("abcdefghijklmnopqrstuvwxyz" in text for text in texts.values())
    assert run_app(by) == 2
    assert "there is such a file" in capsys.readouterr().err


@pytest.mark.live
def test_the_command_exits_with_1_where_something_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "graderd.toml"
    config.write_text('[rotation]\nprofile = "none_such"\n')
    given = ["--socket", str(tmp_path / "none.sock"), "doctor", "--config", str(config), "--json"]
    assert run_app(given) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "fail"
    assert any(f["check"] == "configuration" and "none_such" in f["seen"] for f in told["findings"])
