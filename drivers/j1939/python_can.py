"""python-can, imported without asammdf.

Importing it imports asammdf where that is installed, for one log format, and with it pandas: 2 s of processor time in
each process that opens a bus, the guard's too. Whoever reads an MF4 log says so (:func:`load_mf4`).
"""

from __future__ import annotations

import importlib
import sys

_LOG_LIBRARY = "asammdf"

if _LOG_LIBRARY in sys.modules:  # somebody paid for it already
    import can
else:
    sys.modules[_LOG_LIBRARY] = None  # type: ignore[assignment]  # the language's way to say: cannot be imported
    try:
        import can
    finally:
        del sys.modules[_LOG_LIBRARY]

from can.interfaces.slcan import slcanBus
from can.interfaces.socketcan import SocketcanBus
from can.io.generic import BinaryIOMessageReader
from can.io.player import MESSAGE_READERS

__all__ = ["MESSAGE_READERS", "BinaryIOMessageReader", "SocketcanBus", "can", "load_mf4", "slcanBus"]


def load_mf4() -> None:
    """Let python-can find asammdf: call it before an MF4 log is opened. Without the extra ``mf4`` nothing changes."""
    reader = sys.modules["can.io.mf4"]
    if getattr(reader, _LOG_LIBRARY) is None:
        importlib.reload(reader)
