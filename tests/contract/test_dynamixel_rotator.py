"""The PH54 driver: the rotator's conformance class and what is the servo's own, over four transports."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.drivers.dynamixel import Ph54Rotator
from graderd.hal.lifecycle import Lifecycle
from tests.contract.conformance import RotatorConformance, RotatorStand, state
from tests.dynamixel_sim import Bench
from tests.dynamixel_sim import bench as make_bench

TRANSPORTS: dict[str, dict[str, dict[str, float]]] = {
    "clean": {},
    "one_byte_at_a_time": {"trickle": {}},
    "loss_20_percent": {"drop": {"rate": 0.1}, "drop_requests": {"rate": 0.11}},  # one exchange in five
    "30_ms_late": {"delay": {"seconds": 0.03}},
}


class Ph54Stand(RotatorStand):
    """The virtual servo."""

    low, high, reached, still = -60.0, 60.0, 0.5, 0.3
    of_the_wire = frozenset({"servo_bus.lossy"})

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.clock = bench.clock

    @property
    def device(self) -> Ph54Rotator:
        return self.bench.rotator

    def true_position(self) -> float:
        return self.bench.servo.shaft_deg

    async def lose_wire(self) -> None:
        await self.bench.bus.unplug()

    async def restore_wire(self) -> None:
        await self.bench.bus.replug()


@pytest.mark.parametrize("transport", TRANSPORTS)
class TestPh54OverFourTransports(RotatorConformance):
    """The driver, unchanged, over each transport."""

    @pytest.fixture
    async def bench(self, tmp_path: Path, transport: str) -> AsyncIterator[Bench]:
        async with make_bench(tmp_path, opened=False, wire={"seed": 4}) as made:
            made.servo.shaft_deg = 7.0
            for name, params in TRANSPORTS[transport].items():
                made.bus.inject(name, **params)
            yield made
            assert "no_reply" not in made.conditions()

    @pytest.fixture
    def stand(self, bench: Bench) -> Ph54Stand:
        return Ph54Stand(bench)

    async def test_open_leaves_torque_alone_and_reads_everything(self, bench: Bench) -> None:
        await bench.rotator.open()
        telemetry = bench.rotator.telemetry()
        assert telemetry.torque_on is not None
        assert not telemetry.torque_on.value
        assert not bench.servo.torque_enabled
        for reading in (
            telemetry.velocity_deg_per_s,
            telemetry.current_a,
            telemetry.torque_nm,
            telemetry.voltage_v,
            telemetry.temperature_c,
        ):
            assert reading is not None
        assert telemetry.voltage_v is not None
        assert telemetry.voltage_v.value == pytest.approx(24.0, abs=0.5)

    async def test_torque_is_on_while_armed_and_off_after_disarm_and_close(self, bench: Bench) -> None:
        await bench.rotator.open()
        for end in (bench.rotator.disarm, bench.rotator.close):
            await bench.rotator.arm()
            assert bench.servo.torque_enabled
            await end()
            assert not bench.servo.torque_enabled

    async def test_hold_stops_within_the_braking_way(self, bench: Bench) -> None:
        await bench.rotator.open()
        await bench.rotator.arm()
        await bench.drive(50.0, bench.past(22.0))
        bench.rotator.hold()
        held_deg = bench.servo.shaft_deg
        await bench.until(lambda: abs(bench.servo.shaft_velocity_deg_per_s) < 0.5)
        # what it turns within the 30 ms delay, and the braking
        assert bench.servo.shaft_deg == pytest.approx(held_deg, abs=6.0)
        assert state(bench.rotator) is Lifecycle.ACTIVE

    async def test_a_goal_not_renewed_is_counted(self, bench: Bench) -> None:
        await bench.rotator.open()
        await bench.rotator.arm()
        await bench.drive(50.0, bench.past(17.0))
        await bench.until(lambda: bench.rotator.telemetry().counters.get("goal_timeouts_n", 0) > 0)
        await bench.until(lambda: abs(bench.servo.shaft_velocity_deg_per_s) < 0.5)
        assert bench.servo.shaft_deg < 45.0
