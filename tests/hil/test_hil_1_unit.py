"""The unit itself: its rights, its limits, how it starts."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from hil.service import CONFIG, SOCKET, Grader, run

PROBE = Path(__file__).with_name("sandbox_probe.py")
UNITS = ("graderd.service", "graderd-can@vcan0.service")


def test_the_units_are_correct_to_systemd() -> None:
    done = run("systemd-analyze", "verify", *UNITS)
    assert done.stdout + done.stderr == ""


@pytest.mark.parametrize("unit", UNITS)
def test_exposure_is_low(unit: str) -> None:
    path = f"/usr/lib/systemd/system/{unit.replace('vcan0', '')}"
    run("systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=19", path)


def test_it_starts_disarmed_and_says_so(service: Grader) -> None:
    assert service.unit.state == "active"
    assert service.status()["mode"] == "disarmed"
    assert "disarmed" in service.unit.show("StatusText")
    axes = service.status()["axes"]
    assert axes["rotation"]["torque_on"] is False


def test_only_its_group_may_use_the_socket(service: Grader) -> None:
    entry = SOCKET.stat()
    assert stat.S_IMODE(entry.st_mode) == 0o660
    assert SOCKET.group() == "graderd"
    assert SOCKET.parent.stat().st_mode & 0o007 == 0
    assert CONFIG.stat().st_mode & 0o007 == 0
    stranger = run("setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups", "graderd", "status", check=False)
    assert stranger.returncode == 1
    member = run(
        "setpriv", "--reuid=nobody", "--regid=nogroup", "--groups=graderd", "graderd", "status", "--json", check=False
    )
    assert json.loads(member.stdout)["mode"] == "disarmed"


def test_the_running_process_has_no_privilege(service: Grader) -> None:
    lines = Path(f"/proc/{service.unit.pid}/status").read_text(encoding="ascii").splitlines()
    said = {key: value.split() for key, value in (line.split(":", 1) for line in lines)}
    assert "0" not in said["Uid"]
    assert said["NoNewPrivs"] == ["1"]
    assert said["Seccomp"] == ["2"]
    for kind in ("CapEff", "CapPrm", "CapBnd", "CapInh", "CapAmb"):
        assert int(said[kind][0], 16) == 0, kind
    assert service.unit.show("MemoryMax") == str(1 << 30)
    assert service.unit.show("TasksMax") == "128"


def test_the_sandbox_holds(service: Grader) -> None:
    """A stand-in for the daemon under the very same unit tries what a taken-over daemon would."""
    text = Path("/usr/lib/systemd/system/graderd.service").read_text(encoding="utf-8")
    dropped = ("ExecStart", "ExecStopPost", "Type=", "WatchdogSec", "Restart", "RuntimeDirectory", "NotifyAccess")
    kept = [line for line in text.splitlines() if not line.startswith(dropped)]
    kept.insert(
        kept.index("[Service]") + 1, "Type=oneshot\nExecStart=/opt/graderd/bin/python -I /var/tmp/hil-probe/probe.py"
    )
    place = Path("/var/tmp/hil-probe")
    place.mkdir(exist_ok=True)
    (place / "probe.py").write_bytes(PROBE.read_bytes())
    unit = Path("/run/systemd/system/hil-sandbox.service")
    # PrivateTmp hides /var/tmp: only the probe is let in.
    unit.write_text("\n".join(kept).replace("[Install]", "BindReadOnlyPaths=/var/tmp/hil-probe\n[Install]"), "utf-8")
    Path("/home/hil-secret").write_text("secret", encoding="utf-8")
    run("systemctl", "start", unit.name, check=False)
    log = run("journalctl", "-u", unit.name, "-o", "cat", "--no-pager").stdout
    result = json.loads(next(line for line in log.splitlines() if line.startswith("{")))
    assert result["got_through"] == [], result
    assert result["broken"] == [], result
    assert result["tried_n"] >= 20
