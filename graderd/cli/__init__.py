"""The command line: ``graderd COMMAND``. One file per command; the daemon's own work is imported only where needed."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status: 0 done, 1 refused or failed, 2 bad usage or configuration.
    Interrupted (Ctrl-C), at whatever moment, it dies by SIGINT, so that a shell ends what it would do next."""
    # Before numpy is imported, here and in every process that is started from here. Its products of matrices are of
    # three columns: threads that wait for such pieces take a processor from the control loop and make nothing quicker.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.stdout is None:  # closed by whoever started us: what is printed is not wanted, and a stop is all the same
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  (for as long as we live)
    try:
        from graderd.cli.app import run_app

        status = run_app(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
        raise  # not reached
    except OSError as error:
        sys.exit(_unsaid(error))
    sys.exit(_all_said(status))


def _all_said(status: int) -> int:
    """The exit status once what was printed has gone out."""
    try:
        sys.stdout.flush()
        return status
    except OSError as error:
        return _unsaid(error, status)


def _unsaid(error: OSError, status: int = 0) -> int:
    """The exit status where the reader of what was printed has gone or its disk is full. The interpreter, which would
    tell of it with a traceback, or a second time, has nothing left to write."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):
        sys.stderr.write(f"graderd: standard output: {error.strerror}. Look at where it goes\n")
    return status or 1
