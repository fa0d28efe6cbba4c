"""The Makefile installs requirements.lock, whatever an index offers, breaks or lacks, and whatever was there before."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterable
from importlib.metadata import distribution, distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parents[2]
# Each installs, and a first run downloads; they share a pip.
pytestmark = [pytest.mark.timeout(600), pytest.mark.xdist_group("set up")]

NOT_COPIED = shutil.ignore_patterns(".git", ".venv*", ".*_cache", "__pycache__", "*.egg-info", "var", "build", "dist")
NEWEST = "9999"
BUILDERS = ("setuptools", "wheel")
DEBIAN_12_PIP = "23.0.1"
"""It, and each pip since 22.2, resolves a lock with hashes again unless told not to."""


def pins(lock: Path) -> dict[str, str]:
    """Version by name of what the lock names for this Python and machine."""
    found: dict[str, str] = {}
    for line in lock.read_text().splitlines():
        if re.match(r"[a-z0-9]", line):
            pin = Requirement(line.removesuffix("\\"))
            if pin.marker is None or pin.marker.evaluate():
                found[canonicalize_name(pin.name)] = str(pin.specifier).removeprefix("==")
    return found


def installed(project: Path) -> dict[str, str]:
    """Version by name of what the project's environment holds, but for pip, which Python brings, and the project."""
    (packages,) = (project / ".venv/lib").glob("python*/site-packages")
    found = {canonicalize_name(one.name): one.version for one in distributions(path=[str(packages)])}
    return {name: version for name, version in found.items() if name not in ("pip", "graderd")}


def make_wheel(folder: Path, name: str, version: str, metadata: str = "") -> str:
    """Put a wheel with nothing in it into the folder; returns its line of a lock. ``metadata``: none but the least."""
    stem = f"{canonicalize_name(name).replace('-', '_')}-{version}"
    path = folder / f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        least = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        wheel.writestr(f"{stem}.dist-info/METADATA", metadata or least)
        wheel.writestr(f"{stem}.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{stem}.dist-info/RECORD", "")
    return f"{name}=={version} --hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n"


def make_hollow(lock: Path, wheels: Path) -> None:
    """Let the lock name wheels that hold nothing, with names, versions, needs and markers of its own ones: what is in
    them is nothing to whoever installs them, but half a minute of pip's processor time. What builds the project stays.
    """
    named, lines, passing = pins(lock), [], False
    for line in lock.read_text().splitlines():
        if re.match(r"[a-z0-9]", line):
            name = canonicalize_name(Requirement(line.removesuffix("\\")).name)
            passing = name in named and name not in BUILDERS
            if passing:
                metadata = distribution(name).read_text("METADATA")
                assert metadata is not None
                hashed = make_wheel(wheels, name, named[name], metadata).split()[1]
                lines += [line, f"    {hashed}"]
                continue
        if not passing:
            lines.append(line)
    lock.write_text("\n".join(lines) + "\n")
    wanted = [f"{name}=={named[name]}" for name in BUILDERS]
    get = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "download", "--no-deps", "--dest"]
    subprocess.run([*get, wheels, *wanted], check=True)


@pytest.fixture(scope="session")
def debian_12_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python whose environments come with Debian 12's pip, which is unpacked once and copied into each."""
    folder = tmp_path_factory.mktemp("debian-12")
    subprocess.run([sys.executable, "-m", "venv", folder / "first"], check=True)
    subprocess.run(
        [*(folder / "first/bin/python", "-m", "pip", "--disable-pip-version-check", "--quiet"),
         *("install", f"pip=={DEBIAN_12_PIP}")],
        check=True,
    )  # fmt: skip
    (packages,) = (folder / "first/lib").glob("python*/site-packages")
    python = folder / "python3"
    python.write_text(
        f'#!/bin/sh -e\ncase "$*" in "-m venv "*)\n'
        "    for folder; do :; done\n"
        f'    "{sys.executable}" "$@" --without-pip\n'
        f'    exec cp -r "{packages}"/pip* "$folder"/lib/python*/site-packages/ ;;\n'
        "esac\n"
        f'exec "{sys.executable}" "$@"\n'
    )
    python.chmod(0o755)
    return python


class Checkout:
    """A checkout of the project whose environment is made by one of the two tools."""

    def __init__(self, project: Path, tool: str, python: Path) -> None:
        self.project = project
        self.command = [f"UV={Path(sys.executable).with_name('uv') if tool == 'uv' else ''}", f"PYTHON={python}"]

    def make(self, target: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
        """Make the target as a shell of its own would, with these settings of the tools on top."""
        outer = {
            name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "VIRTUAL_ENV")
        }
        outer["PIP_NO_COMPILE"] = "0"  # pip's way to say yes to it; a third of its time
        return subprocess.run(
            ["make", "--no-print-directory", target, *self.command],
            cwd=self.project,
            env=outer | environment,
            capture_output=True,
            text=True,
            check=False,
        )


@pytest.fixture(params=["pip", "uv"])
def tool(request: pytest.FixtureRequest) -> str:
    """Both ways of the Makefile."""
    return str(request.param)


@pytest.mark.slow
def test_set_up_installs_the_lock_whatever_is_newest(tool: str, debian_12_python: Path, tmp_path: Path) -> None:
    project, newer = tmp_path / "project", tmp_path / "newer"
    shutil.copytree(PROJECT, project, ignore=NOT_COPIED)
    newer.mkdir()
    locked = pins(PROJECT / "requirements.lock")
    alone = {}
    if tool == "pip":
        make_hollow(project / "requirements.lock", newer)
        alone = {"PIP_NO_INDEX": "1"}
    for name in locked:
        make_wheel(newer, name, NEWEST)
    finds = {"PIP_FIND_LINKS": f"{os.environ.get('PIP_FIND_LINKS', '')} {newer}".strip(), "UV_FIND_LINKS": str(newer)}
    checkout = Checkout(project, tool, debian_12_python)
    done = checkout.make(".venv/.installed", finds | alone)
    assert done.returncode == 0, done.stderr
    assert installed(project) == locked


class Small(Checkout):
    """A checkout with a lock of its own, and an index that is a folder of wheels."""

    def __init__(self, folder: Path, tool: str, python: Path) -> None:
        super().__init__(folder / "project", tool, python)
        self.wheels = folder / "wheels"
        cache = str(folder / "cache")
        self.offline = {
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": str(self.wheels),
            "PIP_CACHE_DIR": cache,
            "UV_CACHE_DIR": cache,
        }
        self.project.mkdir()
        self.wheels.mkdir()
        shutil.copy(PROJECT / "Makefile", self.project)
        (self.project / "uv.toml").write_text(f'no-index = true\nfind-links = ["{self.wheels}"]\n')

    @property
    def lock(self) -> Path:
        return self.project / "requirements.lock"

    @property
    def stamp(self) -> Path:
        return self.project / ".venv/.locked"

    def name_in_lock(self, names: Iterable[str]) -> None:
        """Offer these packages and write the lock that names them."""
        self.lock.write_text("".join(make_wheel(self.wheels, name, "1.0") for name in names))

    def set_up(self, **environment: str) -> subprocess.CompletedProcess[str]:
        """Install the lock alone."""
        return self.make(".venv/.locked", self.offline | environment)

    def holds(self) -> set[str]:
        """Names of what is installed, but for what Python's own environments begin with."""
        return set(installed(self.project))


@pytest.fixture
def small(tool: str, debian_12_python: Path, tmp_path: Path) -> Small:
    return Small(tmp_path, tool, debian_12_python)


def test_the_environment_is_made_anew_when_it_is_not_what_the_lock_names(small: Small) -> None:
    small.name_in_lock(["stays", "leaves"])
    first = small.set_up()
    assert first.returncode == 0, first.stderr
    assert small.holds() == {"stays", "leaves"}
    assert "up to date" in small.set_up().stdout

    # The lock changed: what left it leaves the environment.
    small.name_in_lock(["stays", "comes"])
    os.utime(small.stamp, (0, 0))  # a file system may write both times alike
    assert small.set_up().returncode == 0
    assert small.holds() == {"stays", "comes"}

    # The set-up was interrupted: no stamp, and a package half there. (A new file: uv's are links into its cache.)
    small.stamp.unlink()
    (half,) = (small.project / ".venv/lib").glob("python*/site-packages/comes-1.0.dist-info/METADATA")
    half.unlink()
    half.write_bytes(b"")
    assert small.set_up().returncode == 0
    assert small.holds() == {"stays", "comes"}

    # The system replaced its Python.
    python = small.project / ".venv/bin/python"
    python.unlink()
    python.symlink_to("/nowhere/python3")
    assert small.set_up().returncode == 0
    assert small.holds() == {"stays", "comes"}


def said(done: subprocess.CompletedProcess[str]) -> str:
    """The last words of a set-up that failed (make's own line comes after them)."""
    assert done.returncode != 0, done.stderr
    *_, line = (line for line in done.stderr.splitlines() if not line.startswith("make"))
    assert line.startswith("set-up of .venv by "), done.stderr
    return line


def test_a_file_that_is_not_the_locks_is_refused(small: Small) -> None:
    small.name_in_lock(["right", "wrong"])
    make_wheel(small.wheels, "wrong", "1.0")
    with zipfile.ZipFile(small.wheels / "wrong-1.0-py3-none-any.whl", "a") as wheel:
        wheel.writestr("evil.py", "")
    assert "not the one that requirements.lock names" in said(small.set_up())
    assert not small.stamp.exists()


def test_an_index_that_is_not_reached_is_told(small: Small) -> None:
    small.name_in_lock(["first"])
    nowhere = "http://127.0.0.1:9/simple"
    unreached = small.set_up(
        PIP_NO_INDEX="0", PIP_FIND_LINKS="", PIP_INDEX_URL=nowhere, PIP_RETRIES="1", PIP_CONFIG_FILE=os.devnull,
        UV_NO_CONFIG="1", UV_DEFAULT_INDEX=nowhere, UV_HTTP_RETRIES="0",
    )  # fmt: skip
    assert "the package index is not reached" in said(unreached)


def test_an_index_without_a_pinned_version_is_told(small: Small) -> None:
    small.name_in_lock(["first"])
    small.lock.write_text(small.lock.read_text().replace("1.0", "2.0"))
    assert "no wheel of a pinned version" in said(small.set_up())
