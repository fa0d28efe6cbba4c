"""The last test: the machine is turning when the computer is told to shut down. The verdict is read afterwards.

It leaves everything as it is and lets the guest shut down in the ordinary, ordered way. What the bus and the rig saw
until the end is written to the result directory; :mod:`hil.shutdown` judges it outside.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from hil.service import Grader, Rig, run, turn
from tests.hil.conftest import LEFT_TURNING

OUT = Path(os.environ.get("HIL_OUT", "/tmp"))


@pytest.mark.shutdown
def test_shutdown_while_turning(request: pytest.FixtureRequest, ready: Grader, rig: Rig) -> None:
    run(
        "systemd-run",
        "--quiet",
        "--unit=hil-witness.service",
        # Begun before the service, so it sees the end of it.
        "--property=Before=graderd.service hil-rig.service",
        f"--property=RequiresMountsFor={OUT}",
        f"--property=WorkingDirectory={Path.cwd()}",
        *(sys.executable, "-m", "hil.shutdown", "watch", "wire0", str(OUT / "shutdown.log")),
    )
    turn(ready, rig)
    request.session.stash[LEFT_TURNING] = True
    (OUT / "graceful").touch()
