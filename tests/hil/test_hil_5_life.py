"""How the service ends, hangs, crashes and comes back: always disarmed, and the machine stands."""

from __future__ import annotations

import os
import signal
import time

import pytest

from hil.bus import RawBus, daemons_claim
from hil.service import SOCKET, Grader, Rig, measured, turn, wait_for
from tests.hil.conftest import bus_users

# Until the servo's own watchdog has ended the motion, at the speed the tests turn with.
STANDS_WITHIN_S = 2.0
FURTHER_DEG = 14.0
CAN = "vcan0"
ACM = 0xEF00
OURS = 0xE7

pytestmark = pytest.mark.timeout(240)


def angle(rig: Rig) -> float:
    """The blade's true angle."""
    return float(rig.ask("state")["blade_deg"])


def stands(rig: Rig, began_deg: float, within_s: float = STANDS_WITHIN_S) -> float:
    """Wait until the blade does not move any more; its angle. Judged by the machine's own speed and clock.

    Raises:
        AssertionError: it still moves after ``within_s``, or has gone further than it may.
    """
    until_s = time.monotonic() + within_s
    while True:
        state = rig.ask("state")
        now_deg = float(state["blade_deg"])
        if abs(state["blade_velocity_deg_per_s"]) < 0.05:
            assert abs(now_deg - began_deg) <= FURTHER_DEG, f"from {began_deg:.1f} it went on to {now_deg:.1f} deg"
            return now_deg
        assert state["time_s"] < until_s, f"still moving at {now_deg:.2f} deg after {within_s:g} s"
        time.sleep(0.05)


def back_disarmed(grader: Grader, old_pid: int, timeout_s: float) -> None:
    """A new process, disarmed, that can be armed again."""
    # Asking systemd starts a program each time, which takes the processor from the guard and the new process.
    wait_for("a new process", lambda: grader.unit.pid not in (0, old_pid), timeout_s, 0.5)
    state = grader.wait("it answers", lambda s: s["mode"], timeout_s)
    assert state["mode"] == "disarmed"
    grader.wait_ready()


@pytest.mark.endurance
@pytest.mark.restarts(1)
def test_a_frozen_daemon_is_replaced_and_the_blade_stands(ready: Grader, rig: Rig, listener: RawBus) -> None:
    turn(ready, rig)
    pid = ready.unit.pid
    began_deg = angle(rig)
    os.kill(pid, signal.SIGSTOP)
    # The servo's own watchdog stops it long before systemd's comes.
    stood_deg = stands(rig, began_deg)
    assert stood_deg < 44.0, "it stopped on the way"
    listener.drain()
    back_disarmed(ready, pid, 30.0)
    assert "watchdog" in ready.unit.journal(200).lower()
    assert angle(rig) == pytest.approx(stood_deg, abs=0.3), "the new process left it where it was"
    enabled = [f for f in listener.drain() if f.pgn == ACM and f.data[3] & 0x10]
    assert not enabled, "no motion was enabled after the freeze"
    # The freeze was our doing and told: this reason is kept for the operator.
    assert ready.status()["mode"] == "disarmed"


@pytest.mark.restarts(1)
def test_a_killed_daemon_is_replaced_and_the_guard_speaks(ready: Grader, rig: Rig, listener: RawBus) -> None:
    turn(ready, rig)
    pid = ready.unit.pid
    listener.drain()
    began_deg = angle(rig)
    os.kill(pid, signal.SIGKILL)
    stood_deg = stands(rig, began_deg)
    assert stood_deg < 44.0, "it stopped on the way"
    back_disarmed(ready, pid, 30.0)
    frames = [f for f in listener.drain() if f.pgn == ACM]
    assert frames
    assert not any(f.data[3] & 0x10 for f in frames), "nothing enabled motion again"
    assert angle(rig) == pytest.approx(stood_deg, abs=0.3)
    log = ready.unit.journal(200)
    assert "guard" in log


def test_stop_and_start_by_hand(ready: Grader, rig: Rig, listener: RawBus) -> None:
    turn(ready, rig)
    began_deg, began_s = angle(rig), time.monotonic()
    ready.unit.ctl("stop")
    took_s = time.monotonic() - began_s
    assert ready.unit.show("Result") == "success"
    assert took_s < 10.0
    stood_deg = stands(rig, began_deg)
    assert stood_deg < 44.0, "it stopped on the way"
    assert not bus_users(CAN), "a socket is left behind"
    assert not SOCKET.parent.exists()
    listener.drain()
    ready.unit.ctl("start")
    ready.wait("stopped, as it was left", lambda status: status["mode"] == "stopped")
    ready.client.reset()
    state = ready.wait_ready()
    assert state["mode"] == "disarmed"
    assert daemons_claim(listener)[0] == OURS, "a start asks for the preferred address, whatever it had before"
    assert angle(rig) == pytest.approx(stood_deg, abs=0.3)


@pytest.mark.endurance
def test_the_clock_may_jump(ready: Grader, rig: Rig) -> None:
    """An hour forward and back, by a GPS receiver or a person: control does not notice."""
    turn(ready, rig)
    pid, overruns = ready.unit.pid, ready.status()["tick"]["overruns_n"]
    real_s, mono_s = time.time(), time.monotonic()
    try:
        for step_s in (3600.0, -3600.0, 86_400.0 * 400):
            time.clock_settime(time.CLOCK_REALTIME, real_s + step_s + time.monotonic() - mono_s)
            state = ready.status()
            assert state["mode"] == "auto"
    finally:
        time.clock_settime(time.CLOCK_REALTIME, real_s + time.monotonic() - mono_s)
    state = ready.wait("it got there", lambda s: abs(measured(s, "rotation") - 45.0) <= 0.5, 20.0)
    assert state["mode"] == "auto"
    assert ready.unit.pid == pid
    assert state["tick"]["overruns_n"] - overruns <= 3
