"""Run a part of the hardware-in-the-loop suite here and now: ``python3 -m hil.suite PART PACKAGE.deb [UNPACKED]``.

Needs root, systemd as the first process and a kernel that makes a vcan: a guest, or a machine of your own that has no
graderd installed. Installs the package, runs the tests, and (outside a guest) takes the package away again. UNPACKED: a
folder of the host with what is in the package, which a guest then need not write.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).resolve().parent.parent
TESTS: Final = PROJECT / "tests" / "hil"
# pyproject keeps tests/hil out of `make test`; this takes its addopts' place.
OPTIONS: Final = (
    "-o",
    "addopts=",
    "-ra",
    "--strict-markers",
    "--strict-config",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:xdist",
)
# "work" and "endurance" take about as long as each other and make up the whole.
PARTS: Final = {
    "all": "not shutdown",
    "work": "not endurance",
    "endurance": "endurance",
    "soak": "soak",
}
NOTHING_SELECTED: Final = 5


def install(package: Path, unpacked: Path | None) -> None:
    """``dpkg -i``: what apt does once the dependencies are there.

    Raises:
        SystemExit: it failed.
    """
    began_s = time.monotonic()
    bulk = ["--path-exclude=/opt/graderd/*"] if unpacked else []
    if unpacked:
        mount_unpacked(unpacked / "opt")
    done = subprocess.run(
        ["dpkg", "-i", "--force-unsafe-io", "--no-triggers", *bulk, str(package)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"hil: {package.name} does not install:\n{done.stdout}{done.stderr}")
    sys.stdout.write(f"hil: {package.name} installed in {time.monotonic() - began_s:.1f} s\n")
    sys.stdout.flush()


def mount_unpacked(opt: Path) -> None:
    """Let the guest see the package's /opt as ``dpkg-deb -x`` laid it out on the host, writable in memory.

    Five thousand small files: written one by one in the guest they take a quarter of a minute.
    """
    layers = Path("/run/hil-opt")
    for name in ("lower", "upper", "work"):
        (layers / name).mkdir(parents=True)
    options = f"lowerdir={layers}/lower,upperdir={layers}/upper,workdir={layers}/work"
    subprocess.run(["mount", "-t", "hostfs", "-o", f"ro,{opt}", "none", f"{layers}/lower"], check=True)
    subprocess.run(["mount", "-t", "overlay", "-o", options, "overlay", "/opt"], check=True)


def pytest(part: str) -> int:
    """Run the tests of one part with this project's environment."""
    chosen = os.environ.get("PYTEST_ARGS", "").split()
    command = [str(PROJECT / ".venv/bin/python"), "-m", "pytest", *OPTIONS, "-m", PARTS[part], str(TESTS), *chosen]
    status = subprocess.run(command, cwd=PROJECT, check=False).returncode
    # Tests somebody asked for by name may all be in the other part.
    return 0 if chosen and status == NOTHING_SELECTED else status


def main() -> int:
    """Install, test, clean up; the first status that is not 0."""
    part, package = sys.argv[1], Path(sys.argv[2])
    unpacked = Path(sys.argv[3]) if len(sys.argv) > 3 else None
    if os.geteuid() != 0 or not Path("/run/systemd/system").exists():
        raise SystemExit("hil.suite: needs root and systemd; use `make hil`, which starts a guest where they are not")
    install(package, unpacked)
    try:
        return pytest(part)
    finally:
        if not os.environ.get("HIL_GUEST"):
            subprocess.run(["systemctl", "stop", "graderd.service", "hil-rig.service"], check=False)
            subprocess.run(["dpkg", "--purge", "graderd"], check=False)


if __name__ == "__main__":
    sys.exit(main())
