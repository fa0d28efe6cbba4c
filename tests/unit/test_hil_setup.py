"""``hil/setup``: what it says and does where packages, mirror or kernel are not as they were."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

SETUP = Path(__file__).parents[2] / "hil" / "setup"
KERNEL = "6.1.99"


class Machine:
    """A machine's package tools, played by scripts that note how they were called."""

    def __init__(self, folder: Path) -> None:
        self._bin = folder / "bin"
        self._bin.mkdir()
        self._calls = folder / "calls"
        self._installed = folder / "installed"
        self.cache = folder / "cache"
        self.modules = folder / "modules"
        (self.modules / KERNEL).mkdir(parents=True)
        self.tool("id", "echo 0")
        self.tool("linux.uml", f"echo {KERNEL}")
        self.tool("dpkg", "true")
        self.tool("dpkg-query", f'[ -e {self._installed} ] && printf "installed 1.0" || exit 1')
        self.tool("apt-cache", 'printf "$2:\\n  Installed: (none)\\n  Candidate: 1.0\\n"')
        self.tool("apt-get", f'case " $* " in *" --download-only "*) ;; *" install "*) touch {self._installed} ;; esac')

    def tool(self, name: str, script: str) -> None:
        path = self._bin / name
        path.write_text(f'#!/bin/sh\necho "{name} $*" >>{self._calls}\n{script}\n', encoding="utf-8")
        path.chmod(0o755)

    def calls(self, name: str) -> list[str]:
        lines = self._calls.read_text(encoding="utf-8").splitlines() if self._calls.exists() else []
        return [line for line in lines if line.split()[0] == name]

    def set_up(self) -> subprocess.CompletedProcess[str]:
        environment = {
            "PATH": f"{self._bin}:/usr/bin:/bin",
            "GRADERD_HIL_CACHE": str(self.cache),
            "GRADERD_UML_MODULES": str(self.modules),
        }
        return subprocess.run([SETUP], env=environment, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def error_of(done: subprocess.CompletedProcess[str]) -> str:
    """The last line of a failure, which tells all of it."""
    assert done.returncode == 1, done.stderr
    return done.stderr.splitlines()[-1]


def test_what_is_missing_is_fetched_into_the_cache_then_installed_and_nothing_the_second_time(machine: Machine) -> None:
    first = machine.set_up()
    assert first.returncode == 0, first.stderr
    fetched, installed = (call for call in machine.calls("apt-get") if " install " in call)
    assert "--download-only" in fetched
    assert "--download-only" not in installed
    for call in (fetched, installed):
        assert f"Dir::Cache::Archives={machine.cache}/debian" in call
        assert "Keep-Downloaded-Packages=true" in call
    done_n = len(machine.calls("apt-get"))
    assert machine.set_up().returncode == 0
    assert len(machine.calls("apt-get")) == done_n


def test_a_mirror_that_fails_is_named_with_what_to_do_and_what_has_come_stays(machine: Machine) -> None:
    machine.tool("apt-get", 'case "$*" in *download-only*) echo "E: Failed to fetch x.deb" >&2; exit 100 ;; esac')
    (machine.cache / "debian").mkdir(parents=True)
    (machine.cache / "debian" / "come.deb").touch()
    said = error_of(machine.set_up())
    assert said.startswith("hil: download: E: Failed to fetch x.deb")
    assert f"run this again: what has come stays in {machine.cache}" in said
    assert (machine.cache / "debian" / "come.deb").exists()


def test_package_lists_that_cannot_be_renewed_do_not_hinder_what_the_cache_has(machine: Machine) -> None:
    install = next(iter(machine._bin.glob("apt-get"))).read_text(encoding="utf-8")
    machine.tool("apt-get", 'case "$*" in *update*) exit 100 ;; esac\n' + install.split("\n", 2)[2])
    done = machine.set_up()
    assert done.returncode == 0, done.stderr
    assert "going on with the package lists that are there" in done.stderr


def test_an_installation_that_was_interrupted_is_taken_up(machine: Machine) -> None:
    machine.tool("dpkg", '[ "$1" != --audit ] || echo "half-configured: user-mode-linux"')
    assert machine.set_up().returncode == 0
    assert "dpkg --configure -a" in machine.calls("dpkg")
    assert any("--fix-broken" in call for call in machine.calls("apt-get"))


def test_a_package_the_release_no_longer_has_is_named(machine: Machine) -> None:
    machine.tool("apt-cache", 'printf "$2:\\n  Candidate: (none)\\n"')
    said = error_of(machine.set_up())
    assert said.startswith("hil: user-mode-linux: ")
    assert "has no such package" in said
    assert "apt-cache policy user-mode-linux" in said
    assert not any(" install " in call for call in machine.calls("apt-get"))


def test_a_kernel_without_its_modules_is_told_with_both_releases(machine: Machine) -> None:
    machine.tool("linux.uml", "echo 6.2.0")
    said = error_of(machine.set_up())
    assert "its kernel is 6.2.0, its modules are 6.1.99" in said
    assert "apt-get install --reinstall user-mode-linux" in said


def test_a_kernel_that_moved_on_is_said_and_no_failure(machine: Machine) -> None:
    done = machine.set_up()
    assert done.returncode == 0
    assert "user-mode-linux is 1.0 here; the suite was last seen with " in done.stderr


def test_somebody_who_may_not_install_learns_what_is_missing(machine: Machine) -> None:
    machine.tool("id", "echo 1000")
    said = error_of(machine.set_up())
    assert "these Debian packages are missing: user-mode-linux" in said
    assert "sudo hil/setup" in said
    assert not machine.calls("apt-get")
