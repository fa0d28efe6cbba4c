"""A machine with three users, as an installation makes it: the daemon's, an operator (of the group), a stranger.

All of it lives in a mount namespace of its own: the users in a copy of /etc, the directories on file systems in memory.
Nothing of the computer it runs on changes, and it is gone with its process. It takes root and the right to mount.
"""

from __future__ import annotations

import ctypes
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parents[1]
UNIT = dict(
    line.split("=", 1)
    for line in (PROJECT / "systemd" / "graderd.service").read_text(encoding="utf-8").splitlines()
    if "=" in line and not line.startswith("#")
)
DAEMON, OPERATOR, STRANGER, ROOT = "graderd", "oper", "strange", "root"
IDS = {DAEMON: 61001, OPERATOR: 61002, STRANGER: 61003}
CONFIG = Path("/etc/graderd/graderd.toml")
STATE = Path("/var/lib/graderd")

SETUP = """
set -eu
mount -t tmpfs -o mode=755 tmpfs /run
{visible}
mkdir /run/etc
cp -a /etc/. /run/etc/
mount --bind /run/etc /etc
mount -t tmpfs -o mode=755 tmpfs /var/lib
mount -t tmpfs -o mode=755 tmpfs /home
for name in {names}; do
    id=${{name#*:}} name=${{name%:*}}
    echo "$name:x:$id:$id::/home/$name:/bin/sh" >>/etc/passwd
    echo "$name:x:$id:$([ $name = graderd ] && echo oper)" >>/etc/group
    install -d -m 0750 -o $id -g $id /home/$name
done
rm -rf /etc/graderd
tmpfiles() {{
    while read -r kind path mode user group _; do
        case $kind in
        d) install -d -m "$mode" -o "$user" -g "$group" "$path" ;;
        z) [ ! -e "$path" ] || {{ chown "$user:$group" "$path" && chmod "$mode" "$path"; }} ;;
        esac
    done <{project}/systemd/graderd.tmpfiles
}}
tmpfiles
{python} -m graderd.config.template {config}
tmpfiles
install -d -m {runtime_mode} -o graderd -g graderd /run/graderd
install -d -m {state_mode} -o graderd -g graderd {state}
echo ready
exec sleep infinity
"""


@dataclass(frozen=True)
class Machine:
    """The namespace, by the process that holds it."""

    holder_pid: int
    _sessions: dict[str, subprocess.Popen[str]] = field(default_factory=dict)

    def command(self, user: str, *words: str | Path) -> list[str]:
        """``words`` as ``user`` would start them."""
        inside = ["nsenter", "--target", str(self.holder_pid), "--mount"]
        if user != ROOT:
            inside += ["setpriv", "--reuid", user, "--regid", str(IDS[user]), "--init-groups", "--no-new-privs"]
        umask = UNIT["UMask"] if user == DAEMON else "0022"
        return [*inside, "sh", "-c", f"umask {umask}; cd {_home(user)}; exec {shlex.join(map(str, words))}"]

    def run(self, user: str, *words: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
        """Run a program to its end, with what others leave of the processors: a hundred such would starve machines."""
        return subprocess.run(
            ["nice", "-n", "10", *self.command(user, *words)],
            env=environment(user),
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=100,
            check=False,
            **options,
        )

    def graderd(self, user: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """``graderd`` with ``words``, in the session of ``user`` (:mod:`tests.commands`)."""
        if user not in self._sessions:
            self._sessions[user] = subprocess.Popen(
                ["nice", "-n", "10", *self.command(user, sys.executable, "-P", PROJECT / "tests" / "commands.py")],
                env=environment(user),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        session = self._sessions[user]
        assert session.stdin is not None
        assert session.stdout is not None
        session.stdin.write(json.dumps([str(word) for word in words]) + "\n")
        session.stdin.flush()
        answer = json.loads(session.stdout.readline())
        return subprocess.CompletedProcess(
            ["graderd", *map(str, words)], answer["status"], answer["out"], answer["err"]
        )

    def end(self) -> None:
        """End the users' sessions."""
        for session in self._sessions.values():
            session.communicate()

    def python(self, user: str, code: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """A few lines of Python."""
        return self.run(user, sys.executable, "-P", "-c", code, *words)

    def must(self, user: str, *words: str | Path) -> str:
        """Run a program that has to succeed; its output."""
        done = self.run(user, *words)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def rights(self, path: Path) -> str:
        """``root:graderd 640``."""
        return self.must(ROOT, "stat", "-c", "%U:%G %a", path)


def environment(user: str) -> dict[str, str]:
    """What a login, or the unit, gives a process."""
    given = {"PATH": os.environ["PATH"], "LANG": "C.UTF-8"}
    given |= {"HOME": str(_home(user)), "USER": user, "PYTHONDONTWRITEBYTECODE": "1"}
    if "PYTHONPYCACHEPREFIX" in os.environ:  # byte code that is there is read
        given["PYTHONPYCACHEPREFIX"] = os.environ["PYTHONPYCACHEPREFIX"]
    if user == DAEMON:
        given |= {"STATE_DIRECTORY": str(STATE), "RUNTIME_DIRECTORY": "/run/graderd"}
    return given


def _home(user: str) -> Path:
    return Path("/" if user == ROOT else f"/home/{user}")


def _visible() -> str:
    """Programs to be run by everybody may lie where only root looks (a checkout under /root): put them, at their own
    places, into an empty directory that anybody may pass."""
    wanted = sorted({PROJECT, Path(sys.prefix), Path(sys.base_prefix), Path(sys.executable).resolve().parents[1]})
    lines, covered = [], []
    for number, path in enumerate(wanted):
        closed = [above for above in reversed(path.parents) if not above.stat().st_mode & 0o001]
        inside = any(path.is_relative_to(other) for other in wanted if other != path)
        if closed and not inside:
            covered.append((closed[0], path, f"/run/visible/{number}"))
            lines.append(f"mkdir -p /run/visible/{number}; mount --bind {shlex.quote(str(path))} /run/visible/{number}")
    lines += [
        f"mount -t tmpfs -o mode=755 tmpfs {shlex.quote(str(above))}" for above in sorted({c[0] for c in covered})
    ]
    lines += [f"mkdir -p {shlex.quote(str(p))}; mount --bind {kept} {shlex.quote(str(p))}" for _, p, kept in covered]
    return "\n".join(lines)


@contextmanager
def three_users() -> Iterator[Machine]:
    """Such a machine, installed, without a daemon.

    Raises:
        PermissionError: not root, or root without the right to mount.
    """
    script = SETUP.format(
        visible=_visible(),
        names=" ".join(f"{name}:{number}" for name, number in IDS.items()),
        project=shlex.quote(str(PROJECT)),
        python=shlex.quote(sys.executable),
        config=CONFIG,
        state=STATE,
        runtime_mode=UNIT["RuntimeDirectoryMode"],
        state_mode=UNIT["StateDirectoryMode"],
    )
    command = ["unshare", "--mount", "sh", "-c", script]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment(ROOT)) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stderr is not None
            if holder.stdout.readline() != "ready\n":
                raise PermissionError(holder.stderr.read().strip())
            machine = Machine(holder.pid)
            try:
                yield machine
            finally:
                machine.end()
        finally:
            holder.kill()


@contextmanager
def bound_by_file_rights() -> Iterator[None]:
    """Root, too, is held by the rights of files: its powers to pass over them are put aside. Others always are."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # _LINUX_CAPABILITY_VERSION_3, this thread
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable, twice
    assert libc.capget(header, sets) == 0
    before = sets[0]
    sets[0] &= ~0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    assert libc.capset(header, sets) == 0
    try:
        yield
    finally:
        sets[0] = before
        assert libc.capset(header, sets) == 0
