"""What a telemetry block says about the servo's motion: whether it can be true, and where a hold brings it to rest.

Degrees of the servo's output in the frame of its own registers, so that nothing here depends on zero, sign or turns:
a hold that were told in another frame than the servo's would drive it there. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_SLACK_DEG = 0.3
_STAMP_S = 0.02
"""When within its exchange a reading was taken is known this well."""
_HULL_S = 0.1
"""Between readings further apart the speed may have been anything: the older one vouches for nothing."""
_STILL_DEG_PER_S = 0.6
STANDS_DEG, PUSHES_DEG = 2.0, 1.5
"""Of the blade: a set point so far ahead of one that stands is led back to so little: enough to push and to be told as
not moving, too little to leap when it comes free. One that is followed runs ahead too, but of a blade in motion."""


@dataclass(frozen=True, slots=True)
class ServoMotion:
    """One reading. ``setpoint_*``: the servo's own trajectory, which its profile moves and its loop follows."""

    time_s: float
    position_deg: float
    velocity_deg_per_s: float
    setpoint_deg: float
    setpoint_deg_per_s: float


def possible(before: ServoMotion, after: ServoMotion, top_deg_per_s: float) -> bool:
    """Whether a servo that was there can be here: it went a way between its two speeds times the time."""
    took_s = max(0.0, after.time_s - before.time_s)
    if took_s > _HULL_S:
        return False
    speeds = [max(-top_deg_per_s, min(top_deg_per_s, m.velocity_deg_per_s)) for m in (before, after)]
    slack_deg = _SLACK_DEG + _STAMP_S * max(abs(v) for v in speeds)
    way_deg = after.position_deg - before.position_deg
    return min(speeds) * took_s - slack_deg <= way_deg <= max(speeds) * took_s + slack_deg


@dataclass(frozen=True, slots=True)
class MoveProfile:
    """How the servo goes to a goal: its profile's velocity and acceleration, of its output."""

    deg_per_s: float
    deg_per_s2: float

    def speeds_up(self, deg_per_s: float, age_s: float) -> tuple[float, float]:
        """The way made in that time towards a goal ahead, and the speed then; what an older reading does not vouch for
        is not made up."""
        gain_s = min(age_s, _HULL_S, max(0.0, self.deg_per_s - deg_per_s) / self.deg_per_s2)
        faster = deg_per_s + self.deg_per_s2 * gain_s
        return 0.5 * (deg_per_s + faster) * gain_s + faster * (age_s - gain_s), faster

    def slows_down(self, deg_per_s: float, age_s: float) -> tuple[float, float]:
        """The way made in that time on the way back to a goal behind, at most to where it turns, and the speed then."""
        loss_s = min(age_s, max(0.0, deg_per_s) / self.deg_per_s2)
        slower = deg_per_s - self.deg_per_s2 * loss_s
        return 0.5 * (deg_per_s + slower) * loss_s, slower


def rest_deg(
    motion: ServoMotion,
    now_s: float,
    braking_deg_per_s2: float,
    goal_deg: float | None,
    move: MoveProfile,
    former_deg: float | None = None,
) -> float:
    """The goal that brings the servo to rest soonest without turning back: measured + v·age + the way to brake.

    The servo's set point may run ahead of what is measured: then its way to rest counts, or it would turn back.
    ``goal_deg``: the goal the servo has, or may have; a hold never goes beyond one that lies ahead. On its way there it
    has changed its speed since the reading, as ``move`` lets it. ``former_deg``: of a hold that may not have been
    taken; it is never pulled back from.
    """
    age_s, speed = max(0.0, now_s - motion.time_s), motion.velocity_deg_per_s
    if abs(speed) < _STILL_DEG_PER_S:
        if former_deg is not None and abs(former_deg - motion.position_deg) < 1.0:
            return former_deg
        return motion.position_deg
    ahead = math.copysign(1.0, speed)  # from here on lengths count forward

    goal_ahead = goal_deg is not None and ahead * goal_deg >= ahead * motion.position_deg

    def rests(position_deg: float, deg_per_s: float) -> float:
        forward = ahead * deg_per_s
        if goal_deg is None:
            way_deg, then = forward * age_s, forward
        else:
            way_deg, then = (move.speeds_up if goal_ahead else move.slows_down)(forward, age_s)
        return ahead * position_deg + way_deg + then * abs(then) / (2.0 * braking_deg_per_s2)

    far = rests(motion.position_deg, speed)
    if ahead * motion.setpoint_deg_per_s > 0.0:
        far = max(far, rests(motion.setpoint_deg, motion.setpoint_deg_per_s))
    if goal_ahead and goal_deg is not None:
        far = min(far, ahead * goal_deg)
    if former_deg is not None:
        far = max(far, ahead * former_deg)
    return ahead * far


def led_back_deg(motion: ServoMotion, goal_deg: float, share: float, *, was_led_back: bool) -> float | None:
    """The goal of a servo that stands while its own set point runs away from it; None: it follows, or has come so far.

    ``share``: degrees of the servo for one of the blade. ``was_led_back``: until it moves again.
    """
    lag = motion.setpoint_deg - motion.position_deg
    away = goal_deg - motion.position_deg
    if abs(motion.velocity_deg_per_s) >= _STILL_DEG_PER_S or abs(away) <= PUSHES_DEG * share:
        return None
    if not was_led_back and (abs(lag) <= STANDS_DEG * share or lag * away < 0.0):
        return None
    return motion.position_deg + math.copysign(PUSHES_DEG * share, away)
