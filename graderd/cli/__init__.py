"""The command line: ``graderd COMMAND``. One file per command; the daemon's own work is imported only where needed."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status: 0 done, 1 refused or failed, 2 bad usage, 3 no daemon. Interrupted
    (Ctrl-C), at whatever moment, it dies by SIGINT, so that a shell ends what it would do next."""
    # Before numpy is imported, here and in every process that is started from here. Its products of matrices are of
    # three columns: threads that wait for such pieces take a processor from the control loop and make nothing quicker.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from graderd.cli.app import run_app

        status = run_app(list(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
        raise  # not reached
    sys.exit(status)
