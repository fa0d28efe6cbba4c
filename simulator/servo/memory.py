"""A control table as a servo keeps it: bytes with access rules, limits, lock and indirect addressing."""

from __future__ import annotations

from dataclasses import dataclass, field

from graderd.drivers.dynamixel.codec import StatusError
from graderd.drivers.dynamixel.table import ControlTable, Register


class TableError(Exception):
    """A read or write that the table refuses; ``error`` is what the status packet says."""

    def __init__(self, error: StatusError) -> None:
        super().__init__(error.name)
        self.error = error


@dataclass
class Backup:
    """What Control Table Backup keeps (indirect addresses and torque are not part of it)."""

    values: dict[str, int] = field(default_factory=dict)


_NOT_BACKED_UP = {"torque_enable", "bus_watchdog", "id", "baud_rate"}


class ControlMemory:
    """The table's bytes. Values by name for the servo itself; checked access by address for the bus."""

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self._bytes = bytearray(table.memory_bytes)
        self.backup: Backup | None = None
        self._indirect_n = sum(1 for r in table.registers if r.name.startswith("indirect_data_"))
        self._indirect_base = table["indirect_data_1"].address if self._indirect_n else 0
        self._pointer_base = table["indirect_address_1"].address if self._indirect_n else 0
        self.reset_all()

    def __getitem__(self, name: str) -> int:
        r = self.table[name]
        return int.from_bytes(self._bytes[r.address : r.end], "little", signed=r.signed)

    def __setitem__(self, name: str, value: int) -> None:
        r = self.table[name]
        low, high = (-(1 << 8 * r.size - 1), (1 << 8 * r.size - 1) - 1) if r.signed else (0, (1 << 8 * r.size) - 1)
        self._bytes[r.address : r.end] = r.encode(max(low, min(high, value)))

    def reset_all(self, keep: tuple[str, ...] = ()) -> None:
        """Factory state of every register but those in ``keep``."""
        for r in self.table.registers:
            if r.name not in keep:
                self[r.name] = r.default

    def reset_ram(self) -> None:
        """What a power-up does to the RAM area."""
        for r in self.table.registers:
            if not r.eeprom:
                self[r.name] = r.default
        self["backup_ready"] = 1 if self.backup else 0

    def save_backup(self) -> None:
        """Keep every writable value."""
        rows = (r for r in self.table.registers if r.writable and r.name not in _NOT_BACKED_UP)
        self.backup = Backup({r.name: self[r.name] for r in rows if not r.name.startswith("indirect_")})
        self["backup_ready"] = 1

    def restore_backup(self, *, eeprom: bool) -> None:
        """Bring back the EEPROM or the RAM half of the backup.

        Raises:
            TableError: there is none.
        """
        if self.backup is None:
            raise TableError(StatusError.RESULT_FAIL)
        for name, value in self.backup.values.items():
            if self.table[name].eeprom == eeprom:
                self[name] = value

    def read(self, address: int, size: int) -> bytes:
        """Bytes as the bus sees them; gaps between registers read 0.

        Raises:
            TableError: no bytes asked for, or the range starts or ends outside the table's registers.
        """
        if size <= 0:
            raise TableError(StatusError.DATA_LENGTH)
        if self.table.at(address) is None or self.table.at(address + size - 1) is None:
            raise TableError(StatusError.ACCESS)
        if address + size <= self._indirect_base or not self._indirect_n:
            return bytes(self._bytes[address : address + size])
        return bytes(self._bytes[self._resolve(a)] for a in range(address, address + size))

    def check_write(self, address: int, data: bytes, *, torque_on: bool, tripped: bool) -> list[tuple[Register, int]]:
        """What a write would do, register by register, without doing it.

        Raises:
            TableError: unknown or read-only address, EEPROM while torque is on, part of a register, value out of
                range or above its limit, or a goal while the bus watchdog has tripped.
        """
        if not data:
            raise TableError(StatusError.DATA_LENGTH)
        changes: list[tuple[Register, int]] = []
        for start, run in self._runs(address, data):
            at = 0
            while at < len(run):
                r = self.table.at(start + at)
                if r is None or r.address != start + at or not r.writable:
                    raise TableError(StatusError.ACCESS)
                if r.eeprom and torque_on:
                    raise TableError(StatusError.ACCESS)
                if at + r.size > len(run):
                    raise TableError(StatusError.DATA_LENGTH)
                value = r.decode(run[at : at + r.size])
                self._check_value(r, value, changes, tripped=tripped)
                changes.append((r, value))
                at += r.size
        return changes

    def commit(self, changes: list[tuple[Register, int]]) -> None:
        """Carry out what :meth:`check_write` returned."""
        for r, value in changes:
            self._bytes[r.address : r.end] = r.encode(value)

    def _check_value(self, r: Register, value: int, changes: list[tuple[Register, int]], *, tripped: bool) -> None:
        if tripped and (r.name.startswith("goal_") or (r.name == "bus_watchdog" and value != 0)):
            raise TableError(StatusError.DATA_RANGE)
        if r.name in ("max_voltage_limit", "min_voltage_limit") and not r.allows(value):
            raise TableError(StatusError.DATA_LIMIT)
        if not r.limit and not r.allows(value):
            raise TableError(StatusError.DATA_RANGE)
        low, high = self._bounds(r, {c.name: v for c, v in changes})
        if not low <= value <= high:
            raise TableError(StatusError.DATA_LIMIT)

    def _bounds(self, r: Register, pending: dict[str, int]) -> tuple[int, int]:
        """Run-time bounds; a limit written by the same packet already counts."""

        def now(name: str) -> int:
            return pending.get(name, self[name])

        if r.limit == "position_limits" and now("operating_mode") == 3:
            return now("min_position_limit"), now("max_position_limit")
        if r.limit and r.limit != "position_limits":
            top = now(r.limit)
            return (-top if r.signed else 0), top
        return -(1 << 31), (1 << 32) - 1

    def _resolve(self, address: int) -> int:
        index = address - self._indirect_base
        if not 0 <= index < self._indirect_n:
            return address
        at = self._pointer_base + 2 * index
        target = self._bytes[at] | self._bytes[at + 1] << 8
        return target if self.table.at(target) is not None else address

    def _runs(self, address: int, data: bytes) -> list[tuple[int, bytes]]:
        """``data`` cut into runs of neighbouring addresses after indirect addressing."""
        end = address + len(data)
        if end <= self._indirect_base or address >= self._indirect_base + self._indirect_n or not self._indirect_n:
            return [(address, data)]
        runs: list[tuple[int, bytearray]] = []
        for offset, byte in enumerate(data):
            target = self._resolve(address + offset)
            if runs and target == runs[-1][0] + len(runs[-1][1]):
                runs[-1][1].append(byte)
            else:
                runs.append((target, bytearray((byte,))))
        return [(start, bytes(run)) for start, run in runs]
