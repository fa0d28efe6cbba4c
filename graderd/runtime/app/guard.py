"""The guard: runs after the daemon ended, whatever it died of, and makes both wires safe from a process of its own."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

from graderd.config import Config, ConfigError, load
from graderd.drivers.dynamixel.safe_off import safe_off as servo_safe_off
from graderd.drivers.electrak.safe_off import safe_off as actuators_safe_off
from graderd.hal.errors import DeviceError
from graderd.runtime.app.sim import attach

log = logging.getLogger("graderd.guard")


def run_guard(config_path: Path | None, rig_dir: Path | None = None) -> int:
    """Motion disabled on the CAN bus, torque on the servo bus as ``rotation.torque_at_exit`` says.

    The two wires do not wait for each other's success. Returns 0 if both were told, else 1; a configuration that
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
    addresses = (config.lift_left.address_n, config.lift_right.address_n, config.tilt.address_n)
    actions: dict[str, Callable[[], str]] = {
        "can": lambda: f"{actuators_safe_off(config.can, addresses)} motion-disable messages sent",
        "rotation": lambda: servo_safe_off(config.rotation),
    }
    for name, action in actions.items():
        try:
            log.info("guard: %s: %s", name, action())
        except DeviceError as error:
            failed.append(name)
            log.error("guard: %s: %s", name, error)
    log.info("guard: %s", json.dumps({"failed": failed}))
    return 1 if failed else 0
