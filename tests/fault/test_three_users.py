"""Daemon, operator and stranger on one machine: each does what is theirs, and the rest is refused in one line.

It takes root (users, a mount namespace). `.ci/run` runs as root and insists on it (GRADERD_THREE_USERS=1); elsewhere it
is said that it was left out. The rules it rests on are tested everywhere: tests/unit/test_config_rewrite.py,
test_guard_config.py, test_cli_rights.py.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from graderd.client import Client, ClientError
from graderd.config.rewrite import merged
from graderd.core.status import Status
from tests.machine import PICTURES
from tests.unit.test_cli_offline import leaf_commands
from tests.users import CONFIG, DAEMON, OPERATOR, ROOT, STATE, STRANGER, Machine, environment, three_users

# One machine for all of them.
pytestmark = [pytest.mark.whole_machine, pytest.mark.xdist_group("a line"), pytest.mark.timeout(600)]
READY_S = 120.0
POSE = "0.9,0.05,0.6,30,1,-1"
USERS = (DAEMON, OPERATOR, STRANGER)
GRADERD = (sys.executable, "-P", "-m", "graderd")


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    try:
        with three_users() as made:
            yield made
    except (PermissionError, FileNotFoundError) as error:
        if os.environ.get("GRADERD_THREE_USERS"):
            raise
        pytest.skip(f"NOT TESTED HERE: three users on one machine takes root and the right to mount ({error})")


@pytest.fixture(scope="module")
def installed(machine: Machine) -> str:
    """A copy of the configuration as it was installed, but for its pictures, which nobody here measures."""
    kept = "/run/installed.toml"
    machine.must(ROOT, "cp", "-p", CONFIG, kept)
    # Depth stays as large as it comes: a calibration is made from it.
    camera = {key: value for key, value in tomllib.loads(PICTURES)["camera"].items() if not key.startswith("depth_")}
    few = merged(machine.must(ROOT, "cat", CONFIG), {"camera": camera})
    assert machine.python(ROOT, f"open({kept!r}, 'w').write({few!r})").returncode == 0
    return kept


@pytest.fixture(autouse=True)
def configuration(machine: Machine, installed: str) -> None:
    """As it was installed, before each test."""
    machine.must(ROOT, "cp", "-p", "--remove-destination", installed, CONFIG)


class Service:
    """The daemon as the unit starts it, on the simulated grader."""

    def __init__(self, machine: Machine, *grader: str, socket: str = "/run/graderd/graderd.sock") -> None:
        self.machine = machine
        self.client = Client(Path(f"/proc/{machine.holder_pid}/root{socket}"), name="test")
        words = [*GRADERD, "run", "--config", str(CONFIG), *(grader or ["--sim"])]
        command = machine.command(DAEMON, *words)
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115  (until end)
        self.process = subprocess.Popen(command, env=environment(DAEMON), stderr=self.log)

    def until(self, reached: Callable[[Status], bool]) -> None:
        """Wait for a status, which is looked at from outside: a command line for each look would keep the machine busy
        with nothing else."""
        give_up_s = time.monotonic() + READY_S
        while True:
            assert self.process.poll() is None, self._said()
            with suppress(ClientError):
                if reached(self.client.status()):
                    return
            assert time.monotonic() < give_up_s, self._said()
            time.sleep(0.05)

    def status(self, user: str = OPERATOR) -> dict[str, Any]:
        """What ``user`` is told by the command line."""
        told: dict[str, Any] = json.loads(self.machine.graderd(user, "status", "--json").stdout)
        return told

    def _said(self) -> str:
        self.log.seek(0)
        return self.log.read()

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        self.process.send_signal(number)
        self.process.wait(30)
        self.log.close()


@pytest.fixture(scope="class")
def service(machine: Machine) -> Iterator[Service]:
    """One for all who leave it as it was: disarmed."""
    running = Service(machine)
    try:
        running.until(lambda _: True)
        yield running
    finally:
        running.end()


def in_one_line(done: subprocess.CompletedProcess[str]) -> bool:
    """Whether what was said is one line for people."""
    said = done.stderr
    return "Traceback" not in said and said.count("\n") == 1 and said.startswith(("graderd: ", "rig: "))


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """What was said, if it is one line for people."""
    assert in_one_line(done), done.stderr
    return done.stderr


def lives(machine: Machine) -> None:
    """The daemon's user still reads the configuration, and it still is root's."""
    assert machine.rights(CONFIG) == "root:graderd 640"
    assert machine.graderd(DAEMON, "config", "check", CONFIG).returncode == 0


def test_installed(machine: Machine) -> None:
    assert machine.rights(CONFIG.parent) == "root:graderd 750"
    assert machine.rights(CONFIG) == "root:graderd 640"
    assert machine.rights(STATE) == "graderd:graderd 750"
    for user in USERS:
        assert machine.run(user, "touch", CONFIG.parent / "planted").returncode == 1, user
        assert machine.run(user, "sh", "-c", f"echo >>{CONFIG}").returncode != 0, user


@pytest.mark.parametrize(("user", "status"), [(DAEMON, 0), (OPERATOR, 0), (STRANGER, 2)])
def test_config(machine: Machine, user: str, status: int) -> None:
    for words in (["config", "check"], ["config", "check", CONFIG], ["config", "show"]):
        done = machine.graderd(user, *words)
        assert done.returncode == status, done
        if status:
            assert "Permission denied" in one_line(done)


class TestBesideARunningDaemon:
    def test_run(self, machine: Machine, service: Service) -> None:
        """A second daemon, by whoever: refused, and the first goes on."""
        for user, status, says in (
            (STRANGER, 2, "Permission denied"),
            (OPERATOR, 1, ""),
            (DAEMON, 1, "another daemon"),
        ):
            done = machine.graderd(user, "run", "--sim", "--config", CONFIG)
            assert done.returncode == status, done
            assert "Traceback" not in done.stderr
            assert says in done.stderr
        assert service.status()["mode"] == "disarmed"

    def test_a_stranger_gets_one_line_from_every_command(self, machine: Machine, service: Service) -> None:
        more: dict[str, list[str | Path]] = {
            "jog": ["rotate", "+5deg"],
            "config check": [CONFIG],
            "config show": [CONFIG],
            "profile verify": ["rotation"],
            "classify": [CONFIG],
            "calibrate camera": ["--yes"],
            "rotation reboot": ["--yes"],
            "rotation step": ["--yes"],
            "rotation confirm-turns": ["--yes"],
            "rig": ["--dir", STATE],
        }
        # Need no daemon; a machine of its own; tested by themselves.
        own = {"explain", "config schema", "demo", "guard", "run"}
        wrong = []
        for words in leaf_commands():
            if " ".join(words) in own or words[0] == "study":  # which computes for hours where its engine is installed
                continue
            done = machine.graderd(STRANGER, *words, *more.get(" ".join(words), []))
            if done.returncode not in (1, 2, 3) or not in_one_line(done):
                wrong.append(done)
        assert wrong == []
        assert service.status()["mode"] == "disarmed"

    def test_calibrating_live(self, machine: Machine, service: Service) -> None:
        """Whoever cannot write the result moves nothing; who can gets the pictures, and they do not stay."""
        service.until(lambda s: all(need.met for need in s.readiness) and s.soil.frames_per_s > 0)
        live = ["calibrate", "camera", "--yes", "--angles-deg", "-15,0,15"]
        stands_deg = service.status()["axes"]["rotation"]["measured"]
        for user in (OPERATOR, STRANGER):
            assert machine.graderd(user, *live).returncode == 1
        state = service.status()
        assert state["mode"] == "disarmed"
        assert state["axes"]["rotation"]["measured"] == pytest.approx(stands_deg, abs=0.5)
        own = Path("/home/oper/own.toml")
        machine.must(OPERATOR, "touch", own)
        for user, words in ((OPERATOR, ["--config", own]), (ROOT, ["--save", "/run/picture.jpg"])):
            done = machine.graderd(user, *live, *words)
            assert "turn to" in done.stdout
            assert done.returncode == 0, done
            assert machine.must(ROOT, "find", STATE, "-name", "calibration-*") == ""
        assert "calibrated_at" in machine.must(OPERATOR, "cat", own)
        lives(machine)

    def test_an_operator_commands_the_machine(self, machine: Machine, service: Service) -> None:
        service.until(lambda s: all(need.met for need in s.readiness if need.mandatory))
        orders = (["preset"], ["arm"], ["manual"], ["jog", "rotate", "+2deg"], ["stop"], ["reset"])
        for _ in range(3):  # a machine busy with other things may disarm itself between two commands
            refused = [d for words in orders if (d := machine.graderd(OPERATOR, *words)).returncode]
            if not refused:
                break
        assert refused == []
        assert "permission" not in machine.graderd(OPERATOR, "preset", "nowhere").stderr.lower()


def test_calibrating_by_hand(machine: Machine) -> None:
    """An operator is refused, and neither locks the daemon out; root keeps whose the file is, whatever its umask."""
    for user in USERS:
        done = machine.graderd(user, "calibrate", "camera", "--pose", POSE, "--yes")
        assert done.returncode == 1, done
        assert "sudo" in one_line(done) or user == STRANGER
        lives(machine)
    done = machine.run(
        ROOT, "sh", "-c", f"umask 077; exec {sys.executable} -m graderd calibrate camera --pose {POSE} --yes"
    )
    assert done.returncode == 0, done
    lives(machine)
    assert "position_x_m = 0.9" in machine.must(DAEMON, "cat", CONFIG)


def test_the_guard_acts_on_what_the_daemon_last_ran_with(machine: Machine) -> None:
    """After a daemon that was killed, whatever became of its configuration: the wires are in its last run's words."""
    folder = "/run/graderd/rig"
    rig = subprocess.Popen(
        machine.command(DAEMON, sys.executable, "-P", "-m", "graderd", "rig", "--dir", folder),
        env=environment(DAEMON),
        stdout=subprocess.DEVNULL,
    )
    try:
        machine.must(DAEMON, "sh", "-c", f"until [ -e {folder}/rig.json ]; do sleep 0.1; done")
        service = Service(machine, "--rig-dir", folder)
        try:
            service.until(lambda s: s.axes["rotation"].measured is not None)
        finally:
            service.end(signal.SIGKILL)
        for spoil in (f"chmod 600 {CONFIG}", f"chown oper:oper {CONFIG}", f"echo [[[ >{CONFIG}", f"rm {CONFIG}"):
            machine.must(ROOT, "sh", "-c", spoil)
            done = machine.graderd(DAEMON, "guard", "--config", CONFIG, "--no-such-option")
            assert "12 motion-disable messages sent" in done.stderr
            assert '{"failed": []}' in done.stderr
            assert done.returncode == 0
            assert "Traceback" not in done.stderr
    finally:
        rig.terminate()
        rig.wait(30)


def test_the_guard_of_anybody_else_says_what_it_cannot(machine: Machine) -> None:
    done = machine.graderd(STRANGER, "guard")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "Permission denied" in done.stderr


MIGRATE = """
import sys
from pathlib import Path
from graderd.config.migrate import STEPS, migrate_file, rename
print(migrate_file(Path(sys.argv[1]), {0: lambda document: rename(document, "servo", "rotation"), **STEPS}))
"""


def test_an_upgrade_writes_through_no_name_that_was_planted(machine: Machine) -> None:
    """In a directory the group may write to, as older versions made it."""
    machine.must(ROOT, "chmod", "770", CONFIG.parent)
    victim = "/run/victim"
    machine.must(ROOT, "sh", "-c", f"echo precious >{victim}; rm {CONFIG}")
    machine.must(ROOT, "sh", "-c", f"echo 'version = 0\n[servo]\nzero_deg = 1.5' >{CONFIG}")
    machine.must(ROOT, "chown", "root:graderd", CONFIG)
    machine.must(ROOT, "chmod", "640", CONFIG)
    names = (f".{CONFIG.name}.new", "graderd.toml.new")
    try:
        for name in names:
            machine.must(OPERATOR, "ln", "-s", victim, CONFIG.parent / name)
        done = machine.python(ROOT, MIGRATE, CONFIG)
        assert done.returncode == 0, done
        assert machine.must(ROOT, "cat", victim) == "precious"
        assert not machine.must(ROOT, "find", CONFIG, "-type", "l")
        lives(machine)
        backups = machine.must(ROOT, "find", CONFIG.parent, "-name", "*.bak", "-newer", victim).split()
        assert [machine.rights(Path(name)) for name in backups] == ["root:graderd 640"]
        machine.must(ROOT, "mv", CONFIG, "/run/real.toml")
        machine.must(OPERATOR, "ln", "-s", "/run/real.toml", CONFIG)
        done = machine.python(ROOT, MIGRATE, CONFIG)
        assert "not followed" in done.stderr
        machine.must(ROOT, "rm", CONFIG)
    finally:
        machine.must(ROOT, "rm", "-f", *(CONFIG.parent / name for name in names))
        machine.must(ROOT, "chmod", "750", CONFIG.parent)


@pytest.mark.parametrize("user", USERS)
def test_an_upgrade_by_anybody_else_is_refused_in_a_line(machine: Machine, user: str) -> None:
    done = machine.run(user, sys.executable, "-P", "-m", "graderd.config.migrate", CONFIG)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "sudo" in done.stderr
    lives(machine)


def test_a_full_disk_keeps_the_configuration(machine: Machine) -> None:
    machine.must(ROOT, "cp", "-p", CONFIG, "/run/keep")
    machine.must(ROOT, "mount", "-t", "tmpfs", "-o", "size=64k,mode=750", "tmpfs", CONFIG.parent)
    try:
        machine.must(ROOT, "sh", "-c", f"chgrp graderd {CONFIG.parent}; cp -p /run/keep {CONFIG}")
        machine.run(ROOT, "sh", "-c", f"cat /dev/zero >{CONFIG.parent}/rest")
        done = machine.graderd(ROOT, "calibrate", "camera", "--pose", POSE, "--yes")
        assert done.returncode == 1
        assert "No space left on device); it is as it was. Make room" in one_line(done)
        machine.must(ROOT, "cmp", "/run/keep", CONFIG)
        lives(machine)
        assert machine.must(ROOT, "ls", "-A", CONFIG.parent).split() == ["graderd.toml", "rest"]
    finally:
        machine.must(ROOT, "umount", CONFIG.parent)


def test_a_socket_elsewhere_is_found(machine: Machine) -> None:
    """By root, as the package asks before an upgrade, and by an operator; both without being told where."""
    elsewhere = "/run/graderd/elsewhere.sock"
    machine.must(ROOT, "sh", "-c", f"printf '[api]\\nsocket = \"{elsewhere}\"\\n' >{CONFIG}")
    service = Service(machine, socket=elsewhere)
    try:
        service.until(lambda _: True)
        assert service.status(ROOT)["mode"] == "disarmed"
        assert machine.graderd(OPERATOR, "status").returncode == 0
        assert machine.graderd(STRANGER, "status").returncode == 1
    finally:
        service.end()
