"""What the daemon last ran with, kept in its state directory: the guard acts on that, whatever became of the file."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from graderd import places
from graderd.config import Config
from graderd.hal.settings import Ph54Settings

FILE: Final = "last_run.json"

log = logging.getLogger(__name__)


class LastRun(BaseModel):
    """A configuration in force, and the file it was read from."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: Path
    config: Config


def remember(config: Config, source: Path | None) -> None:
    """Write down what the daemon runs with; called before it touches a device.

    The directory is systemd's, where the guard finds it without a configuration, else the configured one; without
    either nothing is kept. What cannot be written is told, and the former one goes: it would be wrong.
    """
    directory = os.environ.get("STATE_DIRECTORY") or config.state.directory
    if not directory:
        return
    path = Path(directory) / FILE
    temporary = path.with_suffix(".new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(LastRun(source=_absolute(source), config=config).model_dump_json(), encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        log.warning("%s: cannot be written (%s): the guard will read the configuration itself", path, error.strerror)
        for wrong in (temporary, path):
            try:
                wrong.unlink(missing_ok=True)
            except OSError as again:
                log.warning("%s: cannot be removed (%s)", wrong, again.strerror)


def recall(configured: str) -> LastRun | None:
    """What the daemon last ran with, None where nothing usable is kept; ``configured`` is ``state.directory``.

    A simulated machine that is gone is nothing to act on.
    """
    path = Path(os.environ.get("STATE_DIRECTORY") or configured or places.STATE) / FILE
    try:
        last = LastRun.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        log.warning("%s: not usable (%s)", path, str(error).splitlines()[0])
        return None
    rotation = last.config.rotation
    gone = last.config.simulated and isinstance(rotation, Ph54Settings) and not Path(rotation.port).exists()
    return None if gone else last


def is_of(last: LastRun, source: Path | None) -> bool:
    """Whether it was read from ``source`` (None: the default place)."""
    return last.source == _absolute(source)


def _absolute(source: Path | None) -> Path:
    return Path(os.path.abspath(source or places.config()))
