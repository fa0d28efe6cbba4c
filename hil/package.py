"""The package's life in clean Debian roots: ``make hil-package``.

First the package itself: lintian finds no error, and a second build (another checkout, time zone, locale and umask,
from an index that offers a newer version of everything) is the same file. Then, in a root of each Debian with systemd
and Python and nothing else: ``apt install ./graderd_*.deb`` against Debian's archive; ``tests/hil/offline.sh`` there,
which has upgrades fail, disks fill up, configurations come from newer versions; ``tests/hil/users.sh``, where the
daemon, an operator and a stranger use it; and a user-mode Linux guest that boots the root, where
``tests/hil/lifecycle.sh`` starts (``GRADERD_SIM=1``), uses, upgrades and purges the package as a newcomer would. Last a
root of the older Debian that is brought to the newer one with the package in it.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from hil import uml
from hil.newer_index import NewerIndex
from hil.run import PROJECT, PYTHON, RESULTS, newest_package

SCRIPTS = tuple(PROJECT / "tests" / "hil" / name for name in ("lifecycle.sh", "offline.sh", "users.sh"))
SUITES = ("bookworm", "trixie")
# What hil/setup downloads into as well.
CACHE = (
    Path(
        os.environ.get("GRADERD_HIL_CACHE")
        or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "graderd-hil"
    )
    / "debian"
)
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
    CACHE.mkdir(parents=True, exist_ok=True)
    command = ["mmdebstrap", "--quiet", "--variant=minbase", "--mode=root", f"--include={','.join(include)}"]
    command += [f"--architectures={architecture}"] if architecture else []
    # What Debian's archive sends is kept: a slow mirror costs once.
    archives = '"$1/var/cache/apt/archives"'
    command += [
        "--skip=download/empty,essential/unlink",
        f"--setup-hook=mkdir -p {archives}/partial && find {CACHE} -name '*.deb' -exec cp -t {archives} {{}} +",
        f"--customize-hook=find {archives} -name '*.deb' -exec cp -n -t {CACHE} {{}} +",
    ]
    if subprocess.run([*command, suite, str(directory), *([mirror] if mirror else [])], check=False).returncode:
        raise SystemExit(
            f"hil: no clean root of {suite}: mmdebstrap failed as said above. Where the mirror is at fault, run it "
            f"again: what has come stays in {CACHE}"
        )


def apt_install(root: Path, package: Path) -> None:
    """``apt install ./PACKAGE`` in the root, dependencies from the archive; nothing starts there.

    Raises:
        SystemExit: apt failed, or the root lacks something the package needs and does not say.
    """
    (root / PLACE).mkdir()
    shutil.copy(package, root / PLACE / package.name)
    shutil.copy("/etc/resolv.conf", root / "etc" / "resolv.conf")
    in_root(
        root,
        f"apt install of {package.name}",
        "apt-get update -qq",
        # Nothing here must outlive a power cut: each of the package's files would wait for the disk.
        f"apt-get install -y -qq --no-install-recommends -o Dpkg::Options::=--force-unsafe-io ./{package.name}",
        "graderd --help",
    )
    sys.stdout.write(f"hil: apt installed {package.name} in a clean root\n")


def in_root(root: Path, what: str, *steps: str, show: bool = False) -> None:
    """Run shell commands in the root, with what of a machine they need: ``/proc``, ``/dev``, the archive's cache.

    Raises:
        SystemExit: one of them failed.
    """
    inside = " && ".join(("mount -t proc proc /proc", f"cd /{PLACE}", *steps))
    outside = (
        f"mount --bind {CACHE} {root}/var/cache/apt/archives && mkdir -p {CACHE}/partial && "
        f"mount --rbind /dev {root}/dev && exec chroot {root} /bin/sh -c '{inside}'"
    )
    environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8", "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        ["unshare", "--mount", "--fork", "/bin/sh", "-c", outside],
        env=environment,
        stdout=None if show else subprocess.PIPE,
        stderr=None if show else subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"hil: {what} fails in the clean root:\n{(done.stdout or '')[-5000:]}")


def newer_version(package: Path, directory: Path) -> Path:
    """The same package under a later version number and with a later format of the configuration, for the upgrade."""
    tree = directory.with_name(f"{directory.name}-newer")
    subprocess.run(["dpkg-deb", "--raw-extract", package, tree], check=True)
    control = tree / "DEBIAN" / "control"
    lines = [f"Version: {NEWER}" if line.startswith("Version:") else line for line in control.read_text().splitlines()]
    control.write_text("\n".join(lines) + "\n", encoding="utf-8")
    newer_format(tree / "opt" / "graderd" / "lib" / "common" / "graderd" / "config")
    (tree / "DEBIAN" / "md5sums").unlink()  # dpkg makes its own where a package has none
    result = tree.with_suffix(".deb")
    subprocess.run(["dpkg-deb", "--root-owner-group", "-Zzstd", "-z1", "--build", tree, result], check=True, stdout=-3)
    return result


def newer_format(config: Path) -> None:
    """Let the package ``graderd.config`` know one format more, in which ``yard.zero_deg`` is ``rotation.zero_deg``.

    Raises:
        SystemExit: it does not look as expected (any more).
    """
    found = re.findall(r"version: Literal\[(\d+)\]", (config / "models.py").read_text(encoding="utf-8"))
    now_n = int(found[0]) if found else 0
    substitute(
        config / "models.py", f"version: Literal[{now_n}] = {now_n}", "version: Literal[{0}] = {0}".format(now_n + 1)
    )
    steps = "STEPS: Final[Mapping[int, Step]] = {"
    step = f"{now_n}: lambda document: rename(document, 'yard.zero_deg', 'rotation.zero_deg'), "
    substitute(config / "migrate.py", steps, steps + step)


def substitute(source: Path, old: str, new: str) -> None:
    """Change a module of the package.

    Raises:
        SystemExit: the text is not there (any more).
    """
    text = source.read_text(encoding="utf-8")
    if text.count(old) != 1:
        raise SystemExit(f"hil: {source.name} has no {old!r}: correct hil/package.py")
    source.write_text(text.replace(old, new), encoding="utf-8")


def lint(package: Path) -> None:
    """lintian's errors are ours.

    Raises:
        SystemExit: it finds some.
    """
    done = subprocess.run(["lintian", "--fail-on=error", package], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"hil: lintian finds errors in {package.name}:\n{done.stdout}{done.stderr}")
    sys.stdout.write(f"hil: lintian finds no error in {package.name}\n")


def reproduced(package: Path, scratch: Path) -> None:
    """Build it again where all is different that must not matter, and compare.

    Raises:
        SystemExit: the build fails, or makes another file.
    """
    checkout = scratch / "a checkout elsewhere"
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", PROJECT, checkout], check=True, umask=0o077)
    kept = subprocess.run(
        ["git", "ls-files", "--modified", "--others", "--exclude-standard", "-z"],
        cwd=PROJECT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    for name in filter(None, kept.split("\0")):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PROJECT / name, checkout / name)
    pins = (PROJECT / "requirements.lock").read_text(encoding="utf-8")
    with NewerIndex(pins) as index:
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith(("PIP_", "LC_", "MAKE", "PYTHON"))
        }
        environment |= {
            "TZ": "Pacific/Kiritimati",
            "LC_ALL": "C",
            "LANG": "de_DE.UTF-8",
            "PYTHONHASHSEED": "7",
            "PIP_CONFIG_FILE": os.devnull,
            "PIP_INDEX_URL": index.url,
            "PIP_NO_CACHE_DIR": "1",
        }
        done = subprocess.run(
            [PYTHON, "packaging/build_deb.py", "--out", scratch / "again"],
            cwd=checkout, env=environment, umask=0o077, capture_output=True, text=True, check=False,
        )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"hil: the second build fails:\n{done.stdout}{done.stderr}")
    again = newest_package(scratch / "again")
    if again.read_bytes() != package.read_bytes():
        raise SystemExit(
            f"hil: two builds differ: {', '.join(differences(package, again, scratch)) or 'in the packing'}"
        )
    sys.stdout.write(f"hil: a second build made the same file; {index.offered_n} newer versions were offered to it\n")


def differences(one: Path, other: Path, scratch: Path) -> list[str]:
    """The files in which two packages differ, twenty at most."""
    trees = [scratch / "one", scratch / "other"]
    for package, tree in zip((one, other), trees, strict=True):
        subprocess.run(["dpkg-deb", "--raw-extract", package, tree], check=True)
    done = subprocess.run(
        ["diff", "--recursive", "--brief", "--no-dereference", *trees], capture_output=True, text=True, check=False
    )
    return done.stdout.splitlines()[:20]


def lay_out(root: Path, package: Path, scratch: Path) -> None:
    """Put beside the installed package in the root what the scripts take."""
    shutil.copy(newer_version(package, scratch / root.name), root / PLACE / "newer.deb")
    for script in SCRIPTS:
        shutil.copy(script, root / PLACE / script.name)


def live(root: Path, package: Path, out: Path) -> int:
    """Boot the root and run the life cycle of a service there; 0 where every step did what it should."""
    return uml.Guest(
        ("/bin/sh", f"/{PLACE}/lifecycle.sh", f"/{PLACE}/{package.name}", f"/{PLACE}/newer.deb"),
        out,
        directory=Path("/"),
        timeout_s=900.0,
        root=root,
    ).run()


def release_upgrade(root: Path, package: Path) -> None:
    """From the older Debian to the newer one, with the package installed and its Python taken away under it.

    Raises:
        SystemExit: it fails, or leaves a package that does not work.
    """
    former, later = SUITES
    in_root(
        root,
        f"{former} to {later}",
        "/usr/lib/graderd/bytecode make",
        f"sed -i s/{former}/{later}/g /etc/apt/sources.list",
        "apt-get update -qq",
        "apt-get -y -qq -o Dpkg::Options::=--force-confnew -o Dpkg::Options::=--force-unsafe-io full-upgrade",
        "apt-get -y -qq autoremove",
    )
    in_root(root, f"the package after {former} to {later}", f"sh offline.sh whole {package.name}", show=True)
    sys.stdout.write(f"hil: {former} was brought to {later} with the package in it\n")


def main() -> int:
    """Command line; 0 where every step did what it should."""
    parser = argparse.ArgumentParser(prog="make hil-package", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--suite", action="append", help="only this release (bookworm, trixie, noble); several: again")
    parser.add_argument("--mirror", default="", help="for releases that are not Debian's")
    parser.add_argument("--only", choices=("package", "life", "release-upgrade"), help="only this part")
    options = parser.parse_args()
    package = newest_package()
    status = 0
    with tempfile.TemporaryDirectory(prefix="graderd-clean-", dir="/var/tmp") as temporary:
        scratch = Path(temporary)
        if options.only in (None, "package"):
            lint(package)
            reproduced(package, scratch)
        for suite in options.suite or SUITES:
            if options.only not in (None, "life"):
                break
            sys.stdout.write(f"hil: {suite}\n")
            root = scratch / suite
            clean_root(root, suite, options.mirror)
            apt_install(root, package)
            lay_out(root, package, scratch)
            in_root(root, "offline.sh", f"sh offline.sh all {package.name} newer.deb", show=True)
            in_root(root, "users.sh", f"sh users.sh {package.name} newer.deb", show=True)
            status = status or live(root, package, RESULTS / "package" / suite)
        if not status and not options.suite and options.only in (None, "release-upgrade"):
            root = scratch / "upgraded"
            clean_root(root, SUITES[0], options.mirror)
            apt_install(root, package)
            lay_out(root, package, scratch)
            release_upgrade(root, package)
            status = live(root, package, RESULTS / "package" / root.name)
    return status


if __name__ == "__main__":
    uml.end_in_order()
    sys.exit(main())
