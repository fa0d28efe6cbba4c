"""An installed graderd beside somebody else's ``drivers``, ``simulator`` and ``firmware_profiles``.

The proof of docs/adr/0003-import-names.md: the project's own wheel is installed with pip into an environment of its
own, next to a distribution that provides these names, and started in a folder that has them once more. Whoever imports
one of them fails loudly.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import subprocess
import sys
import sysconfig
import venv
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from graderd.core.status import Status

PROJECT = Path(__file__).resolve().parents[2]
GENERIC = ("drivers", "simulator", "firmware_profiles")
NOT_OURS = "raise RuntimeError(\"somebody else's package was imported as graderd's\")\n"
FOREIGN = """\
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "somebody-elses"
version = "1.0"
[tool.setuptools]
packages = {packages}
"""
BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"
READY_S = 90.0

# One environment for all of them; none has a short deadline.
pytestmark = [pytest.mark.xdist_group("installed"), pytest.mark.timeout(300)]


def lay_generic(folder: Path) -> None:
    """The three packages, which raise when they are imported."""
    for name in GENERIC:
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(NOT_OURS, encoding="utf-8")


def our_source(target: Path) -> None:
    """The tree as git knows it: a build in place picks up leftovers."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=PROJECT,
        capture_output=True,
        check=True,
    ).stdout
    for name in filter(None, listed.decode().split("\0")):
        source = PROJECT / name
        if source.is_file() or source.is_symlink():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target / name, follow_symlinks=False)


def wheel_of(source: Path, out: Path) -> Path:
    """Build a wheel with the setuptools of this environment."""
    built = subprocess.run(
        [sys.executable, "-c", BUILD, str(out)], cwd=source, capture_output=True, check=True, text=True
    )
    return out / built.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of executables of an environment with both wheels; the dependencies are this environment's."""
    folder = tmp_path_factory.mktemp("installed")
    our_source(folder / "graderd")
    lay_generic(folder / "foreign")
    (folder / "foreign/pyproject.toml").write_text(FOREIGN.format(packages=list(GENERIC)), encoding="utf-8")
    wheels = [wheel_of(folder / name, folder) for name in ("graderd", "foreign")]
    venv.create(folder / "env", with_pip=True)
    python = folder / "env/bin/python"
    subprocess.run(
        [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", *wheels],
        check=True,
    )
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder / "env")}))
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return folder / "env/bin"


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A current directory with the three folders."""
    lay_generic(tmp_path / "here")
    return tmp_path / "here"


def test_the_scene_is_what_it_claims_to_be(installed: Path, here: Path) -> None:
    """graderd comes from the wheel, and both strangers are in the way of whoever would take a generic name."""
    asked = "import graderd, graderd.drivers, sys; print(graderd.__file__)"
    told = subprocess.run([installed / "python", "-c", asked], cwd=here, capture_output=True, text=True, check=True)
    assert str(installed.parent) in told.stdout
    for isolated in ([], ["-P"]):
        for name in GENERIC:
            stranger = subprocess.run(
                [installed / "python", *isolated, "-c", f"import {name}"], cwd=here, capture_output=True, text=True
            )
            assert "somebody else's package" in stranger.stderr


async def test_run_sim_comes_up_and_answers(installed: Path, here: Path, tmp_path: Path) -> None:
    socket = tmp_path / "graderd.sock"
    (tmp_path / "graderd.toml").write_text(f'[api]\nsocket = "{socket}"\n', encoding="utf-8")
    daemon = await asyncio.create_subprocess_exec(
        *(installed / "graderd", "run", "--sim", "--config", tmp_path / "graderd.toml"),
        cwd=here,
        stderr=asyncio.subprocess.PIPE,
    )
    saying = asyncio.create_task(daemon.communicate())
    try:
        transport = httpx.AsyncHTTPTransport(uds=str(socket))
        async with (
            httpx.AsyncClient(transport=transport, base_url="http://graderd") as client,
            asyncio.timeout(READY_S),
        ):
            while True:
                assert daemon.returncode is None
                with suppress(httpx.TransportError):
                    status = Status.model_validate((await client.get("/v1/status")).json())
                    # All axes, and pictures: rig, its camera process and the perception child have come up too.
                    if all(need.met for need in status.readiness if need.mandatory) and status.soil.frames_per_s > 0:
                        break
                await asyncio.sleep(0.1)
        asked = await asyncio.create_subprocess_exec(
            *(installed / "graderd", "--socket", socket, "status", "--json"), cwd=here, stdout=asyncio.subprocess.PIPE
        )
        told, _ = await asked.communicate()
        assert Status.model_validate_json(told).mode == "disarmed"
    finally:
        if daemon.returncode is None:
            daemon.send_signal(signal.SIGTERM)
        _, log = await saying
    assert await daemon.wait() == 0, log.decode()
    assert b"Traceback" not in log


async def test_the_demonstrations_children_come_up(installed: Path, here: Path) -> None:
    demo = await asyncio.create_subprocess_exec(
        *(installed / "graderd", "demo", "--json"), cwd=here, stdout=asyncio.subprocess.PIPE
    )
    assert demo.stdout is not None
    events: list[str] = []
    try:
        async with asyncio.timeout(READY_S):
            while "armed" not in events:
                line = await demo.stdout.readline()
                assert line, f"it ended after {events}"
                events.append(json.loads(line)["event"])
    finally:
        if demo.returncode is None:
            demo.send_signal(signal.SIGINT)
        await demo.communicate()
    assert await demo.wait() == 130
