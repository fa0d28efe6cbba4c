"""The head of a request, judged before anything else of it is looked at: by its size, and by the guard of TCP."""

from __future__ import annotations

from typing import Any

import h11

from graderd.api.problem import Problem, ProblemError
from graderd.api.tcp_guard import TcpGuard

HEAD_MAX_BYTES = 8192
"""Request line and headers."""
LINE_BYTES = 256
"""So much of a request is kept to know its first line by, should the rest of its head not be valid."""
SENT_AHEAD = "sent_ahead"
"""Known of a connection whose client does not wait for its answers (HTTP calls it pipelining)."""
VERSIONS = (b"1.0", b"1.1")


class JudgedConnection(h11.Connection):
    """h11's parser, which gives nobody a request whose head was not judged. ``line``: how the newest request begins,
    as it came. ``known``: what is known of whoever sent the newest, its ``grant`` and whether it was
    :data:`SENT_AHEAD`; the application gets it as the request's state."""

    def __init__(self, guard: TcpGuard | None) -> None:
        super().__init__(h11.SERVER, HEAD_MAX_BYTES)
        self._guard = guard
        self.line = b""
        self.known: dict[str, Any] = {}

    def receive_data(self, data: bytes) -> None:
        """As in h11."""
        if self.their_state is h11.IDLE and len(self.line) < LINE_BYTES:
            self.line = (self.line + data[:LINE_BYTES]).lstrip()[:LINE_BYTES]
        super().receive_data(data)

    def next_event(self) -> Any:
        """As in h11.

        Raises:
            h11.RemoteProtocolError: no valid HTTP, or a head that is too long.
            RefusedError: the guard does not let it in.
        """
        event = super().next_event()
        if isinstance(event, h11.Request):
            if event.http_version not in VERSIONS:  # h11 takes any that has the form of one
                raise h11.RemoteProtocolError("no version of HTTP that is spoken here")
            size_n = len(event.target) + sum(len(name) + len(value) + 4 for name, value in event.headers)
            if size_n > HEAD_MAX_BYTES:
                raise h11.RemoteProtocolError("too long a head", error_status_hint=431)
            if self._guard is not None:
                try:
                    self.known["grant"] = self._guard.admit(event.method, event.target, event.headers)
                except ProblemError as refusal:
                    raise RefusedError(refusal) from refusal
            self.line = b""
        return event


class RefusedError(h11.RemoteProtocolError):
    """A request that the guard does not let in, in the form in which uvicorn expects a parser to fail."""

    def __init__(self, refusal: ProblemError) -> None:
        super().__init__(str(refusal), refusal.status_code)
        self.refusal = refusal


def problem_of_head(error: BaseException | None) -> tuple[int, Problem]:
    """What to answer where a request's head was not taken."""
    if isinstance(error, RefusedError):
        return error.refusal.status_code, error.refusal.problem
    if isinstance(error, h11.RemoteProtocolError) and error.error_status_hint == 431:
        return 431, Problem(
            error=f"the request's head is longer than {HEAD_MAX_BYTES} bytes",
            where="request",
            remedy="send fewer or shorter headers",
        )
    return 400, Problem(error="this is no valid HTTP request", where="request")
