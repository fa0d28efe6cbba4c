"""A loop of wire with an output at one end and an input at the other, whatever those two belong to.

The output drives the loop, the normally closed contacts lie in it, the input reads it. Closed is what follows the
output: a press, a cut wire and a pulled plug read open, and a test pulse tells a short circuit from a closed loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from graderd.hal.errors import DeviceLostError, DeviceMissingError

FOLLOW_S = 0.03
"""USB adapters tell a changed line after some 1 to 16 ms."""
_LOOK_EVERY_S = 0.001


class LoopWire(Protocol):
    """An open output and input. Every method raises ``OSError`` where the device is gone."""

    def drive(self, on: bool) -> None:
        """Switch the output."""
        ...

    def reads(self) -> bool:
        """The input."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class LoopStopInput:
    """A stop input (see the contract in :mod:`graderd.hal.stop_input`) on a wire that ``open_wire`` opens.

    ``where`` names it for people, ``setting`` the one to check where it is missing. ``sleep`` is for tests.
    """

    def __init__(
        self, where: str, setting: str, open_wire: Callable[[], LoopWire], sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self.where = where
        self._setting = setting
        self._open_wire = open_wire
        self._sleep = sleep
        self._wire: LoopWire | None = None

    def open(self) -> None:
        """See the contract."""
        self.close()
        try:
            self._wire = self._open_wire()
            self._wire.drive(True)
            self._wire.reads()
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            self.close()
            raise DeviceMissingError(
                self.where, f"cannot be used as stop input ({error})", f"Check its cable and {self._setting}"
            ) from error

    def is_closed(self) -> bool:
        """See the contract."""
        return self._guarded(lambda wire: wire.reads())

    def follows(self) -> bool:
        """See the contract."""
        return self._guarded(self._pulse)

    def close(self) -> None:
        """See the contract."""
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()

    def _guarded(self, ask: Callable[[LoopWire], bool]) -> bool:
        if self._wire is None:
            raise DeviceLostError(self.where, "is not open")
        try:
            return ask(self._wire)
        except OSError as error:
            self.close()
            raise DeviceLostError(self.where, f"is gone ({error})", "Plug the adapter in again") from error

    def _pulse(self, wire: LoopWire) -> bool:
        try:
            wire.drive(False)
            opened = self._becomes(wire, False)
        finally:
            wire.drive(True)
        # Back before the next look at the loop, or the pulse itself would be taken for a press.
        self._becomes(wire, True)
        return opened

    def _becomes(self, wire: LoopWire, wanted: bool) -> bool:
        for _ in range(round(FOLLOW_S / _LOOK_EVERY_S)):
            if wire.reads() is wanted:
                return True
            self._sleep(_LOOK_EVERY_S)
        return False
