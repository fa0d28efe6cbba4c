"""Build ``graderd_VERSION_ARCH.deb``: ``make deb``, or ``make deb DEB_ARGS="--arch arm64"``.

The package brings everything but Python itself. Under /opt/graderd stands a virtual environment whose interpreter is
the system's python3: ``lib/common`` holds what every Python takes, ``lib/pythonX.Y/site-packages`` the compiled
packages of each supported Python. So one package serves Debian 12 (3.11), Ubuntu 24.04 (3.12) and Debian 13 (3.13).
Nothing is compiled: every dependency comes as a wheel named in requirements.lock with its hash, which is also why an
arm64 package can be built on any machine.

The package is a function of the sources: two builds of a commit are the same file, whoever makes them, where and when.
Its time stamps are $SOURCE_DATE_EPOCH, or the commit's.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from lock import Pin, Target, read_lock, roots, select
from notices import copyright_file
from packaging.utils import canonicalize_name

PROJECT = Path(__file__).resolve().parent.parent
DEBIAN = Path(__file__).with_name("debian")
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
PYTHONS = ("3.11", "3.12", "3.13")
EXTRAS = ("camera",)
PREFIX = Path("opt/graderd")

# Folders of dependencies that serve only their own development.
NOT_SHIPPED = {"tests", "_pyinstaller", "__pyinstaller", "include"}
# And files: debugging symbols that were split off.
NOT_SHIPPED_SUFFIX = ".debug"

# Where our own files go: source in the project, place in the package, mode.
FILES = (
    ("systemd/graderd.service", "usr/lib/systemd/system/graderd.service", 0o644),
    ("systemd/graderd-can@.service", "usr/lib/systemd/system/graderd-can@.service", 0o644),
    ("systemd/graderd-generator", "usr/lib/systemd/system-generators/graderd-generator", 0o755),
    ("systemd/graderd.sysusers", "usr/lib/sysusers.d/graderd.conf", 0o644),
    ("systemd/graderd.tmpfiles", "usr/lib/tmpfiles.d/graderd.conf", 0o644),
    ("systemd/udev/70-graderd.rules", "usr/lib/udev/rules.d/70-graderd.rules", 0o644),
    ("systemd/can-link", "usr/lib/graderd/can-link", 0o755),
    ("systemd/adapter-name", "usr/lib/graderd/adapter-name", 0o755),
    ("packaging/bytecode", "usr/lib/graderd/bytecode", 0o755),
    ("systemd/graderd.env", "usr/share/graderd/default", 0o644),
    ("systemd/adapters", "usr/share/graderd/adapters", 0o644),
    ("systemd/network/70-graderd-can.link", "usr/share/graderd/network/70-graderd-can.link", 0o644),
    ("systemd/network/80-graderd-can.network", "usr/share/graderd/network/80-graderd-can.network", 0o644),
    ("systemd/dropins/realtime.conf", "usr/share/graderd/dropins/realtime.conf", 0o644),
    ("systemd/dropins/web-page.conf", "usr/share/graderd/dropins/web-page.conf", 0o644),
    ("systemd/dropins/gpio.conf", "usr/share/graderd/dropins/gpio.conf", 0o644),
    ("systemd/dropins/bind-devices.conf", "usr/share/graderd/dropins/bind-devices.conf", 0o644),
    ("packaging/debian/lintian-overrides", "usr/share/lintian/overrides/graderd", 0o644),
)

# How dpkg-deb packs: as any dpkg reads it; or, for tests on this machine, in a tenth of the time and a sixth larger.
# Higher levels take twice as long and more for a package that is a fourteenth smaller. One thread: into how many pieces
# several cut the package must not be the machine's affair.
PACKED = ("-Zxz", "-z1", "--threads-max=1")
PACKED_FAST = ("-Zzstd", "-z3", "--threads-max=1")

LAUNCHER = """\
#!/opt/graderd/bin/python -I
import sys

from {module} import {function}

sys.exit({function}())
"""


@dataclass(frozen=True, slots=True)
class Package:
    """What is to be built, for which Pythons, and the tree it is built in."""

    version: str
    architecture: str
    pythons: tuple[str, ...]
    tree: Path

    @property
    def machine(self) -> str:
        """The architecture as wheels name it."""
        return MACHINES[self.architecture]

    @property
    def prefix(self) -> Path:
        """/opt/graderd in the tree."""
        return self.tree / PREFIX


def run(*command: str | Path, cwd: Path = PROJECT) -> None:
    """Run a command; its output is shown only when it fails."""
    result = subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(f"build_deb: {' '.join(map(str, command[:6]))}… failed:\n{result.stdout}{result.stderr}")


def commit_time_s() -> int:
    """$SOURCE_DATE_EPOCH, else when the commit was made, in seconds since 1970.

    Raises:
        SystemExit: neither is known.
    """
    said = os.environ.get("SOURCE_DATE_EPOCH")
    if not said:
        asked = subprocess.run(
            ["git", "log", "-1", "--format=%ct"], cwd=PROJECT, capture_output=True, text=True, check=False
        )
        said = asked.stdout.strip()
    if not said.isascii() or not said.isdigit():
        raise SystemExit(
            f"build_deb: the time of the package's files is {said!r}, not seconds since 1970. Build in a git checkout, "
            "or set SOURCE_DATE_EPOCH"
        )
    return int(said)


def pip(*arguments: str | Path) -> None:
    """Run this environment's pip."""
    run(sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments)


def our_wheel(package: Package, scratch: Path) -> Path:
    """The project's own wheel, built from the files git does not ignore (a build in place picks up leftovers)."""
    source = scratch / "source"
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=PROJECT,
        capture_output=True,
        check=True,
    ).stdout
    for name in listed.decode().split("\0"):
        # The links graderd/drivers and so on are copied as links: they lead into the copy.
        if name and ((PROJECT / name).is_file() or (PROJECT / name).is_symlink()):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(PROJECT / name, source / name, follow_symlinks=False)
    project = source / "pyproject.toml"
    text = project.read_text(encoding="utf-8")
    own = tomllib.loads(text)["project"]["version"]
    project.write_text(text.replace(f'version = "{own}"', f'version = "{package.version}"', 1), encoding="utf-8")
    pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", scratch, source)
    return next(scratch.glob("graderd-*.whl"))


def wheels_for(package: Package, scratch: Path) -> dict[str, list[Path]]:
    """Download the wheels of every supported Python; returns them by Python version."""
    site = [Path(entry) for entry in sys.path if entry.endswith("site-packages")]
    pins = read_lock(PROJECT / "requirements.lock")
    wanted = roots(PROJECT / "pyproject.toml", EXTRAS)
    targets = {python: Target(python, package.machine) for python in package.pythons}
    chosen = {python: select(pins, wanted, site, target) for python, target in targets.items()}
    first, *others = package.pythons
    found = {first: download(targets[first], chosen[first], scratch)}
    # What serves every Python is fetched once.
    shared = {project_of(wheel): wheel for wheel in found[first] if serves_all(wheel, first)}

    def rest(python: str) -> list[Path]:
        names = {canonicalize_name(pin.name) for pin in chosen[python]}
        own = [pin for pin in chosen[python] if canonicalize_name(pin.name) not in shared]
        same = [wheel for name, wheel in shared.items() if name in names]
        return sorted(same + download(targets[python], own, scratch), key=lambda wheel: wheel.name)

    with ThreadPoolExecutor(thread_name_prefix="download") as pool:
        found |= dict(zip(others, pool.map(rest, others), strict=True))
    for python, wheels in found.items():
        if len(wheels) != len(chosen[python]):
            raise SystemExit(f"build_deb: {len(wheels)} wheels for {len(chosen[python])} pins of Python {python}")
    return found


def download(target: Target, pins: Sequence[Pin], scratch: Path) -> list[Path]:
    """Let pip fetch the wheels of these pins for one Python; two at a time, since it takes one after the other."""
    folder = scratch / f"wheels-{target.python}"
    options = ("--no-deps", "--require-hashes", *target.pip_options(), "--dest", folder)

    def fetch(start_n: int) -> None:
        listing = scratch / f"requirements-{target.python}-{start_n}.txt"
        listing.write_text("\n".join(pin.line() for pin in pins[start_n::2]) + "\n", encoding="utf-8")
        pip("download", *options, "--requirement", listing)

    with ThreadPoolExecutor(thread_name_prefix="fetch") as pool:
        list(pool.map(fetch, range(min(2, len(pins)))))
    return sorted(folder.glob("*.whl"))


def project_of(wheel: Path) -> str:
    """The normalised project name in a wheel's file name."""
    return canonicalize_name(wheel.name.partition("-")[0])


def serves_all(wheel: Path, python: str) -> bool:
    """Whether a wheel is the same file for each Python: pure, or of the stable ABI, not one made for ``python``."""
    return wheel.stem.split("-")[-2] in ("abi3", "none") and "cp" + python.replace(".", "") not in wheel.stem


def unpack(wheel: Path, folder: Path) -> None:
    """Install a wheel by unpacking it; the scripts of other projects are left out."""
    with zipfile.ZipFile(wheel) as archive:
        for member in archive.infolist():
            top, _, rest = member.filename.partition("/")
            if top.endswith(".data"):
                kind, _, rest = rest.partition("/")
                if kind not in ("purelib", "platlib") or not rest:
                    continue
                member.filename = rest
            if member.filename.endswith(NOT_SHIPPED_SUFFIX):
                continue
            if not NOT_SHIPPED.intersection(Path(member.filename).parts[1:-1]):
                archive.extract(member, folder)


def make_environment(package: Package, wheels: dict[str, list[Path]], own: Path) -> None:
    """Lay out /opt/graderd: the interpreter link, the shared packages, the compiled ones of each Python."""
    common = package.prefix / "lib" / "common"
    common.mkdir(parents=True)
    unpack(own, common)
    shared: set[str] = set()
    for python, files in wheels.items():
        site = package.prefix / "lib" / f"python{python}" / "site-packages"
        site.mkdir(parents=True)
        (site / "common.pth").write_text("../../common\n", encoding="ascii")
        for wheel in files:
            # pyrealsense2 and numpy are compiled per Python.
            if not serves_all(wheel, python):
                unpack(wheel, site)
            elif wheel.name not in shared:
                shared.add(wheel.name)
                unpack(wheel, common)
    (package.prefix / "bin").mkdir()
    (package.prefix / "bin" / "python").symlink_to("/usr/bin/python3")
    (package.prefix / "pyvenv.cfg").write_text(
        "home = /usr/bin\ninclude-system-site-packages = false\n", encoding="ascii"
    )
    scripts = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    for name, entry in scripts.items():
        module, _, function = entry.partition(":")
        launcher = package.prefix / "bin" / name
        launcher.write_text(LAUNCHER.format(module=module, function=function), encoding="utf-8")
        launcher.chmod(0o755)


def place_files(package: Package) -> None:
    """Units, rules, configuration, man page, completions, documents."""
    for source, place, mode in FILES:
        target = package.tree / place
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PROJECT / source, target)
        target.chmod(mode)
    (package.tree / "usr/bin").mkdir(parents=True, exist_ok=True)
    (package.tree / "usr/bin/graderd").symlink_to("/opt/graderd/bin/graderd")
    write_gzip(package.tree / "usr/share/man/man1/graderd.1.gz", (DEBIAN.parent / "graderd.1").read_bytes())
    write_gzip(package.tree / "usr/share/doc/graderd/changelog.gz", (PROJECT / "CHANGELOG.md").read_bytes())
    template = package.tree / "usr/share/graderd/graderd.toml"
    run(sys.executable, "-m", "graderd.config.template", template)
    for shell, place in (
        ("bash", "usr/share/bash-completion/completions/graderd"),
        ("zsh", "usr/share/zsh/vendor-completions/_graderd"),
        ("fish", "usr/share/fish/vendor_completions.d/graderd.fish"),
    ):
        target = package.tree / place
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(completion(shell), encoding="utf-8")


def completion(shell: str) -> str:
    """The completion script the CLI itself gives for a shell."""
    program = "import sys; sys.argv[0] = 'graderd'; from graderd.cli import main; main()"
    environment = {**os.environ, "_GRADERD_COMPLETE": f"source_{shell}"}
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=PROJECT, env=environment, capture_output=True, text=True, check=False
    )
    if "graderd" not in result.stdout:
        raise SystemExit(f"build_deb: the CLI gives no {shell} completion:\n{result.stdout}{result.stderr}")
    return result.stdout


def write_gzip(target: Path, content: bytes) -> None:
    """A .gz without a time stamp in it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(gzip.compress(content, 9, mtime=0))


def write_control(package: Package) -> None:
    """DEBIAN/: control, maintainer scripts, checksums."""
    folder = package.tree / "DEBIAN"
    folder.mkdir()
    files = [path for path in package.tree.rglob("*") if path.is_file() and not path.is_symlink()]
    size_kib = sum(path.stat().st_size for path in files) // 1024
    above = f"3.{int(package.pythons[-1].split('.')[1]) + 1}"
    control = (
        (DEBIAN / "control")
        .read_text(encoding="utf-8")
        .format(
            version=package.version,
            architecture=package.architecture,
            size_kib=size_kib,
            first=package.pythons[0],
            above=above,
        )
    )
    (folder / "control").write_text(control, encoding="utf-8")
    for name, mode in (("postinst", 0o755), ("prerm", 0o755), ("postrm", 0o755), ("triggers", 0o644)):
        shutil.copyfile(DEBIAN / name, folder / name)
        (folder / name).chmod(mode)
    sums = [
        f"{hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest()}  {path.relative_to(package.tree)}\n"
        for path in sorted(files)
    ]
    (folder / "md5sums").write_text("".join(sums), encoding="utf-8")


def level(tree: Path) -> None:
    """Give every file the same time, whenever it was written."""
    time_s = int(os.environ["SOURCE_DATE_EPOCH"])
    for path in [tree, *tree.rglob("*")]:
        os.utime(path, (time_s, time_s), follow_symlinks=False)


def system_python() -> str:
    """The version of this machine's own Python.

    Raises:
        SystemExit: it is none of those the package supports.
    """
    version = "import sys; print('%d.%d' % sys.version_info[:2])"
    own = subprocess.run(["/usr/bin/python3", "-c", version], capture_output=True, text=True, check=True).stdout.strip()
    if own not in PYTHONS:
        raise SystemExit(f"build_deb: /usr/bin/python3 is {own}; the package supports {', '.join(PYTHONS)}")
    return own


def build(version: str, architecture: str, pythons: tuple[str, ...], folder: Path, packing: Sequence[str]) -> Path:
    """Build the package into ``folder``, packed as these options of dpkg-deb say; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    if find_spec("pip") is None:
        # An environment that uv made has none; Python itself brings one.
        run(sys.executable, "-m", "ensurepip")
    with tempfile.TemporaryDirectory(prefix="graderd-deb-") as temporary:
        scratch = Path(temporary)
        package = Package(version, architecture, pythons, scratch / "tree")
        package.tree.mkdir(mode=0o755)
        os.umask(0o022)
        # dpkg-deb writes a time of its own, and takes it from here.
        os.environ["SOURCE_DATE_EPOCH"] = str(commit_time_s())
        with ThreadPoolExecutor(thread_name_prefix="beside the download") as pool:
            own = pool.submit(our_wheel, package, scratch)
            placed = pool.submit(place_files, package)
            wheels = wheels_for(package, scratch)
            make_environment(package, wheels, own.result())
            placed.result()
        place_of = {
            wheel: str(PREFIX / "lib" / ("common" if serves_all(wheel, python) else f"python{python}/site-packages"))
            for python, files in wheels.items()
            for wheel in files
        }
        notices = package.tree / "usr/share/doc/graderd/copyright"
        notices.write_text(copyright_file(wheels, place_of), encoding="utf-8")
        run("chmod", "-R", "u+rwX,go+rX,go-w", package.tree)
        write_control(package)
        level(package.tree)
        result = folder / f"graderd_{version}_{architecture}.deb"
        run("dpkg-deb", "--root-owner-group", *packing, "--build", package.tree, result)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of the package builder."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    native = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True).stdout.strip()
    parser = argparse.ArgumentParser(prog="make deb", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arch", choices=sorted(MACHINES), default=native)
    parser.add_argument("--version", default=project["version"])
    parser.add_argument("--out", type=Path, default=PROJECT / "dist")
    parser.add_argument("--system-python", action="store_true", help="for this machine's Python only, for tests on it")
    options = parser.parse_args(arguments)
    pythons = (system_python(),) if options.system_python else PYTHONS
    packing = PACKED_FAST if options.system_python else PACKED
    result = build(options.version, options.arch, pythons, options.out, packing)
    sys.stdout.write(f"{result} ({result.stat().st_size / 1e6:.0f} MB)\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
