"""A hostile bus for a minute at a time, and a monitor between gate and bus: nothing enables motion but what was passed.

What the gate passes reaches a driver by ``set_target_mm``. The monitor notes it there and looks at every frame that our
link gives the bus: an enabled control message needs a target that was passed, is not older than its time-out, was not
ended by a hold, and lies between the actuator and that target. In simulated time, each seed another minute.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable

import pytest

from graderd.drivers.electrak import ElectrakActuator
from graderd.drivers.electrak.codec import ElectrakCodec
from graderd.drivers.j1939.can_port import BusPort, PortFullError
from graderd.drivers.j1939.ids import GLOBAL, NULL, Frame, Pgn, destination_of, make_id, pgn_of, source_of
from graderd.hal.device import Lifecycle
from graderd.hal.errors import DeviceError
from harness.electrak_sim import Machine, SimulatedLoop, run_simulated, state

OURS = 231
BEYOND_MM = 3.0
"""The last target lies beyond the wanted one by the dead zone, 1.6 times that of the data sheet at most."""
MINUTE_S = 60.0


class Monitor:
    """Between gate and bus."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._codecs = {axis.address: ElectrakCodec(axis.profile.layout) for axis in machine.axes.values()}
        self._passed: dict[int, tuple[float, float] | None] = {}
        self.enabled_n = self.disabled_n = 0
        self.wrong: list[str] = []
        self.mute = False
        factory = machine.link._factory
        assert factory is not None
        machine.link._factory = lambda: self._watched(factory())

    def drive(self, axis: ElectrakActuator, target_mm: float) -> None:
        """What the gate passes; what cannot wait is on the bus before the call returns."""
        former = self._passed.get(axis.address)
        self._passed[axis.address] = (target_mm, self._machine.clock.now_s())
        try:
            axis.set_target_mm(target_mm)
        except DeviceError:
            self._passed[axis.address] = former
            raise

    def end(self, axis: ElectrakActuator) -> None:
        """A stop."""
        self._passed[axis.address] = None
        axis.hold()

    def _watched(self, port: BusPort) -> BusPort:
        send = port.send

        def watch(frame: Frame) -> None:
            self._judge(frame)
            if self.mute:
                raise PortFullError("nobody takes it")
            send(frame)

        port.send = watch  # type: ignore[method-assign]
        return port

    def _judge(self, frame: Frame) -> None:
        if pgn_of(frame.can_id) != Pgn.PROPRIETARY_A:
            return
        address = destination_of(frame.can_id)
        control = self._codecs[address].decode_control(frame.data)
        if not control.motion_enable:
            self.disabled_n += 1
            return
        self.enabled_n += 1
        now_s = self._machine.clock.now_s()
        axis = next(axis for axis in self._machine.axes.values() if axis.address == address)
        passed, here = self._passed.get(address), axis.telemetry().position_mm
        if passed is None or now_s - passed[1] > axis.settings.target_timeout_s or here is None:
            self.wrong.append(f"{now_s:.3f} s: {control} to {address}, which nobody passed ({passed})")
            return
        low, high = sorted((here.value, passed[0]))
        if not low - BEYOND_MM <= control.target_mm <= high + BEYOND_MM:
            self.wrong.append(f"{now_s:.3f} s: {control} to {address} at {here.value} mm, passed {passed[0]} mm")
        if source_of(frame.can_id) != self._machine.link.address:
            self.wrong.append(f"{now_s:.3f} s: enabled from address {source_of(frame.can_id)}, which is not ours")


class Attacker:
    """Everything that a bus can do to us, at random."""

    def __init__(self, machine: Machine, monitor: Monitor, seed: int) -> None:
        self._machine, self._monitor = machine, monitor
        self._random = random.Random(seed)
        self._thieving = False
        self._our_name = machine.link.node.claimer.name.to_bytes()
        machine.bus.listen(self._on_frame)

    def _on_frame(self, frame: Frame) -> None:
        if self._thieving and pgn_of(frame.can_id) == Pgn.ADDRESS_CLAIMED and frame.data == self._our_name:
            self._claim(source_of(frame.can_id), bytes(8))

    def _claim(self, address: int, name: bytes) -> None:
        self._send(make_id(6, Pgn.ADDRESS_CLAIMED, address), name)

    def _send(self, can_id: int, data: bytes) -> None:
        self._machine.bus.send(Frame(can_id, data))

    def strike(self) -> None:
        """One attack, and perhaps the end of another."""
        bus, link, pick = self._machine.bus, self._machine.link, self._random
        ours = link.address or OURS
        attacks: list[Callable[[], object]] = [
            lambda: self._claim(ours, bytes(8)),
            lambda: self._claim(ours, b"\xff" * 8),
            lambda: self._claim(ours, self._our_name),
            lambda: setattr(self, "_thieving", not self._thieving),
            lambda: bus.inject("flood", rate_hz=2000.0),
            lambda: bus.inject("claim_storm", rate_hz=300.0, at_address=ours, wins=pick.randint(0, 1)),
            lambda: bus.inject("bus_off"),
            lambda: setattr(self._monitor, "mute", not self._monitor.mute),
            bus.interface_down,
            bus.unplug,
            bus.clear_faults,
            bus.clear_faults,
            lambda: bus.inject("power_cut", address=pick.choice((19, 20, 27))),
            lambda: bus.inject("garbage", address=pick.choice((19, 20, 27))),
            self._requests,
            self._clear_to_send,
            self._nonsense,
        ]
        pick.choice(attacks)()

    def _requests(self) -> None:
        for _ in range(100):
            about = self._random.choice((Pgn.ADDRESS_CLAIMED, Pgn.COMPONENT_ID, Pgn.DM1, 0xF004))
            to = self._random.choice((self._machine.link.address or OURS, GLOBAL))
            self._send(make_id(6, Pgn.REQUEST, self._random.choice((40, NULL)), to), about.to_bytes(3, "little"))

    def _clear_to_send(self) -> None:
        body = bytes((17, 255, 1, 255, 255)) + Pgn.COMPONENT_ID.to_bytes(3, "little")
        for _ in range(200):
            self._send(make_id(7, Pgn.TP_CONNECTION, 40, self._machine.link.address or OURS), body)

    def _nonsense(self) -> None:
        for _ in range(50):
            self._send(self._random.getrandbits(29), self._random.randbytes(self._random.randint(0, 8)))


@pytest.mark.parametrize("seed", range(6))
def test_no_command_that_the_gate_did_not_pass(seed: int) -> None:
    async def main(loop: SimulatedLoop) -> None:
        machine = Machine(loop)
        monitor = Monitor(machine)
        async with machine:
            attacker, pick = Attacker(machine, monitor, seed), random.Random(1000 + seed)
            axes = tuple(machine.axes.values())
            targets = {axis.name: 90.0 for axis in axes}
            driving = True
            for tick in range(round(MINUTE_S / 0.02)):
                if tick % 40 == 39:
                    attacker.strike()
                if tick % 150 == 149:
                    machine.bus.clear_faults()
                    monitor.mute = False
                    targets = {axis.name: pick.uniform(10.0, 90.0) for axis in axes}
                if tick % 60 == 0:
                    driving = not driving or pick.random() < 0.6
                    if not driving:  # a stop in the middle of it
                        for axis in axes:
                            monitor.end(axis)
                for axis in axes if driving else ():
                    if state(axis) is Lifecycle.STANDBY and tick % 50 == 0 and machine.link.address is not None:
                        try:
                            await axis.arm()
                        except DeviceError:
                            continue  # refused, as it should where something is wrong
                    if state(axis) is Lifecycle.ACTIVE:
                        monitor.drive(axis, targets[axis.name])
                await asyncio.sleep(0.02)
            assert monitor.enabled_n > 100, "it drove"
            assert monitor.disabled_n > 100
            for axis in axes:
                monitor.end(axis)
            enabled_n = monitor.enabled_n
            machine.bus.clear_faults()
            monitor.mute = False
            await asyncio.sleep(0.5)
            assert monitor.enabled_n == enabled_n, "after the stop nothing enables motion"
            assert monitor.wrong == []
            assert all(unit.velocity_mm_per_s == 0 for unit in machine.units.values())

    run_simulated(main)
