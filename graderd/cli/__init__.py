"""The command line: ``graderd COMMAND``. One file per command; the daemon's own work is imported only where needed."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status: 0 done, 1 refused or failed, 2 bad usage, 3 no daemon."""
    from graderd.cli.app import run_app

    sys.exit(run_app(list(sys.argv[1:] if arguments is None else arguments)))
