"""What can be made to go wrong on the virtual bus: a name, a sentence, its parameters with defaults."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One fault that :meth:`~graderd.simulator.servo.VirtualServoBus.inject` knows."""

    text: str
    params: dict[str, float] = field(default_factory=dict)


def parse(text: str, separator: str = ",") -> tuple[str, dict[str, float]]:
    """``name`` and parameters from ``name:key=value,key=value`` (or with spaces, for the console).

    Raises:
        ValueError: a parameter is not ``key=number``.
    """
    name, _, rest = text.strip().replace(":", " ", 1).partition(" ")
    params: dict[str, float] = {}
    for pair in filter(None, (p.strip() for p in rest.replace(separator, " ").split(" "))):
        key, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"{pair!r} is not key=number")
        params[key] = float(value)
    return name, params


ALERT_BITS = {
    "alert_voltage": 0x01,
    "alert_hall_sensor": 0x02,
    "alert_overheating": 0x04,
    "alert_encoder": 0x08,
    "alert_electrical_shock": 0x10,
    "alert_overload": 0x20,
}

FAULTS: dict[str, FaultKind] = {
    # on the wire
    "drop": FaultKind("status packets are lost with this probability", {"rate": 1.0}),
    "drop_requests": FaultKind("instruction packets are lost with this probability", {"rate": 1.0}),
    "damage_requests": FaultKind("instructions arrive damaged, are answered CRC Error, with this rate", {"rate": 1.0}),
    "delay": FaultKind("status packets come later", {"seconds": 0.03}),
    "flip": FaultKind("one bit of a status packet is flipped with this probability", {"rate": 1.0}),
    "truncate": FaultKind("the end of a status packet is missing with this probability", {"rate": 1.0}),
    "echo": FaultKind("the adapter echoes what the host sends"),
    "foreign_id": FaultKind("status packets carry another servo's id", {"servo_id": 99}),
    "noise": FaultKind("stray bytes before status packets", {"bytes_n": 7}),
    "babble": FaultKind("before status packets a header that claims so long a packet", {"length": 1000}),
    "twin": FaultKind("a second servo with the same id answers after the first one"),
    "collide": FaultKind("a second servo with the same id answers at the same time: what differs is damaged"),
    "trickle": FaultKind("bytes come and go one at a time", {"gap_s": 0.0003}),
    "unplug": FaultKind("the cable is pulled: port and link vanish"),
    # in the servo
    "power_cut": FaultKind("the 24 V supply fails; back after `seconds`, 0: when faults are cleared", {"seconds": 0.0}),
    "ram_reset": FaultKind("a supply dip resets the RAM registers at once, without silence"),
    "refuse": FaultKind("writes that begin at `address` are refused with `error`", {"address": 556, "error": 6}),
    "wrong_position": FaultKind("so many position readings are off, with a right CRC", {"deg": 30.0, "reads_n": 1}),
    "keeps_turns": FaultKind("torque-on in position mode does not bring the count back to within one turn"),
    "torque_off": FaultKind("torque is switched off by somebody else"),
    "turns_lost": FaultKind("the multi-turn count is off by so many turns", {"turns_n": 1}),
    "wrong_model": FaultKind("another model answers", {"model_n": 2010}),
    "jam": FaultKind("the shaft is blocked"),
    "wrong_way": FaultKind("the motor turns the wrong way"),
    "push": FaultKind("an external torque on the shaft", {"torque_nm": 120.0}),
    "voltage": FaultKind("supply reads so many volts", {"volts": 19.0}),
    "temperature": FaultKind("temperature reads so many °C", {"celsius": 75.0}),
    **{name: FaultKind(f"hardware error bit 0x{bit:02X}") for name, bit in ALERT_BITS.items()},
}
