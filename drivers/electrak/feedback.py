"""The feedback of one actuator: whether it can be believed, which faults it reports, and what follows from it. Pure.

How the axis moves is judged where it is for every axis, in ``graderd.core.plausibility``.
"""

from __future__ import annotations

import collections
import math
from typing import Final

from graderd.drivers.electrak.codec import Feedback
from graderd.drivers.electrak.planner import Motion
from graderd.drivers.electrak.profile import Figures
from graderd.hal.fault import PresentFaults

_JUMP_MARGIN_MM: Final = 3.0
_BAD_N: Final = 3
_BAD_WINDOW_S: Final = 1.0
_FLOOD_FACTOR: Final = 1.7
_RATE_N: Final = 20
FAILING: Final = frozenset({"no_feedback", "wrong_address", "feedback_flood", "implausible_feedback"})
"""Conditions under which nothing is known about the axis: it has failed until they are gone."""
TRIPPING: Final = frozenset({"overload", "fatal", "restarted"})
"""Conditions after which the actuator is not as arming left it. They end motion; the next arming takes them as read."""
INFORMATIVE: Final = frozenset({"saturation", "thermal_derating", "voltage", "temperature", "backdrive"})
"""Conditions with which an axis may be armed; the fault catalogue decides what the machine does about them."""

_FLAG_TEXT: Final = {
    "parameter": "the actuator refuses a control message: a field is out of its range (a defect of graderd's profile)",
    "saturation": "running within 10 % of its capability",
    "backdrive": "the actuator reports that its load moves it",
    "fatal": "the actuator reports a fatal error and needs service",
}


class FeedbackMonitor:
    """Judges the feedback messages of one actuator, one by one."""

    def __init__(self, figures: Figures, address: int, faults: PresentFaults) -> None:
        self._figures = figures
        self._address = address
        self._faults = faults
        self._bad_s: collections.deque[float] = collections.deque(maxlen=_BAD_N)
        self._times_s: collections.deque[float] = collections.deque(maxlen=_RATE_N)
        self._last: tuple[float, float] | None = None
        self.bad_n = 0

    def reset(self) -> None:
        """Begin anew (arming, a restart, feedback after a gap)."""
        self._last = None
        self._bad_s.clear()
        self._times_s.clear()

    def on_garbage(self, detail: str, now_s: float) -> None:
        """A feedback message that cannot be true."""
        self.bad_n += 1
        self._bad_s.append(now_s)
        if len(self._bad_s) == _BAD_N and now_s - self._bad_s[0] < _BAD_WINDOW_S:
            self._faults.set(
                "implausible_feedback", f"{_BAD_N} bad messages within a second, the last: {detail}", now_s
            )

    def on_feedback(self, feedback: Feedback, now_s: float) -> bool:
        """Judge one message; False where it cannot be true and must not be used."""
        if not self._plausible(feedback.position_mm, now_s):
            return False
        self._rate(now_s)
        self._flags(feedback, now_s)
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
            if flag in TRIPPING and flag in flags:
                self._faults.tell(flag, text, now_s)
            elif flag not in TRIPPING:
                self._faults.keep(flag, flag in flags, text, now_s)
        for quantity, unit in (("voltage", "supply voltage"), ("temperature", "temperature")):
            side = "low" if f"{quantity}_low" in flags else "high" if f"{quantity}_high" in flags else ""
            detail = f"{unit} too {side}: the actuator finishes a move and begins no new one"
            self._faults.keep(quantity, bool(side), detail, now_s)


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
