"""Every way by which a stop may come, and what it does to a machine in motion."""

from __future__ import annotations

import asyncio
import math
import os
import sys
import time
from collections.abc import Awaitable, Callable

from harness.campaign.conduct import EVERYTHING, come_to
from harness.campaign.model import Phase
from harness.campaign.stack import Stack

ISO_ALL_STOP_ID = 0x0CFD0280
"""PGN 64770 (ISO 11783-7, all implements stop operations) from address 128, priority 3."""
STOP_PGN_ID = (3 << 26) | (64999 << 8) | 0x80


async def by_command_line(stack: Stack) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "graderd", "stop"),
        env=os.environ | {"GRADERD_SOCKET": str(stack.directory / "graderd.sock")},
        stdout=asyncio.subprocess.DEVNULL,
    )
    assert await process.wait() == 0


async def by_stop_request(stack: Stack) -> None:
    assert (await stack.client.stop("test")).accepted


async def by_command(stack: Stack) -> None:
    assert (await stack.command("stop"))["accepted"]


async def by_all_stop_message(stack: Stack) -> None:
    await stack.ask_rig("can_frame", can_id=ISO_ALL_STOP_ID, data_hex="ffffffffffff01fc")


async def by_configured_message(stack: Stack) -> None:
    await stack.ask_rig("can_frame", can_id=STOP_PGN_ID, data_hex="00")


async def by_stop_input(stack: Stack) -> None:
    await stack.ask_rig("stop_loop", state="open")


WAYS: dict[str, Callable[[Stack], Awaitable[None]]] = {
    "stop request": by_stop_request,
    "command": by_command,
    "ISO 11783 message": by_all_stop_message,
    "configured message": by_configured_message,
    "stop input": by_stop_input,
    "command line": by_command_line,
}


async def stopped_in_motion(stack: Stack, phase: Phase, way: Callable[[Stack], Awaitable[None]]) -> dict[str, float]:
    """Stop in mid-motion; seconds from the call to what the wires and the axes did."""
    await come_to(stack, phase)
    asked_s = time.monotonic()
    await way(stack)
    took_s = time.monotonic() - asked_s
    return {"took_s": took_s, **await what_came_of(stack, asked_s)}


async def what_came_of(stack: Stack, asked_s: float) -> dict[str, float]:
    """Of a stop that was asked for at ``asked_s``: seconds until the servo had its last goal (``servo_s``), until each
    actuator that had leave to move had the message that took it back (``can_s``; infinite where one never had), until
    every axis stood (``still_s``), and how far the blade turned meanwhile (``way_deg``)."""
    await stack.rest()
    assert await stack.watch.until_still(EVERYTHING, 0.3, 4.0)
    state = stack.watch.newest().state
    last_s = asked_s
    for name in ("lift_left", "lift_right", "tilt"):
        allowed_s, forbidden_s = state[f"{name}_enabled_s"], state[f"{name}_disabled_s"]
        if allowed_s is not None:
            last_s = max(last_s, math.inf if forbidden_s is None or forbidden_s < allowed_s else forbidden_s)
    return {
        "servo_s": max(0.0, state["servo_goal_written_s"] - asked_s),
        "can_s": last_s - asked_s,
        "still_s": stack.watch.standstill_s(EVERYTHING, asked_s),
        "way_deg": abs(state["blade_deg"] - _blade_deg(stack, asked_s)),
    }


def _blade_deg(stack: Stack, at_s: float) -> float:
    """Where the blade was, between two samples."""
    after = next(n for n, sample in enumerate(stack.watch.samples) if sample.time_s >= at_s)
    first, second = stack.watch.samples[max(0, after - 1)], stack.watch.samples[after]
    share = (at_s - first.time_s) / max(1e-6, second.time_s - first.time_s)
    return float(first.state["blade_deg"] + share * (second.state["blade_deg"] - first.state["blade_deg"]))
