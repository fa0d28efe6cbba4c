"""The one command that waits for the wire: the newest goal, or a hold, which goes first and cancels goals."""

from __future__ import annotations

import math

from drivers.dynamixel import arming
from drivers.dynamixel.calibration import Calibration
from drivers.dynamixel.device import Ph54Device
from graderd.hal.settings import RotatorSettings


class CommandSlot:
    """What was commanded and what of it the servo has taken.

    ``goal_deg``: the goal in force, None while holding. ``hold_wanted``: a hold that has not gone out yet.
    """

    def __init__(self, settings: RotatorSettings, calibration: Calibration) -> None:
        self.goal_deg: float | None = None
        self.hold_wanted = False
        self._goal_s = -math.inf
        self._settings = settings
        self._calibration = calibration
        self._sent_counts: int | None = None
        self._braking = False

    def goal(self, goal_deg: float, now_s: float) -> None:
        """The newest goal wins, also over a hold that has not gone out yet."""
        self.goal_deg, self._goal_s, self.hold_wanted = goal_deg, now_s, False

    def hold(self) -> None:
        """Hold with the next packet; nothing to do where the last thing sent was a hold."""
        if self.goal_deg is None and self._braking and not self.hold_wanted:
            return
        self.goal_deg, self.hold_wanted = None, True

    def forget(self, sent_counts: int | None = None) -> None:
        """No command in force; ``sent_counts``: the goal that arming has left on the servo."""
        self.goal_deg, self.hold_wanted, self._braking = None, False, False
        self._sent_counts = sent_counts

    def expired(self, now_s: float) -> bool:
        """Whether the goal was not renewed in time."""
        return self.goal_deg is not None and now_s - self._goal_s > self._settings.goal_timeout_s

    async def send_hold(self, device: Ph54Device, measured_deg: float) -> int:
        """Goal := measured with a harder profile, in one packet. Returns the counts sent."""
        low, high = self._calibration.servo_limits()
        counts = max(low, min(high, self._calibration.counts(measured_deg)))  # beyond them the servo would refuse
        profile = arming.profile_counts(self._settings, self._calibration, arming.HOLD_ACCELERATION_FACTOR)
        await device.write_block(device.profile_block, {**profile, "goal_position": counts}, attempts_n=1, urgent=True)
        self._braking, self.hold_wanted, self._sent_counts = True, False, counts
        return counts

    async def send_goal(self, device: Ph54Device) -> int | None:
        """The goal, where the servo has not got it yet. Returns the counts sent, None where nothing was to send."""
        if self.goal_deg is None:
            return None
        counts = self._calibration.counts(self.goal_deg)
        if self._braking:
            profile = arming.profile_counts(self._settings, self._calibration)
            await device.write_block(device.profile_block, {**profile, "goal_position": counts}, attempts_n=1)
            self._braking = False
        elif counts != self._sent_counts:
            await device.write("goal_position", counts, attempts_n=1)
        else:
            return None
        self._sent_counts = counts
        return counts
