"""What happens inside the QEMU machine of ``make hil-usb``: ``python3 -m hil.usb_guest``, as root.

The servo is on an emulated FTDI adapter whose far end is a virtual servo on the host; the actuators are simulated here,
on the second of two SJA1000 controllers, and reach the service across the bus. Every step prints what was seen and how
long it took; the first that is not as it should be ends the run. Requests to pull and plug the adapter are files that
the host answers.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from graderd.client import ClientError, Lease
from hil.bus import details, interface_exists
from hil.service import PYTHON, Grader, Unit, brief, faults, measured, run, wait_for

OUT: Final = Path(os.environ.get("HIL_OUT", "/run/hil-out"))
SERVO: Final = Path("/dev/graderd/servo")
SERIAL: Final = "FT4U2D2A"
OURS, THEIRS = "can0", "can1"
# The machine is emulated, ten to fifty times slower than a computer. Longer deadlines, and no pictures to look at.
SETTINGS: Final[dict[str, object]] = {
    "rotation.port": str(SERVO),
    "rotation.poll_hz": 10.0,
    "rotation.speed_deg_per_s": 1.7,
    "rotation.watchdog_s": 1.0,
    "rotation.goal_timeout_s": 1.0,
    "rotation.reply_timeout_s": 1.2,
    "rotation.not_moving_s": 4.0,
    "control.tick_hz": 10.0,
    "rotation.max_age_s": 2.5,
    "lift_left.max_age_s": 2.5,
    "lift_right.max_age_s": 2.5,
    "tilt.max_age_s": 2.5,
    "control.overrun_s": 2.0,
    "control.shutdown_timeout_s": 10.0,
    "lift_pair.silent_s": 0.6,
    "lift_pair.reading_max_age_s": 2.5,
    "machine.lease_s": 5.0,
    "camera.source": "folder",
    "camera.path": "/run/hil-project/docs/pictures",
    "camera.repeat": True,
    "camera.rate_hz": 0.05,
    "rule.votes_needed_n": 1,  # a picture every 20 s: four never lie within the 10 s that votes may last
    "rule.vote_max_age_s": 10.0,
    "camera.stale_s": 60.0,
    "camera.restart_s": 600.0,
    "can.channel": OURS,
}
RENEW_S: Final = 0.1
TIMEOUT_S: Final = 180.0
TOLD_S: Final = 5.0


class Report:
    """The steps of the run, each with its time and what it found; on disk after every one."""

    def __init__(self) -> None:
        self._steps: list[dict[str, object]] = []

    @contextmanager
    def step(self, name: str) -> Iterator[dict[str, object]]:
        """One step; what the block puts into the dictionary is reported."""
        began_s, found = time.monotonic(), dict[str, object]()
        ok = False
        try:
            yield found
            ok = True
        finally:
            took_s = round(time.monotonic() - began_s, 1)
            self._steps.append({"name": name, "ok": ok, "took_s": took_s, **found})
            told = ", ".join(f"{key} {value}" for key, value in found.items())
            sys.stdout.write(
                f"hil-usb: {'ok' if ok else 'FAILED'} {took_s:6.1f} s  {name}{': ' if told else ''}{told}\n"
            )
            sys.stdout.flush()
            content = {"kernel": platform.release(), "package": _package(), "steps": self._steps}
            (OUT / "report.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def host(request: str) -> None:
    """Let the host do something to this machine, and wait until it is done."""
    # A name of its own each time: the guest may still take one that the host removed for there.
    path = OUT / f"please-{request}-{time.monotonic_ns()}"
    path.touch()
    wait_for(f"the host to {request}", lambda: not path.exists(), 30.0, 0.2)


def link(name: str) -> dict[str, Any]:
    """What matters of a CAN interface as the kernel tells it."""
    data: Any = details(name)["info_data"]
    queue = Path(f"/sys/class/net/{name}/tx_queue_len").read_text(encoding="ascii").strip()
    return {
        "bitrate": data["bittiming"]["bitrate"],
        "restart_ms": data.get("restart_ms"),
        "state": data["state"],
        "queue": int(queue),
    }


def latency_ms() -> int:
    """The latency timer of the adapter behind the servo's lasting name."""
    port = SERVO.resolve().name
    return int(Path(f"/sys/class/tty/{port}/device/latency_timer").read_text(encoding="ascii"))


def within(what: str, grader: Grader, check: Callable[[Any], Any], limit_s: float) -> float:
    """Seconds until ``check`` is true of the status."""
    began_s = time.monotonic()
    grader.wait(what, check, limit_s)
    return round(time.monotonic() - began_s, 2)


def ready(grader: Grader) -> None:
    """All axes readable, nothing against arming."""
    grader.wait(
        "ready to arm",
        lambda s: (
            all(a["lifecycle"] == "standby" for a in s["axes"].values())
            and all(r["met"] for r in s["readiness"] if r["mandatory"])
        ),
        TIMEOUT_S,
    )


@contextmanager
def turning(grader: Grader, goal_deg: float) -> Iterator[float]:
    """Arm and jog towards the goal, with the key held down while the block lasts; yields an angle under way."""
    grader.arm("manual")
    start = measured(grader.status(), "rotation")
    let_go = threading.Event()

    def hold_down(lease: Lease) -> None:
        with suppress(ClientError):  # the machine has ended it
            while not let_go.wait(RENEW_S):
                lease.renew()

    with grader.client.lease() as lease:
        lease.jog("rotate", goal_deg)
        key = threading.Thread(target=hold_down, args=(lease,), name="key")
        key.start()
        try:
            state = grader.wait("turning", lambda s: abs(measured(s, "rotation") - start) > 1.0, 30.0)
            yield measured(state, "rotation")
        finally:
            let_go.set()
            key.join()


def set_up() -> None:
    """What a person does once: name the adapter, say what is where."""
    Path("/etc/graderd/adapters").write_text(f"servo {SERIAL}\n", encoding="utf-8")
    run("udevadm", "control", "--reload")
    drop_in = Path("/etc/systemd/system/graderd.service.d/hil.conf")
    drop_in.parent.mkdir(parents=True, exist_ok=True)
    drop_in.write_text("[Service]\nWatchdogSec=30\nTimeoutStartSec=300\nTimeoutStopSec=60\n", encoding="utf-8")
    run("systemctl", "daemon-reload", timeout_s=TIMEOUT_S)


def main() -> int:
    """Every step in order; 0 where all were as they should be."""
    report, grader = Report(), Grader()
    with report.step("two SJA1000 controllers are found") as found:
        wait_for("both", lambda: interface_exists(OURS) and interface_exists(THEIRS), 60.0)
        found["driver"] = Path(f"/sys/class/net/{OURS}/device/driver").resolve().name
    with report.step("an FTDI adapter named in /etc/graderd/adapters is plugged in") as found:
        set_up()
        host("plug")
        wait_for(str(SERVO), SERVO.exists, 30.0)
        found |= {"port": SERVO.resolve().name, "latency_ms": wait_for("latency timer", latency_ms, 5.0)}
        assert found["latency_ms"] == 1, found
    with report.step("an adapter that was there first gets its name when the package is configured"):
        SERVO.unlink()
        run("/var/lib/dpkg/info/graderd.postinst", "configure", timeout_s=TIMEOUT_S)
        wait_for(str(SERVO), SERVO.exists, 30.0)
    with report.step("graderd-can@ sets the far controller up") as found:
        run("systemctl", "start", f"graderd-can@{THEIRS}.service", timeout_s=TIMEOUT_S)
        found |= link(THEIRS)
    actuators = ("-I", "-m", "graderd.simulator.actuators", f"--can={THEIRS}")
    run("systemd-run", "--quiet", "--unit=hil-actuators.service", PYTHON, *actuators, timeout_s=TIMEOUT_S)
    with report.step("the service starts, sets its own controller up and finds all four axes") as found:
        grader.configure(SETTINGS)
        run("systemctl", "daemon-reload", timeout_s=TIMEOUT_S)
        run("systemctl", "restart", grader.unit.name, timeout_s=TIMEOUT_S)
        ready(grader)
        found |= link(OURS)
        assert {key: found[key] for key in ("bitrate", "restart_ms", "state", "queue")} == {
            "bitrate": 250_000,
            "restart_ms": 100,
            "state": "ERROR-ACTIVE",
            "queue": 128,
        }, found
    pid = grader.unit.pid
    with report.step("the adapter is pulled while the blade turns: told, disarmed, the service stays") as found:
        with turning(grader, 30.0) as found["at_deg"]:
            host("unplug")
            found["told_s"] = within("told", grader, lambda s: "rotation.unplugged" in faults(s), TOLD_S)
            grader.wait("disarmed", lambda s: s["mode"] == "disarmed", TOLD_S)
        wait_for("the name to go", lambda: not SERVO.exists(), 10.0)
    with report.step("plugged in again: same name, same latency, nothing moves, armed and turned again") as found:
        host("plug")
        found["back_s"] = within(
            "the servo", grader, lambda s: s["axes"]["rotation"]["lifecycle"] == "standby", TIMEOUT_S
        )
        found["latency_ms"] = latency_ms()
        assert found["latency_ms"] == 1, found
        before = measured(grader.status(), "rotation")
        time.sleep(3.0)
        after = measured(grader.status(), "rotation")
        assert abs(after - before) < 0.2, "it stands"
        assert before < 25.0, "it stopped on the way, for the servo's own watchdog ended the motion"
        found["stands_at_deg"] = after
        ready(grader)
        with turning(grader, 0.0):
            pass
        grader.disarm()
        assert grader.unit.pid == pid
    device = Path(f"/sys/class/net/{OURS}/device").resolve()
    with report.step("the CAN controller is removed while armed: told, disarmed, the service stays") as found:
        ready(grader)
        grader.arm("manual")
        (device / "remove").write_text("1", encoding="ascii")
        found["told_s"] = within("told", grader, lambda s: "can.unplugged" in faults(s), TOLD_S)
        grader.wait("disarmed", lambda s: s["mode"] == "disarmed", TOLD_S)
        wait_for("the link's unit to end", lambda: Unit(f"graderd-can@{OURS}.service").state == "inactive", 30.0)
    with report.step("found again by a rescan: set up by udev and systemd alone, armed again") as found:
        Path("/sys/bus/pci/rescan").write_text("1", encoding="ascii")
        wait_for(OURS, lambda: interface_exists(OURS), 30.0)
        ready(grader)
        found |= link(OURS)
        assert (found["bitrate"], found["restart_ms"], found["queue"]) == (250_000, 100, 128), found
        grader.arm("manual")
        grader.disarm()
        assert grader.unit.pid == pid
        assert grader.unit.restarts_n == 0
    sys.stdout.write(f"hil-usb: {brief(grader.status())}\n")
    return 0


def _package() -> str:
    return run("dpkg-query", "-W", "graderd").stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
