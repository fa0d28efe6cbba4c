"""The whole hardware-in-the-loop run: ``make hil``.

Where the running kernel makes a vcan, root runs, systemd is the first process and no graderd is installed, the suite
runs here. Elsewhere it runs in user-mode Linux guests of this machine's own files: the suite with the shutdown in one,
the soak beside it in another. The same tests either way; only the shutdown needs a computer that may be shut down.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from hil import uml

PROJECT = Path(__file__).resolve().parent.parent
PYTHON = PROJECT / ".venv" / "bin" / "python"
RESULTS = PROJECT / "var" / "hil"


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the run in a guest of its own."""

    name: str
    suite: str
    timeout_s: float


def newest_package() -> Path:
    """The package ``make deb`` built last.

    Raises:
        SystemExit: there is none.
    """
    architecture = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True).stdout
    found = sorted((PROJECT / "dist").glob(f"graderd_*_{architecture.strip()}.deb"), key=lambda p: p.stat().st_mtime)
    if not found:
        raise SystemExit("hil: no package in dist/. Build it first: make deb")
    return found[-1]


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


def in_guest(part: Part, package: Path, *, follow: bool) -> int:
    """Run one part in a guest; its log, journal and console stay under var/hil/PART."""
    command = (str(PYTHON), "-m", "hil.suite", part.suite, str(package))
    out = RESULTS / part.name
    status = uml.Guest(command, out, directory=PROJECT, timeout_s=part.timeout_s).run(follow=follow)
    if status in (uml.TIMED_OUT, uml.GUEST_DIED):
        sys.stderr.write(
            f"hil: {part.name}: {'timed out' if status == uml.TIMED_OUT else 'the guest died'}; see {out}\n"
        )
    return status


def judge_shutdown() -> int:
    """The verdict on the shutdown that followed the suite; 0 where the machine was brought to a stand."""
    from hil.shutdown import judge

    record = RESULTS / "suite" / "shutdown.log"
    wrong = judge(record) if record.exists() else ["nothing was recorded"]
    sys.stdout.write("".join(f"hil: shutdown: {line}\n" for line in wrong or ["the blade stood, motion was disabled"]))
    return 1 if wrong else 0


def main() -> int:
    """Command line; the first status that is not 0."""
    parser = argparse.ArgumentParser(prog="make hil", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", choices=["suite", "soak", "both"], default="both")
    parser.add_argument("--soak-s", type=float, default=120.0, help="length of the soak in seconds")
    parser.add_argument("--guest", action="store_true", help="in a guest even where it could run here")
    options = parser.parse_args()
    os.environ["GRADERD_SOAK_S"] = str(options.soak_s)
    package, began_s = newest_package(), time.monotonic()
    why = "asked for" if options.guest else can_run_here()
    if not why:
        sys.stdout.write("hil: on this machine's own kernel\n")
        parts = [p for p in ("all", "soak") if options.part in ("both", {"all": "suite"}.get(p, p))]
        results = [
            subprocess.run([PYTHON, "-m", "hil.suite", p, package], cwd=PROJECT, check=False).returncode for p in parts
        ]
    else:
        if absent := uml.missing():
            sys.stderr.write(f"hil: no {', '.join(absent)}. Run `sudo hil/setup` once\n")
            return uml.GUEST_DIED
        sys.stdout.write(f"hil: in user-mode Linux ({why})\n")
        sys.stdout.flush()
        results = in_guests(package, options.part, options.soak_s)
    sys.stdout.write(f"hil: {'passed' if not any(results) else 'FAILED'} in {time.monotonic() - began_s:.0f} s\n")
    return next((status for status in results if status), 0)


def in_guests(package: Path, part: str, soak_s: float) -> list[int]:
    """Suite and soak in two guests side by side; the soak's log is printed after the suite's."""
    suite = Part("suite", "all-and-shutdown", 900.0)
    soak = Part("soak", "soak", soak_s + 420.0)
    with ThreadPoolExecutor(max_workers=2, thread_name_prefix="guest") as pool:
        beside = pool.submit(in_guest, soak, package, follow=part == "soak") if part != "suite" else None
        results = [in_guest(suite, package, follow=True), judge_shutdown()] if part != "soak" else []
        if beside is not None:
            results.append(beside.result())
            if part == "both":
                sys.stdout.write((RESULTS / soak.name / "log").read_text(encoding="utf-8", errors="replace"))
    return results


if __name__ == "__main__":
    uml.end_in_order()
    sys.exit(main())
