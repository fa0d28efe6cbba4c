"""One servo by register names: reads, writes that are read back, identification and judgement. No state of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from graderd.drivers.dynamixel.bus import ServoBus, ServoRefusedError
from graderd.drivers.dynamixel.codec import Instruction, StatusError
from graderd.drivers.dynamixel.table import Block, ControlTable, Register
from graderd.hal.errors import DeviceRefusedError, DeviceTimeoutError, WrongDeviceError

EXTENDED_MODE, POSITION_MODE = 4, 3
WATCHDOG_TRIPPED = -1
WATCHDOG_STEP_S = 0.020
WITNESS = {"led_green": 0x47, "led_blue": 0x52}
"""Left in the servo's RAM once its turns are known: a restart forgets it as it forgets the turns. The LED shows it."""
_RUN_BYTES = 64
ATTEMPTS_N = 8
"""Attempts of a request on which a whole procedure depends (opening, arming); polling has the next poll instead."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One register whose content is not what the profile says.

    ``kind``: ``expected`` (judged at every start), ``range`` (outside the documented range), ``refused`` (the servo
    does not know the register): these are wrong. ``default`` is not: legal, and neither the factory's value nor ours.
    """

    register: str
    address: int
    device: int | None
    profile: str
    kind: str
    text: str


class Ph54Device:
    """Registers of the servo ``servo_id`` on ``bus``."""

    def __init__(self, bus: ServoBus, table: ControlTable, servo_id: int) -> None:
        self.bus = bus
        self.table = table
        self.servo_id = servo_id
        telemetry = table.profile["telemetry"]
        self.telemetry_block = table.block(telemetry["first"], telemetry["last"])
        self.health_block = table.block("torque_enable", "hardware_error_status")
        self.witness_block = table.block("led_green", "led_blue")
        self.goal_block = table.block("bus_watchdog", "goal_position")
        self.arm_block = table.block("goal_current", "goal_position")
        self.profile_block = table.block("profile_acceleration", "goal_position")
        self.limit_block = table.block("current_limit", "min_position_limit")

    @property
    def where(self) -> str:
        """For error texts."""
        return f"servo {self.servo_id} at {self.bus.port}"

    async def read(self, name: str) -> int:
        """Value of one register in counts."""
        register = self.table[name]
        packet = await self.bus.read(self.servo_id, register.address, register.size, attempts_n=ATTEMPTS_N)
        return register.decode(packet.data)

    async def read_block(self, block: Block, *, attempts_n: int = ATTEMPTS_N) -> tuple[dict[str, int], bool]:
        """Values of neighbouring registers, and whether the servo's alert bit is set."""
        packet = await self.bus.read(self.servo_id, block.address, block.size, attempts_n=attempts_n)
        return block.decode(packet.data), packet.alert

    async def write(self, name: str, value: int, *, attempts_n: int = ATTEMPTS_N, urgent: bool = False) -> None:
        """Write one register."""
        register, data = self.table[name], self.table[name].encode(value)
        await self.bus.write(self.servo_id, register.address, data, attempts_n=attempts_n, urgent=urgent)

    async def write_block(
        self, block: Block, values: Mapping[str, int], *, attempts_n: int = ATTEMPTS_N, urgent: bool = False
    ) -> None:
        """Write neighbouring registers in one packet: all of them take effect, or none."""
        data = block.encode(dict(values))
        await self.bus.write(self.servo_id, block.address, data, attempts_n=attempts_n, urgent=urgent)

    async def confirm(self, values: Mapping[str, int], block: Block) -> None:
        """Read a block back and compare.

        Raises:
            DeviceRefusedError: something is not as written; all of it in one message.
        """
        actual, _ = await self.read_block(block)
        wrong = [f"{n} reads {actual[n]}, written {v}" for n, v in values.items() if actual[n] != v]
        if wrong:
            raise DeviceRefusedError(self.where, f"not as written: {'; '.join(wrong)}", "Try again; reboot the servo")

    async def torque(self, on: bool) -> None:
        """Switch torque and read it back.

        Raises:
            DeviceRefusedError: it reads back otherwise.
        """
        await self.write("torque_enable", int(on), urgent=not on)
        if bool(await self.read("torque_enable")) != on:
            raise DeviceRefusedError(self.where, f"torque did not go {'on' if on else 'off'}", "See the hardware error")

    async def identify(self, expected_mode: int) -> int:
        """Find the servo and judge it; returns the firmware version. Nothing that moves or powers it is written.

        The one thing set is Status Return Level 2 where it is lower (a RAM value: without it writes go unanswered).

        Raises:
            WrongDeviceError: model, firmware or settings are not what is expected; every mismatch in one message.
            DeviceTimeoutError, DeviceLostError: nothing answers.
        """
        bus, table = self.bus, self.table
        try:
            model, firmware = await bus.ping(self.servo_id, attempts_n=6)
        except DeviceTimeoutError as e:
            if bus.damaged_n:
                raise DeviceTimeoutError(
                    self.where,
                    f"every answer at {bus.baud_n} bit/s is damaged",
                    f"Look for a second servo with id {self.servo_id}; check shield and termination of the RS-485 line",
                ) from e
            raise DeviceTimeoutError(
                self.where,
                f"nothing answers at {bus.baud_n} bit/s",
                "Check the 24 V supply, the RS-485 cable, rotation.servo_id_n and rotation.baud_n",
            ) from e
        if await bus.answers_twice():
            raise WrongDeviceError(
                self.where,
                f"two servos answer to id {self.servo_id}",
                "Leave one of them on the bus and give it another id",
            )
        if model != table.model_number:
            raise WrongDeviceError(
                self.where,
                f"model number {model} answers, expected {table.model_number} ({table.title})",
                "Connect the right servo, or choose its profile",
            )
        level = table["status_return_level"]
        await bus.send(self.servo_id, Instruction.WRITE, level.address.to_bytes(2, "little") + level.encode(2))
        mismatches = judge(table, await self._settings(), firmware, expected_mode)
        if mismatches:
            raise WrongDeviceError(
                self.where,
                "; ".join(d.text for d in mismatches),
                "Set them with torque off (Dynamixel Wizard), then start again",
            )
        return firmware

    async def _settings(self) -> dict[str, int]:
        """The registers that are judged, in two reads."""
        first, _ = await self.read_block(self.table.block("drive_mode", "homing_offset"))
        limits, _ = await self.read_block(self.table.block("velocity_limit", "shutdown"))
        return {**first, **limits}

    async def verify(self, expected_mode: int, written: Mapping[str, int]) -> list[Difference]:
        """Read every register and compare it with the profile; reads only. ``written``: what arming writes is right.

        Raises:
            DeviceTimeoutError, DeviceLostError: the servo stopped answering.
        """
        model, firmware = await self.bus.ping(self.servo_id, attempts_n=ATTEMPTS_N)
        found: list[Difference] = []
        values: dict[str, int] = {"model_number": model}
        for run in _runs(self.table.registers):
            try:
                values |= (await self.read_block(Block(run)))[0]
            except ServoRefusedError:
                for register in run:
                    try:
                        values[register.name] = await self.read(register.name)
                    except ServoRefusedError as e:
                        known = f"{register.size} bytes, {'rw' if register.writable else 'r'}"
                        found.append(Difference(register.name, register.address, None, known, "refused", str(e)))
        found += judge(self.table, values, firmware, expected_mode)
        judged = {d.register for d in found}
        for register in self.table.registers:
            name = register.name
            if name in values and name not in judged and values[name] != written.get(name):
                found += _compare(self.table, register, values[register.name])
        return sorted(found, key=lambda d: d.address)

    async def reboot(self) -> None:
        """Send a reboot; the acknowledgement may be lost, the reboot is not sent twice."""
        try:
            await self.bus.request(self.servo_id, Instruction.REBOOT, attempts_n=1)
        except DeviceTimeoutError:
            return
        except ServoRefusedError as e:
            if e.error != StatusError.RESULT_FAIL:
                raise


def judge(table: ControlTable, values: Mapping[str, int], firmware: int, expected_mode: int) -> list[Difference]:
    """Settings that make the servo unfit or dangerous as a blade servo, each with what it should be."""
    expected = table.profile["expected"]
    found: list[Difference] = []

    def check(name: str, ok: bool, wanted: str, why: str) -> None:
        if not ok:
            value = firmware if name == "firmware_version" else values[name]
            text = f"{table[name].label} ({table[name].address}) is {value}, expected {wanted}: {why}"
            found.append(Difference(name, table[name].address, value, wanted, "expected", text))

    check(
        "firmware_version", firmware >= table.profile["firmware_min"], f">= {table.profile['firmware_min']}", "too old"
    )
    check("operating_mode", values["operating_mode"] == expected_mode, str(expected_mode), "needed for the soft limits")
    for name, why in (
        ("drive_mode", "reverse, time profile and torque-by-goal change what a goal does"),
        ("protocol_type", "Protocol 2.0 is spoken here"),
        ("homing_offset", "zero lives in our calibration"),
        ("startup_configuration", "torque must not come on at power-up"),
    ):
        check(name, values[name] == expected[name], str(expected[name]), why)
    check("secondary_id", values["secondary_id"] > 252, "255 (off)", "another id would also move the servo")
    must = expected["shutdown_must_have"]
    check("shutdown", values["shutdown"] & must == must, f"bits 0x{must:02X} set", "overload must cut the torque")
    return found


def _compare(table: ControlTable, register: Register, value: int) -> list[Difference]:
    def difference(kind: str, wanted: str, what: str) -> list[Difference]:
        unit = f" x {register.scale:g} {register.unit}" if register.unit else ""
        text = f"{register.label} ({register.address}) is {value}{unit}, {what} {wanted}"
        return [Difference(register.name, register.address, value, wanted, kind, text)]

    tripped = register.name == "bus_watchdog" and value == WATCHDOG_TRIPPED
    if register.writable and not tripped and not register.allows(value):
        return difference("range", f"{register.min}…{register.max}", "outside")
    disputed = [
        v
        for row in table.profile.get("disagreement", [])
        if row["register"] == register.name and row["field"] == "default"
        for v in row["values"]
    ]
    kept = register.eeprom and (register.writable or register.name == "model_number")
    if kept and value != register.default and value not in disputed:
        return difference(
            "expected" if register.name == "model_number" else "default", str(register.default), "factory value is"
        )
    return []


def _runs(registers: Sequence[Register]) -> list[tuple[Register, ...]]:
    """Registers in runs without gaps, each short enough for one read (and never as long as a ping's reply)."""
    runs: list[list[Register]] = []
    for r in registers:
        if runs and runs[-1][-1].end == r.address and r.end - runs[-1][0].address <= _RUN_BYTES:
            runs[-1].append(r)
        else:
            runs.append([r])
    return [
        part
        for run in runs
        for part in ([tuple(run)] if run[-1].end - run[0].address != 3 else [(register,) for register in run])
    ]
