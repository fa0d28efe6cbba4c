"""The 64-bit NAME of SAE J1939-81, which decides who keeps an address: the numerically lower one wins."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

# (field, lowest bit, bits); little-endian on the wire
_LAYOUT: Final = (
    ("identity", 0, 21),
    ("manufacturer", 21, 11),
    ("ecu_instance", 32, 3),
    ("function_instance", 35, 5),
    ("function", 40, 8),
    ("reserved", 48, 1),
    ("vehicle_system", 49, 7),
    ("vehicle_system_instance", 56, 4),
    ("industry_group", 60, 3),
    ("arbitrary_address_capable", 63, 1),
)


@dataclass(frozen=True, slots=True)
class Name:
    """The fields of a NAME, each a bare number with the width of J1939-81.

    Raises:
        ValueError: a field does not fit its width.
    """

    identity: int = 0
    manufacturer: int = 0
    ecu_instance: int = 0
    function_instance: int = 0
    function: int = 0
    reserved: int = 0
    vehicle_system: int = 0
    vehicle_system_instance: int = 0
    industry_group: int = 0
    arbitrary_address_capable: int = 0

    def __post_init__(self) -> None:
        for field, _, bits in _LAYOUT:
            if not 0 <= getattr(self, field) < 1 << bits:
                raise ValueError(f"NAME field {field} = {getattr(self, field)} does not fit {bits} bits")

    @property
    def value(self) -> int:
        """The 64-bit number that is compared in arbitration."""
        return sum(int(getattr(self, field)) << low for field, low, _ in _LAYOUT)

    def to_bytes(self) -> bytes:
        """The eight bytes of an address claim."""
        return self.value.to_bytes(8, "little")

    @classmethod
    def from_value(cls, value: int) -> Name:
        """Take a 64-bit number apart."""
        return cls(**{field: (value >> low) & ((1 << bits) - 1) for field, low, bits in _LAYOUT})

    @classmethod
    def from_bytes(cls, data: bytes) -> Name:
        """Take the data of an address claim apart.

        Raises:
            ValueError: it is not eight bytes long.
        """
        if len(data) != 8:
            raise ValueError(f"a NAME has 8 bytes, got {len(data)}")
        return cls.from_value(int.from_bytes(data, "little"))

    def as_dict(self) -> dict[str, int]:
        """Field names and values, lowest bits first."""
        return {field.name: getattr(self, field.name) for field in fields(self)}
