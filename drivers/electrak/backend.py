"""The Electraks as the wiring gets them: ``lift_left.backend = "electrak"``, and so on."""

from __future__ import annotations

from collections.abc import Mapping

from graderd.drivers.backend import LinearActuatorBackend, Parts
from graderd.drivers.electrak.actuator import ElectrakActuator
from graderd.drivers.electrak.safe_off import safe_off
from graderd.hal.settings import CanSettings, ElectrakSettings


def _build(name: str, settings: ElectrakSettings, parts: Parts) -> ElectrakActuator:
    return ElectrakActuator(name, settings, parts.can, parts.clock)


def _safe_off(axes: Mapping[str, ElectrakSettings], can: CanSettings) -> str:
    return f"{safe_off(can, [axis.address_n for axis in axes.values()])} motion-disable messages sent"


ELECTRAK = LinearActuatorBackend(ElectrakSettings, _build, _safe_off)
