"""The PH54 as the wiring gets it: ``rotation.backend = "ph54"``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from graderd.drivers.backend import Parts, RotatorBackend
from graderd.drivers.dynamixel.dump import wire_line
from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.drivers.dynamixel.safe_off import safe_off
from graderd.hal.service import DeviceService, WatchBus
from graderd.hal.settings import CanSettings, Ph54Settings


def _build(settings: Ph54Settings, parts: Parts) -> Ph54Rotator:
    return Ph54Rotator(settings, parts.clock)


def _safe_off(settings: Ph54Settings, _: CanSettings) -> str:
    return safe_off(settings)


def _services(rotator: Ph54Rotator) -> Mapping[str, DeviceService]:
    async def verify_profile(_: dict[str, Any]) -> dict[str, Any]:
        return {"differences": [asdict(difference) for difference in await rotator.verify_profile()]}

    async def reboot(_: dict[str, Any]) -> dict[str, Any]:
        await rotator.reboot()
        return {"rebooted": True}

    async def confirm_turns(_: dict[str, Any]) -> dict[str, Any]:
        rotator.confirm_turns()
        return {"confirmed": True}

    return {
        "verify_profile": DeviceService(verify_profile, only_reads=True),
        "reboot": DeviceService(reboot),
        "confirm_turns": DeviceService(confirm_turns),
    }


def _buses(rotator: Ph54Rotator) -> Mapping[str, WatchBus]:
    def watch(listener: Callable[[str], None]) -> Callable[[], None]:
        return rotator.tap(lambda t_s, direction, data: listener(wire_line(t_s, direction, data)))

    return {"servo": watch}


PH54 = RotatorBackend(Ph54Settings, _build, _safe_off, _services, _buses)
