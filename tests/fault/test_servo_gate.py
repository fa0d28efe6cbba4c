"""What reaches the servo is what the gate passed: the real control loop and driver over each hostile transport.

A monitor at the servo's end of the wire takes the bytes apart by itself (the SDK's CRC, the addresses and units of the
e-manual) and holds each motion write against what the gate has passed: its value, its time, and never after a stop.
In simulated time, over a socket instead of a pseudo-terminal: the same bytes at the same moments in every run.
"""

from __future__ import annotations

import asyncio
import math
import os
import socket
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

import pytest
from dynamixel_sdk import Protocol2PacketHandler

from graderd.config import Config
from graderd.core import commands as cmd
from graderd.core.machine import Mode
from graderd.core.tick import AxisTick, Sensed, Tick
from graderd.drivers.dynamixel import serial_port
from graderd.drivers.dynamixel.calibration import Calibration
from graderd.drivers.dynamixel.device import Ph54Device
from graderd.drivers.dynamixel.ph54 import Ph54Rotator
from graderd.drivers.dynamixel.servo_task import CommandSlot
from graderd.hal.errors import DeviceTimeoutError
from graderd.runtime.control import ControlLoop
from graderd.runtime.devices import Devices
from graderd.runtime.state_file import StateFile
from graderd.simulator.servo import VirtualServo
from graderd.simulator.servo import bus as simulated_bus
from harness.electrak_sim import SimulatedLoop, run_simulated
from harness.fakes import FakeActuator, FakeEyes, FakeLink
from tests.contract.test_dynamixel_rotator import TRANSPORTS
from tests.dynamixel_sim import Bench, bench, standing

SEEDS_N = int(os.environ.get("GRADERD_GATE_SEEDS", "3"))
SPEED_DEG_PER_S, ACCELERATION_DEG_PER_S2, WATCHDOG_S, GOAL_TIMEOUT_S = 40.0, 160.0, 0.4, 0.2
WINDOW_DEG, LOW_DEG, HIGH_DEG = 30.0, -60.0, 60.0
ZERO_DEG, SIGN = 5.0, -1
"""As on a machine: a conversion that forgets one of them shows."""

# PH54-200-S500-R, e-manual: control table and units.
COUNTS_PER_TURN: Final = 1_003_846
DEG_PER_S_PER_COUNT, DEG_PER_S2_PER_COUNT, WATCHDOG_STEP_S = 0.06, 0.1, 0.02
CURRENT_LIMIT, MAX_POSITION, MIN_POSITION, TORQUE, STATUS_LEVEL = 38, 48, 52, 512, 516
WATCHDOG, GOAL_CURRENT, GOAL_VELOCITY, ACCELERATION, VELOCITY, GOAL = 546, 550, 552, 556, 560, 564
SIZES: Final = {
    CURRENT_LIMIT: 2, MAX_POSITION: 4, MIN_POSITION: 4, TORQUE: 1, STATUS_LEVEL: 1, WATCHDOG: 1,
    GOAL_CURRENT: 2, GOAL_VELOCITY: 4, ACCELERATION: 4, VELOCITY: 4, GOAL: 4,
}  # fmt: skip
CONTINUOUS_MA = 9300
PING, READ, WRITE = 1, 2, 3

NEAR_DEG = 4.0
"""A hold brakes within 0.5° at these speeds, and knows where the blade is as of its last reading but one."""
BLIND_S = 0.4
"""So long a line that loses one exchange in five may bring no reading: the goals passed by older ones have run out."""
ROUNDING_DEG = 0.001
WIRE: Final = {"delay": {"seconds": 0.002}}
"""What every exchange takes at least, with an adapter on USB."""
BACK_DEG = 0.5
"""Where the driver believes the blade is, and where it is."""
HOLD_WITHIN_N = 8
"""Packets: one that was under way, a reading asked for up to four times where a former hold is in doubt, the rest of a
poll."""


def servo_deg(blade_deg: float) -> float:
    """Of the servo's own frame."""
    return SIGN * (blade_deg + ZERO_DEG)


class GateMonitor:
    """Judges every packet that a client writes to the servo; ``found`` says what was not as it has to be."""

    def __init__(self, servo: VirtualServo, now_s: Callable[[], float]) -> None:
        self.found: list[str] = []
        self.seen: Counter[str] = Counter()
        self._servo = servo
        self._now_s = now_s
        self._sdk = Protocol2PacketHandler()
        self._bytes = bytearray()
        self._passed: deque[tuple[float, float]] = deque(maxlen=200)
        self._been: deque[tuple[float, float]] = deque(maxlen=200)
        self._under_way: float | None = None
        self._torque_under_way = False
        self._powered = False
        self._moves = False
        self._held_deg: float | None = None
        self._owed_n: int | None = None

    # -- what the gate said ---------------------------------------------------------------------------------------

    def ticked(self, _: Sensed, tick: Tick) -> None:
        """What this tick let pass to the servo."""
        self._been.append((tick.now_s, self._servo.shaft_deg))
        decided = tick.axes["rotation"]
        if decided.send is not None:
            self._passed.append((tick.now_s, servo_deg(decided.send)))
            self._under_way = None
        elif self._passed:
            # One packet may have been written before this was decided, and be heard after it.
            self._under_way = self._passed[-1][1]
            self._passed.clear()
            self._owed_n = HOLD_WITHIN_N if self._moves else None
        if self._powered and not tick.intents.power:
            self._torque_under_way = True
        self._powered = tick.intents.power
        self.seen["stops"] += tick.stopped_now

    # -- what came by the wire ------------------------------------------------------------------------------------

    def heard(self, data: bytes) -> None:
        """Bytes of the client, in pieces of any size."""
        self._bytes += data
        while len(self._bytes) >= 7:
            assert self._bytes[:4] == b"\xff\xff\xfd\x00", f"no header: {self._bytes.hex(' ')}"
            size = 7 + int.from_bytes(self._bytes[5:7], "little")
            if len(self._bytes) < size:
                return
            packet, self._bytes = self._bytes[:size], self._bytes[size:]
            crc = self._sdk.updateCRC(0, packet, size - 2)
            assert crc == int.from_bytes(packet[-2:], "little"), f"wrong CRC: {packet.hex(' ')}"
            self._judge(packet[7], bytes(packet[8:-2]).replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))
            self._under_way, self._torque_under_way = None, False

    def _judge(self, instruction: int, params: bytes) -> None:
        if instruction == WRITE:
            self._judge_write(int.from_bytes(params[:2], "little"), params[2:])
        elif instruction not in (PING, READ):
            self._find(f"instruction {instruction:#x}")
        if self._servo.tripped:  # its watchdog has stopped it, and it takes no hold
            self._owed_n = None
        if self._owed_n is not None:
            self._owed_n -= 1
            if self._owed_n <= 0:
                self._find("the gate passes nothing, and no hold has come")
                self._owed_n = None

    def _judge_write(self, address: int, data: bytes) -> None:
        written: dict[int, int] = {}
        while data:
            size = SIZES.get(address)
            if size is None:
                self._find(f"a write to {address}")
                return
            written[address] = int.from_bytes(data[:size], "little", signed=True)
            address, data = address + size, data[size:]
        powered = self._servo.torque_enabled
        limits = {
            MIN_POSITION: (servo_deg(HIGH_DEG) - 1.0, powered), MAX_POSITION: (servo_deg(LOW_DEG) + 1.0, powered),
        }  # fmt: skip
        for register, value in written.items():
            match register:
                case 38 | 550:
                    self._within(register, value, 1, CONTINUOUS_MA)
                case 48 | 52:
                    wanted_deg, too_late = limits[register]
                    if too_late or abs(deg(value) - wanted_deg) > ROUNDING_DEG:
                        self._find(f"position limit {register} := {deg(value):.2f}°, powered: {powered}")
                case 512 if value:
                    self.seen["torque"] += 1
                    if not (self._powered or self._torque_under_way):
                        self._find("torque on, and nobody asked for power")
                case 512:
                    self._moves, self._owed_n = False, None
                case 546:
                    self._within(register, value, int(powered), round(WATCHDOG_S / WATCHDOG_STEP_S))
                case 556:
                    self._within(register, value, 1, round(10.0 * ACCELERATION_DEG_PER_S2 / DEG_PER_S2_PER_COUNT))
                case 560:
                    self._within(register, value, 1, round(SPEED_DEG_PER_S / DEG_PER_S_PER_COUNT))
        if GOAL in written:
            self._judge_goal(deg(written[GOAL]), written.get(ACCELERATION, 0) * DEG_PER_S2_PER_COUNT, powered)

    def _judge_goal(self, goal_deg: float, acceleration_deg_per_s2: float, powered: bool) -> None:
        shaft_deg, former_deg = self._servo.shaft_deg, deg(self._servo.memory["goal_position"])
        if not powered:
            if abs(goal_deg - shaft_deg) > BACK_DEG:
                self._find(f"goal {goal_deg:.2f}° where it stands at {shaft_deg:.2f}°, before torque")
            return
        since_s = self._now_s() - GOAL_TIMEOUT_S
        passed = {at_deg for time_s, at_deg in self._passed if time_s >= since_s}
        if self._under_way is not None:
            passed.add(self._under_way)
        if any(abs(goal_deg - at_deg) <= ROUNDING_DEG for at_deg in passed):
            self.seen["goals"] += 1
            self._moves, self._held_deg = True, None
            hard = acceleration_deg_per_s2 > ACCELERATION_DEG_PER_S2 + DEG_PER_S2_PER_COUNT
            if hard and abs(goal_deg - shaft_deg) > NEAR_DEG:
                self._find(f"a move to {goal_deg:.2f}° with {acceleration_deg_per_s2:.0f} °/s²")
            return
        # Nothing but a hold is left: near the blade, or where it was while nothing was heard, and not beyond the goal
        # that the servo has. One that was good may be said again: the servo does not say whether it has taken it.
        speed = self._servo.shaft_velocity_deg_per_s
        been = [shaft_deg, *(at_deg for time_s, at_deg in self._been if time_s >= self._now_s() - BLIND_S)]
        reach = (*been, former_deg, shaft_deg + (math.copysign(NEAR_DEG, speed) if abs(speed) > 1.0 else 0.0))
        near = min(been) - NEAR_DEG <= goal_deg <= max(been) + NEAR_DEG
        near = near and min(reach) - BACK_DEG <= goal_deg <= max(reach) + BACK_DEG
        if near or goal_deg == self._held_deg:
            self.seen["holds"] += 1
            self._held_deg = goal_deg
            self._moves, self._owed_n = False, None
            return
        last = f", the last passed {self._passed[-1][1]:.2f}°" if self._passed else ""
        self._find(f"goal {goal_deg:.2f}° passed by nobody; blade at {shaft_deg:.2f}°, had {former_deg:.2f}°{last}")

    def _within(self, register: int, value: int, low: int, high: int) -> None:
        if not low <= value <= high:
            self._find(f"register {register} := {value}, not within {low}…{high}")

    def _find(self, what: str) -> None:
        self.found.append(f"{self._now_s():.3f} s: {what}")


def deg(counts: int) -> float:
    return counts * 360.0 / COUNTS_PER_TURN


class Cab:
    """Somebody who drives the daemon's control loop by its commands."""

    def __init__(self, loop: ControlLoop, rig: Bench, monitor: GateMonitor) -> None:
        self.loop, self.rig, self.monitor = loop, rig, monitor

    async def arm(self) -> None:
        state = self.loop.tick.state
        if state.mode is Mode.STOPPED:
            reply = await self.loop.command(cmd.Reset(stop_n=state.stop_n))
            assert reply.accepted, reply
        async with asyncio.timeout(20.0):
            while self.loop.tick.state.mode is not Mode.MANUAL:  # on a bad line it takes more than one attempt
                await self.loop.command(cmd.Arm())
                await asyncio.sleep(0.02)

    async def jog(self, to_deg: float, met: Callable[[], object]) -> None:
        """Jog, and renew the lease until ``met()``; a fault that held it meanwhile ends the jog, it is asked anew."""
        jog = cmd.Jog(axis="rotate", value=to_deg)
        await self.loop.command(jog)
        async with asyncio.timeout(20.0):
            while not met():
                if not (await self.loop.command(cmd.Renew())).accepted:
                    await self.loop.command(jog)
                await asyncio.sleep(0.01)

    def turned(self, way_deg: float) -> Callable[[], bool]:
        """The blade, since now, by so much."""
        from_deg = self.rig.servo.shaft_deg
        return lambda: abs(self.rig.servo.shaft_deg - from_deg) > way_deg

    def stop(self) -> None:
        self.loop.stop_now(cmd.Stop())

    async def rest(self) -> None:
        await self.until(lambda: standing(self.rig))

    async def until(self, met: Callable[[], object]) -> None:
        async with asyncio.timeout(10.0):
            while not met():
                await asyncio.sleep(0.005)


class SocketPair:
    """In the place of the pseudo-terminal, and of the port that the driver opens: no thread of the kernel between."""

    def __init__(self, _: Path) -> None:
        self._ends = socket.socketpair()
        for end in self._ends:
            end.setblocking(False)
        self.master, self.slave = (end.fileno() for end in self._ends)

    def close(self) -> None:
        for end in self._ends:
            end.close()


class Port(socket.socket):
    """The driver's end, as far as it asks a serial port for more than its descriptor."""

    def set_low_latency_mode(self, _: bool) -> None:
        raise NotImplementedError


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[SocketPair] = []

    def terminal(link: Path) -> SocketPair:
        made.append(SocketPair(link))
        return made[-1]

    monkeypatch.setattr(simulated_bus, "LinkedTerminal", terminal)
    monkeypatch.setattr(serial_port, "open_port", lambda *_: Port(fileno=os.dup(made[-1].slave)))


@asynccontextmanager
async def cab(
    folder: Path, clock: SimulatedLoop, wire: dict[str, dict[str, float]], seed: int = 4
) -> AsyncIterator[Cab]:
    """A control loop that ticks, with the real driver on a virtual servo and a monitor at its end of the wire."""
    servo, heard = VirtualServo(), list[Callable[[bytes], None]]()
    servo.shaft_deg = servo_deg(0.0)
    moves: dict[str, Any] = {
        "speed_deg_per_s": SPEED_DEG_PER_S, "acceleration_deg_per_s2": ACCELERATION_DEG_PER_S2,
        "watchdog_s": WATCHDOG_S, "goal_timeout_s": GOAL_TIMEOUT_S, "window_deg": WINDOW_DEG,
        "min_deg": LOW_DEG, "max_deg": HIGH_DEG, "zero_deg": ZERO_DEG, "sign": SIGN,
    }  # fmt: skip
    to_monitor = {"seed": seed, "heard": lambda data: heard[0](data)}
    async with bench(folder, servo, opened=False, wire=to_monitor, clock=clock, **moves) as rig:
        monitor = GateMonitor(servo, rig.clock.now_s)
        heard.append(monitor.heard)
        become(rig, wire)
        await rig.rotator.open()
        at = {"lift_left": 100.0, "lift_right": 100.0, "tilt": 50.0}
        actuators = {name: FakeActuator(name, rig.clock, mm, []) for name, mm in at.items()}
        devices = Devices(rig.rotator, FakeLink(), dict(actuators))
        config = Config().model_copy(update={"rotation": rig.rotator.settings})
        loop = ControlLoop(config, devices, FakeEyes(), rig.clock, StateFile())
        loop.on_step = monitor.ticked
        ticking = asyncio.create_task(loop.run())
        try:
            yield Cab(loop, rig, monitor)
        finally:
            ticking.cancel()
            await asyncio.gather(ticking, return_exceptions=True)
            await rig.rotator.close()


def become(rig: Bench, wire: dict[str, dict[str, float]]) -> None:
    rig.bus.clear_faults()
    for name, params in {**WIRE, **wire}.items():
        rig.bus.inject(name, **params)


def lose_answers(rig: Bench, seconds: float, wire: dict[str, dict[str, float]]) -> None:
    """Nothing the servo says is heard for so long, whatever else is wrong with the wire."""
    rig.bus.inject("drop")
    asyncio.get_running_loop().call_later(seconds, become, rig, wire)


@pytest.mark.parametrize("seed", range(SEEDS_N))
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_nothing_reaches_the_servo_that_the_gate_did_not_pass(tmp_path: Path, transport: str, seed: int) -> None:
    wire = TRANSPORTS[transport]

    async def work(clock: SimulatedLoop) -> None:
        async with cab(tmp_path, clock, wire, seed) as at:
            rig, monitor = at.rig, at.monitor
            await at.arm()
            await at.jog(50.0, at.turned(20.0))
            await at.jog(-50.0, at.turned(15.0))  # back, on the way
            at.stop()
            await at.rest()
            await at.arm()
            await at.jog(25.0, at.turned(8.0))
            lose_answers(rig, 0.1, wire)  # the hold's among them
            at.stop()
            await at.rest()
            await at.arm()
            await at.jog(-20.0, at.turned(8.0))
            await at.until(lambda: at.loop.tick.state.lease is None)  # nobody renews it
            await at.rest()
            await at.jog(20.0, at.turned(8.0))
            reply = await at.loop.command(cmd.Disarm())
            assert reply.accepted
            await at.until(lambda: not rig.servo.torque_enabled)
            assert monitor.found == []
            seen = monitor.seen
            assert seen["goals"] >= 20
            assert seen["holds"] >= 4
            assert seen["torque"] >= 3
            assert seen["stops"] == 2

    run_simulated(work)


def test_a_loop_that_stands_still_leaves_no_goal_to_be_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was passed grows old: the driver holds by itself, and goes nowhere until there is a new one."""

    async def work(clock: SimulatedLoop) -> None:
        async with cab(tmp_path, clock, {}) as at:
            await at.arm()
            await at.jog(25.0, at.turned(8.0))
            monkeypatch.setattr(at.loop, "run_tick", lambda _: None)
            holds_n = at.monitor.seen["holds"]
            await at.until(lambda: at.monitor.seen["holds"] > holds_n)
            await at.rest()
            assert at.monitor.found == []

    run_simulated(work)


Spoil = Callable[[pytest.MonkeyPatch], None]


def repeats_an_old_goal(patch: pytest.MonkeyPatch) -> None:
    """Where nobody answers the hold, what was commanded before it is sent again."""
    send_hold = CommandSlot.send_hold

    async def repeats(slot: CommandSlot, device: Ph54Device, *given: Any, **how: Any) -> int:
        former = slot.sent_counts
        try:
            return await send_hold(slot, device, *given, **how)
        except DeviceTimeoutError:
            if former is not None:
                await device.write("goal_position", former, attempts_n=1, urgent=True)
            raise

    patch.setattr(CommandSlot, "send_hold", repeats)


def goes_where_it_was_asked(patch: pytest.MonkeyPatch) -> None:
    tell = ControlLoop._tell

    def unclamped(loop: ControlLoop, axis: str, decided: AxisTick) -> None:
        tell(loop, axis, decided if decided.send is None else decided._replace(send=decided.requested))

    patch.setattr(ControlLoop, "_tell", unclamped)


def takes_no_hold(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Ph54Rotator, "hold", lambda _: None)


def turns_as_fast_as_it_can(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Calibration, "velocity_counts", lambda *_: 0)


@pytest.mark.parametrize(
    ("spoil", "ends", "says"),
    [
        (repeats_an_old_goal, cmd.Stop(), "passed by nobody"),
        (goes_where_it_was_asked, cmd.Stop(), "passed by nobody"),
        (takes_no_hold, cmd.Release(), "no hold has come"),
        (turns_as_fast_as_it_can, cmd.Stop(), "register 560 := 0"),
    ],
)
def test_a_spoiled_driver_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Spoil, ends: cmd.Command, says: str
) -> None:
    spoil(monkeypatch)

    async def work(clock: SimulatedLoop) -> None:
        async with cab(tmp_path, clock, {}) as at:
            await at.arm()
            await at.jog(50.0, at.turned(10.0))
            lose_answers(at.rig, 0.2, {})
            await at.loop.command(ends)
            await at.until(lambda: at.monitor.found)
            assert any(says in found for found in at.monitor.found), at.monitor.found

    run_simulated(work)
