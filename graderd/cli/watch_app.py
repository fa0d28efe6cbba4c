"""The screen of ``graderd watch`` (Textual): the status as :mod:`graderd.view` lays it out, keys and pad below.

What moves the blade is a lease of the daemon's. It is renewed by this program's own loop, and only while a key is known
to be held: a terminal that sends no more keys, one that takes no more output (which blocks the loop) and a program that
is halted all end the motion, at the latest when the lease lapses, 0.3 s after its last renewal.
"""

from __future__ import annotations

import asyncio
import os
import select
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any, ClassVar, Final

from rich.text import Text
from textual import events
from textual.app import App, ComposeResult
from textual.binding import BindingType
from textual.widgets import Static

from graderd.cli.console import ExitCode
from graderd.cli.dead_man import HeldKey
from graderd.cli.gamepad import Pad, Stick
from graderd.client import AsyncClient, AsyncLease, ClientError
from graderd.core.axes import JOG_AXES, JogName
from graderd.view import LEAST_COLUMNS_N, LEAST_LINES_N, STYLES, Line, fitting, lines

STALE_S: Final = 0.5
STATUS_HZ: Final = 10.0
RENEW_S: Final = 0.1
LOOK_S: Final = 0.03
RETRY_S: Final = 0.5
END_DEG: Final = 0.05
KEYS: Final = "SPACE stop  A arm O auto m manual d disarm R reset q quit"
HOLDS: Final = "hold: ← → rotate   ↑ ↓ height   [ ] slope   , . pitch"
FOOT_N: Final = 3
COMMANDS: Final[Mapping[str, str]] = {
    "A": "arm",
    "O": "auto",
    "m": "manual",
    "d": "disarm",
    "R": "reset",
}
"""What may lead to motion is a capital: no slip of a finger arms."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A jog as a key or a stick means it: by so much while it is held, the rotation to the end of its travel.

    One command and renewals: a jog takes a lease anew, so one that is sent again could move a blade that was let go
    (docs/adr/0071-the-page-is-files.md).
    """

    axis: JogName
    by: float


HELD: Final[Mapping[str, Motion]] = {
    "left": Motion("rotate", 10.0),
    "right": Motion("rotate", -10.0),
    "up": Motion("height", 50.0),
    "down": Motion("height", -50.0),
    "left_square_bracket": Motion("slope", 2.0),
    "right_square_bracket": Motion("slope", -2.0),
    "comma": Motion("pitch", 2.0),
    "full_stop": Motion("pitch", -2.0),
}


class WatchApp(App[None]):
    """See the module's text. ``address``: the daemon's socket; ``pad``: an event device."""

    CSS = "Screen { overflow: hidden; } Static { height: auto; } #foot { dock: bottom; height: 3; }"
    TITLE = "graderd watch"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = []

    def __init__(self, address: Path | None = None, pad: Path | None = None) -> None:
        super().__init__()
        self.interrupted = False
        self._client = AsyncClient(address, name="watch", timeout_s=2.0)
        self._status: dict[str, Any] | None = None
        self._heard_s = time.monotonic()
        self._said = ""
        self._hand = HeldKey()
        self._pad = Pad(pad) if pad is not None else None
        self._moving: Motion | None = None
        self._ends_deg: dict[bool, float] = {}

    def compose(self) -> ComposeResult:
        yield Static(id="body")
        yield Static(id="foot")

    def on_mount(self) -> None:
        self.run_worker(self._listen(), group="listen")
        self.set_interval(LOOK_S, self._look)
        self.set_interval(RENEW_S, self._draw)
        if sys.__stdin__ is not None and sys.__stdin__.isatty():
            Thread(target=_end_with, args=(sys.__stdin__.fileno(),), name="terminal", daemon=True).start()
        if self._pad is not None:
            self.say(self._pad.open())

    # -- keys ----------------------------------------------------------------------------------------------------------

    async def on_event(self, event: events.Event) -> None:
        """Keys come here first, before any widget or binding: the stop is nobody's to keep."""
        if isinstance(event, events.Key):
            event.stop()
            event.prevent_default()
            self._key(event)
            return
        await super().on_event(event)

    def _key(self, event: events.Key) -> None:
        if event.key == "space":
            self.stop()
        elif event.key in HELD:
            self._hand.press(event.key, event.time)
            self._look()
        else:
            self._hand.release()
            if event.key in ("q", "ctrl+c", "ctrl+q"):
                self.interrupted = event.key == "ctrl+c"
                self.exit()
            elif event.character is not None and event.character in COMMANDS:
                self.run_worker(self._command(COMMANDS[event.character]), group="command")

    def on_app_blur(self) -> None:
        """The terminal is no longer looked at."""
        self._hand.release()

    # -- what goes out -------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Tell the daemon, whatever else is on its way."""
        self._hand.release()
        self.say("STOP sent")
        self.run_worker(self._stop(), group="stop")

    async def _stop(self) -> None:
        try:
            self.say((await self._client.stop("stop key of graderd watch")).message)
        except ClientError as error:
            self.say(f"STOP NOT TAKEN: {error}. If the blade moves, use the emergency stop")

    async def _command(self, name: str) -> None:
        try:
            reply = await (self._client.reset() if name == "reset" else self._client.command(name))
            self.say(reply.message)
        except ClientError as error:
            self.say(str(error))

    def _wanted(self) -> Motion | None:
        """What hand or pad want now; two at once is nothing."""
        now_s = time.monotonic()
        key = self._hand.held(now_s)
        stick = self._pad.wants(now_s) if self._pad is not None else None
        if key is not None and stick is not None:
            return None
        if key is not None:
            return HELD[key]
        return _by_stick(stick) if stick is not None else None

    def _look(self) -> None:
        """Begin a motion where one is wanted and none is under way; one under way looks by itself."""
        if self._moving is None and (wanted := self._wanted()) is not None and not self._is_stale():
            self._moving = wanted
            self.run_worker(self._jog(wanted), group="jog")

    async def _jog(self, motion: Motion) -> None:
        try:
            async with self._client.lease(rate_hz=STATUS_HZ) as lease:
                if self._wanted() == motion:
                    await self._hold(lease, motion)
            self.say("released")
        except ClientError as error:
            self.say(str(error))
            self._hand.release()
        finally:
            self._moving = None

    async def _hold(self, lease: AsyncLease, motion: Motion) -> None:
        """Move while it is wanted. Nothing here takes a lease that has ended again."""
        end_deg = self._ends_deg.get(motion.by > 0.0) if motion.axis == "rotate" else None
        if end_deg is not None:
            await lease.jog(motion.axis, end_deg)
            self.say(f"moving: rotate, to {end_deg:+.0f} deg at most")
        else:
            await lease.jog(motion.axis, motion.by, relative=True)
            self.say(f"moving: {motion.axis}, by {motion.by:+g} {JOG_AXES[motion.axis].unit} at most")
        renewed_s = time.monotonic()
        while self._wanted() == motion:
            if time.monotonic() - renewed_s >= RENEW_S:
                renewed_s = time.monotonic()
                await lease.renew()
            await asyncio.sleep(LOOK_S)

    # -- what comes in -------------------------------------------------------------------------------------------------

    async def _listen(self) -> None:
        while True:
            try:
                self._ends_deg = _ends_deg(await self._client.config())
                async with self._client.statuses(STATUS_HZ) as statuses:
                    async for status in statuses:
                        self._status, self._heard_s = status.model_dump(mode="json"), time.monotonic()
                        self._draw()
            except ClientError as error:
                self.say(str(error))
            await asyncio.sleep(RETRY_S)

    def _is_stale(self) -> bool:
        return time.monotonic() - self._heard_s > STALE_S

    def say(self, text: str) -> None:
        """What became of the last thing asked."""
        self._said = text
        self._draw()

    def _draw(self) -> None:
        if not self.query("#foot"):
            return
        columns_n, lines_n = self.size
        columns_n, lines_n = max(columns_n, LEAST_COLUMNS_N), max(lines_n, LEAST_LINES_N)
        self.query_one("#body", Static).update(_text(self._body(columns_n, lines_n - FOOT_N)))
        foot = [Line(fitting(self._said, columns_n), "warn"), Line(KEYS, "title"), Line(HOLDS, "dim")]
        self.query_one("#foot", Static).update(_text(foot))

    def _body(self, columns_n: int, lines_n: int) -> list[Line]:
        """The status; where it is old, no number of it: only how old."""
        if self._status is None:
            return [Line("no status yet", "warn")]
        if self._is_stale():
            age_s = time.monotonic() - self._heard_s
            return [Line(f"LAST HEARD {age_s:.1f} s AGO", "stop"), Line("nothing on this screen is known", "warn")]
        return lines(self._status, columns_n, lines_n)


def _end_with(terminal: int) -> None:
    """End this process when its terminal hangs up: nobody sees the screen any more, and a pad is no hand without it.

    A signal tells that to those alone whose session it ends (not below su or sudo). In a thread, and without a word, as
    the loop may hang in what it still had to write.
    """
    hung_up = select.poll()
    hung_up.register(terminal, 0)
    hung_up.poll()
    os._exit(ExitCode.FAILED)


def _ends_deg(config: dict[str, Any]) -> dict[bool, float]:
    """The ends of the rotation's travel, to the left (True) and the right, a hair inside."""
    rotation = config.get("rotation", {})
    if "max_deg" not in rotation or "min_deg" not in rotation:
        return {}
    return {True: float(rotation["max_deg"]) - END_DEG, False: float(rotation["min_deg"]) + END_DEG}


def _by_stick(stick: Stick) -> Motion:
    """Sideways turns the blade, forth and back raises it."""
    if stick == "left" or stick == "right":
        return HELD[stick]
    return HELD["down" if stick == "forward" else "up"]


def _text(shown: list[Line]) -> Text:
    return Text("\n").join(Text(line.text, STYLES[line.kind], no_wrap=True, overflow="crop") for line in shown)
