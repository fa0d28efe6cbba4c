"""Run a command as root in a user-mode Linux guest that sees this machine's files: ``python3 -m hil.uml -- COMMAND…``.

The guest boots Debian's ``user-mode-linux`` kernel (which has SocketCAN, vcan, slcan and the kernel's J1939 as
modules) on this machine's own root directory, read-only under an overlay in memory, with systemd as its first
process. So the project, its virtual environment and the installed tools are simply there, and whatever the guest
installs or deletes vanishes with it. Only ``--out`` is written through to the host.

Exit status: the command's; 124 when the time ran out; 125 when the guest ended without a result.
Needs the packages ``hil/setup`` installs, and no root on the host (files only root may read stay unreadable then).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread

TIMED_OUT = 124
GUEST_DIED = 125
KERNEL = Path("/usr/bin/linux.uml")
MODULES = Path("/usr/lib/uml/modules")
BUSYBOX = Path("/bin/busybox")
INIT = Path(__file__).with_name("guest") / "init"
PREFERENCE = -10
MEMORY_MIB = 2048
PASSED_ON = ("PYTEST_ARGS", "GRADERD_HIL_SEED", "GRADERD_SOAK_S", "TERM")

_running: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True, slots=True)
class Guest:
    """What to run, on which files (``root``), with how much; ``memory_mib`` also holds everything the guest writes."""

    command: Sequence[str]
    out: Path
    directory: Path = field(default_factory=Path.cwd)
    timeout_s: float = 600.0
    memory_mib: int = MEMORY_MIB
    kernel: Path = KERNEL
    root: Path = Path("/")
    kernel_args: tuple[str, ...] = ()
    place_n: int | None = 0
    """Which of the host's processors it gets, counted from 0 and round again; None: whichever is free."""

    def run(self, *, follow: bool = True) -> int:
        """Boot, run, power off; print the command's output while it comes. Returns the exit status described above."""
        self.out.mkdir(parents=True, exist_ok=True)
        for name in ("exit", "log", "journal", "graceful"):
            (self.out / name).unlink(missing_ok=True)
        (self.out / "log").touch()
        (self.out / "guest-command").write_text(self._script(), encoding="utf-8")
        with tempfile.TemporaryDirectory(prefix="graderd-hil-") as scratch, contextlib.ExitStack() as stack:
            command = self.command_line(Path(scratch))
            console = stack.enter_context((self.out / "console").open("wb"))
            stack.enter_context(_on_one_processor(self.place_n))
            process = stack.enter_context(_guest_process(command, console.fileno(), scratch))
            done = Event()
            follower = Thread(target=_follow, args=(self.out / "log", done), name="guest log")
            if follow:
                follower.start()
            try:
                process.wait(self.timeout_s)
                timed_out = False
            except subprocess.TimeoutExpired:
                timed_out = True
            finally:
                done.set()
                if follow:
                    follower.join()
        if timed_out:
            return TIMED_OUT
        try:
            return int((self.out / "exit").read_text(encoding="ascii"))
        except (FileNotFoundError, ValueError):
            return GUEST_DIED

    def _script(self) -> str:
        exports = "".join(
            f"export {name}={shlex.quote(os.environ[name])}\n" for name in PASSED_ON if name in os.environ
        )
        return (
            f"{exports}cd {shlex.quote(str(self.directory))} || exit 1\n"
            f"{shlex.join(self.command)}\n"
            'echo $? > "$HIL_OUT/exit.new" && mv "$HIL_OUT/exit.new" "$HIL_OUT/exit"\n'
            "# A command that wants the ordinary, ordered shutdown leaves this file; hil-journal.service follows it.\n"
            'if [ -e "$HIL_OUT/graceful" ]; then systemctl --no-block start poweroff.target; exit; fi\n'
            "systemctl stop hil-journal.service\n"
            "systemctl poweroff --force\n"
        )

    def command_line(self, scratch: Path) -> list[str]:
        """What starts the guest; files it needs are made in ``scratch``."""
        # A kernel of our own has everything built in.
        modules = [overlay_module()] if self.kernel == KERNEL else []
        return [
            str(self.kernel),
            f"mem={self.memory_mib}M",
            f"initrd={build_initramfs(scratch, modules)}",
            "con=null",
            "ssl=null",
            "con0=null,fd:1",
            "console=tty0",
            "quiet",
            "panic=-1",
            f"hil_root={self.root}",
            f"hil_out={self.out.resolve()}",
            *self.kernel_args,
        ]


def cannot() -> str:
    """Why no guest runs here; empty where one does (tried, which takes some seconds)."""
    if absent := missing():
        return f"no {', '.join(absent)}: run `sudo hil/setup` (Debian, Ubuntu) once"
    with tempfile.TemporaryDirectory(prefix="graderd-hil-out-") as out:
        status = Guest(("/bin/true",), Path(out), directory=Path("/"), timeout_s=120.0).run(follow=False)
        said = (Path(out) / "console").read_text(encoding="utf-8", errors="replace").split("\n")
    return "" if status == 0 else f"a guest does not start (status {status}): {' / '.join(said[-4:])}"


def end_in_order() -> None:
    """Let a launcher that is terminated or interrupted take every guest of its away, whichever thread waits for it."""

    def end(number: int, _: object) -> None:
        for guest in list(_running):
            _take_away(guest)
        sys.exit(128 + number)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)


def overlay_module() -> Path:
    """The module that makes the guest's root, of the installed kernel's own release: others may lie beside it."""
    asked = subprocess.run([KERNEL, "--version"], capture_output=True, text=True, check=True)
    return MODULES / asked.stdout.strip() / "kernel/fs/overlayfs/overlay.ko"


def missing() -> list[str]:
    """What the launcher needs and this machine has not, as paths."""
    absent = [str(path) for path in (KERNEL, BUSYBOX) if not path.exists()]
    if KERNEL.exists() and not overlay_module().exists():
        absent.append(str(overlay_module()))
    if shutil.which("cpio") is None:
        absent.append("cpio")
    return absent


def build_initramfs(directory: Path, modules: Sequence[Path]) -> Path:
    """Pack busybox, kernel modules to be loaded in that order and our ``init`` into ``directory/initramfs``."""
    root = directory / "initramfs.d"
    (root / "bin").mkdir(parents=True)
    (root / "modules").mkdir()
    shutil.copy(BUSYBOX, root / "bin" / "busybox")
    shutil.copy(INIT, root / "init")
    (root / "init").chmod(0o755)
    for number, module in enumerate(modules):
        shutil.copy(module, root / "modules" / f"{number:02}-{module.name}")
    names = "\n".join(str(path.relative_to(root)) for path in sorted(root.rglob("*")))
    archive = directory / "initramfs"
    with archive.open("wb") as target:
        subprocess.run(
            ["cpio", "--create", "--format=newc", "--quiet"], cwd=root, input=names.encode(), stdout=target, check=True
        )
    return archive


@contextlib.contextmanager
def _on_one_processor(place_n: int | None) -> Iterator[None]:
    """What this thread starts runs on one processor.

    Each system call in a user-mode guest is a change between two processes of the host. On two processors each of them
    wakes the other across; on one a boot took 5.6 s instead of 8.6 to 11.3 on a busy host.
    """
    allowed = os.sched_getaffinity(0)
    if place_n is not None:
        os.sched_setaffinity(0, {sorted(allowed)[place_n % len(allowed)]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def _guest_process(command: Sequence[str], output_fd: int, scratch: str) -> Iterator[subprocess.Popen[bytes]]:
    """The kernel in a process group of its own, all of which is gone afterwards whatever happens."""
    # The kernel keeps its memory and its sockets in these; the scratch directory takes them away again.
    environment = {**os.environ, "TMPDIR": _place_for_memory() or scratch, "HOME": scratch}
    # The kernel keeps a descriptor for each file of the host the guest has looked at.
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=output_fd, stderr=output_fd, env=environment, start_new_session=True
    )
    _running.add(process)
    _weigh(process.pid)
    try:
        yield process
    finally:
        _take_away(process)
        process.wait()
        _running.discard(process)


def _take_away(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def _weigh(pid: int) -> None:
    """Give the guest preference over the rest of the host, unless the launcher was started with `nice`.

    A guest that waits for the host's processor misses deadlines that a machine would meet. The scheduler weighs
    sessions against each other where it groups by session, else processes; both need privilege.
    """
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    wanted = niceness if niceness > 0 else PREFERENCE
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, wanted)
        Path(f"/proc/{pid}/autogroup").write_text(str(wanted), encoding="ascii")


def _place_for_memory() -> str:
    """A memory file system that is large enough and may hold programs (a container's /dev/shm often is neither)."""
    try:
        shm = os.statvfs("/dev/shm")
    except OSError:
        return ""
    enough = shm.f_bavail * shm.f_frsize > 2 * MEMORY_MIB << 20
    return "/dev/shm" if enough and not shm.f_flag & os.ST_NOEXEC and os.access("/dev/shm", os.W_OK) else ""


def _follow(path: Path, done: Event) -> None:
    """Copy what is appended to ``path`` to standard output until ``done``, then the rest."""
    with path.open("rb") as source:
        while True:
            last = done.is_set()
            while block := source.read(65536):
                sys.stdout.buffer.write(block)
                sys.stdout.buffer.flush()
            if last:
                return
            done.wait(0.2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of the launcher."""
    parser = argparse.ArgumentParser(prog="python3 -m hil.uml", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-t", "--timeout", type=float, default=600.0, metavar="SECONDS")
    parser.add_argument("-m", "--memory", type=int, default=MEMORY_MIB, metavar="MIB")
    parser.add_argument("-o", "--out", type=Path, help="keep log, journal, console and result files here")
    parser.add_argument("command", nargs="+", help="what to run in the guest, after --")
    options = parser.parse_args(arguments)
    absent = missing()
    if absent:
        sys.stderr.write(f"hil: no {', '.join(absent)}. Run `sudo hil/setup` (Debian, Ubuntu) once\n")
        return GUEST_DIED
    with contextlib.ExitStack() as stack:
        out = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="graderd-hil-out-")))
        guest = Guest(options.command, out.resolve(), timeout_s=options.timeout, memory_mib=options.memory)
        began_s = time.monotonic()
        status = guest.run()
        if status in (TIMED_OUT, GUEST_DIED):
            said = (out / "console").read_text(encoding="utf-8", errors="replace").strip()
            reason = f"no result in {options.timeout:g} s" if status == TIMED_OUT else "the guest ended with no result"
            sys.stderr.write(f"hil: {reason}\n" + "".join(f"  {line}\n" for line in said.splitlines()[-15:]))
        sys.stderr.write(f"hil: guest up and down in {time.monotonic() - began_s:.1f} s, status {status}\n")
        return status


if __name__ == "__main__":
    end_in_order()
    sys.exit(main())
