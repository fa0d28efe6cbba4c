"""The perception child that lies when ``$GRADERD_CAMPAIGN_LIE`` names a file that says so; else it is the real one.

The file: ``{"line": "..."}`` sends that line in place of every observation (nonsense on the wire),
``{"fields": {...}}`` overwrites fields of every observation.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from pydantic import BaseModel

from graderd.runtime.app import perception_child as product
from graderd.runtime.perception_protocol import Observed


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
    vars(product)["Worker"] = LyingWorker  # the child is the same but for what it says
    sys.exit(product.main())
