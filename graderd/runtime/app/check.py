"""What a valid configuration may ask that this installation cannot do: `run` and `config check` refuse the same."""

from __future__ import annotations

import grp
import os
from pathlib import Path

from graderd.api.server import MAX_PATH_BYTES
from graderd.config import Config, ConfigError
from graderd.hal.clock import SystemClock
from graderd.hal.errors import DeviceError
from graderd.runtime.app.backends import check_plugins
from graderd.runtime.app.devices import build_devices, build_stop_input


def problems(config: Config) -> list[str]:
    """A line each with place, cause and remedy; nothing is opened, whatever is or is not plugged in."""
    found = []
    clock = SystemClock()
    try:
        check_plugins(config)
        build_devices(config, clock, on_bus_stop=lambda _: None)
        build_stop_input(config, clock, on_stop=lambda _: None)
    except ConfigError as error:
        found += error.problems
    except (DeviceError, LookupError) as error:
        found.append(" ".join(str(error).split()))
    api = config.api
    if not Path(api.socket).name or len(os.fsencode(api.socket)) > MAX_PATH_BYTES:
        found.append(f"api.socket: {api.socket!r} is no path of 1 to {MAX_PATH_BYTES} bytes. Choose a shorter one")
    if api.socket_group:
        try:
            grp.getgrnam(api.socket_group)
        except KeyError:
            found.append(f"api.socket_group: there is no group {api.socket_group}. Create it, or name another")
    return found
