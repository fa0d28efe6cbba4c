"""The PH54 as the wiring gets it: ``rotation.backend = "ph54"``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from graderd.drivers.backend import Parts, RotatorBackend
from graderd.drivers.dynamixel.dump import wire_line
from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.drivers.dynamixel.safe_off import safe_off
from graderd.hal.device import DeviceService, NoArguments, WatchBus
from graderd.hal.settings import CanSettings, Ph54Settings


def _build(settings: Ph54Settings, parts: Parts) -> Ph54Rotator:
    return Ph54Rotator(settings, parts.clock)


def _safe_off(settings: Ph54Settings, _: CanSettings) -> str:
    return safe_off(settings)


def _services(rotator: Ph54Rotator) -> Mapping[str, DeviceService]:
    async def verify_profile(_: NoArguments) -> dict[str, Any]:
        return {"differences": [asdict(difference) for difference in await rotator.verify_profile()]}

    async def scan(_: NoArguments) -> dict[str, Any]:
        return {"servos": [asdict(found) for found in await rotator.scan()]}

    async def reboot(_: NoArguments) -> dict[str, Any]:
        await rotator.reboot()
        return {"rebooted": True}

    async def confirm_turns(_: NoArguments) -> dict[str, Any]:
        rotator.confirm_turns()
        return {"confirmed": True}

    return {
        "verify_profile": DeviceService(
            verify_profile, only_reads=True, summary="Compare the servo's settings with its profile"
        ),
        "scan": DeviceService(scan, summary="Find the servos on the wire, at every id and baud rate"),
        "reboot": DeviceService(reboot, summary="Reboot the servo, which clears its alerts"),
        "confirm_turns": DeviceService(confirm_turns, summary="Say that the angle shown is the blade's"),
    }


def _buses(rotator: Ph54Rotator) -> Mapping[str, WatchBus]:
    def watch(listener: Callable[[str], None]) -> Callable[[], None]:
        return rotator.tap(lambda t_s, direction, data: listener(wire_line(t_s, direction, data)))

    return {"servo": watch}


PH54 = RotatorBackend(Ph54Settings, _build, _safe_off, _services, _buses)
