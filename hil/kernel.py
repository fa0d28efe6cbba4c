"""A user-mode kernel with virtual time, built once from Debian's ``linux-source``.

In virtual time the guest's clock moves only while every process of it waits: computing costs no time, and a wait takes
none of the host's. So no deadline is missed for want of a processor, however busy the host is. Debian's packaged
user-mode kernel is built without it (``CONFIG_UML_TIME_TRAVEL_SUPPORT``; Linux, Documentation/virt/uml and
arch/um/Kconfig).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

SOURCES = Path("/usr/src")
FRAGMENT = Path(__file__).with_name("guest") / "virtual-time.config"
VIRTUAL_TIME = "time-travel=inf-cpu"
NEEDED = ("gcc", "make", "flex", "bison", "bc", "xz")
NEWS_EVERY_S = 15.0


def virtual_time_kernel(cache: Path) -> Path:
    """The kernel, built in some minutes where ``cache`` has none of this source and configuration yet.

    Raises:
        SystemExit: source or tools are not installed, or it does not build.
    """
    absent = [name for name in NEEDED if shutil.which(name) is None]
    archives = sorted(SOURCES.glob("linux-source-*.tar.xz"), key=lambda path: path.stat().st_mtime)
    if not archives or absent:
        what = ", ".join([*absent, *([] if archives else [f"{SOURCES}/linux-source-*.tar.xz"])])
        raise SystemExit(f"hil: no {what}: run `sudo hil/setup --kernel` (Debian, Ubuntu) once")
    archive = archives[-1]
    made_of = hashlib.sha256(FRAGMENT.read_bytes() + f"{archive} {archive.stat().st_size}".encode()).hexdigest()[:12]
    kernel = cache / f"linux-virtual-time-{made_of}"
    if not kernel.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="graderd-kernel-", dir="/var/tmp") as scratch:
            shutil.copy(_build(archive, Path(scratch), cache / "kernel.log"), kernel.with_suffix(".new"))
        kernel.with_suffix(".new").replace(kernel)
    return kernel


def _build(archive: Path, scratch: Path, log: Path) -> Path:
    """Unpack, configure, compile; what the tools say goes to ``log``."""
    began_s = time.monotonic()
    # What a make that started us hands down is not for this one.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    run_make = ("make", "ARCH=um", f"-j{len(os.sched_getaffinity(0))}")
    with log.open("wb") as said:

        def step(what: str, *command: str | Path, directory: Path, news: Callable[[], str] = str) -> None:
            with subprocess.Popen(
                command, cwd=directory, env=environment, stdin=subprocess.DEVNULL, stdout=said, stderr=said
            ) as process:
                try:
                    while process.poll() is None:
                        sys.stdout.write(f"hil: kernel: {what}{news()}, {time.monotonic() - began_s:.0f} s\n")
                        sys.stdout.flush()
                        with contextlib.suppress(subprocess.TimeoutExpired):
                            process.wait(NEWS_EVERY_S)
                finally:
                    process.terminate()
            if process.returncode:
                raise SystemExit(f"hil: kernel: {what} failed (status {process.returncode}); see {log}")

        step(f"unpacking {archive.name}", "tar", "--extract", "--xz", "--file", archive, directory=scratch)
        tree = next(path for path in scratch.iterdir() if path.is_dir())
        step("default configuration", *run_make, "defconfig", directory=tree)
        step("ours", "scripts/kconfig/merge_config.sh", "-m", ".config", FRAGMENT, directory=tree)
        step("the rest", *run_make, "olddefconfig", directory=tree)
        _check(tree / ".config")
        step("compiling", *run_make, "linux", directory=tree, news=lambda: f", {_objects_n(tree)} files of about 950")
        step("stripping", "strip", "linux", directory=tree)
    return tree / "linux"


def _objects_n(tree: Path) -> int:
    return sum(1 for _ in tree.rglob("*.o"))


def _check(made: Path) -> None:
    """Another version of the kernel may want an option named otherwise, and drops unknown ones in silence."""
    lines = set(made.read_text(encoding="utf-8").splitlines())
    wanted = [line for line in FRAGMENT.read_text(encoding="utf-8").splitlines() if line.endswith("=y")]
    if lost := [line for line in wanted if line not in lines]:
        raise SystemExit(f"hil: this kernel does not take {', '.join(lost)} of {FRAGMENT}")
