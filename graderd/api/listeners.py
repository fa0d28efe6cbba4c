"""The sockets the interface listens on, with their rights; a living daemon's socket is told from a dead one's."""

from __future__ import annotations

import contextlib
import fcntl
import grp
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

from graderd.api.settings import TcpSettings
from graderd.hal.errors import DeviceError

MAX_PATH_BYTES = 107


class SocketInUseError(DeviceError):
    """Another daemon serves this socket."""


class SocketError(DeviceError):
    """The socket cannot be made or given its rights."""


@contextlib.contextmanager
def unix_socket(path: Path, mode: int, group: str | None) -> Iterator[socket.socket]:
    """A listening socket at ``path``. A lock beside it, which dies with its process, tells a living daemon from a
    socket file that a dead one left behind.

    Raises:
        SocketInUseError: see :func:`serve`.
        SocketError: see :func:`serve`.
    """
    where = f"api socket {path}"
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise SocketError(where, f"the path is longer than {MAX_PATH_BYTES} bytes", "choose a shorter one")
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(_lock(path))
            _remove_stale(path)
            listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            # Linux takes the rights of the new file from the socket: nobody else gets in before they are set for good.
            os.fchmod(listener.fileno(), 0o600)
            listener.bind(str(path))
            stack.callback(path.unlink, missing_ok=True)
            if group is not None:
                os.chown(path, -1, _group_id(group, where))
            os.chmod(path, mode)
        except OSError as error:
            raise SocketError(
                where, str(error.strerror or error), "see that the directory exists and the daemon may write to it"
            ) from error
        listener.setblocking(False)
        yield listener


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold the lock beside the socket. The file carries our process id, for people, and goes with us."""
    lock_path = path.with_name(path.name + ".lock")
    while True:
        descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.read(descriptor, 32).decode("ascii", "replace").strip()
            os.close(descriptor)
            raise SocketInUseError(
                f"api socket {path}",
                f"another daemon{f' (process {pid})' if pid else ''} serves it",
                "stop that one, or give this one another socket",
            ) from None
        # Its former holder may have taken the file away between our open and our lock: then it locks nobody out.
        if lock_path.exists() and os.path.samestat(os.fstat(descriptor), lock_path.stat()):
            break
        os.close(descriptor)
    try:
        os.truncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        lock_path.unlink(missing_ok=True)
        os.close(descriptor)


def _remove_stale(path: Path) -> None:
    """Take away what a dead daemon left at ``path``, and nothing else."""
    try:
        kind = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(kind):
        raise SocketError(f"api socket {path}", "there is a file of another kind", "remove it, or choose another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except BlockingIOError:
            pass  # its queue is full: somebody listens
    raise SocketInUseError(
        f"api socket {path}", "another program listens on it", "stop that one, or choose another path"
    )


def _group_id(group: str, where: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise SocketError(where, f"there is no group {group}", "create it, or change socket_group") from None


@contextlib.contextmanager
def tcp_socket(tcp: TcpSettings) -> Iterator[socket.socket]:
    where = f"api tcp {tcp.host}:{tcp.port_n}"
    family = socket.AF_INET6 if ":" in tcp.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((tcp.host, tcp.port_n))
        except OSError as error:
            raise SocketError(where, str(error.strerror or error), "choose another host or port_n") from error
        listener.setblocking(False)
        yield listener
