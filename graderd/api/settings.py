"""Settings of the interface: who may reach it, and how much of the daemon's time it may take."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from graderd import places
from graderd.hal.settings import Positive, Settings

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")


class TcpSettings(Settings):
    """The interface on TCP, and the operator page. Beyond loopback it speaks TLS."""

    host: str = Field("127.0.0.1", description="address to listen on")
    port_n: int = Field(8431, ge=0, le=65535, description="TCP port; 0: any free one")
    stop_port_n: int | None = Field(
        None, ge=0, le=65535, description="TCP port that serves stop alone; none: the one after port_n"
    )
    token_file: Path = Field(
        default_factory=places.tokens,
        description=f"tokens that clients must send, hashed; see 'graderd token'. Default: {places.STATE}/api-tokens; "
        "where nothing is installed, ~/.local/state/graderd/api-tokens",
    )
    certificate_file: Path | None = Field(
        None, description="PEM certificate, and those up to its authority; with it the interface speaks TLS alone"
    )
    key_file: Path | None = Field(None, description="PEM private key of the certificate, readable by the daemon alone")
    allowed_hosts: tuple[str, ...] = Field(
        (), description="names or addresses, beside the loopback ones, under which clients may reach this machine"
    )

    def port_of_stop_n(self) -> int:
        """Where stop alone is served; 0: any free port."""
        if self.stop_port_n is not None:
            return self.stop_port_n
        return self.port_n + 1 if 0 < self.port_n < 65535 else 0

    @model_validator(mode="after")
    def _named(self) -> TcpSettings:
        if (self.certificate_file is None) != (self.key_file is None):
            raise ValueError("certificate_file and key_file go together: give both, or neither")
        loopback = self.host in ("127.0.0.1", "::1", "localhost")
        if not loopback and self.certificate_file is None:
            raise ValueError(
                f"host {self.host} is not loopback, and without TLS anybody on the way reads the tokens: give "
                "certificate_file and key_file, or keep 127.0.0.1 and use an SSH tunnel"
            )
        if not loopback and not self.allowed_hosts:
            raise ValueError(
                f"host {self.host} is not loopback: list in allowed_hosts the names by which clients reach it, "
                "or keep 127.0.0.1 and use an SSH tunnel"
            )
        return self


class ApiLimits(Settings):
    """Bounds that keep a flood of requests from taking the control tick's time. Stop has a lane of its own."""

    body_max_bytes_n: int = Field(16_384, ge=256, description="largest request body and WebSocket message")
    body_timeout_s: Positive = Field(5.0, le=60, description="a request whose body takes longer is refused")
    connections_max_n: int = Field(128, ge=4, description="open connections; the oldest makes room for a new one")
    websockets_max_n: int = Field(16, ge=1, description="status streams and jog sockets together")
    accept_rate_hz: Positive = Field(
        300.0, le=10_000, description="new connections taken per second; more wait in the kernel"
    )
    rate_hz: Positive = Field(150.0, le=10_000, description="requests served per second in the long run")
    burst_n: int = Field(25, ge=1, description="requests served at once after a quiet time")
    active_n: int = Field(8, ge=1, description="requests in work at the same time")
    waiting_n: int = Field(48, ge=0, description="requests that may wait for their turn; beyond that: 503")
    penalty_s: Positive = Field(
        1.0, le=10, description="a refused request is answered this much later, to slow a flood"
    )
    stop_rate_hz: Positive = Field(
        100.0, ge=10, le=10_000, description="stop requests served per second, whatever else is going on"
    )
    maneuver_lease_s: Positive = Field(
        0.5, ge=0.1, le=5, description="a client silent for so long moves nothing by a service; slow emulators need 5 s"
    )
    services_n: int = Field(2, ge=1, description="device services running at the same time")
    command_timeout_s: Positive = Field(
        2.0, le=10, description="a control tick that answers later is reported as stuck"
    )
    stream_max_hz: Positive = Field(20.0, le=200, description="status messages per second and client")
