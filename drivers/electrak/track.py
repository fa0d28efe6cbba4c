"""What an actuator's feedback says of it: the newest message, the speed it moves with, how far it can be trusted."""

from __future__ import annotations

import collections
import math
from typing import Final

from drivers.electrak.codec import Feedback
from drivers.electrak.planner import Motion
from drivers.electrak.profile import Figures

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
