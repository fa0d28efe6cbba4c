"""Where an installed graderd has its things; ``systemd/`` and ``packaging/`` make these places."""

from __future__ import annotations

from pathlib import Path
from typing import Final

CONFIG: Final = Path("/etc/graderd/graderd.toml")
SOCKET: Final = Path("/run/graderd/graderd.sock")
STATE: Final = Path("/var/lib/graderd")
TOKENS: Final = STATE / "api-tokens"
