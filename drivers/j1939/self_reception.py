"""Our own frames that an adapter hands back to us (self-reception): no other node, and no conflict of addresses.

An adapter hands back every frame, in the order in which they were sent, or none. So the first frame after the bus was
opened decides; one that does not come back ends the belief, until many in a row have come. A second controller that
sends what we send is therefore told from an echo, unless it opens the bus in the same quarter of a second.
"""

from __future__ import annotations

import collections
from typing import Final

from graderd.drivers.j1939.ids import Frame

_BACK_WITHIN_S: Final = 0.25
_PROOF_N: Final = 64
"""Frames that must come back in a row, about two seconds of traffic, before one that did not is forgotten."""
_WAITING_MAX_N: Final = 512


class SelfReception:
    """Tells an echo from another node's frame. One object for each opening of the bus."""

    def __init__(self) -> None:
        self._waiting: collections.deque[tuple[Frame, float]] = collections.deque(maxlen=_WAITING_MAX_N)
        self._returned_n = 0
        self._needed_n = 1

    def on_sent(self, frame: Frame, now_s: float) -> None:
        """A frame left."""
        self._waiting.append((frame, now_s))

    def is_echo(self, frame: Frame, now_s: float) -> bool:
        """Whether a frame that came is one of ours, come back."""
        while self._waiting and now_s - self._waiting[0][1] > _BACK_WITHIN_S:
            self._waiting.popleft()
            self._returned_n, self._needed_n = 0, _PROOF_N
        if not self._waiting or self._waiting[0][0] != frame:
            return False
        self._waiting.popleft()
        self._returned_n += 1
        return self._returned_n >= self._needed_n
