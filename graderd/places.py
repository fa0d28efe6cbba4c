"""Where an installed graderd has its things (``systemd/`` and ``packaging/`` make these places), and where those of a
user's own daemon are."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

CONFIG: Final = Path("/etc/graderd/graderd.toml")
SOCKET: Final = Path("/run/graderd/graderd.sock")
STATE: Final = Path("/var/lib/graderd")


def config() -> Path:
    """The configuration that is meant where none is named: the machine's, and on a computer without one the user's own
    (``$XDG_CONFIG_HOME``). Root has none of its own: what root writes is the machine's."""
    own = _of_the_user("XDG_CONFIG_HOME", ".config")
    return CONFIG if own is None or os.geteuid() == 0 or is_there(CONFIG) else own / CONFIG.name


def state_of(config_path: Path) -> Path:
    """Where a daemon that runs by that configuration keeps recordings, last stop and tokens: by the machine's in the
    service's directory, by any other in the user's own (``$XDG_STATE_HOME``)."""
    own = _of_the_user("XDG_STATE_HOME", ".local/state")
    return STATE if own is None or config_path.absolute() == CONFIG else own


def tokens() -> Path:
    """Where tokens are, where no configuration says so."""
    return state_of(config()) / "api-tokens"


def own_socket() -> Path | None:
    """The socket of a daemon that this user runs: in ``$XDG_RUNTIME_DIR``, and where a session has none (``su``, a
    container) where that daemon's state is; None where there is no such user."""
    own = _of_the_user("XDG_RUNTIME_DIR", ".local/state")
    return None if own is None else own / "graderd.sock"


def _of_the_user(variable: str, under_home: str) -> Path | None:
    """graderd's folder in a place of the user's; None where there is no such user. A relative path counts for nothing,
    as the base directory specification of freedesktop.org has it."""
    named = Path(os.environ.get(variable, ""))
    base = named if named.is_absolute() else Path(os.path.expanduser("~")) / under_home
    return base / "graderd" if base.is_absolute() else None


def is_there(path: Path) -> bool:
    """Whether it is; also where this user may not look: there is one then, and it is not for us to do without it."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True
    return True
