"""The guard: runs after the daemon ended, whatever it died of, and makes both wires safe from a process of its own."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from graderd.config import Config, ConfigError, load
from graderd.runtime.app.backends import actuator_of, rotator_of
from graderd.runtime.app.sim import attach

log = logging.getLogger("graderd.guard")


def run_guard(config_path: Path | None, rig_dir: Path | None = None) -> int:
    """Every driver's own safe-off: motion disabled on the CAN bus, the servo as ``rotation.torque_at_exit`` says.

    The wires do not wait for each other's success. Returns 0 if all were told, else 1; a configuration that
    cannot be read is answered with the defaults, because a stop must not fail for a typing mistake.
    """
    try:
        config = load(config_path)
    except ConfigError as error:
        log.error("guard: configuration not usable, taking the defaults: %s", error.problems[0])
        config = Config()
    failed = []
    if rig_dir is not None:
        config = attach(config, rig_dir)
    for name, action in _actions(config).items():
        try:
            log.info("guard: %s: %s", name, action())
        except Exception as error:  # whatever one driver raises, the next one is asked too
            failed.append(name)
            log.error("guard: %s: %s", name, error)
    log.info("guard: %s", json.dumps({"failed": failed}))
    return 1 if failed else 0


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
