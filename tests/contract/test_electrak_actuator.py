"""The Electrak driver: the linear actuator's conformance class, over every wire there is: in process, slcan pty, vcan.

Where this kernel has no vcan interface, the vcan variant is not collected (see the test ids).
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from graderd.drivers.electrak import CanLink, ElectrakActuator
from graderd.drivers.j1939.can_port import BusPort, PortFullError, SlcanPort
from graderd.drivers.j1939.ids import Frame
from graderd.drivers.j1939.python_can import can
from graderd.hal.device import Lifecycle
from graderd.hal.errors import (
    CommandRangeError,
    DeviceMissingError,
    DeviceRefusedError,
    DeviceTimeoutError,
    LifecycleError,
    StaleReadingError,
)
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.settings import CanSettings, ElectrakSettings
from graderd.simulator.actuators import VirtualActuatorBus, VirtualElectrak
from harness.awake_clock import AwakeClock
from harness.electrak_sim import until
from tests.contract.conformance import ActuatorStand, LinearActuatorConformance, state

VCAN = next((path.name for path in sorted(Path("/sys/class/net").glob("vcan*"))), None)
WIRES = ["in_process", "python_can_virtual", "slcan_pty", *([VCAN] if VCAN else [])]


class Bench:
    """One virtual actuator, the link and the driver under test."""

    def __init__(self, wire: str, tmp_path: Path) -> None:
        self.clock = AwakeClock()
        self.unit = VirtualElectrak(position_mm=100.0, seed=5)
        self.external: can.BusABC | None = None
        self.bus: VirtualActuatorBus
        link: Path | None = None
        factory = None
        settings = CanSettings(interface="virtual", channel=str(tmp_path))
        if wire == "slcan_pty":
            link = tmp_path / "can"
            settings = CanSettings(interface="slcan", channel=str(link))
        elif wire == "in_process":
            factory = lambda: BusPort(self.bus.connect())  # noqa: E731  (bound late: the bus is made below)
        elif wire != "python_can_virtual":
            settings = CanSettings(interface="socketcan", channel=wire)
            self.external = can.Bus(interface="socketcan", channel=wire)
        self.bus = VirtualActuatorBus([self.unit], link=link, bus=self.external, clock=self.clock)
        self.link = CanLink(settings, self.clock, bus_factory=factory)
        self.axis = ElectrakActuator("lift_left", ElectrakSettings(address_n=19), self.link, self.clock)
        self._relay: asyncio.Task[None] | None = None
        self._relay_bus = (
            can.Bus(interface="virtual", channel=settings.channel) if wire == "python_can_virtual" else None
        )

    async def start(self) -> None:
        await self.bus.start()
        if self._relay_bus is not None:
            self._relay = asyncio.create_task(self._carry(self._relay_bus), name="relay")

    async def _carry(self, outside: can.BusABC) -> None:
        """python-can's virtual bus has no file descriptor: the machine's side of it is polled here."""
        inside = self.bus.connect()
        while True:
            for source, sink in ((outside, inside), (inside, outside)):
                while (message := source.recv(0)) is not None:
                    sink.send(message)
            await asyncio.sleep(0.002)

    async def stop(self) -> None:
        await self.axis.close()
        await self.link.close()
        if self._relay is not None:
            self._relay.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._relay
        await self.bus.close()
        for bus in (self._relay_bus, self.external):
            if bus is not None:
                bus.shutdown()

    async def renew(self, target_mm: float, seconds: float, share: float = 1.0) -> None:
        for _ in range(round(seconds / 0.02)):
            self.axis.set_target_mm(target_mm, share)
            await asyncio.sleep(0.02)


class ElectrakStand(ActuatorStand):
    """The virtual actuator."""

    low, high, reached, still = 5.0, 295.0, 1.5, 0.3

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.clock = bench.clock
        self._send: Callable[[Frame], None] | None = None

    @property
    def device(self) -> ElectrakActuator:
        return self.bench.axis

    def true_position(self) -> float:
        return self.bench.unit.position_mm

    def mute(self) -> None:
        port = self.bench.link._port
        assert port is not None
        if isinstance(port, SlcanPort):
            self.bench.bus.inject("adapter_refuses")
            return

        def refuse(frame: Frame) -> None:
            raise PortFullError(f"no buffer space for {frame.can_id:X}")

        self._send = port.send
        port.send = refuse  # type: ignore[method-assign]

    def unmute(self) -> None:
        self.bench.bus.clear_faults()
        port = self.bench.link._port
        if port is not None and self._send is not None:
            port.send = self._send  # type: ignore[method-assign, assignment]

    async def lose_wire(self) -> None:
        self.bench.bus.inject("silence")

    async def restore_wire(self) -> None:
        self.bench.bus.clear_faults()


@pytest.fixture(params=WIRES)
async def bench(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Bench]:
    made = Bench(request.param, tmp_path)
    await made.start()
    yield made
    await made.stop()


class TestElectrakOverEveryWire(LinearActuatorConformance):
    """The driver, unchanged, over each wire."""

    @pytest.fixture
    def stand(self, bench: Bench) -> ElectrakStand:
        return ElectrakStand(bench)


async def test_what_is_an_electraks_own(bench: Bench) -> None:
    """Nothing moves until a target is set, to the tenth of a millimetre; what it counts and tells besides."""
    axis: LinearActuator = bench.axis
    with pytest.raises(LifecycleError, match="Open it first"):
        await axis.arm()
    await axis.open()
    with pytest.raises(LifecycleError, match="Arm it first"):
        axis.set_target_mm(120.0)
    await axis.arm()
    await asyncio.sleep(0.25)
    assert bench.unit.position_mm == 100.0
    await bench.renew(125.0, 1.6)
    assert bench.unit.position_mm == pytest.approx(125.0, abs=0.9)
    telemetry = axis.telemetry()
    assert telemetry.current_a is not None
    assert telemetry.moving is not None
    assert telemetry.counters["feedback_n"] > 10
    assert 0.0 <= telemetry.thermal_load < 0.1
    with pytest.raises(StaleReadingError):
        telemetry.current_a.fresh(bench.clock.now_s() + 5.0, 0.3)
    await axis.close()
    assert not bench.unit.received_control[-1].motion_enable


async def test_a_target_that_is_not_renewed_is_counted_once(bench: Bench) -> None:
    axis = bench.axis
    await axis.open()
    await axis.arm()
    axis.set_target_mm(250.0)
    await until(lambda: axis.telemetry().counters["target_timeouts_n"] > 0)
    await until(lambda: bench.unit.velocity_mm_per_s == 0)
    assert 100.0 < bench.unit.position_mm < 160.0
    assert axis.telemetry().counters["target_timeouts_n"] == 1


async def test_silence_is_no_feedback(bench: Bench) -> None:
    axis = bench.axis
    await axis.open()
    bench.bus.inject("silence")
    await until(lambda: state(axis) is Lifecycle.FAILED)
    assert [fault.condition for fault in axis.faults()] == ["no_feedback"]


async def test_no_answer_is_a_timeout_that_says_what_to_look_at(bench: Bench) -> None:
    bench.unit.cut_power()
    with pytest.raises(DeviceTimeoutError, match="no feedback from address 19"):
        await bench.axis.open()
    assert state(bench.axis) is Lifecycle.CLOSED


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (CanSettings(interface="slcan", channel="/nowhere/can"), "cannot be opened"),
        (CanSettings(interface="socketcan", channel="can_absent"), "no such network interface"),
    ],
)
async def test_a_channel_that_does_not_exist_is_said_at_once(settings: CanSettings, why: str) -> None:
    link = CanLink(settings)
    axis = ElectrakActuator("tilt", ElectrakSettings(), link)
    with pytest.raises(DeviceMissingError, match=why):
        await axis.open()
    assert state(axis) is Lifecycle.CLOSED
    await axis.close()
    await link.close()


async def test_settings_beyond_the_model_are_refused(tmp_path: Path) -> None:
    link = CanLink(CanSettings(interface="virtual", channel=str(tmp_path)))
    with pytest.raises(CommandRangeError, match="beyond the stroke of 100"):
        ElectrakActuator("tilt", ElectrakSettings(profile="electrak_md_a050"), link)


async def test_a_fault_present_forbids_arming(bench: Bench) -> None:
    await bench.axis.open()
    bench.bus.inject("fatal")
    await until(lambda: bool(bench.axis.faults()))
    with pytest.raises(DeviceRefusedError, match="fatal"):
        await bench.axis.arm()
    assert state(bench.axis) is Lifecycle.STANDBY
