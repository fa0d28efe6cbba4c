"""A maneuver of the daemon itself (step response, calibration): an operator like any other, through machine and gate.

It arms, moves by jogs whose lease it renews, and disarms on the way out whatever happened. Stop, faults and every
limit act on it as on anybody.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import TracebackType
from typing import Self

from graderd.core import commands as cmd
from graderd.core.machine import Mode, lapse_of
from graderd.hal.errors import DeviceLostError, DeviceRefusedError
from graderd.runtime.control import ControlLoop

CLIENT = "maneuver"
SAMPLE_S = 0.02
RENEW_S = 0.1


class Maneuver:
    """``async with Maneuver(loop) as blade: await blade.rotate_to(...)``. The caller has a person's consent."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop

    async def __aenter__(self) -> Self:
        """Arm.

        Raises:
            DeviceRefusedError: not ready, or arming failed; the message says why.
        """
        try:
            await self._obey(cmd.Arm(client=CLIENT))
            await self._armed()
        except asyncio.CancelledError:  # the client that asked is gone: nobody else would disarm what it armed
            await self._loop.command(cmd.Disarm(client=CLIENT))
            raise
        return self

    async def _armed(self) -> None:
        """Wait for as long as the machine does: it alone gives up (``machine.arm_timeout_s``), and then arms nothing.
        Who gave up before it would leave behind a machine that becomes armed, with nobody there."""
        while True:
            state = self._loop.tick.state
            self._check_ours()
            if state.arming_since_s is None:
                break
            await asyncio.sleep(SAMPLE_S)
        if state.mode is Mode.AUTO:  # somebody asked for it meanwhile: not with what was armed for this
            await self._loop.command(cmd.Disarm(client=CLIENT))
        if state.mode is not Mode.MANUAL:
            raise DeviceRefusedError("arm", state.reason)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._loop.armed_by == CLIENT:
            await self._loop.command(cmd.Disarm(client=CLIENT))

    async def rotate_to(self, angle_deg: float, dwell_s: float, each: Callable[[], None] | None = None) -> None:
        """Go to ``angle_deg`` and stay until ``dwell_s`` after the start; ``each`` is called every 20 ms.

        Raises:
            DeviceRefusedError: beyond a limit, or another client is moving the blade.
            DeviceLostError: the machine left manual mode (stop, fault) under way, or the rotation was held.
        """
        self._check_manual()
        await self._jog(angle_deg)
        clock = asyncio.get_running_loop().time
        end_s = clock() + dwell_s
        renew_s = clock() + RENEW_S
        while clock() < end_s:
            self._check_manual()
            if clock() >= renew_s:
                renew_s = clock() + RENEW_S
                if not (await self._loop.command(cmd.Renew(client=CLIENT))).accepted:
                    self._check_lapsed()
                    # A late renewal on a loaded machine: the blade held meanwhile; ask again.
                    await self._jog(angle_deg)
            if each is not None:
                each()
            await asyncio.sleep(SAMPLE_S)

    async def _obey(self, command: cmd.Command) -> None:
        reply = await self._loop.command(command)
        if not reply.accepted:
            raise DeviceRefusedError(reply.command, reply.message, reply.remedy)

    async def _jog(self, angle_deg: float) -> None:
        try:
            await self._obey(cmd.Jog(axis="rotate", value=angle_deg, client=CLIENT))
        except DeviceRefusedError:
            self._check_manual()  # a stop between two commands is why the second one is refused: tell the stop
            raise

    def _check_lapsed(self) -> None:
        """What ended otherwise than by our own lateness (a fault held the rotation) does not go on by itself."""
        state = self._loop.tick.state
        if state.reason != lapse_of(CLIENT):
            raise DeviceLostError("maneuver", f"ended under way: {state.reason}")

    def _check_ours(self) -> None:
        """What somebody stopped or disarmed, and another armed again, is that one's machine: nothing goes on there."""
        if (armed_by := self._loop.armed_by) != CLIENT:
            raise DeviceLostError("maneuver", f"ended under way: {armed_by or 'somebody'} has armed the machine since")

    def _check_manual(self) -> None:
        self._check_ours()
        state = self._loop.tick.state
        if state.mode is not Mode.MANUAL:
            raise DeviceLostError("maneuver", f"ended under way: {state.reason}")
