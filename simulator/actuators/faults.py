"""What can be made to go wrong on the virtual bus: faults of one actuator, by name, and badly behaved neighbours."""

from __future__ import annotations

import random
from typing import Final

from graderd.drivers.j1939.ids import GLOBAL, NULL, Frame, Pgn, make_id, pgn_of, source_of
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


_FLOOD_MAX_N: Final = 200
_ASK_FOR_CLAIMS: Final = Pgn.ADDRESS_CLAIMED.to_bytes(3, "little")
LOWEST_PRIORITY_NAME: Final = (1 << 64) - 1


class RivalController:
    """A second controller that wants an address and answers every claim for it at once, without any limit.

    ``name`` is its NAME; None copies the NAME of whoever claims, so that arbitration cannot end (two controllers
    with equal NAMEs); such a one first asks who is there, as every node does that joins. ``claims_hz`` claims without
    being asked as well (a claim storm).
    """

    def __init__(self, address: int, name: int | None = None, claims_hz: float = 0.0) -> None:
        self.address = address
        self._name = name
        self._claims_hz = claims_hz
        self._due_s = 0.0
        self._joined = False
        self.heard_n = 0
        """Claims of others for this address."""
        self.sent_n = 0

    def on_frame(self, frame: Frame) -> list[Frame]:
        """Answer a claim for the address."""
        if pgn_of(frame.can_id) != Pgn.ADDRESS_CLAIMED or source_of(frame.can_id) != self.address:
            return []
        self.heard_n += 1
        return [self._claim(int.from_bytes(frame.data, "little"))]

    def advance(self, now_s: float) -> list[Frame]:
        """What is sent unasked up to ``now_s``."""
        if self._name is None:
            joined, self._joined = self._joined, True
            return [] if joined else [Frame(make_id(6, Pgn.REQUEST, NULL, GLOBAL), _ASK_FOR_CLAIMS)]
        out: list[Frame] = []
        if not self._claims_hz:
            return out
        self._due_s = max(self._due_s, now_s - 0.1)
        while self._due_s <= now_s:
            self._due_s += 1.0 / self._claims_hz
            out.append(self._claim(self._name))
        return out

    def _claim(self, other: int) -> Frame:
        self.sent_n += 1
        name = other if self._name is None else self._name
        return Frame(make_id(6, Pgn.ADDRESS_CLAIMED, self.address), name.to_bytes(8, "little"))


class Flood:
    """Random proprietary broadcasts at ``rate_hz`` from one address (a full bus carries some 1,600 a second)."""

    def __init__(self, rate_hz: float, source: int = 0x55, seed: int = 0) -> None:
        self._rate_hz = rate_hz
        self._source = source
        self._random = random.Random(seed)
        self._debt = 0.0
        self._last_s: float | None = None

    def advance(self, now_s: float) -> list[Frame]:
        """Frames due up to ``now_s``."""
        if self._last_s is not None:
            self._debt = min(self._debt + (now_s - self._last_s) * self._rate_hz, _FLOOD_MAX_N)
        self._last_s = now_s
        count, self._debt = int(self._debt), self._debt % 1.0
        return [
            Frame(make_id(3, 0xFF00 | self._random.randrange(256), self._source, GLOBAL), self._random.randbytes(8))
            for _ in range(count)
        ]
