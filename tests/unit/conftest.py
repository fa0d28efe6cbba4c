"""`make unit` takes seconds: a test here starts no process and serves no socket, unless it says so (``live``)."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator

import pytest

from graderd.runtime.app.journal import LaterHandler

LIVE = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system", "socket.bind"}
"""Events of PEP 578, which no library gets around."""
_judged = ""


def _refuse(event: str, _: tuple[object, ...]) -> None:
    if _judged and event in LIVE:
        raise RuntimeError(f"{_judged}: {event} in a unit test; mark it @pytest.mark.live")


sys.addaudithook(_refuse)


@pytest.fixture(autouse=True)
def as_marked(request: pytest.FixtureRequest) -> Iterator[None]:
    """Hold the test to its mark: one that is ``pure`` runs beside whole machines, and in `make unit`."""
    global _judged
    _judged = request.node.nodeid if request.node.get_closest_marker("pure") else ""
    yield
    _judged = ""


@pytest.fixture(autouse=True)
def no_log_of_another_test() -> Iterator[None]:
    """A command that set up the daemon's log in this process leaves it to no other test's standard error."""
    yield
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if isinstance(handler, LaterHandler):
            root.removeHandler(handler)
            handler.close()
            logging.getLogger("graderd").setLevel(logging.NOTSET)
