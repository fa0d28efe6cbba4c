"""Address claim of SAE J1939-81 as a pure state machine.

A node claims its address with its NAME, waits 250 ms for objections (addresses 128 to 247; the others may start at
once) and from then on defends it: of two claims for one address the numerically lower NAME wins. The loser takes
another address (arbitrary address capable) or says that it cannot claim and is silent.

The standard asks for unique NAMEs and says nothing sensible about equal ones; answering each other's claim then never
ends. Here every claim leaves through a limiter, equal NAMEs are reported and not answered without end, and a storm of
foreign claims cannot make this node storm. A claim that is owed (to a request, to a NAME that loses) and that the
limiter keeps back is put off and never dropped: whoever hears none takes the address for free.
"""

from __future__ import annotations

import math
import random
from enum import StrEnum
from typing import Final

from graderd.drivers.j1939.ids import GLOBAL, MAX_ADDRESS, NULL, Frame, Pgn, make_id
from graderd.drivers.j1939.name import Name
from graderd.hal.clock import Pace

VETO_S: Final = 0.25
"""Wait after a claim before other traffic (J1939-81, addresses 128 to 247)."""
CANNOT_CLAIM_DELAY_MAX_S: Final = 0.153
"""Cannot-claim messages are delayed by a random time up to this, so that losers do not collide."""
SELF_CONFIGURABLE: Final = range(128, 208)
"""Addresses an arbitrary-address-capable node of industry group 3 may take."""
RETRY_S: Final = 10.0
"""A node that could not claim tries its preferred address again after so long."""
_CLAIM_RATE_HZ: Final = 1.0 / VETO_S
_CLAIM_BURST_N: Final = 3
_EQUAL_NAME_RATE_HZ: Final = 0.2
_EQUAL_NAME_BURST_N: Final = 2
_STORM_N: Final = 10
_STORM_WINDOW_S: Final = 1.0
_CONFLICT_MEMORY_S: Final = 5.0


class ClaimState(StrEnum):
    """Where the claim stands."""

    IDLE = "idle"
    WAITING = "waiting"
    CLAIMED = "claimed"
    CANNOT_CLAIM = "cannot_claim"


class AddressClaimer:
    """Claims and defends one address. Every method takes monotonic seconds and returns the frames to send."""

    def __init__(self, name: Name, preferred: int, *, obey_commanded: bool = False, seed: int | None = None) -> None:
        self.name = name
        self.state = ClaimState.IDLE
        self.wanted = preferred
        """The address claimed or being claimed."""
        self.contentions_n = 0
        self.sent_n = 0
        self._preferred = preferred
        self._obey = obey_commanded
        self._random = random.Random(seed)
        self._limiter = Pace(_CLAIM_RATE_HZ, _CLAIM_BURST_N)
        self._equal_name_limiter = Pace(_EQUAL_NAME_RATE_HZ, _EQUAL_NAME_BURST_N)
        self._veto_until_s = 0.0
        self._owed: int | None = None
        self._due_s: float | None = None
        self._retry_at_s: float | None = None
        self._refused: set[int] = set()
        self._foreign: dict[int, int] = {}
        self._foreign_times_s: list[float] = []
        self._equal_name_at_s: float | None = None
        self._violation_at_s: float | None = None

    @property
    def address(self) -> int | None:
        """The address traffic may be sent from; None before the veto time is over or without an address."""
        return self.wanted if self.state is ClaimState.CLAIMED else None

    @property
    def seen(self) -> dict[int, int]:
        """Addresses of other nodes and the NAME each claimed last."""
        return self._foreign

    def equal_name_seen(self, now_s: float) -> bool:
        """Whether another node claimed our address with our own NAME within the last seconds."""
        return self._equal_name_at_s is not None and now_s - self._equal_name_at_s < _CONFLICT_MEMORY_S

    def violated(self, now_s: float) -> bool:
        """Whether another node sent with our address within the last seconds."""
        return self._violation_at_s is not None and now_s - self._violation_at_s < _CONFLICT_MEMORY_S

    def storming(self, now_s: float) -> bool:
        """Whether others claimed our address more than ten times within the last second."""
        self._foreign_times_s = [t for t in self._foreign_times_s if now_s - t < _STORM_WINDOW_S]
        return len(self._foreign_times_s) > _STORM_N

    def start(self, now_s: float) -> list[Frame]:
        """Ask who is there (from the null address) and claim."""
        self._refused.clear()
        self._foreign.clear()
        self._due_s = self._retry_at_s = None
        self.wanted = self._preferred
        ask = Frame(make_id(6, Pgn.REQUEST, NULL, GLOBAL), Pgn.ADDRESS_CLAIMED.to_bytes(3, "little"))
        return [ask, *self._claim(now_s)]

    def poll(self, now_s: float) -> list[Frame]:
        """What became due: end of the veto time, a claim that was put off, a delayed cannot-claim, a new try."""
        if self._retry_at_s is not None and now_s >= self._retry_at_s:
            return self.start(now_s)
        if self._due_s is not None and now_s >= self._due_s:
            self._due_s = None
            return self._owe(NULL, now_s)
        if self.state is ClaimState.WAITING and now_s >= self._veto_until_s:
            self.state = ClaimState.CLAIMED
        return self._pay(now_s)

    def on_claim(self, source: int, name: int, now_s: float) -> list[Frame]:
        """A claim of another node (or a cannot-claim, where ``source`` is 254)."""
        if source > MAX_ADDRESS:
            return []
        if source != self.wanted:
            # a node that moved leaves its old address free
            for address in [a for a, n in self._foreign.items() if n == name and a != source]:
                del self._foreign[address]
            self._foreign[source] = name
            return []
        if self.state not in (ClaimState.WAITING, ClaimState.CLAIMED):
            return []
        self.contentions_n += 1
        self._foreign_times_s.append(now_s)
        del self._foreign_times_s[: -2 * _STORM_N]
        if name == self.name.value:
            self._equal_name_at_s = now_s
            return self._owe(self.wanted, now_s) if self._equal_name_limiter.take(now_s) else []
        if self.name.value < name:
            return self._owe(self.wanted, now_s)
        self._foreign[source] = name
        self._refused.add(source)
        return self._take_another(now_s)

    def on_request(self, now_s: float) -> list[Frame]:
        """A request for address claimed, to us or to all."""
        if self.state in (ClaimState.WAITING, ClaimState.CLAIMED):
            return self._owe(self.wanted, now_s)
        if self.state is ClaimState.CANNOT_CLAIM:
            self._schedule_cannot_claim(now_s)
        return []

    def on_violation(self, now_s: float) -> list[Frame]:
        """Somebody else sent a frame from our address: claim again, at most once in five seconds."""
        quiet = not self.violated(now_s)
        self._violation_at_s = now_s if quiet else self._violation_at_s
        return self._owe(self.wanted, now_s) if quiet and self.state is ClaimState.CLAIMED else []

    def on_commanded(self, name: int, address: int, now_s: float) -> list[Frame]:
        """A commanded address (PGN 65240): obeyed only where configured and when it names us."""
        if not self._obey or name != self.name.value or address > MAX_ADDRESS:
            return []
        self.wanted = address
        self._refused.discard(address)
        return self._claim(now_s)

    def _take_another(self, now_s: float) -> list[Frame]:
        if self.name.arbitrary_address_capable:
            free = (a for a in SELF_CONFIGURABLE if a not in self._refused and a not in self._foreign)
            address = next(free, None)
            if address is not None:
                self.wanted = address
                return self._claim(now_s)
        self.state = ClaimState.CANNOT_CLAIM
        self._owed = None
        self._retry_at_s = now_s + RETRY_S
        self._schedule_cannot_claim(now_s)
        return []

    def _schedule_cannot_claim(self, now_s: float) -> None:
        due_s = now_s + self._random.uniform(0.0, CANNOT_CLAIM_DELAY_MAX_S)
        if self._due_s is None or self._due_s > due_s:
            self._due_s = due_s

    def _claim(self, now_s: float) -> list[Frame]:
        self.state = ClaimState.WAITING
        self._due_s = None
        self._veto_until_s = math.inf  # it begins when the claim leaves
        return self._owe(self.wanted, now_s)

    def _owe(self, source: int, now_s: float) -> list[Frame]:
        """A claim (from the null address: cannot claim), sent now or as soon as the limiter lets it."""
        self._owed = source
        return self._pay(now_s)

    def _pay(self, now_s: float) -> list[Frame]:
        if self._owed is None or not self._limiter.take(now_s):
            return []
        source, self._owed = self._owed, None
        self.sent_n += 1
        if self.state is ClaimState.WAITING and math.isinf(self._veto_until_s):
            if 128 <= self.wanted <= 247:
                self._veto_until_s = now_s + VETO_S
            else:
                self.state = ClaimState.CLAIMED
        return [Frame(make_id(6, Pgn.ADDRESS_CLAIMED, source), self.name.to_bytes())]
