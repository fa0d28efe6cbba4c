"""What is wrong with one actuator, found in its feedback: detectors that only name conditions. Pure."""

from __future__ import annotations

import collections
import math
from dataclasses import replace
from typing import Final

from graderd.drivers.electrak.codec import Feedback
from graderd.drivers.electrak.planner import Motion
from graderd.drivers.electrak.profile import Figures
from graderd.hal.fault import DeviceFault

NOT_MOVING_S: Final = 0.7
_NOT_MOVING_MM: Final = 0.5
_UNCOMMANDED_MM: Final = 2.0
_UNCOMMANDED_STILL_S: Final = 0.4
"""A braked motor is at rest well within this time; feedback of before the stop arrives within it too."""
_WRONG_WAY_MM: Final = 4.0
_JUMP_MARGIN_MM: Final = 3.0
_BAD_N: Final = 3
_BAD_WINDOW_S: Final = 1.0
_FLOOD_FACTOR: Final = 1.7
_RATE_N: Final = 20
_SHOWN_S: Final = 1.0
"""An event counts as present for so long, that nobody who looks now and then misses it."""

LATCHING: Final = frozenset({"overload", "fatal", "restarted", "uncommanded_motion", "not_moving"})
"""Conditions that stay until the axis is armed again."""
FAILING: Final = frozenset({"no_feedback", "wrong_address", "feedback_flood", "implausible_feedback"})
"""Conditions under which nothing is known about the axis: it has failed until they are gone."""
DISARMING: Final = LATCHING | FAILING
"""Conditions that end motion and take the axis out of the active state."""
INFORMATIVE: Final = frozenset({"saturation", "thermal_derating", "voltage", "temperature", "backdrive"})
"""Conditions with which an axis may be armed; the fault catalogue decides what the machine does about them."""

_FLAG_TEXT: Final = {
    "parameter": "the actuator refuses a control message: a field is out of its range (a defect of graderd's profile)",
    "saturation": "running within 10 % of its capability",
    "backdrive": "the actuator reports that its load moves it",
    "fatal": "the actuator reports a fatal error and needs service",
}


class FaultMemory:
    """Conditions present, each with the time it began."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._present: dict[str, DeviceFault] = {}
        self._seen_s: dict[str, float] = {}

    def set(self, condition: str, detail: str, now_s: float) -> None:
        """The condition is present (a later detail does not replace that of a latched one)."""
        former = self._present.get(condition)
        self._seen_s[condition] = now_s
        if former is not None and condition in LATCHING:
            return
        since_s = former.since_s if former else now_s
        self._present[condition] = DeviceFault(self._device, condition, detail, since_s)

    def clear(self, *conditions: str) -> None:
        """The conditions are gone."""
        for condition in conditions:
            self._present.pop(condition, None)

    def keep(self, condition: str, present: bool, detail: str, now_s: float) -> None:
        """Set or clear by a truth value."""
        if present:
            self.set(condition, detail, now_s)
        else:
            self.clear(condition)

    def all(self, now_s: float, standing: frozenset[str] = frozenset()) -> tuple[DeviceFault, ...]:
        """Everything present; a latching condition counts as latched when it was not seen for a second.

        ``standing``: conditions that the actuator reports by a flag now, which are there however long ago they began.
        """
        return tuple(
            replace(fault, latched=self._is_latched(fault.condition, now_s, standing))
            for fault in self._present.values()
        )

    def _is_latched(self, condition: str, now_s: float, standing: frozenset[str]) -> bool:
        if condition not in LATCHING or condition in standing:
            return False
        return now_s - self._seen_s[condition] > _SHOWN_S

    def names(self) -> frozenset[str]:
        """Names of everything present."""
        return frozenset(self._present)


class FeedbackMonitor:
    """Watches the feedback of one actuator against what it was told."""

    def __init__(self, figures: Figures, address: int, faults: FaultMemory) -> None:
        self._figures = figures
        self._address = address
        self._faults = faults
        self._bad_s: collections.deque[float] = collections.deque(maxlen=_BAD_N)
        self._times_s: collections.deque[float] = collections.deque(maxlen=_RATE_N)
        self._last: tuple[float, float] | None = None
        self._enabled_since_s: float | None = None
        self._disabled_since_s = 0.0
        self._reference_mm: float | None = None
        self._wrong_way_from_mm: float | None = None
        self._progress: tuple[float, float] | None = None
        self.bad_n = 0

    def reset(self, now_s: float) -> None:
        """Begin anew (arming, a restart, feedback after a gap)."""
        self._last = None
        self._reference_mm = self._wrong_way_from_mm = None
        self._progress = None
        self._enabled_since_s = None
        self._disabled_since_s = now_s
        self._bad_s.clear()
        self._times_s.clear()

    def on_sent(self, enabled: bool, direction: int, now_s: float) -> None:
        """A control message left."""
        if enabled:
            self._enabled_since_s = now_s if self._enabled_since_s is None else self._enabled_since_s
            self._reference_mm = None
        else:
            if self._enabled_since_s is not None:
                self._disabled_since_s = now_s
            self._enabled_since_s = None
            self._progress = None
        if not direction:
            self._wrong_way_from_mm = None

    def on_garbage(self, detail: str, now_s: float) -> None:
        """A feedback message that cannot be true."""
        self.bad_n += 1
        self._bad_s.append(now_s)
        if len(self._bad_s) == _BAD_N and now_s - self._bad_s[0] < _BAD_WINDOW_S:
            self._faults.set(
                "implausible_feedback", f"{_BAD_N} bad messages within a second, the last: {detail}", now_s
            )

    def on_feedback(self, feedback: Feedback, direction: int, remaining_mm: float, now_s: float) -> bool:
        """Judge one message; False where it cannot be true and must not be used.

        ``direction`` and ``remaining_mm``: what the axis was told, 0 where motion is disabled.
        """
        if not self._plausible(feedback.position_mm, now_s):
            return False
        self._rate(now_s)
        self._flags(feedback, now_s)
        if self._enabled_since_s is None:
            self._uncommanded(feedback, now_s)
        else:
            self._commanded(feedback, direction, remaining_mm, now_s)
        return True

    def _plausible(self, position_mm: float, now_s: float) -> bool:
        last, figures = self._last, self._figures
        if position_mm > figures.stroke_mm + _JUMP_MARGIN_MM:
            self.on_garbage(f"position {position_mm:.1f} mm is beyond the stroke of {figures.stroke_mm:.0f} mm", now_s)
            return False
        self._last = (position_mm, now_s)
        if last is not None:
            moved_mm, elapsed_s = abs(position_mm - last[0]), now_s - last[1]
            # feedback may bunch up on the way: judge against at least one period
            possible_mm = 1.5 * figures.speed_no_load_mm_per_s * max(elapsed_s, figures.afm_period_s) + _JUMP_MARGIN_MM
            if moved_mm > possible_mm:
                self.on_garbage(f"position jumped by {moved_mm:.1f} mm in {elapsed_s:.2f} s", now_s)
                return False
        return True

    def _rate(self, now_s: float) -> None:
        times_s = self._times_s
        times_s.append(now_s)
        if len(times_s) < _RATE_N:
            return
        rate_hz = (len(times_s) - 1) / max(1e-3, times_s[-1] - times_s[0])
        expected_hz = 1.0 / self._figures.afm_period_s
        detail = (
            f"{rate_hz:.0f} feedback messages a second from address {self._address}, {expected_hz:.0f} are due: "
            "two actuators share the address (wire the address-select pins), or one babbles"
        )
        self._faults.keep("feedback_flood", rate_hz > _FLOOD_FACTOR * expected_hz, detail, now_s)

    def _flags(self, feedback: Feedback, now_s: float) -> None:
        flags = feedback.flags
        for flag, text in _FLAG_TEXT.items():
            if flag in flags:
                self._faults.set(flag, text, now_s)
            elif flag not in LATCHING:
                self._faults.clear(flag)
        for quantity, unit in (("voltage", "supply voltage"), ("temperature", "temperature")):
            side = "low" if f"{quantity}_low" in flags else "high" if f"{quantity}_high" in flags else ""
            detail = f"{unit} too {side}: the actuator finishes a move and begins no new one"
            self._faults.keep(quantity, bool(side), detail, now_s)

    def _uncommanded(self, feedback: Feedback, now_s: float) -> None:
        position_mm = feedback.position_mm
        if now_s - self._disabled_since_s < _UNCOMMANDED_STILL_S or self._reference_mm is None:
            self._reference_mm = position_mm
        moved_mm = position_mm - self._reference_mm
        if abs(moved_mm) > _UNCOMMANDED_MM:
            who = "by its own motor: manual override?" if feedback.duty_percent > 0 else "by its load or by hand"
            self._faults.set("uncommanded_motion", f"moved {moved_mm:+.1f} mm with motion disabled, {who}", now_s)
            self._reference_mm = position_mm

    def _commanded(self, feedback: Feedback, direction: int, remaining_mm: float, now_s: float) -> None:
        position_mm = feedback.position_mm
        far = remaining_mm > self._figures.restart_zone_mm + 1.0
        if self._progress is None or abs(position_mm - self._progress[0]) > _NOT_MOVING_MM or not far:
            self._progress = (position_mm, now_s)
        elif now_s - self._progress[1] > NOT_MOVING_S:
            detail = f"{remaining_mm:.1f} mm to go and no movement for {now_s - self._progress[1]:.1f} s"
            self._faults.set("not_moving", detail, now_s)
        if not direction:
            return
        start_mm = self._wrong_way_from_mm
        if start_mm is None or (position_mm - start_mm) * direction > 0:
            self._wrong_way_from_mm = position_mm
        elif (start_mm - position_mm) * direction > _WRONG_WAY_MM:
            detail = f"moved {abs(position_mm - start_mm):.1f} mm against the commanded direction"
            self._faults.set("uncommanded_motion", detail, now_s)


RECOVERY_N: Final = 3
"""Feedback messages in a row after which a lost actuator is back."""
TRUST_N: Final = 10
"""Plausible messages in a row after which feedback is believed again."""
_VELOCITY_N: Final = 3


class FeedbackTrack:
    """The newest feedback of one actuator and what follows from the last few.

    ``good_n``: plausible messages in a row; ``feedback_at_s``: when the newest of them came.
    """

    def __init__(self, figures: Figures) -> None:
        self._figures = figures
        self._points: collections.deque[tuple[float, float]] = collections.deque(maxlen=_VELOCITY_N)
        self.forget()

    def forget(self) -> None:
        """Nothing is known."""
        self.feedback: Feedback | None = None
        self.feedback_at_s = -math.inf
        self.velocity_mm_per_s = 0.0
        self.begin_anew()

    def begin_anew(self) -> None:
        """There was a gap: what comes now is not the continuation of what was before."""
        self._points.clear()
        self.good_n = 0

    def take(self, feedback: Feedback, now_s: float) -> None:
        """A plausible message came."""
        self.feedback, self.feedback_at_s = feedback, now_s
        self.good_n += 1
        self._points.append((now_s, feedback.position_mm))
        if not feedback.moving and feedback.duty_percent == 0:
            self.velocity_mm_per_s = 0.0
            return
        first_s, first_mm = self._points[0]
        if now_s - first_s > 0.5 * self._figures.afm_period_s:
            fastest = 1.1 * self._figures.speed_no_load_mm_per_s
            velocity = (feedback.position_mm - first_mm) / (now_s - first_s)
            self.velocity_mm_per_s = min(max(velocity, -fastest), fastest)

    @property
    def flags(self) -> frozenset[str]:
        """The flags that the newest message sets."""
        return self.feedback.flags if self.feedback else frozenset()

    def age_s(self, now_s: float) -> float:
        """Age of the newest message; infinite where none came."""
        return now_s - self.feedback_at_s

    def motion(self, now_s: float) -> Motion:
        """What the planner needs of it."""
        feedback = self.feedback
        if feedback is None:
            return Motion(0.0, 0.0, moving=False, age_s=0.0)
        return Motion(feedback.position_mm, self.velocity_mm_per_s, feedback.moving, max(0.0, self.age_s(now_s)))
