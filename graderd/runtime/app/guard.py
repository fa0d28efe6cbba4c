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
from graderd.runtime.app.last_run import is_of, recall

log = logging.getLogger("graderd.guard")


def run_guard(config_path: Path | None) -> int:
    """Make the machine safe that the daemon last ran, else the one that ``config_path`` describes.

    Never raises: a stop must not fail for a typing mistake. Returns 0 if both wires were told, else 1.
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
    """Motion disabled on the CAN bus, torque on the servo bus as ``rotation.torque_at_exit`` says.

    The two wires do not wait for each other's success. Returns 0 if both were told, else 1.
    """
    failed = []
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
        except Exception:
            # A mistake of ours on one wire is no reason to leave the other.
            failed.append(name)
            log.exception("guard: %s", name)
    log.info("guard: %s", json.dumps({"failed": failed}))
    return 1 if failed else 0
