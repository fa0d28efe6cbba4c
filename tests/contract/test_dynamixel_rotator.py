"""The PH54 driver: the rotator's conformance class and what is the servo's own, over four transports."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from graderd.drivers.dynamixel import Ph54Rotator, model_file
from graderd.hal.device import Lifecycle
from graderd.hal.errors import CommandRangeError, WrongDeviceError
from graderd.simulator.servo import VirtualServo
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

    def mute(self) -> None:
        self.bench.bus.inject("drop_requests")

    def unmute(self) -> None:
        self.bench.bus.clear_faults()

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


@pytest.mark.parametrize("model", ["PH42-020-S300-R", "PM54-040-S250-R"])
class TestOthersOfTheFamilyByTheirProfile(RotatorConformance):
    """The same driver on another servo, with nothing but the profile that ``graderd profile import`` makes."""

    @pytest.fixture
    async def stand(self, tmp_path: Path, model: str) -> AsyncIterator[Ph54Stand]:
        assert model_file.main([model, "--to", str(tmp_path)]) == 0
        profile = str(next(tmp_path.glob("*.toml")))
        async with make_bench(tmp_path, VirtualServo(profile=profile), opened=False, profile=profile) as bench:
            bench.servo.shaft_deg = 7.0
            yield Ph54Stand(bench)

    async def test_it_is_that_servo_and_its_rating_that_limits_it(self, stand: Ph54Stand, model: str) -> None:
        await stand.device.open()
        await stand.device.arm()
        servo, rating = stand.bench.servo, stand.device.table.profile["rating"]
        assert model in stand.device.table.title
        assert servo.memory["model_number"] == stand.device.table.model_number != 2020
        assert servo.memory["goal_current"] == rating["current_continuous_a"] * 1000
        assert {d.kind for d in await stand.device.verify_profile()} <= {"default"}

    async def test_the_profile_of_another_is_refused(self, stand: Ph54Stand) -> None:
        settings = stand.device.settings.model_copy(update={"profile": "ph54_200_s500"})
        with pytest.raises(WrongDeviceError, match="expected 2020"):
            await Ph54Rotator(settings).open()

    def test_more_current_than_the_servo_takes_is_refused(self, stand: Ph54Stand) -> None:
        settings = stand.device.settings.model_copy(update={"current_limit_a": 9.3})
        with pytest.raises(CommandRangeError, match=r"current_limit_a 9\.3 is above 4\."):
            Ph54Rotator(settings)
