"""The wiring: daemon, perception child and guard. The only package that imports drivers.

The functions import what they need when called, so that ``graderd --help`` and the other clients start fast.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from graderd.config import Config
    from graderd.record.reader import Recording


def run_daemon(
    config_path: Path | None,
    sim: bool,
    rig_dir: Path | None,
    as_json: bool,
    log_level: int = logging.INFO,
    socket: Path | None = None,
) -> int:
    """See :func:`graderd.runtime.app.daemon.run_daemon`."""
    from graderd.runtime.app.daemon import run_daemon as run

    return run(config_path, sim, rig_dir, as_json, log_level, socket)


def run_guard(config_path: Path | None) -> int:
    """See :func:`graderd.runtime.app.guard.run_guard`."""
    from graderd.runtime.app.guard import run_guard as run

    return run(config_path)


def serve_recording(
    recording: Recording, socket: Path, port_n: int | None, speed: float, from_s: float, ready: Callable[[float], None]
) -> None:
    """See :func:`graderd.runtime.app.replay_server.serve_recording`."""
    from graderd.runtime.app.replay_server import serve_recording as run

    run(recording, socket, port_n, speed, from_s, ready)


def problems(config: Config) -> list[str]:
    """See :func:`graderd.runtime.app.devices.problems`."""
    from graderd.runtime.app.devices import problems as find

    return find(config)


def on_rig(config: Config, directory: Path) -> Config:
    """See :func:`graderd.runtime.app.sim.attach`."""
    from graderd.runtime.app.sim import attach

    return attach(config, directory)
