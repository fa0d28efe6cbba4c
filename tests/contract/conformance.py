"""What every device must do: one class per contract of ``graderd.hal``, to be run on each implementation of it.

A test file makes a *stand* (the device, and what a person beside the machine could see and do) and subclasses the
conformance class with a fixture ``stand`` that gives it, closed, with its wire in place::

    class TestMyRotator(RotatorConformance):
        @pytest.fixture
        async def stand(self) -> AsyncIterator[RotatorStand]:
            ...
"""

from __future__ import annotations

import asyncio
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import pytest

from graderd.core.faults.catalogue import CATALOGUE
from graderd.core.faults.monitor import catalogue_key
from graderd.hal.camera import Camera, EndOfFrames, Frame
from graderd.hal.clock import Clock
from graderd.hal.device import Lifecycle
from graderd.hal.errors import (
    CommandRangeError,
    DeviceError,
    DeviceLostError,
    DeviceMissingError,
    DeviceTimeoutError,
    LifecycleError,
    StaleReadingError,
)
from graderd.hal.fault import DeviceFault
from graderd.hal.linear_actuator import LinearActuator
from graderd.hal.reading import Reading
from graderd.hal.rotator import Rotator
from graderd.hal.stop_input import StopInput

TIMEOUT_S = 15.0
"""Deadline of waits: long, because the machine may be busy; nothing is measured by it."""
RENEW_S = 0.02
FRESH_S = 0.4
"""As old as a reading may be for the control tick (``max_age_s`` of an actuator)."""


class AxisStand(ABC):
    """An axis on its wire, and the truth about it. Positions are in the axis's unit.

    ``low``, ``high``: the soft limits it is configured with; it stands between them, nearer to ``low``. ``reached``:
    how near to a goal it comes. ``still``: as much it may move while it stands. ``instant``: a fake that is where it is
    told to be at once, so that nothing can be caught in the middle of a move. ``of_the_wire``: faults that the
    transport under it brings about.
    """

    low: float
    high: float
    reached: float
    still: float
    clock: Clock
    instant: ClassVar[bool] = False
    of_the_wire: ClassVar[frozenset[str]] = frozenset()

    @property
    @abstractmethod
    def device(self) -> Rotator | LinearActuator:
        """The driver under test."""

    @abstractmethod
    def position(self) -> Reading[float] | None:
        """The reading of the position."""

    @abstractmethod
    def sent(self) -> Reading[float] | None:
        """The reading of the goal sent."""

    @abstractmethod
    def set_goal(self, goal: float) -> None:
        """Command a goal."""

    @abstractmethod
    def true_position(self) -> float:
        """Where the axis is, not asking the driver."""

    @abstractmethod
    async def lose_wire(self) -> None:
        """Cut the driver off from the device."""

    @abstractmethod
    async def restore_wire(self) -> None:
        """Undo it."""

    @abstractmethod
    def mute(self) -> None:
        """Nothing that the driver sends gets through any more, and where it can be, it hears the device on."""

    @abstractmethod
    def unmute(self) -> None:
        """Undo it."""

    def faults(self) -> tuple[DeviceFault, ...]:
        """What it tells, but for what the transport under it brings about (``of_the_wire``)."""
        return tuple(f for f in self.device.faults() if f.name not in self.of_the_wire)

    async def wait(self, seconds: float) -> None:
        """Let time pass."""
        until_s = self.clock.now_s() + seconds
        while self.clock.now_s() < until_s:
            await asyncio.sleep(0.005)

    async def until(self, met: Callable[[], object]) -> None:
        """Let time pass until something is so."""
        until_s = self.clock.now_s() + TIMEOUT_S
        while not met():
            assert self.clock.now_s() < until_s, f"{self.device.lifecycle}, {self.device.faults()}"
            await self.wait(RENEW_S)

    async def drive(self, goal: float, met: Callable[[], object]) -> None:
        """Renew a goal as the control tick does, until something is so."""
        until_s = self.clock.now_s() + TIMEOUT_S
        while not met():
            assert self.clock.now_s() < until_s, f"{self.device.lifecycle}, {self.device.faults()}"
            self.set_goal(goal)
            await self.wait(RENEW_S)

    def at(self, goal: float) -> Callable[[], bool]:
        """Condition: it stands at the goal, by its own reading."""
        return lambda: (now := self.position()) is not None and abs(now.value - goal) <= self.reached

    async def come_to_rest(self) -> float:
        """Wait until the axis has not moved for 0.3 s, and say where it stands."""
        for _ in range(50):
            was = self.true_position()
            await self.wait(0.3)
            if abs(self.true_position() - was) <= self.still:
                return self.true_position()
        raise AssertionError("it does not come to rest")


def state(device: Rotator | LinearActuator) -> Lifecycle:
    """A call, so that the type checker does not take the state for a constant."""
    return device.lifecycle


def all_known(faults: tuple[DeviceFault, ...]) -> bool:
    """Whether the catalogue has a row for each: one that has none stops the machine."""
    return all(catalogue_key(fault.device, fault.condition) in CATALOGUE for fault in faults)


class _AxisConformance:
    """What rotator and linear actuator have in common."""

    async def test_closed_it_takes_no_command_but_hold(self, stand: AxisStand) -> None:
        assert state(stand.device) is Lifecycle.CLOSED
        with pytest.raises(LifecycleError):
            await stand.device.arm()
        with pytest.raises(LifecycleError):
            stand.set_goal(stand.low)
        stand.device.hold()
        await stand.device.disarm()
        await stand.device.close()
        assert state(stand.device) is Lifecycle.CLOSED

    async def test_open_reads_and_moves_nothing(self, stand: AxisStand) -> None:
        before = stand.true_position()
        await stand.device.open()
        assert state(stand.device) is Lifecycle.STANDBY
        reading = stand.position()
        assert reading is not None
        assert reading.fresh(stand.clock.now_s(), FRESH_S) == pytest.approx(before, abs=stand.reached)
        with pytest.raises(LifecycleError):
            stand.set_goal(stand.low)
        with pytest.raises(LifecycleError):
            await stand.device.open()
        await stand.wait(0.3)
        assert stand.true_position() == pytest.approx(before, abs=stand.still)
        assert stand.faults() == ()

    async def test_readings_are_renewed_and_age(self, stand: AxisStand) -> None:
        await stand.device.open()
        first = stand.position()
        assert first is not None
        assert math.isfinite(first.value)
        await stand.until(lambda: (now := stand.position()) is not None and now.time_s > first.time_s)
        assert first.time_s <= stand.clock.now_s()
        with pytest.raises(StaleReadingError):
            first.fresh(first.time_s + FRESH_S + 0.01, FRESH_S)

    async def test_arm_moves_nothing(self, stand: AxisStand) -> None:
        await stand.device.open()
        before = stand.true_position()
        await stand.device.arm()
        assert state(stand.device) is Lifecycle.ACTIVE
        with pytest.raises(LifecycleError):
            await stand.device.arm()
        await stand.wait(0.3)
        assert stand.true_position() == pytest.approx(before, abs=stand.still)

    async def test_it_is_not_armed_while_its_stop_could_not_be_sent(self, stand: AxisStand) -> None:
        """What will be written to stop it is written, and found taken, before anything can move."""
        await stand.device.open()
        before = stand.true_position()
        stand.mute()
        with pytest.raises(DeviceError):
            await stand.device.arm()
        assert state(stand.device) is not Lifecycle.ACTIVE
        stand.unmute()
        await stand.until(lambda: state(stand.device) is Lifecycle.STANDBY)
        await stand.until(lambda: not stand.faults())
        await stand.device.arm()
        assert stand.true_position() == pytest.approx(before, abs=stand.still)

    async def test_a_goal_is_reached_and_told(self, stand: AxisStand) -> None:
        goal = stand.true_position() + 0.15 * (stand.high - stand.low)
        await self._armed(stand)
        await stand.drive(goal, stand.at(goal))
        assert stand.true_position() == pytest.approx(goal, abs=2 * stand.reached)
        assert stand.sent() is not None
        assert all_known(stand.device.faults())

    async def test_illegal_goals_are_refused_and_change_nothing(self, stand: AxisStand) -> None:
        await self._armed(stand)
        before = stand.true_position()
        for goal in (math.nan, math.inf, -math.inf, stand.low - 0.01, stand.high + 0.01, 1e9):
            with pytest.raises(CommandRangeError):
                stand.set_goal(goal)
        await stand.wait(0.3)
        assert stand.true_position() == pytest.approx(before, abs=stand.still)
        assert state(stand.device) is Lifecycle.ACTIVE

    async def test_hold_stops_it_and_stays(self, stand: AxisStand) -> None:
        await self._armed(stand)
        await self._under_way(stand)
        stand.device.hold()
        stand.device.hold()
        rest = await stand.come_to_rest()
        assert stand.instant or rest < stand.high - 10 * stand.reached
        await stand.wait(0.3)
        assert stand.true_position() == pytest.approx(rest, abs=stand.still)
        assert state(stand.device) is Lifecycle.ACTIVE

    async def test_a_goal_not_renewed_becomes_a_hold(self, stand: AxisStand) -> None:
        await self._armed(stand)
        await self._under_way(stand)
        rest = await stand.come_to_rest()
        assert stand.instant or rest < stand.high - 10 * stand.reached
        assert state(stand.device) is Lifecycle.ACTIVE

    async def test_disarm_ends_motion_and_an_old_goal_does_not_come_back(self, stand: AxisStand) -> None:
        await self._armed(stand)
        await self._under_way(stand)
        await stand.device.disarm()
        await stand.device.disarm()
        assert state(stand.device) is Lifecycle.STANDBY
        with pytest.raises(LifecycleError):
            stand.set_goal(stand.low)
        rest = await stand.come_to_rest()
        await stand.device.arm()
        await stand.wait(0.3)
        assert stand.true_position() == pytest.approx(rest, abs=stand.still)

    async def test_close_ends_motion_and_it_can_be_opened_again(self, stand: AxisStand) -> None:
        await self._armed(stand)
        await self._under_way(stand)
        await stand.device.close()
        assert state(stand.device) is Lifecycle.CLOSED
        await stand.come_to_rest()
        await stand.device.close()
        stand.device.hold()
        assert state(stand.device) is Lifecycle.CLOSED
        await stand.device.open()
        assert state(stand.device) is Lifecycle.STANDBY

    async def test_a_lost_wire_fails_it_and_it_comes_back_to_standby_only(self, stand: AxisStand) -> None:
        await self._armed(stand)
        await self._under_way(stand)
        await stand.lose_wire()
        await stand.until(lambda: state(stand.device) is Lifecycle.FAILED)
        assert stand.device.faults()
        assert all_known(stand.device.faults())
        with pytest.raises(LifecycleError):
            await stand.device.arm()
        with pytest.raises(LifecycleError):
            stand.set_goal(stand.low)
        stand.device.hold()
        last = stand.position()
        await stand.wait(0.5)
        now = stand.position()
        assert last is None or now is None or now.time_s == last.time_s, "nothing is heard, so nothing may look young"
        await stand.come_to_rest()  # the device's own dead man, or nothing that was still under way
        await stand.restore_wire()
        await stand.until(lambda: state(stand.device) is Lifecycle.STANDBY)
        await stand.until(lambda: not stand.faults())
        rest = stand.true_position()
        await stand.wait(0.3)
        assert state(stand.device) is Lifecycle.STANDBY
        assert stand.true_position() == pytest.approx(rest, abs=stand.still)
        await stand.device.arm()

    async def test_an_absent_device_is_said_and_leaves_it_closed(self, stand: AxisStand) -> None:
        await stand.lose_wire()
        with pytest.raises((DeviceMissingError, DeviceTimeoutError)):
            await stand.device.open()
        assert state(stand.device) is Lifecycle.CLOSED
        await stand.restore_wire()
        await stand.device.open()
        assert state(stand.device) is Lifecycle.STANDBY

    async def _armed(self, stand: AxisStand) -> None:
        await stand.device.open()
        await stand.device.arm()

    async def _under_way(self, stand: AxisStand) -> None:
        """Leave for the far limit; returns in the middle of the move."""
        began = stand.true_position()
        gone = 10 * stand.reached
        await stand.drive(stand.high, lambda: stand.true_position() - began > gone)


class RotatorStand(AxisStand):
    """A rotator; positions are degrees at the blade."""

    @property
    @abstractmethod
    def device(self) -> Rotator: ...

    def position(self) -> Reading[float] | None:
        return self.device.telemetry().angle_deg

    def sent(self) -> Reading[float] | None:
        return self.device.telemetry().goal_sent_deg

    def set_goal(self, goal: float) -> None:
        self.device.set_goal_deg(goal)


class RotatorConformance(_AxisConformance):
    """:class:`graderd.hal.rotator.Rotator`."""


class ActuatorStand(AxisStand):
    """A linear actuator; positions are millimetres of extension."""

    @property
    @abstractmethod
    def device(self) -> LinearActuator: ...

    def position(self) -> Reading[float] | None:
        return self.device.telemetry().position_mm

    def sent(self) -> Reading[float] | None:
        return self.device.telemetry().target_sent_mm

    def set_goal(self, goal: float) -> None:
        self.device.set_target_mm(goal)


class LinearActuatorConformance(_AxisConformance):
    """:class:`graderd.hal.linear_actuator.LinearActuator`."""

    async def test_speed_shares_outside_zero_to_one_are_refused(self, stand: ActuatorStand) -> None:
        await self._armed(stand)
        middle = (stand.low + stand.high) / 2
        before = stand.true_position()
        for share in (0.0, -0.1, 1.01, math.nan, math.inf):
            with pytest.raises(CommandRangeError):
                stand.device.set_target_mm(middle, share)
        await stand.wait(0.3)
        assert stand.true_position() == pytest.approx(before, abs=stand.still)


class CameraStand(ABC):
    """A camera, closed, with its source in place. ``live``: frames come as time passes, and never end."""

    camera: Camera
    live: ClassVar[bool] = True

    @abstractmethod
    def lose(self) -> None:
        """Take the source away."""


class CameraConformance:
    """:class:`graderd.hal.camera.Camera`."""

    def test_closed_it_gives_nothing(self, camera_stand: CameraStand) -> None:
        assert camera_stand.camera.description
        with pytest.raises(LifecycleError):
            camera_stand.camera.read(0.1)
        camera_stand.camera.close()

    def test_every_frame_is_whole_and_handed_out_once(self, camera_stand: CameraStand) -> None:
        camera = camera_stand.camera
        camera.open()
        frames = self._some(camera)
        assert len(frames) >= 2
        for frame in frames:
            assert frame.color_bgr.dtype == np.uint8
            assert frame.color_bgr.ndim == 3
            assert frame.color_bgr.shape[2] == 3
            if frame.color_intrinsics is not None:
                assert (frame.color_intrinsics.height, frame.color_intrinsics.width) == frame.color_bgr.shape[:2]
            if frame.depth_mm is not None:
                assert frame.depth_mm.dtype == np.uint16
            if frame.depth_mm is not None and frame.depth_intrinsics is not None:
                assert (frame.depth_intrinsics.height, frame.depth_intrinsics.width) == frame.depth_mm.shape
            assert frame.capture_s <= time.monotonic()
        numbers = [frame.color_number for frame in frames]
        assert numbers == sorted(set(numbers))
        times = [frame.capture_s for frame in frames]
        assert times == sorted(times)
        assert all(math.isfinite(value) for value in camera.settings_read_back().values())
        camera.close()

    def test_it_can_be_closed_twice_and_opened_again(self, camera_stand: CameraStand) -> None:
        camera = camera_stand.camera
        camera.open()
        camera.read(TIMEOUT_S)
        camera.close()
        camera.close()
        with pytest.raises(LifecycleError):
            camera.read(0.1)
        camera.open()
        assert camera.read(TIMEOUT_S).color_bgr.size

    def test_a_source_that_goes_is_told(self, camera_stand: CameraStand) -> None:
        """A live one says so; a file that was read holds out to its end."""
        camera = camera_stand.camera
        camera.open()
        camera.read(TIMEOUT_S)
        camera_stand.lose()

        def read_on() -> None:
            for _ in range(100):
                camera.read(0.3)

        expected = (DeviceLostError, DeviceTimeoutError) if camera_stand.live else (DeviceError, EndOfFrames)
        with pytest.raises(expected):
            read_on()
        camera.close()

    def test_a_source_that_is_not_there_is_told(self, camera_stand: CameraStand) -> None:
        camera_stand.lose()
        with pytest.raises(DeviceMissingError):
            camera_stand.camera.open()
        with pytest.raises(LifecycleError):
            camera_stand.camera.read(0.1)

    def _some(self, camera: Camera) -> list[Frame]:
        frames: list[Frame] = []
        try:
            while len(frames) < 5:
                frames.append(camera.read(TIMEOUT_S))
        except EndOfFrames:
            pass
        return frames


class StopInputStand(ABC):
    """A stop input, closed, whose loop is whole."""

    source: StopInput

    @abstractmethod
    def become(self, loop: str) -> None:
        """Make the loop ``closed``, ``open``, ``shorted`` or, the adapter pulled out, ``gone``."""


class StopInputConformance:
    """:class:`graderd.hal.stop_input.StopInput`: whatever is not a whole loop is not permission."""

    def test_closed_it_permits_nothing(self, stop_stand: StopInputStand) -> None:
        assert stop_stand.source.where
        with pytest.raises(DeviceLostError):
            stop_stand.source.is_closed()
        with pytest.raises(DeviceLostError):
            stop_stand.source.follows()
        stop_stand.source.close()

    def test_it_follows_the_loop(self, stop_stand: StopInputStand) -> None:
        source = stop_stand.source
        source.open()
        assert source.is_closed()
        stop_stand.become("open")
        assert not source.is_closed()
        stop_stand.become("closed")
        assert source.is_closed()

    def test_the_test_pulse_tells_a_short_circuit_from_a_loop_and_leaves_it_driven(
        self, stop_stand: StopInputStand
    ) -> None:
        source = stop_stand.source
        source.open()
        assert source.follows()
        assert source.is_closed()
        stop_stand.become("shorted")
        assert source.is_closed()
        assert not source.follows()
        stop_stand.become("closed")
        assert source.follows()

    def test_a_lost_port_is_no_permission_and_comes_back(self, stop_stand: StopInputStand) -> None:
        source = stop_stand.source
        source.open()
        assert source.is_closed()
        stop_stand.become("gone")
        with pytest.raises(DeviceLostError):
            source.is_closed()
        with pytest.raises(DeviceLostError):
            source.follows()
        with pytest.raises(DeviceMissingError):
            source.open()
        stop_stand.become("closed")
        source.open()
        assert source.is_closed()

    def test_it_can_be_closed_twice_and_opened_again(self, stop_stand: StopInputStand) -> None:
        source = stop_stand.source
        source.open()
        source.close()
        source.close()
        with pytest.raises(DeviceLostError):
            source.is_closed()
        source.open()
        assert source.is_closed()


class ClockConformance:
    """:class:`graderd.hal.clock.Clock`."""

    def test_it_tells_finite_seconds_and_never_goes_back(self, clock: Clock) -> None:
        looks = [clock.now_s() for _ in range(100)]
        assert all(math.isfinite(look) for look in looks)
        assert looks == sorted(looks)
