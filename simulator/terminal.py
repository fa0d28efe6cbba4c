"""A pseudo-terminal that a simulated device is plugged into, under a link that never leads anywhere else."""

from __future__ import annotations

import contextlib
import os
import subprocess
import tty
from pathlib import Path

_TAKE_AWAY = 'read -r _; [ "$(readlink -- "$1")" = "$2" ] && rm -f -- "$1"'


class LinkedTerminal:
    """A raw pseudo-terminal; hosts open ``link``, the device reads and writes :attr:`master`.

    The kernel gives a terminal's number to the next one that asks as soon as it is free. A link left by a device that
    was killed would then lead a host, which tries again and again, to somebody else's device: another rig's servo, or
    a person's shell. So a small process of its own keeps the terminal's number taken and waits for this one's end,
    however it comes; it takes the link away before it lets go.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self.master, self.slave = os.openpty()
        # The slave stays open: without one, reading the master would fail until a host comes.
        tty.setraw(self.slave)
        tty.setraw(self.master)
        os.set_blocking(self.master, False)
        name = os.ttyname(self.slave)
        self._holder = subprocess.Popen(
            ["/bin/sh", "-c", _TAKE_AWAY, "sh", str(link), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(self.slave,),
            start_new_session=True,
        )
        partial = link.with_name(f".{link.name}.{os.getpid()}")
        partial.unlink(missing_ok=True)
        partial.symlink_to(name)
        partial.replace(link)

    def close(self) -> None:
        """Take the link away, then hang up."""
        with contextlib.suppress(FileNotFoundError):
            self._link.unlink()
        os.close(self.slave)
        os.close(self.master)
        self._holder.kill()
        self._holder.wait()
        assert self._holder.stdin is not None
        self._holder.stdin.close()
