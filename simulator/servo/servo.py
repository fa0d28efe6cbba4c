"""One virtual PH54 as a Protocol 2.0 slave: what each instruction does to its body. Knows nothing of the wire.

Everything happens in :meth:`VirtualServo.advance` (elapsed time) and :meth:`VirtualServo.execute` (one instruction);
the owner of the wire calls both and hands in the time, so the servo is repeatable to the last count.
"""

from __future__ import annotations

from graderd.drivers.dynamixel.codec import ALERT, BROADCAST_ID, Instruction, Packet, StatusError
from graderd.drivers.dynamixel.table import Register
from graderd.simulator.servo.body import ServoBody
from graderd.simulator.servo.memory import TableError

_CLEAR_POSITION = bytes((0x01, 0x44, 0x58, 0x4C, 0x22))
_BACKUP_KEY = bytes((0x43, 0x54, 0x52, 0x4C))


class VirtualServo(ServoBody):
    """A PH54 as seen from its connector; see :class:`~graderd.simulator.servo.body.ServoBody` for the arguments."""

    @property
    def alert_bit(self) -> int:
        """0x80 while a hardware error is set: part of every status packet."""
        return ALERT if self.memory["hardware_error_status"] else 0

    def read(self, address: int, size: int) -> tuple[int, bytes]:
        """Error byte (with the alert bit) and data of a read; no data with an error."""
        self._publish()
        position = self.table["present_position"]
        if self.misread_n and address < position.end and position.address < address + size:
            self.misread_n -= 1
            self.memory["present_position"] += round(self.misread_deg / self._deg_per_count)
        try:
            return self.alert_bit, self.memory.read(address, size)
        except TableError as e:
            return self.alert_bit | e.error, b""

    def write(self, address: int, data: bytes, *, ram_only: bool = False) -> int:
        """Error number of a write; all of it or nothing takes effect."""
        if address in self.refused:
            return self.refused[address]
        try:
            changes = self._checked(address, data)
        except TableError as e:
            return e.error
        if ram_only and any(r.eeprom for r, _ in changes):
            return StatusError.ACCESS
        self.memory.commit([c for c in changes if c[0].name != "torque_enable"])
        for register, value in changes:
            self._written(register, value)
        return StatusError.NONE

    def _checked(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        changes = self.memory.check_write(address, data, torque_on=self.torque_enabled, tripped=self.tripped)
        if self.braked and any(r.name == "torque_enable" and v for r, v in changes):
            raise TableError(StatusError.RESULT_FAIL)  # only a reboot gives torque back (number not documented)
        return changes

    def execute(self, packet: Packet, now_s: float, *, ram_only: bool = False) -> tuple[int, bytes] | None:
        """Carry out an instruction meant for this servo.

        Returns error byte and data for the status packet, or None where the status return level says silence.
        ``ram_only``: it came by the secondary id, which cannot change EEPROM.
        """
        level = self.memory["status_return_level"]
        instruction, params = packet.instruction, packet.params
        if instruction == Instruction.PING:
            model = self.memory["model_number"].to_bytes(2, "little")
            return self.alert_bit, model + bytes((self.memory["firmware_version"],))
        if instruction == Instruction.READ:
            if packet.packet_id == BROADCAST_ID:
                return None
            if len(params) != 4:
                answer = self.alert_bit | StatusError.DATA_LENGTH, b""
            else:
                answer = self.read(int.from_bytes(params[:2], "little"), int.from_bytes(params[2:], "little"))
            return answer if level >= 1 else None
        error = self._change(instruction, params, now_s, ram_only=ram_only, broadcast=packet.packet_id == BROADCAST_ID)
        return (self.alert_bit | error, b"") if level >= 2 else None

    def _change(self, instruction: int, params: bytes, now_s: float, *, ram_only: bool, broadcast: bool) -> int:
        if instruction in (Instruction.WRITE, Instruction.REG_WRITE):
            if len(params) < 3:
                return StatusError.DATA_LENGTH
            if instruction == Instruction.WRITE:
                return self.write(int.from_bytes(params[:2], "little"), params[2:], ram_only=ram_only)
            try:
                self._checked(int.from_bytes(params[:2], "little"), params[2:])
            except TableError as e:
                return e.error
            self._registered = params
            return StatusError.NONE
        if instruction == Instruction.ACTION:
            pending, self._registered = self._registered, None
            return self.write(int.from_bytes(pending[:2], "little"), pending[2:]) if pending else StatusError.NONE
        if instruction == Instruction.REBOOT:
            self._reboot(now_s)
            return StatusError.NONE
        if instruction == Instruction.FACTORY_RESET:
            return self._factory_reset(params, now_s, broadcast=broadcast)
        if instruction == Instruction.CLEAR:
            if params != _CLEAR_POSITION or self.memory["moving"]:
                return StatusError.RESULT_FAIL
            goal_kept = self.trajectory.goal_deg
            self._wrap()
            self._publish()
            self.memory["goal_position"] = self._counts(goal_kept)
            return StatusError.NONE
        if instruction == Instruction.CONTROL_TABLE_BACKUP:
            return self._backup(params, now_s)
        return StatusError.INSTRUCTION

    def _factory_reset(self, params: bytes, now_s: float, *, broadcast: bool) -> int:
        keep = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}.get(params[0] if len(params) == 1 else -1)
        if keep is None:
            return StatusError.DATA_RANGE if len(params) == 1 else StatusError.DATA_LENGTH
        if broadcast and not keep:
            return StatusError.RESULT_FAIL  # would give every servo of a bus the same id
        self._torque(False)
        self.memory.reset_all(keep)
        self._reboot(now_s)
        return StatusError.NONE

    def _backup(self, params: bytes, now_s: float) -> int:
        if params[1:] != _BACKUP_KEY or params[0] not in (1, 2) or self.torque_enabled:
            return StatusError.RESULT_FAIL
        if params[0] == 1:
            self.memory.save_backup()
            return StatusError.NONE
        try:
            self.memory.restore_backup(eeprom=True)
        except TableError as e:
            return e.error
        self._reboot(now_s)
        return StatusError.NONE
