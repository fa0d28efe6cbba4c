"""Badly behaved neighbours for the virtual bus: a node that fights for an address, and one that floods."""

from __future__ import annotations

import random
from typing import Final

from graderd.drivers.j1939.ids import GLOBAL, NULL, Frame, Pgn, make_id, pgn_of, source_of

_FLOOD_MAX_N: Final = 200
_ASK_FOR_CLAIMS: Final = Pgn.ADDRESS_CLAIMED.to_bytes(3, "little")
LOWEST_PRIORITY_NAME: Final = (1 << 64) - 1


class RivalController:
    """A second controller that wants an address and answers every claim for it at once, without any limit.

    ``name`` is its NAME; None copies the NAME of whoever claims, so that arbitration cannot end (two controllers
    with equal NAMEs); such a one first asks who is there, as every node does that joins. ``claims_hz`` claims without
    being asked as well (a claim storm).
    """

    def __init__(self, address: int, name: int | None = None, claims_hz: float = 0.0) -> None:
        self.address = address
        self._name = name
        self._claims_hz = claims_hz
        self._due_s = 0.0
        self._joined = False
        self.heard_n = 0
        """Claims of others for this address."""
        self.sent_n = 0

    def on_frame(self, frame: Frame) -> list[Frame]:
        """Answer a claim for the address."""
        if pgn_of(frame.can_id) != Pgn.ADDRESS_CLAIMED or source_of(frame.can_id) != self.address:
            return []
        self.heard_n += 1
        return [self._claim(int.from_bytes(frame.data, "little"))]

    def advance(self, now_s: float) -> list[Frame]:
        """What is sent unasked up to ``now_s``."""
        if self._name is None:
            joined, self._joined = self._joined, True
            return [] if joined else [Frame(make_id(6, Pgn.REQUEST, NULL, GLOBAL), _ASK_FOR_CLAIMS)]
        out: list[Frame] = []
        if not self._claims_hz:
            return out
        self._due_s = max(self._due_s, now_s - 0.1)
        while self._due_s <= now_s:
            self._due_s += 1.0 / self._claims_hz
            out.append(self._claim(self._name))
        return out

    def _claim(self, other: int) -> Frame:
        self.sent_n += 1
        name = other if self._name is None else self._name
        return Frame(make_id(6, Pgn.ADDRESS_CLAIMED, self.address), name.to_bytes(8, "little"))


class Flood:
    """Random proprietary broadcasts at ``rate_hz`` from one address (a full bus carries some 1,600 a second)."""

    def __init__(self, rate_hz: float, source: int = 0x55, seed: int = 0) -> None:
        self._rate_hz = rate_hz
        self._source = source
        self._random = random.Random(seed)
        self._debt = 0.0
        self._last_s: float | None = None

    def advance(self, now_s: float) -> list[Frame]:
        """Frames due up to ``now_s``."""
        if self._last_s is not None:
            self._debt = min(self._debt + (now_s - self._last_s) * self._rate_hz, _FLOOD_MAX_N)
        self._last_s = now_s
        count, self._debt = int(self._debt), self._debt % 1.0
        return [
            Frame(make_id(3, 0xFF00 | self._random.randrange(256), self._source, GLOBAL), self._random.randbytes(8))
            for _ in range(count)
        ]
