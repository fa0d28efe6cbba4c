"""Faults of one virtual actuator, by name."""

from __future__ import annotations

from typing import Final

from graderd.simulator.actuators.model import VirtualElectrak
from graderd.simulator.actuators.motor import Behaviour

UNIT_FAULTS: Final = (
    "babble",
    "backdrive",
    "drift",
    "fatal",
    "frozen_feedback",
    "garbage",
    "manual_override",
    "overload",
    "parameter",
    "power_cut",
    "restart",
    "saturation",
    "silence",
    "slow",
    "stuck",
    "temperature_high",
    "temperature_low",
    "voltage_high",
    "voltage_low",
    "wrong_address",
)


def inject(unit: VirtualElectrak, fault: str, params: dict[str, float]) -> None:
    """Switch ``fault`` on.

    Parameters and their defaults: ``babble`` rate_hz 500; ``drift`` speed_mm_per_s -4; ``manual_override`` direction
    1 (extend) or -1; ``overload`` load_n 4000; ``slow`` factor 0.7; ``supply_v`` and ``temperature_c`` of the supply
    and temperature faults; ``wrong_address`` to_address 33.

    Raises:
        ValueError: no such fault.
    """
    faults = unit.faults
    match fault:
        case "silence":
            faults.silent = True
        case "babble":
            faults.babble_hz = params.get("rate_hz", 500.0)
        case "stuck":
            faults.stuck = True
        case "drift":
            faults.drift_mm_per_s = params.get("speed_mm_per_s", -4.0)
        case "garbage":
            faults.garbage = True
        case "frozen_feedback":
            faults.frozen_feedback = True
        case "power_cut":
            unit.cut_power()
        case "restart":
            unit.cut_power()
            unit.restore_power()
        case "wrong_address":
            unit.address = int(params.get("to_address", 33))
        case "overload":
            unit.load_n = params.get("load_n", 4000.0)
        case "slow":
            unit.behaviour.speed_factor = params.get("factor", 0.7)
        case "voltage_low":
            unit.supply_v = params.get("supply_v", 8.0)
        case "voltage_high":
            unit.supply_v = params.get("supply_v", 17.0)
        case "temperature_low":
            unit.temperature_c = params.get("temperature_c", -45.0)
        case "temperature_high":
            unit.temperature_c = params.get("temperature_c", 90.0)
        case "fatal":
            unit.fatal = True
        case "manual_override":
            unit.manual_override = "extend" if params.get("direction", 1.0) > 0 else "retract"
        case "backdrive" | "parameter" | "saturation":
            faults.forced_flags |= {fault}
        case _:
            raise ValueError(f"no fault {fault!r} of an actuator; there are {', '.join(UNIT_FAULTS)}")


def clear(unit: VirtualElectrak) -> None:
    """Make the unit healthy: no defect, normal supply and temperature, no load, own address, power on."""
    unit.faults.clear()
    unit.behaviour.speed_factor = Behaviour().speed_factor
    unit.supply_v, unit.temperature_c, unit.load_n = 12.5, 25.0, 0.0
    unit.manual_override = None
    unit.return_home()
    if not unit.powered or unit.fatal:
        unit.cut_power()
        unit.restore_power()
