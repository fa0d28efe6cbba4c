"""The package's life in a clean Debian root: ``make hil-package``.

mmdebstrap makes a root with systemd and Python and nothing else; ``apt install ./graderd_*.deb`` runs in it against
Debian's archive, then a user-mode Linux guest boots that root, with ``GRADERD_SIM=1`` as a newcomer would, and
``tests/hil/lifecycle.sh`` starts, uses, upgrades and purges the package there.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from hil import uml
from hil.run import PROJECT, RESULTS, newest_package

SCRIPT = PROJECT / "tests" / "hil" / "lifecycle.sh"
BASE = ("systemd", "systemd-sysv", "udev", "dbus", "kmod", "iproute2", "ca-certificates")
NEWER = "99.0.0"
PLACE = Path("root/hil")
"""Where the root holds what we bring; its /tmp may be a file system in memory, mounted over what was laid there."""


def clean_root(
    directory: Path, suite: str, mirror: str, include: Sequence[str] = BASE, *, architecture: str = ""
) -> None:
    """A bare root in ``directory`` with a few packages, of this machine's architecture where none is given.

    Raises:
        SystemExit: mmdebstrap is not there or failed.
    """
    command = ["mmdebstrap", "--quiet", "--variant=minbase", "--mode=root", f"--include={','.join(include)}"]
    command += [f"--architectures={architecture}"] if architecture else []
    if subprocess.run([*command, suite, str(directory), *([mirror] if mirror else [])], check=False).returncode:
        raise SystemExit("hil: no clean root: mmdebstrap failed")


def apt_install(root: Path, package: Path) -> None:
    """``apt install ./PACKAGE`` in the root, dependencies from the archive; nothing starts there.

    Raises:
        SystemExit: apt failed, or the root lacks something the package needs and does not say.
    """
    (root / PLACE).mkdir()
    shutil.copy(package, root / PLACE / package.name)
    shutil.copy("/etc/resolv.conf", root / "etc" / "resolv.conf")
    steps = (
        "mount -t proc proc /proc",
        f"cd /{PLACE}",
        "apt-get update -qq",
        f"apt-get install -y -qq --no-install-recommends ./{package.name}",
        "graderd --help",
    )
    command = ["unshare", "--mount", "--fork", "chroot", str(root), "/bin/sh", "-c", " && ".join(steps)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"hil: apt install fails in the clean root:\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    sys.stdout.write(f"hil: apt installed {package.name} in a clean root\n")


def newer_version(package: Path, directory: Path) -> Path:
    """The same package under a later version number and with a later format of the configuration, for the upgrade."""
    tree = directory / "newer"
    subprocess.run(["dpkg-deb", "--raw-extract", package, tree], check=True)
    control = tree / "DEBIAN" / "control"
    lines = [f"Version: {NEWER}" if line.startswith("Version:") else line for line in control.read_text().splitlines()]
    control.write_text("\n".join(lines) + "\n", encoding="utf-8")
    config = tree / "opt" / "graderd" / "lib" / "common" / "graderd" / "config"
    substitute(config / "models.py", "version: Literal[1] = 1", "version: Literal[2] = 2")
    step = "{1: lambda document: rename(document, 'yard.zero_deg', 'rotation.zero_deg')}"
    substitute(
        config / "migrate.py", "STEPS: Final[Mapping[int, Step]] = {}", f"STEPS: Final[Mapping[int, Step]] = {step}"
    )
    result = directory / f"graderd_{NEWER}.deb"
    subprocess.run(["dpkg-deb", "--root-owner-group", "-Zzstd", "-z1", "--build", tree, result], check=True, stdout=-3)
    return result


def substitute(source: Path, old: str, new: str) -> None:
    """Change a module of the package; its byte code, which nobody compares with it, goes.

    Raises:
        SystemExit: the text is not there (any more).
    """
    text = source.read_text(encoding="utf-8")
    if text.count(old) != 1:
        raise SystemExit(f"hil: {source.name} has no {old!r}: correct hil/package.py")
    source.write_text(text.replace(old, new), encoding="utf-8")
    for stale in (source.parent / "__pycache__").glob(f"{source.stem}.*.pyc"):
        stale.unlink()


def main() -> int:
    """Command line; 0 where every step of the life cycle did what it should."""
    parser = argparse.ArgumentParser(prog="make hil-package", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--suite", default="bookworm", help="Debian or Ubuntu release (bookworm, trixie, noble)")
    parser.add_argument("--mirror", default="", help="for releases that are not Debian's")
    options = parser.parse_args()
    package = newest_package()
    with tempfile.TemporaryDirectory(prefix="graderd-clean-", dir="/var/tmp") as scratch:
        root = Path(scratch) / "root"
        clean_root(root, options.suite, options.mirror)
        apt_install(root, package)
        shutil.copy(newer_version(package, Path(scratch)), root / PLACE / "newer.deb")
        shutil.copy(SCRIPT, root / PLACE / SCRIPT.name)
        guest = uml.Guest(
            ("/bin/sh", f"/{PLACE}/{SCRIPT.name}", f"/{PLACE}/{package.name}", f"/{PLACE}/newer.deb"),
            RESULTS / "package",
            directory=Path("/"),
            timeout_s=600.0,
            root=root,
        )
        return guest.run()


if __name__ == "__main__":
    uml.end_in_order()
    sys.exit(main())
