"""Runs in place of the daemon, under its unit: tries what must fail and what must work; prints one JSON object.

Standard library only, and no import from the project: it is copied to where the unit can read it.
"""

import ctypes
import errno
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable

DENIED = (
    errno.EPERM,
    errno.EACCES,
    errno.EROFS,
    errno.ENOENT,
    errno.EAFNOSUPPORT,
    errno.EPROTONOSUPPORT,
    errno.ENETDOWN,
)
LIBC = ctypes.CDLL(None, use_errno=True)


def call(name: str, *arguments: object) -> None:
    """A C library call whose failure is an OSError."""
    if getattr(LIBC, name)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), name)


def write(path: str) -> None:
    """Write a file."""
    with open(path, "a", encoding="ascii") as target:
        target.write("x")


def read(path: str) -> None:
    """Read a file."""
    with open(path, "rb") as source:
        source.read(1)


def setuid_program() -> None:
    """A set-user-id copy of a shell must not gain anything; making one must fail already."""
    path = os.path.join(os.environ["STATE_DIRECTORY"], "shell")
    try:
        with open(path, "wb") as target:
            target.write(b"#!/bin/sh\n")
        os.chmod(path, 0o4755)
    finally:
        os.unlink(path)


def become_root() -> None:
    """Through a set-user-id program of the system."""
    done = subprocess.run(
        ["/bin/su", "-c", "id -u"], capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
    )
    if done.returncode != 0 or done.stdout.strip() != "0":
        raise PermissionError(errno.EPERM, "su")


def executable_memory() -> None:
    """Memory that is writable and executable."""
    LIBC.mmap.restype = ctypes.c_void_p
    got = LIBC.mmap(None, ctypes.c_size_t(4096), 7, 0x22, -1, ctypes.c_long(0))
    if got is None or got == ctypes.c_void_p(-1).value:
        raise OSError(ctypes.get_errno() or errno.EPERM, "mmap")


def others() -> None:
    """See a process of another user."""
    if not any(os.path.isdir(f"/proc/{pid}") for pid in (1, 2)):
        raise PermissionError(errno.EPERM, "hidden")


MUST_FAIL: dict[str, Callable[[], object]] = {
    "write /etc": lambda: write("/etc/hil"),
    "write /etc/graderd": lambda: write("/etc/graderd/hil"),
    "write /usr": lambda: write("/usr/hil"),
    "write /opt/graderd": lambda: write("/opt/graderd/lib/common/graderd/__init__.py"),
    "write /var/lib": lambda: write("/var/lib/hil"),
    "write /run": lambda: write("/run/hil"),
    "write /boot": lambda: write("/boot/hil"),
    "write /proc/sys": lambda: write("/proc/sys/kernel/hostname"),
    "write /sys": lambda: write("/sys/class/net/lo/mtu"),
    "read /home": lambda: read("/home/hil-secret"),
    "read /root": lambda: os.listdir("/root"),
    "read /etc/shadow": lambda: read("/etc/shadow"),
    "read /dev/mem": lambda: read("/dev/mem"),
    "read /dev/kmsg": lambda: read("/dev/kmsg"),
    "IPv4 socket": lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM),
    "IPv6 socket": lambda: socket.socket(socket.AF_INET6, socket.SOCK_DGRAM),
    "packet socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
    "vsock": lambda: socket.socket(socket.AF_VSOCK, socket.SOCK_STREAM),
    "mount": lambda: call("mount", b"none", b"/mnt", b"tmpfs", 0, None),
    "unshare": lambda: call("unshare", 0x10000000),
    "clock": lambda: __import__("time").clock_settime(0, 0),
    "host name": lambda: socket.sethostname("hil"),
    "set-user-id file": setuid_program,
    "become root": become_root,
    "setuid": lambda: os.setuid(0),
    "writable code": executable_memory,
    "real-time": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50)),
    "kernel module": lambda: call("syscall", 175, b"", 0, b""),
    "trace": lambda: call("ptrace", 16, os.getppid(), None, None),
    "processes of others": others,
}
MUST_WORK: dict[str, Callable[[], object]] = {
    "state directory": lambda: write(os.path.join(os.environ["STATE_DIRECTORY"], "hil")),
    "read configuration": lambda: read("/etc/graderd/graderd.toml"),
    "CAN socket": lambda: socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).bind(("",)),
    "unix socket": lambda: socket.socket(socket.AF_UNIX, socket.SOCK_STREAM),
    "private /tmp": lambda: write("/tmp/hil"),
    "threads": lambda: __import__("threading").Thread(target=int).start(),
    "children": lambda: subprocess.run(["/bin/true"], check=True),
    "numpy": lambda: subprocess.run([sys.executable, "-I", "-c", "import numpy, cv2, can"], check=True),
}


def main() -> None:
    """Try everything and print what should not have happened."""
    through, broken = [], []
    for name, action in MUST_FAIL.items():
        try:
            action()
        except OSError as error:
            if error.errno not in DENIED:
                broken.append(f"{name}: {error}")
        else:
            through.append(name)
    for name, action in MUST_WORK.items():
        try:
            action()
        except (OSError, subprocess.SubprocessError) as error:
            broken.append(f"{name}: {error}")
    print(json.dumps({"tried_n": len(MUST_FAIL), "got_through": through, "broken": broken}))  # noqa: T201


main()
