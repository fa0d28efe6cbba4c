"""Commands that hand over to another program of this project, with all further arguments."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

from graderd.cli.console import CliError

TAKES_ANYTHING = {"allow_extra_args": True, "ignore_unknown_options": True, "allow_interspersed_args": False}


def hand_over(module: str, arguments: list[str]) -> None:
    """Become ``python -m module``: signals and the exit status are its own from here on.

    Raises:
        CliError: this installation has no such module.
    """
    try:
        found = find_spec(module) is not None
    except ModuleNotFoundError:
        found = False
    if not found:
        raise CliError(module, "this installation does not contain it", "install the whole of graderd")
    if arguments[:1] == ["--"]:
        arguments = arguments[1:]
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
