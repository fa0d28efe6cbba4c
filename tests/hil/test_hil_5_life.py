"""How the service ends, hangs, crashes and comes back: always disarmed, and the machine stands."""

from __future__ import annotations

import signal
import time

import pytest

from hil.bus import RawBus
from hil.service import Grader, Rig, turn, wait_for

WATCHDOG_S = 2.0
STANDS_WITHIN_S = 1.0
ACM = 0xEF00

pytestmark = pytest.mark.timeout(240)


def stands(rig: Rig, within_s: float) -> float:
    """Wait until the blade does not move any more; its angle.

    Raises:
        AssertionError: it still moves after ``within_s``.
    """
    until_s = time.monotonic() + within_s
    last = float(rig.ask("state")["blade_deg"])
    while True:
        time.sleep(0.15)
        now = float(rig.ask("state")["blade_deg"])
        if abs(now - last) < 0.02:
            return now
        assert time.monotonic() < until_s, f"still moving at {now:.2f} deg after {within_s:g} s"
        last = now


def back_disarmed(grader: Grader, old_pid: int, timeout_s: float) -> None:
    """A new process, disarmed, that can be armed again."""
    wait_for("a new process", lambda: grader.unit.pid not in (0, old_pid), timeout_s)
    state = grader.wait("it answers", lambda s: s["mode"], timeout_s)
    assert state["mode"] == "disarmed"
    grader.wait_ready()


@pytest.mark.restarts(1)
def test_a_frozen_daemon_is_replaced_and_the_blade_stands(ready: Grader, rig: Rig, listener: RawBus) -> None:
    turn(ready, rig)
    pid = ready.unit.pid
    ready.unit.kill(signal.SIGSTOP)
    # The servo's own watchdog stops it long before systemd's comes.
    angle = stands(rig, STANDS_WITHIN_S + 1.0)
    assert angle < 44.0, "it stopped on the way"
    listener.drain()
    back_disarmed(ready, pid, 30.0)
    assert "watchdog" in ready.unit.journal(200).lower()
    assert stands(rig, 1.0) == pytest.approx(angle, abs=0.3), "the new process left it where it was"
    enabled = [f for f in listener.drain() if f.pgn == ACM and f.data[3] & 0x10]
    assert not enabled, "no motion was enabled after the freeze"
    # The freeze was our doing and told: this reason is kept for the operator.
    assert ready.api.status()["mode"] == "disarmed"


@pytest.mark.restarts(1)
def test_a_killed_daemon_is_replaced_and_the_guard_speaks(ready: Grader, rig: Rig, listener: RawBus) -> None:
    turn(ready, rig)
    pid = ready.unit.pid
    listener.drain()
    ready.unit.kill(signal.SIGKILL)
    angle = stands(rig, STANDS_WITHIN_S + 1.0)
    assert angle < 44.0
    back_disarmed(ready, pid, 30.0)
    frames = [f for f in listener.drain() if f.pgn == ACM]
    assert frames
    assert not any(f.data[3] & 0x10 for f in frames), "nothing enabled motion again"
    assert rig.ask("state")["blade_deg"] == pytest.approx(angle, abs=0.3)
    log = ready.unit.journal(200)
    assert "guard" in log


def test_stop_and_start_by_hand(ready: Grader, rig: Rig) -> None:
    turn(ready, rig)
    began_s = time.monotonic()
    ready.unit.ctl("stop")
    took_s = time.monotonic() - began_s
    assert ready.unit.show("Result") == "success"
    assert took_s < 10.0
    angle = stands(rig, 1.0)
    assert angle < 44.0
    state = ready.start()
    assert state["mode"] == "disarmed"
    assert stands(rig, 1.0) == pytest.approx(angle, abs=0.3)


def test_the_clock_may_jump(ready: Grader, rig: Rig) -> None:
    """An hour forward and back, by a GPS receiver or a person: control does not notice."""
    turn(ready, rig)
    pid, overruns = ready.unit.pid, ready.api.status()["tick"]["overruns_n"]
    real_s, mono_s = time.time(), time.monotonic()
    try:
        for step_s in (3600.0, -3600.0, 86_400.0 * 400):
            time.clock_settime(time.CLOCK_REALTIME, real_s + step_s + time.monotonic() - mono_s)
            state = ready.api.status()
            assert state["mode"] == "auto"
    finally:
        time.clock_settime(time.CLOCK_REALTIME, real_s + time.monotonic() - mono_s)
    state = ready.wait("it got there", lambda s: abs(s["axes"]["rotation"]["measured"] - 45.0) <= 0.5, 20.0)
    assert state["mode"] == "auto"
    assert ready.unit.pid == pid
    assert state["tick"]["overruns_n"] - overruns <= 3
