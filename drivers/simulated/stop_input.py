"""The simulated stop input: asks the simulator's stop loop over its unix socket, as a watcher asks a port."""

from __future__ import annotations

import socket

from graderd.hal.errors import DeviceLostError, DeviceMissingError

_TIMEOUT_S = 0.5


class SimulatedStopInput:
    """The client: what the daemon's watcher reads."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._socket: socket.socket | None = None

    @property
    def where(self) -> str:
        """The socket, for people."""
        return f"simulated loop at {self._path}"

    def open(self) -> None:
        """See the contract."""
        self.close()
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.settimeout(_TIMEOUT_S)
        try:
            connection.connect(self._path)
        except OSError as error:
            connection.close()
            raise DeviceMissingError(self.where, f"nobody answers there ({error})", "Start the rig") from error
        self._socket = connection

    def is_closed(self) -> bool:
        """See the contract."""
        return self._ask(b"?") == b"1"

    def follows(self) -> bool:
        """See the contract."""
        return self._ask(b"t") == b"0"

    def close(self) -> None:
        """See the contract."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _ask(self, question: bytes) -> bytes:
        if self._socket is None:
            raise DeviceLostError(self.where, "is not open")
        try:
            self._socket.sendall(question)
            answer = self._socket.recv(1)
        except OSError as error:
            self.close()
            raise DeviceLostError(self.where, f"is gone ({error})") from error
        if not answer:
            self.close()
            raise DeviceLostError(self.where, "hung up")
        return answer
