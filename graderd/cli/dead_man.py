"""A dead man out of a terminal's key-repeat. Pure: times come in with the keys.

A terminal says when a key goes down and repeats it while it is held; it does not say when it is let go. So a key
counts as held once it has repeated a few times running as a keyboard does, quicker than a finger taps (a tap moves
nothing, two taps neither) and no quicker than keyboards are, and for as long as the next one keeps coming in time:
three of the shortest gaps seen, and never longer than 0.25 s, which is shorter than the daemon's lease. Repeats that
come faster than any keyboard sends them are what a frozen connection hands over when it thaws: they are old, and hold
nothing; a gap among them that a busy computer made does not either.
"""

from __future__ import annotations

from typing import Final

MOST_S: Final = 0.25
"""A gap this long is a key that was let go."""
REPEAT_S: Final = 0.12
"""The slowest key-repeat that begins to hold: eight a second. Fingers do not tap so fast."""
LEAST_S: Final = 0.1
"""Shorter pauses are a busy computer's or network's."""
GAPS_N: Final = 3
REPEATS_N: Final = 3
"""So many repeats running begin to hold."""
FASTEST_S: Final = 0.008
"""No keyboard repeats faster; X11 and Windows do 0.03 s, the Linux console 0.033 s."""


class HeldKey:
    """Which key is held. ``now_s`` and ``at_s`` are monotonic."""

    def __init__(self) -> None:
        self.key: str | None = None
        self._last_s = 0.0
        self._shortest_s = MOST_S
        self._repeats_n = 0
        self._held = False

    def press(self, key: str, at_s: float) -> None:
        """The terminal told of a key; another than the one before begins anew, and ends what that one held."""
        gap_s = at_s - self._last_s
        if key != self.key or gap_s > (MOST_S if self._held else REPEAT_S):
            self.key, self._last_s, self._held, self._shortest_s, self._repeats_n = key, at_s, False, MOST_S, 0
        elif gap_s >= FASTEST_S:
            self._shortest_s = min(self._shortest_s, gap_s)
            self._last_s, self._repeats_n = at_s, self._repeats_n + 1
            self._held = self._held or self._repeats_n >= REPEATS_N
        elif not self._held:
            self._last_s, self._repeats_n = at_s, 0

    def release(self) -> None:
        """Whatever is held is let go; it is held again only by repeats that come from now on."""
        self.key, self._held = None, False

    @property
    def allowed_s(self) -> float:
        """So long after its last repeat the key still counts as held."""
        return min(MOST_S, max(LEAST_S, GAPS_N * self._shortest_s))

    def held(self, now_s: float) -> str | None:
        """The key that is held now."""
        if self._held and now_s - self._last_s > self.allowed_s:
            self.release()
        return self.key if self._held else None
