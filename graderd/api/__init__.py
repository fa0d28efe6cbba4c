"""The one interface for every client: HTTP, JSON and WebSocket over a unix socket, and TCP when asked for."""

from graderd.api.app import make_app
from graderd.api.listeners import SocketError, SocketInUseError
from graderd.api.port import DaemonPort, ServiceError
from graderd.api.server import serve
from graderd.api.settings import ApiLimits, TcpSettings

__all__ = [
    "ApiLimits",
    "DaemonPort",
    "ServiceError",
    "SocketError",
    "SocketInUseError",
    "TcpSettings",
    "make_app",
    "serve",
]
