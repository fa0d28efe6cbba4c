"""Whose messages the link carries: what it wants of an actuator."""

from __future__ import annotations

from typing import Protocol


class LinkUser(Protocol):
    """What the link wants of an actuator. The methods never wait."""

    @property
    def address(self) -> int:
        """J1939 address of the actuator."""
        ...

    def control_data(self, now_s: float) -> bytes:
        """Content of the control message that goes out now."""
        ...

    def on_feedback(self, data: bytes, now_s: float) -> None:
        """A feedback message from this address."""
        ...

    def on_claim(self, name: int, solicited: bool, now_s: float) -> None:
        """An address claim from this address; ``solicited`` where somebody asked for claims just before."""
        ...

    def on_link_lost(self, now_s: float) -> None:
        """The bus is gone; nothing can be sent."""
        ...

    def hold(self) -> None:
        """Disable motion from the next control message on."""
        ...
