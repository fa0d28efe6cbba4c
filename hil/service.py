"""The installed service as a user meets it: systemctl, CLI, HTTP on the socket; and the rig in a unit of its own."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tomlkit

from graderd.client import Client, NoDaemonError, RefusedError

SOCKET: Final = Path("/run/graderd/graderd.sock")
CONFIG: Final = Path("/etc/graderd/graderd.toml")
RIG_DIRECTORY: Final = Path("/run/hil-rig")
PYTHON: Final = "/opt/graderd/bin/python"
# SD_MESSAGE_UNIT_RESTART_SCHEDULED of <systemd/sd-messages.h>.
RESTART_SCHEDULED: Final = "5eb03494b6584870a536b337290809b3"
# Each status costs the one processor of a guest several milliseconds, which daemon and rig then do not have.
ASK_EVERY_S: Final = 0.1
# How soon a lost link is told, and how soon the service is ready again once the link is back.
TOLD_S: Final = 1.0
RECOVERED_S: Final = 8.0
Status = dict[str, Any]


class WaitError(AssertionError):
    """Something did not come true in time; the text says what was seen last."""


def measured(status: Status, axis: str) -> float:
    """Where an axis is measured, in its unit; NaN, which is near to nothing and far from nothing, where that is not
    known at this moment."""
    found = status["axes"][axis]["measured"]
    return math.nan if found is None else float(found)


def wait_for(what: str, check: Callable[[], Any], timeout_s: float, every_s: float = 0.05) -> Any:
    """The first true value of ``check``.

    Raises:
        WaitError: none within ``timeout_s``.
    """
    until_s = time.monotonic() + timeout_s
    while True:
        value = check()
        if value:
            return value
        if time.monotonic() > until_s:
            raise WaitError(f"{what}: not within {timeout_s:g} s, last was {value!r}")
        time.sleep(every_s)


def run(*command: str, timeout_s: float = 60.0, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run a command.

    Raises:
        AssertionError: with ``check``, it ended with another status than 0.
    """
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert not check or done.returncode == 0, f"{command}: status {done.returncode}\n{done.stdout}{done.stderr}"
    return done


@dataclass(frozen=True, slots=True)
class Unit:
    """One systemd unit."""

    name: str

    def ctl(self, verb: str, *, check: bool = True) -> subprocess.CompletedProcess[str]:
        """``systemctl VERB UNIT``."""
        return run("systemctl", verb, self.name, check=check)

    def show(self, name: str) -> str:
        """One property."""
        return run("systemctl", "show", "--value", "-p", name, self.name).stdout.strip()

    def numbers(self, *names: str) -> tuple[int, ...]:
        """Several properties that are numbers, at one moment."""
        found = run("systemctl", "show", *(f"--property={name}" for name in names), self.name).stdout
        said = dict(line.split("=", 1) for line in found.splitlines())
        return tuple(int(said[name]) for name in names)

    @property
    def state(self) -> str:
        """ActiveState: active, inactive, failed, activating, deactivating."""
        return self.show("ActiveState")

    @property
    def pid(self) -> int:
        """Main process, 0 where there is none."""
        return int(self.show("MainPID"))

    @property
    def restarts_n(self) -> int:
        """How often systemd has started it again by itself since boot (NRestarts begins anew with a start by hand)."""
        found = run("journalctl", "--boot", "-q", "-o", "cat", f"UNIT={self.name}", f"MESSAGE_ID={RESTART_SCHEDULED}")
        return len(found.stdout.splitlines())

    def journal(self, lines: int = 60) -> str:
        """The newest lines of its log."""
        return run("journalctl", "-u", self.name, "-n", str(lines), "--no-pager", "-o", "short-monotonic").stdout


class Grader:
    """graderd.service with its interface."""

    def __init__(self) -> None:
        self.unit = Unit("graderd.service")
        self.client = Client(SOCKET, name="hil")
        self._settings: Mapping[str, object] = {}

    def status(self) -> Status:
        """Everything at one moment."""
        found: Status = self.client.get("/v1/status")
        return found

    def configure(self, changes: Mapping[str, object]) -> None:
        """Set dotted keys in the installed configuration; comments stay."""
        document = tomlkit.parse(CONFIG.read_text(encoding="utf-8"))
        for dotted, value in changes.items():
            *path, key = dotted.split(".")
            table: Any = document
            for name in path:
                table = table.setdefault(name, tomlkit.table())
            table[key] = value
        CONFIG.write_text(tomlkit.dumps(document), encoding="utf-8")

    def run_with(self, settings: Mapping[str, object]) -> None:
        """Let the service run with these settings, its units ordered after the devices they name; it may already."""
        if settings == self._settings and self.unit.state == "active":
            return
        # Stopped first: systemd reads its units slowly beside a busy service on one processor.
        self.unit.ctl("stop")
        self.configure(settings)
        run("systemctl", "daemon-reload")
        self.start()
        self._settings = dict(settings)

    def start(self, timeout_s: float = 60.0) -> Status:
        """Start (or restart) the service and wait until every axis can be read."""
        run("systemctl", "reset-failed", self.unit.name, check=False)
        run("systemctl", "restart", self.unit.name, timeout_s=timeout_s)
        return self.wait_ready()

    def status_or_none(self) -> Status | None:
        """The status, or None while nobody answers."""
        try:
            return self.status()
        except NoDaemonError:
            return None

    def wait(self, what: str, check: Callable[[Status], Any], timeout_s: float = 20.0) -> Status:
        """The first status for which ``check`` is true.

        Raises:
            WaitError: none in time; tells mode, faults and axes as seen last.
        """
        last: Status | None = None
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            last = self.status_or_none()
            if last is not None and check(last):
                return last
            time.sleep(ASK_EVERY_S)
        raise WaitError(f"{what}: not within {timeout_s:g} s; {brief(last)}\n{self.unit.journal(25)}")

    def wait_ready(self, timeout_s: float = 40.0) -> Status:
        """Wait until all four axes are in standby and nothing mandatory keeps arming away."""

        def ready(status: Status) -> bool:
            axes = status["axes"].values()
            return len(axes) == 4 and all(a["lifecycle"] == "standby" for a in axes) and not mandatory_unmet(status)

        return self.wait("ready to arm", ready, timeout_s)

    def arm(self, mode: str = "manual") -> Status:
        """Arm and wait until it is done, then go to ``mode``. Asked again where one reading was not fresh enough."""

        def accepted() -> bool:
            try:
                self.client.command("arm")
            except RefusedError:
                return False
            return True

        wait_for("arming accepted", accepted, 15.0, 0.5)
        self.wait("armed", lambda s: s["mode"] in ("manual", "auto"), 15.0)
        self.client.command(mode)
        return self.wait(mode, lambda s: s["mode"] == mode, 5.0)

    def jog(self, axis: str, value: float, done: Callable[[Status], Any], timeout_s: float = 30.0) -> None:
        """Jog to ``value``, renewing the lease until ``done``.

        Raises:
            WaitError: it did not get there.
        """
        until_s = time.monotonic() + timeout_s
        with self.client.lease() as lease:
            lease.jog(axis, value)
            while not done(self.status()):
                if time.monotonic() > until_s:
                    raise WaitError(f"jog {axis} {value}: not within {timeout_s:g} s; {brief(self.status())}")
                time.sleep(ASK_EVERY_S)
                try:
                    lease.renew()
                except RefusedError:
                    lease.jog(axis, value)

    def disarm(self) -> None:
        """Back to disarmed from any mode."""
        mode = self.wait("an answer", lambda s: s["mode"], 40.0)["mode"]
        if mode == "stopped":
            self.client.reset()
        elif mode != "disarmed":
            self.client.command("disarm")
        self.wait("disarmed", lambda s: s["mode"] == "disarmed", 10.0)

    def cli(self, *arguments: str, check: bool = True, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
        """``graderd ARGUMENTS…``."""
        return run("graderd", *arguments, check=check, timeout_s=timeout_s)


def mandatory_unmet(status: Status) -> list[str]:
    """Names of the requirements that keep arming away."""
    return [r["name"] for r in status["readiness"] if r["mandatory"] and not r["met"]]


def faults(status: Status) -> set[str]:
    """Names of the active faults."""
    return {fault["name"] for fault in status["faults"]}


def brief(status: Status | None) -> str:
    """What matters of a status, for messages."""
    if status is None:
        return "nobody answers on the socket"
    axes = {name: (a["lifecycle"], a["measured"], a["moving"]) for name, a in status["axes"].items()}
    soil = status["soil"]
    return (
        f"mode {status['mode']} ({status['reason']}), faults {sorted(faults(status))}, axes {axes}, "
        f"soil {soil['zone']} {soil['age_s']} s ({soil['reason']}), unmet {mandatory_unmet(status)}, "
        f"tick {status['tick']}"
    )


def armed_and_then(grader: Grader, action: Callable[[], object], fault: str) -> None:
    """Arm, let ``action`` happen, see the fault told in time and the machine disarmed."""
    grader.arm("manual")
    began_s = time.monotonic()
    action()
    grader.wait(fault, lambda s: fault in faults(s), 3.0)
    told_s = time.monotonic() - began_s
    assert told_s <= TOLD_S, f"{fault} told after {told_s:.2f} s"
    grader.wait("disarmed", lambda s: s["mode"] == "disarmed", 3.0)


def recovered(grader: Grader, pid: int) -> None:
    """Everything readable again, by the same process, and it can be armed."""
    grader.wait("actuators back", lambda s: not any(n.startswith("can.") for n in faults(s)), RECOVERED_S)
    grader.wait_ready(RECOVERED_S)
    assert grader.unit.pid == pid
    grader.arm("manual")
    grader.disarm()


class Rig:
    """The simulated grader in a transient unit of its own, as the daemon's user; it plays the hardware."""

    def __init__(self, can: str, seed: int = 0) -> None:
        self.unit = Unit("hil-rig.service")
        self._can = can
        self._seed = seed

    def start(self) -> None:
        """Start it and wait until its wires are there."""
        run("systemctl", "reset-failed", self.unit.name, check=False)
        (RIG_DIRECTORY / "rig.json").unlink(missing_ok=True)
        run(
            "systemd-run",
            "--quiet",
            f"--unit={self.unit.name}",
            "--uid=graderd",
            "--gid=graderd",
            f"--property=RuntimeDirectory={RIG_DIRECTORY.name}",
            "--property=RuntimeDirectoryPreserve=yes",
            # It plays hardware, which does not wait for the processor; its pictures may.
            "--property=CPUSchedulingPolicy=rr",
            "--property=CPUSchedulingPriority=40",
            "--property=CPUSchedulingResetOnFork=yes",
            "--setenv=MALLOC_TRIM_THRESHOLD_=1000000000",
            "--setenv=MALLOC_MMAP_THRESHOLD_=1000000000",
            # At shutdown the hardware is still there when the service ends.
            "--property=Before=graderd.service",
            *(PYTHON, "-I", "-m", "graderd.simulator", f"--dir={RIG_DIRECTORY}", f"--can=socketcan:{self._can}"),
            f"--seed={self._seed}",
        )
        wait_for("rig.json", (RIG_DIRECTORY / "rig.json").exists, 40.0)

    def stop(self) -> None:
        """End it."""
        self.unit.ctl("stop", check=False)

    def ask(self, command: str, **arguments: object) -> dict[str, Any]:
        """One request on its control socket.

        Raises:
            AssertionError: it refused.
        """
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(20.0)
            connection.connect(str(RIG_DIRECTORY / "control.sock"))
            connection.sendall(json.dumps({"cmd": command, **arguments}).encode() + b"\n")
            with connection.makefile("rb") as lines:
                answer: dict[str, Any] = json.loads(lines.readline())
        assert "error" not in answer, answer
        return answer

    def configuration(self) -> dict[str, object]:
        """What the daemon's configuration says to meet this rig."""
        return {
            "rotation.port": str(RIG_DIRECTORY / "servo"),
            "can.interface": "socketcan",
            "can.channel": self._can,
            "camera.source": "rig",
            "camera.path": str(RIG_DIRECTORY / "camera.sock"),
        }


def new_pass(grader: Grader, rig: Rig, zone: str, seed: int) -> None:
    """As an operator begins a pass: blade square in manual, fresh soil in front of it, then automatic."""
    if grader.status()["mode"] == "disarmed":
        grader.arm("manual")
    else:
        grader.client.command("manual")
    rig.ask("scene", zone="none")
    rig.ask("reset_vehicle")
    grader.wait("pictures", lambda s: s["soil"]["age_s"] is not None)
    grader.jog("rotate", 0.0, lambda s: abs(measured(s, "rotation")) <= 0.5)
    rig.ask("scene", zone=zone, seed=seed)
    grader.client.command("auto")


def turn(grader: Grader, rig: Rig) -> None:
    """Evenly spread soil, which sends the blade to +45 deg; returns while it turns."""
    new_pass(grader, rig, "even", 6)

    def turning(status: Status) -> bool:
        rotation = status["axes"]["rotation"]
        # Well away from 0, where the way there may not quite have ended.
        return (rotation["velocity_per_s"] or 0.0) > 2.0 and measured(status, "rotation") > 5.0

    grader.wait("turning", turning, 40.0)
