"""Run a part of the hardware-in-the-loop suite here and now: ``python3 -m hil.suite PART PACKAGE.deb``.

Needs root, systemd as the first process and a kernel that makes a vcan: a guest, or a machine of your own that has no
graderd installed. Installs the package, runs the tests, and (outside a guest) takes the package away again.
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
PARTS: Final = {
    "all": ("-m", "not soak and not shutdown"),
    "all-and-shutdown": ("-m", "not soak"),
    "soak": ("-m", "soak"),
}


def install(package: Path) -> None:
    """``dpkg -i``: what apt does once the dependencies are there.

    Raises:
        SystemExit: it failed.
    """
    if os.environ.get("HIL_GUEST"):
        # Six thousand small files: kept out of the overlay they take half the time.
        subprocess.run(["mount", "-t", "tmpfs", "tmpfs", "/opt"], check=True)
    began_s = time.monotonic()
    done = subprocess.run(
        ["dpkg", "-i", "--force-unsafe-io", "--no-triggers", *other_pythons(), str(package)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"hil: {package.name} does not install:\n{done.stdout}{done.stderr}")
    sys.stdout.write(f"hil: {package.name} installed in {time.monotonic() - began_s:.1f} s\n")
    sys.stdout.flush()


def other_pythons() -> list[str]:
    """In a guest the parts for Pythons it does not have are left out, for every file takes its time there."""
    if not os.environ.get("HIL_GUEST"):
        return []
    version = "import sys; print('python%d.%d' % sys.version_info[:2])"
    own = subprocess.run(["/usr/bin/python3", "-c", version], capture_output=True, text=True, check=True).stdout.strip()
    return ["--path-exclude=/opt/graderd/lib/python3.*/*", f"--path-include=/opt/graderd/lib/{own}/*"]


def pytest(*arguments: str) -> int:
    """Run pytest with this project's environment."""
    command = [str(PROJECT / ".venv/bin/python"), "-m", "pytest", *OPTIONS, *arguments, str(TESTS)]
    command += os.environ.get("PYTEST_ARGS", "").split()
    return subprocess.run(command, cwd=PROJECT, check=False).returncode


def main() -> int:
    """Install, test, clean up; the first status that is not 0."""
    part, package = sys.argv[1], Path(sys.argv[2])
    if os.geteuid() != 0 or not Path("/run/systemd/system").exists():
        raise SystemExit("hil.suite: needs root and systemd; use `make hil`, which starts a guest where they are not")
    install(package)
    try:
        return pytest(*PARTS[part])
    finally:
        if not os.environ.get("HIL_GUEST"):
            subprocess.run(["systemctl", "stop", "graderd.service", "hil-rig.service"], check=False)
            subprocess.run(["dpkg", "--purge", "graderd"], check=False)


if __name__ == "__main__":
    sys.exit(main())
