"""``python -m harness.bound PARENT COMMAND...``: a command that ends with the program that started it.

Whatever ended process ``PARENT``, the kernel kills the command (SIGKILL, which also ends what is halted). It is the
same process from the first moment on: its number, its files and its exit status are the command's.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # linux/prctl.h; it outlives execve


def bound(*command: str) -> tuple[str, ...]:
    """The command that runs ``command`` bound to this process."""
    return (sys.executable, "-m", "harness.bound", str(os.getpid()), *command)


def main() -> None:
    """Bind this process, then become the command."""
    parent, *command = sys.argv[1:]
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):
        raise SystemExit("harness.bound: who started this is gone already")
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
