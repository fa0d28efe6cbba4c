"""Every way by which a stop may come, and what it does to a machine in motion."""

from __future__ import annotations

import asyncio
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
    await stack.rest()
    assert await stack.watch.until_still(EVERYTHING, 0.3, 4.0)
    state = stack.watch.newest().state
    latest_enabled_s = max(state[f"{name}_enabled_s"] or 0.0 for name in ("lift_left", "lift_right", "tilt"))
    return {
        "took_s": took_s,
        "servo_s": state["servo_goal_written_s"] - asked_s,
        "can_s": max(0.0, latest_enabled_s - asked_s),
        "still_s": stack.watch.standstill_s(EVERYTHING, asked_s),
    }
