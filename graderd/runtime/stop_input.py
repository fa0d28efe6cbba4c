"""Watches the stop input from a thread of its own: an open loop, a lost port and a silent one all mean stop.

The thread may block in the port for as long as it likes: what counts for the control loop is the age of its last word.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from graderd.hal.clock import Clock
from graderd.hal.errors import DeviceError
from graderd.hal.fault import DeviceFault, PresentFaults
from graderd.hal.settings import StopInputSettings
from graderd.hal.stop_input import StopInput

DEVICE = "stop_input"
RETRY_S = 0.5
FIRST_WORD_S = 1.0
"""The machine starts disarmed, and its devices take as long to open: until the first look nothing needs to stop. Every
start would else have to be reset like a stop."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Word:
    """What the thread found last: a condition (empty: the loop is closed) and when."""

    condition: str
    detail: str
    time_s: float


class _Contact:
    """What the looks at a loop say together. Closed looks count against open ones at a third, as time without a fault
    does against it: a contact that shakes is open although it never is for long, and one disturbance is forgotten.
    ``open``: from enough open looks until nothing speaks for it any more."""

    def __init__(self, open_samples_n: int) -> None:
        self.open = False
        self._needed_thirds = 3 * open_samples_n
        self._thirds = 0

    def see(self, closed: bool) -> None:
        """One more look."""
        self._thirds = max(0, self._thirds - 1) if closed else min(self._needed_thirds, self._thirds + 3)
        self.open = self._thirds == self._needed_thirds or (self.open and self._thirds > 0)


class StopInputWatch:
    """One input, looked at ``poll_hz`` times a second. ``on_stop`` runs in the event loop, ahead of any tick."""

    def __init__(
        self, settings: StopInputSettings, source: StopInput, clock: Clock, on_stop: Callable[[str], None]
    ) -> None:
        self._settings = settings
        self._source = source
        self._clock = clock
        self._on_stop = on_stop
        self._ending = threading.Event()
        self._word = _Word("lost", f"{source.where} was not read yet", clock.now_s())
        self._faults = PresentFaults(DEVICE)
        self._quiet_until_s = clock.now_s() + FIRST_WORD_S
        self._asked_s = clock.now_s()
        self._grace_until_s = clock.now_s()

    def faults(self, now_s: float) -> tuple[DeviceFault, ...]:
        """Why operation is not permitted; empty while the loop is closed."""
        word = self._word
        asked_s, self._asked_s = self._asked_s, now_s
        if now_s - asked_s > self._settings.stale_s / 2:
            # This whole process stood still, so the thread did too: that it has not read says nothing about the loop.
            # It gets two of its periods; the freeze itself is a fault of its own (daemon.loop_blocked).
            self._grace_until_s = now_s + 2.0 / self._settings.poll_hz
        if now_s < self._quiet_until_s:
            return ()
        age_s = now_s - word.time_s
        seen = {word.condition: word.detail} if word.condition else {}
        if age_s > self._settings.stale_s and word.condition != "lost" and now_s >= self._grace_until_s:
            seen = {"stale": f"{self._source.where}: no reading for {age_s:.2f} s"}
        self._faults.keep_only(seen, now_s)
        return self._faults.present(now_s)

    async def run(self) -> None:
        """Watch until cancelled. The thread ends by itself, or with the process where its port never returns."""
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._watch, args=(loop,), name="stop-input", daemon=True).start()
        try:
            await loop.create_future()
        finally:
            self._ending.set()

    # ---- the thread --------------------------------------------------------------------------------------------------

    def _watch(self, loop: asyncio.AbstractEventLoop) -> None:
        while not self._ending.is_set():
            try:
                self._source.open()
                log.info("stop input: %s", self._source.where, extra={"device": DEVICE})
                self._read_loop(loop)
            except DeviceError as error:
                # At every attempt: the log repeats it ever more rarely.
                log.warning("stop input: %s", error, extra={"device": DEVICE, "fault": f"{DEVICE}.lost"})
                self._say(loop, "lost", str(error))
                self._ending.wait(RETRY_S)
        self._source.close()

    def _read_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        """Read, and now and then test, until told to end or until the port is lost."""
        settings = self._settings
        contact, stuck = _Contact(settings.open_samples_n), False
        test_due_s = self._clock.now_s()
        while not self._ending.is_set():
            closed = self._source.is_closed()
            if closed and settings.test_every_s and self._clock.now_s() >= test_due_s:
                stuck = not self._source.follows()
                test_due_s = self._clock.now_s() + settings.test_every_s
            contact.see(closed)
            if contact.open:
                self._say(loop, "open", f"{self._source.where}: the loop is open")
            elif closed and stuck:
                self._say(loop, "stuck", f"{self._source.where}: reads closed though nothing drives the loop")
            elif closed:
                self._say(loop, "", "")
            self._ending.wait(1.0 / settings.poll_hz)

    def _say(self, loop: asyncio.AbstractEventLoop, condition: str, detail: str) -> None:
        now_s = self._clock.now_s()
        former, self._word = self._word, _Word(condition, detail, now_s)
        self._quiet_until_s = now_s
        if condition == former.condition:
            return
        if condition:
            if condition != "lost":
                fields = {"event": True, "device": DEVICE, "fault": f"{DEVICE}.{condition}"}
                log.warning("stop input: %s", detail, extra=fields)
            try:
                loop.call_soon_threadsafe(self._on_stop, detail)
            except RuntimeError:
                return  # the event loop has ended, and everything with it
