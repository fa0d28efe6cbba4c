"""The guard: runs after the daemon ended, whatever it died of, and makes both wires safe from a process of its own."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from graderd.config import Config, ConfigError, load
from graderd.hal.errors import DeviceError
from graderd.runtime.app.backends import actuator_of, rotator_of
from graderd.runtime.app.last_run import is_of, recall

log = logging.getLogger("graderd.guard")


def run_guard(config_path: Path | None) -> int:
    """Make the machine safe that the daemon last ran, else the one that ``config_path`` describes.

    Never raises: a stop must not fail for a typing mistake. Returns 0 if all were told, else 1.
    """
    return make_safe(config_to_act_on(config_path))


def config_to_act_on(config_path: Path | None) -> Config:
    """The configuration the daemon last ran with: its wires are the ones that may move, even if the file was changed
    since. Without one of this file, the file; where that cannot be used, what any daemon last ran with; the defaults.
    """
    config = None
    try:
        config = load(config_path)
    except ConfigError as error:
        log.error("guard: configuration not usable: %s", error.problems[0])
    except Exception:
        log.exception("guard: configuration not usable")
    last = recall(config.state.directory if config is not None else "")
    if last is not None and (config is None or is_of(last, config_path)):
        if last.config != config:
            log.info("guard: acting on what the daemon last ran with, read from %s", last.source)
        return last.config
    if config is None:
        log.error("guard: nothing is known of a former run: taking the defaults")
    return config or Config()


def make_safe(config: Config) -> int:
    """Every driver's own safe-off: motion disabled on the CAN bus, the servo as ``rotation.torque_at_exit`` says.

    The wires do not wait for each other: all at once, since one adapter may boot for seconds. What failed is tried once
    more when the others are done, in case two drivers share an adapter that takes one at a time. Returns 0 if all were
    told, else 1.
    """
    actions = _actions(config)
    with ThreadPoolExecutor(len(actions)) as threads:
        done = dict(zip(actions, threads.map(_told, actions, actions.values()), strict=True))
    failed = [name for name, told in done.items() if not told and not _told(name, actions[name])]
    log.info("guard: %s", json.dumps({"failed": failed}))
    return 1 if failed else 0


def _told(name: str, action: Callable[[], str]) -> bool:
    try:
        log.info("guard: %s: %s", name, action())
    except DeviceError as error:
        log.error("guard: %s: %s", name, error)
        return False
    except Exception:
        # Whatever one driver raises, a mistake of ours among it, is no reason to leave the next.
        log.exception("guard: %s", name)
        return False
    return True


def _actions(config: Config) -> dict[str, Callable[[], str]]:
    """Safe-off by the axes that it is for; a driver that cannot be had raises when its turn comes, not before."""

    sections = config.actuators()

    def rotation() -> str:
        backend, settings = rotator_of(config.rotation)
        return backend.safe_off(settings, config.can)

    def actuators(names: list[str]) -> str:
        found = {name: actuator_of(name, sections[name]) for name in names}
        backend = next(iter(found.values()))[0]
        return backend.safe_off({name: settings for name, (_, settings) in found.items()}, config.can)

    by_driver: dict[str, list[str]] = {}
    for name, section in sections.items():
        by_driver.setdefault(section.backend, []).append(name)
    actions = {", ".join(names): partial(actuators, names) for names in by_driver.values()}
    return {**actions, "rotation": rotation}
