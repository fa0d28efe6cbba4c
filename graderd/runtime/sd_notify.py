"""Tells systemd how the service is, as sd_notify(3): readiness, watchdog, status text. Silent without systemd."""

from __future__ import annotations

import os
import socket

from graderd.hal.text import printable


class SystemdNotifier:
    """Sends datagrams to ``$NOTIFY_SOCKET``. The watchdog is fed by the control tick and by nothing else."""

    def __init__(self, address: str | None = None) -> None:
        address = os.environ.get("NOTIFY_SOCKET") if address is None else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
            # A leading @ is systemd's way to write an abstract socket address.
            self._address = "\0" + address[1:] if address.startswith("@") else address

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:
            # A full or vanished socket must not end control; a missed feed is what the watchdog is for.
            return

    def ready(self, status: str) -> None:
        """The service is up."""
        self._send(f"READY=1\nSTATUS={printable(status)}")

    def status(self, text: str) -> None:
        """One line for ``systemctl status``: a line end in it would begin another assignment."""
        self._send(f"STATUS={printable(text)}")

    def feed_watchdog(self) -> None:
        """The control tick is alive."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The service is going down on purpose."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
