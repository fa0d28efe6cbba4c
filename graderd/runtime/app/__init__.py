"""The wiring: daemon, perception child and guard. The only package that imports drivers.

The functions import what they need when called, so that ``graderd --help`` and the other clients start fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from graderd.config import Config


def run_daemon(config_path: Path | None, sim: bool, rig_dir: Path | None, as_json: bool) -> int:
    """See :func:`graderd.runtime.app.daemon.run_daemon`."""
    from graderd.runtime.app.daemon import run_daemon as run

    return run(config_path, sim, rig_dir, as_json)


def run_guard(config_path: Path | None) -> int:
    """See :func:`graderd.runtime.app.guard.run_guard`."""
    from graderd.runtime.app.guard import run_guard as run

    return run(config_path)


def check_drivers(config: Config) -> None:
    """See :func:`graderd.runtime.app.backends.check_plugins`; loads no driver where all are graderd's own."""
    from graderd.hal.settings import PLUGIN, tag_of

    sections = (config.rotation, config.lift_left, config.lift_right, config.tilt, config.camera, config.stop_input)
    if any(tag_of(section) == PLUGIN for section in sections):
        from graderd.runtime.app.backends import check_plugins

        check_plugins(config)
