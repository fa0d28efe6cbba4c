"""The fakes that tests of the runtime drive obey the same contracts as the devices they stand for; so do the clocks."""

from __future__ import annotations

import asyncio

import pytest

from graderd.hal.clock import Clock, ManualClock, SystemClock
from graderd.hal.errors import DeviceRefusedError
from harness.awake_clock import AwakeClock
from harness.fakes import FakeActuator, FakeAxis, FakeRotator
from tests.contract.conformance import (
    ActuatorStand,
    AxisStand,
    ClockConformance,
    LinearActuatorConformance,
    RotatorConformance,
    RotatorStand,
)


class _FakeStand(AxisStand):
    """What a stand has to know of a fake, on a clock that moves when told."""

    low, high, reached, still = -FakeAxis.LIMIT, FakeAxis.LIMIT, 0.5, 0.01
    instant = True

    def __init__(self, name: str, kind: type[FakeAxis]) -> None:
        self.clock: ManualClock = ManualClock(1000.0)
        self.fake = kind(name, self.clock, -100.0, [])

    def true_position(self) -> float:
        return self.fake.position

    def mute(self) -> None:
        self.fake.refuse_arm = DeviceRefusedError(self.fake.name, "cannot be told anything")

    def unmute(self) -> None:
        self.fake.refuse_arm = None

    async def lose_wire(self) -> None:
        self.fake.lose()

    async def restore_wire(self) -> None:
        self.fake.restore()

    async def wait(self, seconds: float) -> None:
        self.clock.advance(seconds)
        if isinstance(self.fake, FakeRotator):
            self.fake.turn()
        await asyncio.sleep(0)


class FakeRotatorStand(_FakeStand, RotatorStand):
    """A fake with no more than a speed."""

    fake: FakeRotator

    def __init__(self) -> None:
        super().__init__("rotation", FakeRotator)

    @property
    def device(self) -> FakeRotator:
        return self.fake


class FakeActuatorStand(_FakeStand, ActuatorStand):
    """The same for an actuator."""

    fake: FakeActuator

    def __init__(self) -> None:
        super().__init__("tilt", FakeActuator)

    @property
    def device(self) -> FakeActuator:
        return self.fake


class TestFakeRotator(RotatorConformance):
    @pytest.fixture
    async def stand(self) -> FakeRotatorStand:
        made = FakeRotatorStand()
        await made.fake.close()
        return made


class TestFakeActuator(LinearActuatorConformance):
    @pytest.fixture
    async def stand(self) -> FakeActuatorStand:
        made = FakeActuatorStand()
        await made.fake.close()
        return made


@pytest.mark.parametrize("made", [SystemClock, ManualClock, AwakeClock])
class TestClocks(ClockConformance):
    @pytest.fixture
    def clock(self, made: type[Clock]) -> Clock:
        return made()
