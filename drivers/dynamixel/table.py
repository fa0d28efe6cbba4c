"""Control tables: registers by name and address, built from a firmware profile."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

from graderd import firmware_profiles
from graderd.hal.errors import WrongDeviceError

_PARTS = ("table", "motion", "rating", "bus", "telemetry", "expected", "hardware_error")
_CODES = {1: "B", 2: "H", 4: "I"}


@dataclass(frozen=True, slots=True)
class Register:
    """One item of a control table; numbers in counts, one count = ``scale`` x ``unit``.

    ``limit`` names the register that bounds the value at run time (``position_limits``: the pair of them).
    """

    name: str
    label: str
    address: int
    size: int
    writable: bool
    eeprom: bool
    signed: bool = False
    default: int = 0
    min: int | None = None
    max: int | None = None
    unit: str = ""
    scale: float = 1.0
    limit: str = ""
    values: tuple[int, ...] = ()
    mask: int | None = None

    @property
    def end(self) -> int:
        """First address after it."""
        return self.address + self.size

    def encode(self, value: int) -> bytes:
        """``value`` as it stands in the table.

        Raises:
            ValueError: it does not fit into the register's bytes.
        """
        try:
            return value.to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            raise ValueError(f"{value} does not fit into {self.name} ({self.size} bytes)") from None

    def decode(self, data: bytes) -> int:
        """The value that stands in ``data`` (exactly ``size`` bytes).

        Raises:
            ValueError: ``data`` has another length.
        """
        if len(data) != self.size:
            raise ValueError(f"{self.name} has {self.size} bytes, not {len(data)}")
        return int.from_bytes(data, "little", signed=self.signed)

    def allows(self, value: int) -> bool:
        """Whether the documented range, value list and bit mask allow ``value``."""
        if self.min is not None and self.max is not None and not self.min <= value <= self.max:
            return False
        if self.values and value not in self.values:
            return False
        return self.mask is None or not value & ~self.mask


@dataclass(frozen=True)
class Block:
    """Neighbouring registers that are read in one request."""

    registers: tuple[Register, ...]
    address: int = field(init=False)
    size: int = field(init=False)
    _names: tuple[str, ...] = field(init=False, repr=False)
    _layout: struct.Struct = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "address", self.registers[0].address)
        object.__setattr__(self, "size", self.registers[-1].end - self.registers[0].address)
        codes, at = ["<"], self.address
        for r in self.registers:
            code = _CODES[r.size]
            codes += ["x" * (r.address - at), code.lower() if r.signed else code]
            at = r.end
        object.__setattr__(self, "_names", tuple(r.name for r in self.registers))
        object.__setattr__(self, "_layout", struct.Struct("".join(codes)))

    def decode(self, data: bytes) -> dict[str, int]:
        """Values by register name from the ``size`` bytes of the block.

        Raises:
            ValueError: ``data`` has another length.
        """
        if len(data) != self.size:
            raise ValueError(f"the block at {self.address} has {self.size} bytes, not {len(data)}")
        return dict(zip(self._names, self._layout.unpack(data), strict=True))

    def encode(self, values: dict[str, int]) -> bytes:
        """The block's bytes for a write of all its registers.

        Raises:
            ValueError: a value does not fit into its register, or one is missing.
        """
        try:
            return self._layout.pack(*(values[name] for name in self._names))
        except (struct.error, KeyError) as e:
            raise ValueError(f"cannot write {self._names}: {e}") from None


class ControlTable:
    """All registers of one model, and the profile's other facts as plain data in ``profile``."""

    def __init__(self, profile: dict[str, Any]) -> None:
        self.profile = profile
        self.name: str = profile["name"]
        self.title: str = profile["title"]
        self.model_number: int = profile["model_number"]
        self.memory_bytes: int = profile["memory_bytes"]
        self.registers: tuple[Register, ...] = tuple(_expand(profile))
        self._by_name = {r.name: r for r in self.registers}
        self._by_address = {a: r for r in self.registers for a in range(r.address, r.end)}

    @classmethod
    def load(cls, name: str) -> ControlTable:
        """The table of the firmware profile ``name``.

        Raises:
            firmware_profiles.UnknownProfileError: there is no such profile.
            WrongDeviceError: it is no servo's.
        """
        profile = firmware_profiles.load(name)
        try:
            if missing := [part for part in _PARTS if part not in profile]:
                raise ValueError(f"{missing[0]} is missing")
            return cls(profile)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            cause = f"is no control table of a servo ({error})"
            raise WrongDeviceError(f"firmware profile {name}", cause, "Correct rotation.profile") from None

    def __getitem__(self, name: str) -> Register:
        return self._by_name[name]

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def at(self, address: int) -> Register | None:
        """The register that covers ``address``, or None in a gap."""
        return self._by_address.get(address)

    def block(self, first: str, last: str) -> Block:
        """Everything from register ``first`` to register ``last``, for one read request."""
        begin, end = self[first].address, self[last].end
        return Block(tuple(r for r in self.registers if begin <= r.address and r.end <= end))


def _expand(profile: dict[str, Any]) -> list[Register]:
    registers = []
    for row in profile["table"]["register"]:
        count = row.get("count", 1)
        for index in range(count):
            address = row["address"] + index * row["size"]
            registers.append(
                Register(
                    name=row["name"] if count == 1 else f"{row['name']}_{index + 1}",
                    label=row["label"] if count == 1 else f"{row['label']} {index + 1}",
                    address=address,
                    size=row["size"],
                    writable=row["access"] == "rw",
                    eeprom=address < profile["eeprom_end"],
                    signed=row.get("signed", False),
                    default=row.get("default", 0) + index * row.get("default_step", 0),
                    min=row.get("min"),
                    max=row.get("max"),
                    unit=row.get("unit", ""),
                    scale=row.get("scale", 1),
                    limit=row.get("limit", ""),
                    values=tuple(row.get("values", ())),
                    mask=row.get("mask"),
                )
            )
    return sorted(registers, key=lambda r: r.address)
