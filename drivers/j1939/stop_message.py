"""Messages on the bus that mean *stop*: ISO 11783-7 "all implements stop operations", and one of your choice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from graderd.drivers.j1939.ids import Pgn
from graderd.drivers.j1939.transport import Message

REPEAT_S: Final = 0.1
_STOP_STATE: Final = 0
_STATE_MASK: Final = 3


class StopWatcher:
    """Calls ``on_stop`` with a reason for every stop message, until it is told otherwise.

    ISO 11783-7, PGN 64770: byte 7 counts the switch's transitions, bits 1-2 of byte 8 are its state (0 stop, 1 all
    implements permitted to operate). A counter that went on by more than one without a change that we saw means that
    a stop was missed, and counts as stop too. A broadcast repeats the state; while it says stop, the stop is told
    again every ``REPEAT_S``, so that a machine armed anew under a pressed switch does not stay armed.
    """

    def __init__(self, stop_pgn_n: int | None, iso_all_stop: bool, on_stop: Callable[[str], None] | None) -> None:
        self._pgn = stop_pgn_n
        self._iso = iso_all_stop
        self._on_stop = on_stop
        self._switches: dict[int, tuple[int, int]] = {}
        self._told_s: dict[int, float] = {}

    def on_message(self, message: Message, now_s: float) -> None:
        """Look at one message from the bus."""
        if self._pgn is not None and message.pgn == self._pgn:
            self._tell(f"CAN message PGN {message.pgn} from address {message.source}")
        if self._iso and message.pgn == Pgn.STOP_ALL_IMPLEMENTS and len(message.data) == 8:
            self._on_switch(message.source, message.data[6], message.data[7] & _STATE_MASK, now_s)

    def _on_switch(self, source: int, count: int, state: int, now_s: float) -> None:
        former = self._switches.get(source)
        self._switches[source] = (count, state)
        if state == _STOP_STATE:
            changed = former is None or former[1] != _STOP_STATE or former[0] != count
            if changed or now_s - self._told_s[source] >= REPEAT_S:
                self._told_s[source] = now_s
                self._tell(f"ISO 11783 'stop all implement operations' from address {source}")
        elif former is not None and (count - former[0]) % 256 > 1:
            self._tell(f"ISO 11783 stop switch at address {source} changed without our seeing it")

    def _tell(self, reason: str) -> None:
        if self._on_stop is not None:
            self._on_stop(reason)
