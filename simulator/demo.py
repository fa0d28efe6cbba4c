"""The demonstration: a client like any other that arms the simulated grader and drives four passes.

It starts the rig and the daemon as processes of their own, lays a pile left, center, right and an even layer in front
of the blade, and lets automatic operation answer each; then the machine drives through the soil.
"""

from __future__ import annotations

import asyncio
import shutil
import sys

from graderd.client import ClientError
from graderd.hal.errors import DeviceError
from graderd.runtime.app.sim import new_rig_directory
from graderd.simulator.control_client import RigControl
from graderd.simulator.operator import Operator, Pass, PassFailedError, ended_by_sigterm, whole_machine
from graderd.simulator.show import Show, make_show

ZONES = ("left", "center", "right", "even")


def run_demo(as_json: bool) -> int:
    """Run the demonstration. Returns 0 if every pass settled at the angle its soil asks for, else 1."""
    show = make_show(as_json)
    try:
        with show:
            return asyncio.run(_demo(show))
    except KeyboardInterrupt:
        return 130


async def _demo(show: Show) -> int:
    directory = new_rig_directory()
    passes: list[Pass] = []
    reason = "ended from outside"
    try:
        async with (
            ended_by_sigterm(),
            whole_machine(directory, show) as client,
            RigControl(directory / "control.sock") as control,
        ):
            operator = Operator(client, control, show)
            for zone in ZONES:
                passes.append(await operator.drive_pass(zone))
            await client.command("disarm")
        wrong = [p for p in passes if p.zone != p.decided]
        reason = "; ".join(f"soil {p.zone} was taken for {p.decided}" for p in wrong)
    except (PassFailedError, ClientError, DeviceError, OSError) as error:
        reason = str(error) or repr(error)
    except Exception as error:
        reason = repr(error)
        raise
    finally:
        shutil.rmtree(directory, ignore_errors=True)
        show.event("demo_finished", passes=[p.told() for p in passes], reason=reason)
    return 1 if reason else 0


if __name__ == "__main__":
    sys.exit(run_demo("--json" in sys.argv[1:]))
