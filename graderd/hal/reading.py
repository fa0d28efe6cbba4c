"""A measured value that cannot be used without its age."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from graderd.hal.errors import StaleReadingError

T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Reading(Generic[T_co]):
    """``value`` as it was at ``time_s`` (monotonic seconds); ``valid`` is False where the source says so.

    There is no way to a number without saying how old it may be: use :meth:`fresh`.
    """

    value: T_co
    time_s: float
    valid: bool = True

    def age_s(self, now_s: float) -> float:
        """Seconds since the value was true; never negative."""
        return max(0.0, now_s - self.time_s)

    def is_fresh(self, now_s: float, max_age_s: float) -> bool:
        """Whether the value is valid and at most ``max_age_s`` old."""
        return self.valid and now_s - self.time_s <= max_age_s

    def age_if_fresh_s(self, now_s: float, max_age_s: float) -> float | None:
        """:meth:`age_s`, or None where the value is not fresh."""
        age_s = now_s - self.time_s
        return max(0.0, age_s) if self.valid and age_s <= max_age_s else None

    def fresh(self, now_s: float, max_age_s: float) -> T_co:
        """The value, if valid and at most ``max_age_s`` old.

        Raises:
            StaleReadingError: it is older, or was marked invalid by its source.
        """
        if not self.valid:
            raise StaleReadingError("the source marked this reading invalid")
        if self.age_s(now_s) > max_age_s:
            raise StaleReadingError(f"reading is {self.age_s(now_s):.3f} s old, at most {max_age_s:.3f} s is accepted")
        return self.value
