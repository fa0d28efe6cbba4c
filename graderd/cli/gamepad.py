"""A gamepad or joystick as a dead man: a button that must be held, and a stick that says where to.

Linux's event device is read as it is (``struct input_event`` of ``include/uapi/linux/input.h``, codes of
``input-event-codes.h``): the package evdev is source only and would need a compiler. The decoder is pure.

A pad tells only changes. So one that is pulled, one that hangs and one that is held perfectly still look alike at
first, and all of them release: without an event for :data:`SILENT_S` nothing is held, and it is held again only after
the button was let go and pressed anew. A stick in a hand sends many events a second.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

EVENT: Final = struct.Struct("@llHHi")
"""Seconds, microseconds, type, code, value: as the kernel's ``long`` is wide."""
EV_SYN: Final = 0x00
EV_KEY: Final = 0x01
EV_ABS: Final = 0x03
SYN_DROPPED: Final = 3
"""Events were lost: what is held is no longer known."""
ABS_X: Final = 0x00
ABS_Y: Final = 0x01
DEAD_MAN: Final = frozenset({0x120, 0x136, 0x137})
"""BTN_TRIGGER of a joystick; BTN_TL and BTN_TR, the shoulder buttons of a gamepad."""
SILENT_S: Final = 1.0
OUT: Final = 0.5
"""So far out of its range the stick means it."""
READ_BYTES: Final = 64 * EVENT.size

Stick = Literal["left", "right", "forward", "back"]


@dataclass(frozen=True, slots=True)
class Event:
    """One ``struct input_event``; ``time_s`` by the kernel's clock."""

    time_s: float
    kind: int
    code: int
    value: int


def events_of(data: bytes) -> Iterator[Event]:
    """The whole events in ``data``; the kernel never hands over a part of one."""
    for seconds, microseconds, kind, code, value in EVENT.iter_unpack(data[: len(data) // EVENT.size * EVENT.size]):
        yield Event(seconds + microseconds / 1e6, kind, code, value)


class PadState:
    """What the events come to. ``ranges``: least and greatest value of ABS_X and ABS_Y, as the device names them."""

    def __init__(self, ranges: dict[int, tuple[int, int]] | None = None) -> None:
        self._ranges = ranges or {}
        self._down: set[int] = set()
        self._at = {ABS_X: 0.0, ABS_Y: 0.0}
        self._heard_s = 0.0

    def take(self, event: Event, now_s: float) -> None:
        """An event that came at ``now_s`` (monotonic)."""
        self._lapse(now_s)
        self._heard_s = now_s
        if event.kind == EV_SYN and event.code == SYN_DROPPED:
            self.release()
        elif event.kind == EV_KEY and event.code in DEAD_MAN:
            if event.value == 0:
                self._down.discard(event.code)
            elif event.value == 1:  # 2 is the kernel's own repeat, not the pad's word
                self._down.add(event.code)
        elif event.kind == EV_ABS and event.code in self._at:
            low, high = self._ranges.get(event.code, (-32768, 32767))
            self._at[event.code] = 2.0 * (event.value - low) / max(1, high - low) - 1.0

    def release(self) -> None:
        """Nothing counts as held until the button is pressed anew."""
        self._down.clear()

    def wants(self, now_s: float) -> Stick | None:
        """Where to, while the button is held, the stick is out, and the pad is heard."""
        self._lapse(now_s)
        if not self._down:
            return None
        x, y = self._at[ABS_X], self._at[ABS_Y]
        if max(abs(x), abs(y)) < OUT:
            return None
        if abs(x) >= abs(y):
            return "left" if x < 0 else "right"
        return "forward" if y < 0 else "back"

    def _lapse(self, now_s: float) -> None:
        if self._down and now_s - self._heard_s > SILENT_S:
            self.release()


class Pad:
    """An event device, read without ever waiting for it."""

    def __init__(self, device: Path) -> None:
        self._device = device
        self._fd = -1
        self._state = PadState()

    def open(self) -> str:
        """Open it; what to tell the person."""
        try:
            self._fd = os.open(self._device, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            return f"pad {self._device}: {error.strerror}. Name another with --pad; it belongs to group input"
        self._state = PadState(_ranges(self._fd))
        return f"pad {self._device}: hold a shoulder button and push the stick"

    def wants(self, now_s: float) -> Stick | None:
        """See :meth:`PadState.wants`; a pad that was pulled wants nothing."""
        while self._fd >= 0:
            try:
                data = os.read(self._fd, READ_BYTES)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                os.close(self._fd)
                self._fd = -1
                return None
            for event in events_of(data):
                self._state.take(event, now_s)
        return self._state.wants(now_s) if self._fd >= 0 else None


def _ranges(fd: int) -> dict[int, tuple[int, int]]:
    """Least and greatest value of the stick's axes (EVIOCGABS); none of what is no event device."""
    import fcntl

    found = {}
    for code in (ABS_X, ABS_Y):
        about = bytearray(struct.calcsize("6i"))
        request = (
            2 << 30 | len(about) << 16 | ord("E") << 8 | 0x40 + code
        )  # _IOR('E', 0x40 + abs, struct input_absinfo)
        try:
            fcntl.ioctl(fd, request, about)
        except OSError:
            continue
        _, least, greatest, *_ = struct.unpack("6i", about)
        found[code] = (least, greatest)
    return found
