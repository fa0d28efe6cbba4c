"""``graderd`` for whoever started this: one command after the other, each in a process of its own, forked once what all
of them import is there. A test of a hundred commands starts one interpreter instead of a hundred.

A line of standard input is a command's words (JSON); the answer, a line too, is its status, output and errors.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
from typing import Any

import graderd.runtime.app.devices  # noqa: F401  (what judges a configuration, and takes longest to import)
from graderd.cli import main
from graderd.cli.app import _parser

LIMIT_S = 100
"""A command that takes longer ends by SIGALRM."""


def next_command() -> list[str]:
    """Answers for each command as long as there are some; in that command's process, it returns its words."""
    for line in sys.stdin:
        out, err = os.memfd_create("out"), os.memfd_create("err")
        child = os.fork()
        if not child:
            signal.alarm(LIMIT_S)
            nothing = os.open(os.devnull, os.O_RDONLY)
            for ours, standard in ((nothing, 0), (out, 1), (err, 2)):
                os.dup2(ours, standard)
                os.close(ours)
            return [str(word) for word in json.loads(line)]
        _, status = os.waitpid(child, 0)
        answer: dict[str, Any] = {"status": os.waitstatus_to_exitcode(status)}
        for name, said in (("out", out), ("err", err)):
            with os.fdopen(said, "rb") as file:
                file.seek(0)
                answer[name] = file.read().decode()
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    sys.exit()


if __name__ == "__main__":
    _parser()  # a command keeps it for as long as it lives: as long as all of them live
    # Three quarters of a forked command's time went into collecting what it was born with, at its end.
    gc.collect()
    gc.freeze()
    main(next_command())
