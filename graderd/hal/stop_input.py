"""Contract of the stop input: a closed loop of wire means that operation is permitted; anything else means stop.

It carries an operator's stop to the software. It does not replace an emergency stop: that takes the power away (see
docs/integrators/safety.md). The loop is normally closed, so that a cut wire, a pulled plug and a pressed button are one
and the same.
"""

from __future__ import annotations

from typing import Protocol


class StopInput(Protocol):
    """One input. All methods belong to one thread, the watcher's, and may block for as long as the wire takes."""

    @property
    def where(self) -> str:
        """Port and line, for people."""
        ...

    def open(self) -> None:
        """Open the wire and drive the loop.

        Raises:
            DeviceMissingError: no such port, or it has no such lines.
        """
        ...

    def is_closed(self) -> bool:
        """Whether the loop is closed now: True permits operation, False means stop.

        Raises:
            DeviceLostError: the port is gone; counts as stop.
        """
        ...

    def follows(self) -> bool:
        """Test pulse: whether the input follows when the loop is not driven for some milliseconds.

        False: it reads closed although nothing drives it (a short circuit, a stuck adapter): a press would not be seen.

        Raises:
            DeviceLostError: the port is gone; counts as stop.
        """
        ...

    def close(self) -> None:
        """Let go of the port; idempotent."""
        ...
