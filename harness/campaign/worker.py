"""The perception child that lies when ``$GRADERD_CAMPAIGN_LIE`` names a file that says so; else it is the real one.

The file: ``{"line": "..."}`` sends that line in place of every observation (nonsense on the wire),
``{"fields": {...}}`` overwrites fields of every observation.

On SIGUSR1 it takes for good what its allocator has free, where the kernel gives it no more (a limit of its address
space): a child that was started a moment ago lives on for long on what its start has left free.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType

from pydantic import BaseModel

from graderd.runtime.app import perception_child as product
from graderd.runtime.perception_protocol import Observed

PIECES_BYTES = (1 << 20, 1 << 16, 1 << 12)
MOST_BYTES = 1 << 28
kept: list[bytearray] = []


def take_what_is_free(_: int, __: FrameType | None) -> None:
    """Large pieces first; what is left is too small for a picture."""
    for size_n in PIECES_BYTES:
        with suppress(MemoryError):
            for _ in range(MOST_BYTES // size_n):
                if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
                    return  # there is memory again
                kept.append(bytearray(size_n))


class LyingWorker(product.Worker):
    """See the module's text."""

    def _send(self, message: BaseModel) -> None:
        lie = Path(os.environ["GRADERD_CAMPAIGN_LIE"])
        if isinstance(message, Observed) and lie.exists():
            wanted = json.loads(lie.read_text(encoding="utf-8"))
            if "line" in wanted:
                self._out.write(wanted["line"].encode() + b"\n")
                self._out.flush()
                return
            message = Observed(observation=message.observation | wanted["fields"])
        super()._send(message)


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, take_what_is_free)
    vars(product)["Worker"] = LyingWorker  # the child is the same but for what it says
    sys.exit(product.main())
