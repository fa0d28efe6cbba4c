"""The arm64 package on a machine of another kind: ``make hil-arm64``.

mmdebstrap makes a bare arm64 root, whose programs run through QEMU's user-mode emulation (binfmt_misc); there
``apt install ./graderd_*_arm64.deb`` and ``tests/hil/emulated.sh``, which drives the simulated grader by the CLI.
Processor and wheels are those of a Jetson or Raspberry Pi, kernel and speed are not.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from hil.package import PLACE, apt_install, clean_root
from hil.run import PROJECT, newest_package

SCRIPT = PROJECT / "tests" / "hil" / "emulated.sh"
MOUNTS = ("mount -t proc proc /proc", "mount -t sysfs sys /sys", "mount -t tmpfs shm /dev/shm")


def main() -> int:
    """Make the root, install, use; 0 where all of it went as it should."""
    package = newest_package(architecture="arm64")
    with tempfile.TemporaryDirectory(prefix="graderd-arm64-", dir="/var/tmp") as scratch:
        root = Path(scratch) / "root"
        clean_root(root, "bookworm", "", architecture="arm64")
        apt_install(root, package)
        shutil.copy(SCRIPT, root / PLACE / SCRIPT.name)
        inside = " && ".join((*MOUNTS, f"sh /{PLACE}/{SCRIPT.name}"))
        # In a mount namespace of its own, which takes the mounts away again.
        outside = f'mount --rbind /dev {root}/dev && chroot {root} /bin/sh -c "{inside}"'
        return subprocess.run(["unshare", "--mount", "--fork", "/bin/sh", "-c", outside], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
