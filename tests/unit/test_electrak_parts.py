"""The small pure parts of the driver: heat, planner, overload policy, bus health, ticker."""

from __future__ import annotations

import asyncio
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graderd.drivers.electrak import safe_off
from graderd.drivers.electrak.codec import ElectrakCodec
from graderd.drivers.electrak.planner import Motion, MotionPlanner, Phase
from graderd.drivers.electrak.profile import load_profile
from graderd.drivers.electrak.thermal import DERATE_FROM, OverloadPolicy, ThermalGuard, Verdict
from graderd.drivers.j1939.bus_health import BusEvent, BusHealth
from graderd.drivers.j1939.can_port import PortFullError
from graderd.drivers.j1939.ids import Frame, Pgn, destination_of, pgn_of
from graderd.drivers.j1939.ticker import Ticker
from graderd.hal.errors import DeviceMissingError
from graderd.hal.settings import CanSettings

HD = load_profile("electrak_hd_b017").figures


# -- heat -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("current_a", [9.0, 12.0, 18.0, 25.0])
def test_with_its_rests_the_load_settles_below_the_limit_at_any_current(current_a: float) -> None:
    guard, now_s, peak = ThermalGuard(HD), 0.0, 0.0
    while now_s < 1500.0:
        now_s += 0.1
        guard.update(current_a if guard.may_move(now_s) else 0.0, now_s)
        peak = max(peak, guard.load)
    assert peak < 1.0
    assert not guard.limited
    assert guard.derating == (current_a > 9.0 * DERATE_FROM**0.5)


def test_beyond_the_limit_motion_ends_until_it_is_cooler() -> None:
    guard, now_s = ThermalGuard(HD), 0.0
    while not guard.limited:
        now_s += 0.1
        guard.update(18.0, now_s)  # somebody moves it by hand override, without asking
    assert now_s == pytest.approx(57.5, abs=1.0)  # 200 s x ln(4 / 3) at four times the continuous heat
    refused = []
    for _ in range(600):
        refused.append(not guard.may_move(now_s))
        now_s += 0.1
        guard.update(0.0, now_s)
    assert refused[0]
    assert not refused[-1]
    assert refused == sorted(refused, reverse=True)


# -- planner ----------------------------------------------------------------------------------------------------------


def planner() -> MotionPlanner:
    return MotionPlanner(HD, current_limit_a=18.0, speed_percent=80)


def still(position_mm: float) -> Motion:
    return Motion(position_mm, 0.0, moving=False, age_s=0.05)


def test_without_a_target_every_message_disables_motion() -> None:
    assert not planner().control(still(100.0)).motion_enable


@given(st.floats(0, 300), st.floats(5, 295), st.floats(0.01, 1.0), st.floats(-78, 78), st.floats(0, 0.35))
def test_no_message_aims_further_than_the_look_ahead(
    position_mm: float, target_mm: float, share: float, velocity_mm_per_s: float, age_s: float
) -> None:
    plan = planner()
    plan.set_target(target_mm, share)
    control = plan.control(Motion(position_mm, velocity_mm_per_s, moving=True, age_s=age_s))
    if not control.motion_enable:
        assert abs(target_mm - position_mm) <= 1.2
        return
    # Its end stops keep the tube inside the stroke, whatever the last velocity was.
    here_mm = min(max(position_mm + velocity_mm_per_s * min(age_s, HD.afm_period_s), 0.0), HD.stroke_mm)
    reach_mm = HD.speed_mm_per_s(control.speed_percent) * 0.3 + HD.dead_zone_mm
    assert abs(control.target_mm - here_mm) <= reach_mm + 0.06 or (
        (control.target_mm - here_mm) * (target_mm - position_mm) <= 0
    )
    assert 0.0 <= control.target_mm <= HD.stroke_mm
    assert abs(control.target_mm - target_mm) <= max(abs(here_mm - target_mm), 2.0) + reach_mm
    assert control.speed_percent % 5 == 0
    assert 25 <= control.speed_percent <= 80


def test_speed_shares_between_the_steps_of_5_percent_are_met_on_average() -> None:
    plan = planner()
    plan.set_target(290.0, 0.72)  # 57.6 %
    duties = [plan.control(still(100.0)).speed_percent for _ in range(100)]
    assert set(duties) == {55.0, 60.0}
    assert sum(duties) / len(duties) == pytest.approx(57.6, abs=0.1)


def test_while_the_motor_has_to_rest_the_target_is_kept() -> None:
    plan = planner()
    plan.set_target(200.0, 1.0)
    assert not plan.control(still(100.0), may_move=False).motion_enable
    assert plan.target_mm == 200.0
    assert plan.control(still(100.0)).motion_enable


def test_a_correction_too_small_for_the_unit_is_not_begun() -> None:
    plan = planner()
    plan.set_target(101.1, 1.0)
    assert not plan.control(still(100.0)).motion_enable
    assert plan.phase is Phase.REST


# -- overload ---------------------------------------------------------------------------------------------------------


def test_retries_are_spent_one_by_one_and_come_back_with_arming() -> None:
    policy = OverloadPolicy(1)
    assert policy.on_feedback(True, True, 0.0) is Verdict.RETRY
    waits = []
    for now_s, tripped in ((0.1, True), (0.5, False), (1.1, False)):
        assert policy.on_feedback(tripped, True, now_s) is Verdict.NOTHING
        waits.append(policy.waiting)
    assert waits == [True, True, False], "the pause is a second"
    assert policy.on_feedback(True, True, 2.0) is Verdict.LATCH
    policy.rearm()
    policy.on_feedback(False, True, 3.0)
    assert policy.on_feedback(True, True, 4.0) is Verdict.RETRY
    assert policy.overloads_n == 3


def test_an_overload_while_nothing_was_commanded_latches_at_once() -> None:
    assert OverloadPolicy(5).on_feedback(True, False, 0.0) is Verdict.LATCH


# -- bus health -------------------------------------------------------------------------------------------------------


class SlowPort:
    """A CAN port whose queue is full for the first frames to one actuator."""

    def __init__(self, deaf: int, full_n: int) -> None:
        self.sent: list[Frame] = []
        self.closed = False
        self._deaf, self._full_n = deaf, full_n

    def send(self, frame: Frame) -> None:
        if destination_of(frame.can_id) == self._deaf and self._full_n:
            self._full_n -= 1
            raise PortFullError("its queue is full")
        self.sent.append(frame)

    def wait_ready(self, _: float) -> bool:
        return True

    def close(self) -> None:
        self.closed = True


def test_the_last_words_are_said_again_to_whom_a_full_queue_kept_from_hearing(monkeypatch: pytest.MonkeyPatch) -> None:
    port = SlowPort(deaf=20, full_n=3)
    monkeypatch.setattr(sys.modules[safe_off.__module__], "open_port", lambda _: port)
    assert safe_off(CanSettings(), (19, 20, 27)) == 9
    codec = ElectrakCodec("electrak_hd")
    told = [destination_of(f.can_id) for f in port.sent if pgn_of(f.can_id) == Pgn.PROPRIETARY_A]
    assert set(told) == {19, 20, 27}
    assert not any(codec.decode_control(f.data).motion_enable for f in port.sent[1:])
    assert port.closed


def test_an_interface_that_came_back_down_is_not_called_unplugged() -> None:
    health = BusHealth()
    health.on_lost("unplugged", "gone", 1.0)
    health.on_open_failed(DeviceMissingError("CAN socketcan can0", "the interface is down"), 2.0)
    assert [f.condition for f in health.faults(2.0)] == ["interface_down"]
    health.on_open_failed(DeviceMissingError("CAN socketcan can0", "no such network interface"), 3.0)
    assert [f.condition for f in health.faults(3.0)] == ["unplugged"]
    health.on_open()
    assert health.faults(4.0) == ()


def test_a_full_queue_after_bus_off_is_only_its_consequence() -> None:

    health = BusHealth()
    health.on_event(BusEvent.BUS_OFF, 1.0)
    health.on_transmit_full("no buffer space", 1.1)
    assert [f.condition for f in health.faults(1.2)] == ["bus_off"]


# -- ticker -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", [True, False])
async def test_the_grid_is_kept_and_missed_points_are_counted(kernel: bool) -> None:
    loop = asyncio.get_running_loop()
    ticker = Ticker(0.01, kernel=kernel)
    start_s, ticks_n = loop.time(), 0
    while ticks_n < 20:
        ticks_n += await ticker.wait()
    assert loop.time() - start_s >= 0.195
    loop.call_soon(lambda: [None for _ in iter(lambda: loop.time() < start_s + 0.3, False)])  # the loop is blocked
    while ticks_n < 28:
        passed_n = await ticker.wait()
        ticks_n += passed_n
    assert ticks_n * 0.01 <= loop.time() - start_s + 0.011
    ticker.close()
    ticker.close()


async def test_woken_ahead_of_the_grid_a_task_can_meet_its_point() -> None:
    loop = asyncio.get_running_loop()
    start_s = loop.time()
    ticker, ahead_n, ticks_n = Ticker(0.02, kernel=True, ahead_s=0.01), 0, 0
    for _ in range(20):
        ticks_n += await ticker.wait()
        ahead_n += loop.time() < start_s + ticks_n * 0.02
        ticker.meet()
        assert loop.time() >= start_s + ticks_n * 0.02
        assert ticker.late_s == pytest.approx(loop.time() - start_s - ticks_n * 0.02, abs=0.02)
    assert ahead_n > 0
    ticker.close()
