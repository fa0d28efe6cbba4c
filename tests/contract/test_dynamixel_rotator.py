"""What every rotator must do (graderd.hal.rotator), run on the PH54 driver over four transports.

:class:`RotatorConformance` needs nothing but a fixture ``bench``: another implementation subclasses it.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.hal.errors import CommandRangeError, LifecycleError
from graderd.hal.lifecycle import Lifecycle
from tests.dynamixel_sim import Bench
from tests.dynamixel_sim import bench as make_bench


class RotatorConformance:
    """Behaviour that callers rely on, whatever the wire does."""

    async def test_open_reads_and_leaves_torque_and_blade_alone(self, bench: Bench) -> None:
        telemetry = bench.rotator.telemetry()
        assert bench.rotator.lifecycle is Lifecycle.STANDBY
        assert telemetry.angle_deg is not None
        assert telemetry.angle_deg.value == pytest.approx(7.0, abs=0.1)
        assert telemetry.torque_on is not None
        assert not telemetry.torque_on.value
        assert not bench.servo.torque_enabled
        assert bench.servo.shaft_deg == pytest.approx(7.0, abs=0.1)

    async def test_every_reading_is_there_and_young(self, bench: Bench) -> None:
        before = bench.rotator.telemetry().angle_deg
        assert before is not None
        await bench.until(lambda: (a := bench.rotator.telemetry().angle_deg) and a.time_s > before.time_s)
        t = bench.rotator.telemetry()
        for reading in (t.angle_deg, t.velocity_deg_per_s, t.current_a, t.torque_nm, t.voltage_v, t.temperature_c):
            assert reading is not None
            assert math.isfinite(reading.value)
        assert t.voltage_v is not None
        assert t.voltage_v.value == pytest.approx(24.0, abs=0.5)

    async def test_arm_does_not_move_the_blade(self, bench: Bench) -> None:
        await bench.rotator.arm()
        assert bench.rotator.lifecycle is Lifecycle.ACTIVE
        assert bench.servo.torque_enabled
        await asyncio.sleep(0.3)
        assert bench.servo.shaft_deg == pytest.approx(7.0, abs=0.1)

    async def test_a_goal_is_reached(self, bench: Bench) -> None:
        await bench.rotator.arm()
        await bench.drive(20.0, bench.at(20.0, 0.3))
        assert bench.servo.shaft_deg == pytest.approx(20.0, abs=0.5)
        sent = bench.rotator.telemetry().goal_sent_deg
        assert sent is not None
        assert sent.value == pytest.approx(20.0, abs=0.01)

    async def test_hold_stops_where_the_blade_is(self, bench: Bench) -> None:
        await bench.rotator.arm()
        await bench.drive(50.0, bench.past(22.0))
        bench.rotator.hold()
        bench.rotator.hold()
        held_deg = bench.servo.shaft_deg
        await bench.until(lambda: abs(bench.servo.shaft_velocity_deg_per_s) < 0.5)
        await asyncio.sleep(0.5)
        assert bench.servo.shaft_deg == pytest.approx(
            held_deg, abs=6.0
        )  # what it turns within the 30 ms delay, and the braking
        assert bench.rotator.lifecycle is Lifecycle.ACTIVE

    async def test_a_goal_not_renewed_becomes_a_hold(self, bench: Bench) -> None:
        await bench.rotator.arm()
        await bench.drive(50.0, bench.past(17.0))
        await bench.until(lambda: bench.rotator.telemetry().counters.get("goal_timeouts_n", 0) > 0)
        await bench.until(lambda: abs(bench.servo.shaft_velocity_deg_per_s) < 0.5)
        assert bench.servo.shaft_deg < 45.0

    async def test_illegal_goals_are_refused_and_change_nothing(self, bench: Bench) -> None:
        await bench.rotator.arm()
        for goal_deg in (math.nan, math.inf, -math.inf, 60.01, -60.01, 1e9):
            with pytest.raises(CommandRangeError):
                bench.rotator.set_goal_deg(goal_deg)
        await asyncio.sleep(0.1)
        assert bench.servo.shaft_deg == pytest.approx(7.0, abs=0.1)

    async def test_no_goal_without_arming(self, bench: Bench) -> None:
        with pytest.raises(LifecycleError):
            bench.rotator.set_goal_deg(0.0)

    async def test_no_second_open_and_no_second_arm(self, bench: Bench) -> None:
        with pytest.raises(LifecycleError):
            await bench.rotator.open()
        await bench.rotator.arm()
        with pytest.raises(LifecycleError):
            await bench.rotator.arm()

    async def test_disarm_takes_torque_off_and_can_be_armed_again(self, bench: Bench) -> None:
        await bench.rotator.arm()
        await bench.drive(50.0, bench.past(17.0))
        await bench.rotator.disarm()
        await bench.rotator.disarm()
        assert bench.rotator.lifecycle is Lifecycle.STANDBY
        assert not bench.servo.torque_enabled
        rest_deg = bench.servo.shaft_deg
        await bench.rotator.arm()
        await asyncio.sleep(0.3)
        assert bench.servo.shaft_deg == pytest.approx(rest_deg, abs=0.3)

    async def test_close_takes_torque_off_and_is_idempotent(self, bench: Bench) -> None:
        await bench.rotator.arm()
        await bench.rotator.close()
        assert not bench.servo.torque_enabled
        assert bench.rotator.lifecycle is Lifecycle.CLOSED
        await bench.rotator.close()
        bench.rotator.hold()  # allowed in every state

    async def test_open_again_after_close(self, bench: Bench) -> None:
        await bench.rotator.close()
        await bench.rotator.open()
        assert bench.rotator.lifecycle is Lifecycle.STANDBY


TRANSPORTS: dict[str, dict[str, dict[str, float]]] = {
    "clean": {},
    "one_byte_at_a_time": {"trickle": {}},
    "loss_20_percent": {"drop": {"rate": 0.1}, "drop_requests": {"rate": 0.11}},  # one exchange in five
    "30_ms_late": {"delay": {"seconds": 0.03}},
}


@pytest.mark.parametrize("transport", TRANSPORTS)
class TestPh54OverFourTransports(RotatorConformance):
    """The driver, unchanged, over each transport."""

    @pytest.fixture
    async def bench(self, tmp_path: Path, transport: str) -> AsyncIterator[Bench]:
        async with make_bench(tmp_path, opened=False, wire={"seed": 4}) as made:
            made.servo.shaft_deg = 7.0
            for name, params in TRANSPORTS[transport].items():
                made.bus.inject(name, **params)
            await made.rotator.open()
            yield made
            assert "no_reply" not in made.conditions()
