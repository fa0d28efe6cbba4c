"""What the readings say about the motion: stuck, pushed, running the wrong way, too hot, too little voltage.

Pure: fed with one sample per telemetry read, says which conditions hold now. Each has a time or a hysteresis, so that
one odd sample raises nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from graderd.hal.settings import Ph54Settings

_STILL_DEG_PER_S = 0.8
"""Below that the blade counts as standing."""
_MOVED_DEG = 0.2
"""Progress that shows that a blade is not stuck (the gear's play is 0.1 degree)."""
_WRONG_WAY_S = 0.15
_WRONG_WAY_DEG = 1.0
_SETTLE_S = 0.5
"""After the profile's own duration, so much more until the blade is expected to stand."""
_VOLTAGE_HYSTERESIS_V = 0.3
_TEMPERATURE_HYSTERESIS_C = 2.0
_AT_REST_S = 0.3
"""Standing for so long is rest; a turning point is not."""
_CALM_S = 1.0
"""A motion fault stays until nothing of it was seen for so long."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One telemetry read, at the blade. ``goal_deg`` is None while no motion is commanded."""

    time_s: float
    angle_deg: float
    velocity_deg_per_s: float
    current_a: float
    voltage_v: float
    temperature_c: float
    goal_deg: float | None


class MotionDetectors:
    """Watches one axis; :meth:`look` returns the conditions present with their detail."""

    def __init__(self, settings: Ph54Settings) -> None:
        self._settings = settings
        self.restart()

    def restart(self) -> None:
        """Forget everything: the device was lost, rebooted or armed anew."""
        self._goal_deg: float | None = None
        self._goal_since_s = 0.0
        self._move_s = 0.0
        self._progress_deg = 0.0
        self._progress_s = 0.0
        self._opposed_since_s: float | None = None
        self._opposed_from_deg = 0.0
        self._opposed_allowed_s = 0.0
        self._rest_deg: float | None = None
        self._rest_since_s = 0.0
        self._still_since_s = math.inf
        self._voltage_bad = False
        self._temperature_bad = False
        self._seen: dict[str, tuple[float, str]] = {}

    def look(self, s: Sample) -> dict[str, str]:
        """Conditions that hold with this sample: name to detail."""
        if math.isinf(self._still_since_s):
            self._still_since_s = s.time_s
        self._follow_goal(s)
        if s.goal_deg is not None:
            self._watch_stuck(s, s.goal_deg)
            self._watch_direction(s, s.goal_deg)
        self._watch_rest(s)
        self._watch_supply(s)
        for name, (seen_s, _) in list(self._seen.items()):
            if s.time_s - seen_s > _CALM_S:
                del self._seen[name]
        return {name: detail for name, (_, detail) in self._seen.items()}

    def _note(self, s: Sample, name: str, detail: str) -> None:
        self._seen[name] = (s.time_s, detail)

    def _follow_goal(self, s: Sample) -> None:
        if s.goal_deg == self._goal_deg:
            return
        moved = self._goal_deg is None or s.goal_deg is None or abs(s.goal_deg - self._goal_deg) > 0.05
        started = self._goal_deg is None
        self._goal_deg = s.goal_deg
        self._goal_since_s = s.time_s
        if s.goal_deg is not None:
            self._move_s = self._duration_s(abs(s.goal_deg - s.angle_deg), abs(s.velocity_deg_per_s))
        if moved:
            self._rest_deg = None
        if started:
            self._progress_deg, self._progress_s = s.angle_deg, s.time_s

    def _duration_s(self, way_deg: float, speed_deg_per_s: float) -> float:
        """How long the profile takes for a way, braking from a speed in the wrong direction first."""
        top, acceleration = self._settings.profile_velocity_deg_per_s, self._settings.profile_acceleration_deg_per_s2
        way_deg += speed_deg_per_s**2 / acceleration
        if way_deg < top**2 / acceleration:
            move_s = 2 * math.sqrt(way_deg / acceleration)
        else:
            move_s = way_deg / top + top / acceleration
        return move_s + speed_deg_per_s / acceleration

    def _watch_stuck(self, s: Sample, goal_deg: float) -> None:
        arrived = abs(goal_deg - s.angle_deg) <= self._settings.tolerance_deg
        st = self._settings
        progress_deg = min(_MOVED_DEG, 0.3 * st.profile_velocity_deg_per_s * st.not_moving_s)
        if arrived or abs(s.angle_deg - self._progress_deg) > progress_deg:
            self._progress_deg, self._progress_s = s.angle_deg, s.time_s
        stuck_s = s.time_s - self._progress_s
        if not arrived and stuck_s > st.not_moving_s:
            detail = f"{goal_deg - s.angle_deg:+.1f}° to go, no movement for {stuck_s:.1f} s at {s.current_a:.1f} A"
            self._note(s, "not_moving", detail)

    def _watch_direction(self, s: Sample, goal_deg: float) -> None:
        error_deg = goal_deg - s.angle_deg
        opposed = error_deg * s.velocity_deg_per_s < 0 and abs(s.velocity_deg_per_s) > _STILL_DEG_PER_S
        if not opposed or abs(error_deg) <= self._settings.tolerance_deg:
            self._opposed_since_s = None
            return
        if self._opposed_since_s is None:
            self._opposed_since_s, self._opposed_from_deg = s.time_s, s.angle_deg
            # A goal behind a moving blade is legal: it must be given the time to brake.
            stopping_s = abs(s.velocity_deg_per_s) / self._settings.profile_acceleration_deg_per_s2
            self._opposed_allowed_s = 1.2 * stopping_s + _WRONG_WAY_S
        lasted_s = s.time_s - self._opposed_since_s
        away_deg = abs(s.angle_deg - self._opposed_from_deg)
        # No permitted speed takes so far to brake: a runaway is not given the time that braking would take.
        st = self._settings
        most_deg = 1.5 * st.profile_velocity_deg_per_s**2 / (2.0 * st.profile_acceleration_deg_per_s2) + _WRONG_WAY_DEG
        if (lasted_s > self._opposed_allowed_s and away_deg > _WRONG_WAY_DEG) or away_deg > most_deg:
            detail = f"turning away from the goal for {lasted_s:.2f} s ({away_deg:.1f}°), {error_deg:+.1f}° to go"
            self._note(s, "wrong_way", detail)

    def _watch_rest(self, s: Sample) -> None:
        still_expected = s.goal_deg is None or s.time_s - self._goal_since_s > self._move_s + _SETTLE_S
        still = abs(s.velocity_deg_per_s) <= _STILL_DEG_PER_S
        if not still_expected:
            self._rest_deg, self._still_since_s = None, s.time_s
            return
        if self._rest_deg is None:
            # Where the blade came to rest; one that was still turning at the switch-over gets time to do so.
            if not still:
                self._still_since_s = s.time_s
            elif s.time_s - self._still_since_s >= _AT_REST_S:
                self._rest_deg, self._rest_since_s = s.angle_deg, s.time_s
            return
        moved_deg = s.angle_deg - self._rest_deg
        if abs(moved_deg) <= self._settings.tolerance_deg:
            return
        if not still:
            self._note(
                s, "moving_uncommanded", f"moved {moved_deg:+.1f}° at {s.velocity_deg_per_s:+.1f} °/s without a command"
            )
            self._rest_since_s = s.time_s
        elif s.goal_deg is None and s.time_s - self._rest_since_s > _SETTLE_S:
            self._rest_deg = s.angle_deg  # unpowered and pushed aside: it rests here now

    def _watch_supply(self, s: Sample) -> None:
        st = self._settings
        slack_v = _VOLTAGE_HYSTERESIS_V if self._voltage_bad else 0.0
        low, high = st.voltage_warn_low_v + slack_v, st.voltage_warn_high_v - slack_v
        self._voltage_bad = not low <= s.voltage_v <= high
        self._set(
            s,
            "voltage_near_limit",
            self._voltage_bad,
            f"{s.voltage_v:.1f} V, warning outside {st.voltage_warn_low_v:g}…{st.voltage_warn_high_v:g} V",
        )
        slack_c = _TEMPERATURE_HYSTERESIS_C if self._temperature_bad else 0.0
        self._temperature_bad = s.temperature_c >= st.temperature_warn_c - slack_c
        self._set(
            s,
            "temperature_near_limit",
            self._temperature_bad,
            f"{s.temperature_c:.0f} °C, warning from {st.temperature_warn_c:g} °C",
        )

    def _set(self, s: Sample, name: str, present: bool, detail: str) -> None:
        if present:
            self._note(s, name, detail)
        else:
            self._seen.pop(name, None)
