"""Where an installed graderd has its things (``systemd/`` and ``packaging/`` make these places), and where a user's own
daemon has its socket."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

CONFIG: Final = Path("/etc/graderd/graderd.toml")
SOCKET: Final = Path("/run/graderd/graderd.sock")
STATE: Final = Path("/var/lib/graderd")
TOKENS: Final = STATE / "api-tokens"


def own_socket() -> Path | None:
    """The socket of a daemon that this user runs; None where the system gives users no such place."""
    own = os.environ.get("XDG_RUNTIME_DIR")
    return Path(own) / "graderd" / "graderd.sock" if own else None
