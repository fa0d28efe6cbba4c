"""The whole hardware-in-the-loop run: ``make hil``.

Where the running kernel makes a vcan, root runs, systemd is the first process and no graderd is installed, the suite
runs here. Elsewhere it runs in two user-mode Linux guests of this machine's own files, side by side: the soak in one,
nearly all else with the shutdown in the other. The same tests either way; only the shutdown needs a computer that
may be shut down.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hil import uml
from hil.kernel import VIRTUAL_TIME, virtual_time_kernel
from hil.shutdown import judge
from hil.suite import PARTS

PROJECT = Path(__file__).resolve().parent.parent
PYTHON = PROJECT / ".venv" / "bin" / "python"
RESULTS = PROJECT / "var" / "hil"


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the run in a guest of its own; its name is one of :data:`hil.suite.PARTS`."""

    name: str
    timeout_s: float
    place_n: int


@dataclass(frozen=True, slots=True)
class Kernel:
    """What the guests boot, with what on its command line, and how much longer than real time a run may take."""

    path: Path = uml.KERNEL
    arguments: tuple[str, ...] = ()
    timeout_factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """How one run ended."""

    status: int
    took_s: float

    def __str__(self) -> str:
        return f"{'passed' if not self.status else 'FAILED'} in {self.took_s:.0f} s"


def newest_package(folder: Path = PROJECT / "dist", architecture: str = "") -> Path:
    """The package built last, for this machine's architecture where none is given.

    Raises:
        SystemExit: there is none.
    """
    if not architecture:
        asked = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True)
        architecture = asked.stdout.strip()
    found = sorted(folder.glob(f"graderd_*_{architecture}.deb"), key=lambda p: p.stat().st_mtime)
    if not found:
        raise SystemExit(f"hil: no package for {architecture} in {folder}. Build it first: make deb, or make hil")
    return found[-1]


def unpacked(package: Path) -> Path:
    """The folder with what is in ``package``; made where there is none yet or the package is newer."""
    place = RESULTS / "cache" / "package"
    stamp, origin = place.with_suffix(".made-of"), f"{package.name} {package.stat().st_mtime_ns}\n"
    if not stamp.exists() or stamp.read_text(encoding="utf-8") != origin:
        stamp.unlink(missing_ok=True)
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        subprocess.run(["dpkg-deb", "--extract", package, place], check=True)
        # Here in seconds, in each guest in a minute.
        bytecode = place / "usr/lib/graderd/bytecode"
        subprocess.run(["/usr/bin/python3", "-I", bytecode, "make", place / "opt/graderd"], check=True)
        stamp.write_text(origin, encoding="utf-8")
    return place


def can_run_here() -> str:
    """Empty where the suite can run on this machine itself, else why not."""
    if os.geteuid() != 0:
        return "not root"
    if not Path("/run/systemd/system").is_dir():
        return "systemd is not the first process"
    if Path("/usr/lib/systemd/system/graderd.service").exists():
        return "a graderd is installed here, which the suite would replace"
    from hil.bus import can_make_vcan

    return "" if can_make_vcan() else "the kernel makes no vcan"


def in_guest(part: Part, package: Path, tree: Path, kernel: Kernel, *, follow: bool) -> int:
    """Run one part in a guest; its log, journal and console stay under var/hil/PART."""
    command = (str(PYTHON), "-m", "hil.suite", part.name, str(package), str(tree))
    out = RESULTS / part.name
    shutil.rmtree(out, ignore_errors=True)
    status = uml.Guest(
        command,
        out,
        directory=PROJECT,
        timeout_s=part.timeout_s * kernel.timeout_factor,
        kernel=kernel.path,
        kernel_args=kernel.arguments,
        place_n=part.place_n,
    ).run(follow=follow)
    if status in (uml.TIMED_OUT, uml.GUEST_DIED):
        sys.stderr.write(
            f"hil: {part.name}: {'timed out' if status == uml.TIMED_OUT else 'the guest died'}; see {out}\n"
        )
    return status


def judge_shutdown(part: Part) -> int:
    """The verdict on the shutdown that followed a part; 0 where the machine was brought to a stand."""
    out = RESULTS / part.name
    if not (out / "graceful").exists():
        sys.stdout.write("hil: shutdown: not tried, for its test did not run to its end\n")
        return 0  # The part's own status tells of a test that failed.
    wrong = judge(out / "shutdown.log")
    sys.stdout.write("".join(f"hil: shutdown: {line}\n" for line in wrong or ["the blade stood, motion was disabled"]))
    return 1 if wrong else 0


def in_guests(package: Path, wanted: str, soak_s: float, kernel: Kernel) -> list[int]:
    """The parts in two guests, side by side where there are two processors; the second's log after the first's."""
    work = Part("work", 900.0, 0)
    endurance = Part("soak" if wanted == "soak" else "endurance", soak_s + 600.0, 1)
    tree = unpacked(package)
    if wanted in ("soak", "endurance"):
        return [in_guest(endurance, package, tree, kernel, follow=True)]
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="guest") as pool:
        run_second = partial(in_guest, endurance, package, tree, kernel, follow=False)
        beside = pool.submit(run_second) if wanted == "all" and len(os.sched_getaffinity(0)) > 1 else None
        results = [in_guest(work, package, tree, kernel, follow=True), judge_shutdown(work)]
        if wanted == "all":
            results.append(beside.result() if beside else run_second())
            sys.stdout.write((RESULTS / endurance.name / "log").read_text(encoding="utf-8", errors="replace"))
    return results


def on_this_machine(package: Path, wanted: str) -> list[int]:
    """The same without a guest; the machine is not shut down."""
    command = [str(PYTHON), "-m", "hil.suite", wanted, str(package)]
    return [subprocess.run(command, cwd=PROJECT, check=False).returncode]


def keep_failed(number: int) -> None:
    """Put the results of a run that failed where the next one does not overwrite them."""
    for part in PARTS:
        if (RESULTS / part).exists():
            kept = RESULTS / f"failed-{number}" / part
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(RESULTS / part, kept)


def main() -> int:
    """Command line; 0 where every run passed."""
    parser = argparse.ArgumentParser(prog="make hil", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", choices=PARTS, default="all", help="endurance: freeze, clock, soak; work: the rest")
    parser.add_argument("--soak-s", type=float, default=120.0, help="length of the soak in seconds")
    parser.add_argument("--guest", action="store_true", help="in a guest even where it could run here")
    parser.add_argument(
        "--virtual-time", action="store_true", help="in guests whose clock waits for them (see hil.kernel)"
    )
    parser.add_argument("--repeat", type=int, default=1, metavar="N", help="so many runs in a row, all of them")
    parser.add_argument("--possible", action="store_true", help="only say whether it can run on this machine")
    options = parser.parse_args()
    os.environ["GRADERD_SOAK_S"] = str(options.soak_s)
    why = "asked for" if options.guest or options.virtual_time else can_run_here()
    if options.possible or (why and uml.missing()):
        problem = uml.cannot() if why else ""
        sys.stderr.write(f"hil: cannot run here: {why}; {problem}\n" if problem else "")
        return uml.GUEST_DIED if problem else 0
    package = newest_package(RESULTS / "dist")
    kernel = Kernel()
    if options.virtual_time:
        kernel = Kernel(virtual_time_kernel(RESULTS / "cache"), (VIRTUAL_TIME,), 4.0)
    sys.stdout.write(f"hil: in user-mode Linux ({why})\n" if why else "hil: on this machine's own kernel\n")
    sys.stdout.flush()
    verdicts: list[Verdict] = []
    for number in range(1, options.repeat + 1):
        began_s = time.monotonic()
        results = (
            in_guests(package, options.part, options.soak_s, kernel) if why else on_this_machine(package, options.part)
        )
        verdict = Verdict(next((status for status in results if status), 0), time.monotonic() - began_s)
        verdicts.append(verdict)
        if verdict.status:
            keep_failed(number)
        sys.stdout.write(f"hil: run {number} of {options.repeat}: {verdict}\n")
        sys.stdout.flush()
    if options.repeat > 1:
        passed_n = sum(not verdict.status for verdict in verdicts)
        sys.stdout.write(f"hil: {passed_n} of {options.repeat} runs passed\n")
    return next((verdict.status for verdict in verdicts if verdict.status), 0)


if __name__ == "__main__":
    uml.end_in_order()
    sys.exit(main())
