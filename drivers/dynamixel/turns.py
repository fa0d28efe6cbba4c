"""Who may use the wire now, and how long an answer may take: the two rules of one request in flight."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Final

_ALLOWANCE_MIN_S: Final = 0.020
_ALLOWANCE_START_S: Final = 0.060
_ALLOWANCE_MAX_S: Final = 0.100
"""Bounds of what a reply may take beyond wire time: scheduling at the low end, a bad USB adapter at the high one."""


class Turns:
    """One at a time; the others wait in order, urgent ones ahead of them. ``taken``: whether it is somebody's turn."""

    def __init__(self) -> None:
        self.taken = False
        self._queue: deque[asyncio.Future[None]] = deque()

    async def take(self, urgent: bool) -> None:
        """Wait for the turn; every turn taken is given back with :meth:`give_back`."""
        if not self.taken:
            self.taken = True
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        if urgent:
            self._queue.appendleft(turn)
        else:
            self._queue.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.give_back()
            raise

    def give_back(self) -> None:
        """End a turn; the next one's begins at once."""
        while self._queue:
            turn = self._queue.popleft()
            if not turn.done():
                turn.set_result(None)  # the line stays taken: it goes over to the next one
                return
        self.taken = False


class Allowance:
    """What a reply may take beyond its time on the wire, learned from what replies took (RFC 6298).

    ``now_s`` is the present allowance: smoothed mean plus four times the smoothed spread, within bounds.
    """

    def __init__(self) -> None:
        self.now_s = _ALLOWANCE_START_S
        self._smooth_s = 0.0
        self._spread_s = 0.0

    def learn(self, extra_s: float) -> None:
        """A reply took so much longer than the wire needs."""
        self._spread_s += 0.25 * (abs(extra_s - self._smooth_s) - self._spread_s)
        self._smooth_s += 0.125 * (extra_s - self._smooth_s)
        wanted_s = self._smooth_s + 4 * self._spread_s + 0.25 * _ALLOWANCE_MIN_S
        self.now_s = min(_ALLOWANCE_MAX_S, max(_ALLOWANCE_MIN_S, wanted_s))

    def widen(self) -> None:
        """No reply came in time."""
        self.now_s = min(_ALLOWANCE_MAX_S, self.now_s * 1.5)
