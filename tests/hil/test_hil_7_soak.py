"""The long run: scenes and faults strewn in at random, every one recovered from, nothing grows."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hil import bus
from hil.service import Grader, Rig, Status, Unit, brief, faults, measured, new_pass

SOAK_S = float(os.environ.get("GRADERD_SOAK_S", "120"))
SEED = int(os.environ.get("GRADERD_HIL_SEED", "0"))
ANGLES = {"left": 30.0, "center": 15.0, "right": -30.0, "even": 45.0}
CAN = "vcan0"
GROWTH_MIB = 24.0
FRESH_S = 1.5
SETTLED_S = 2.0

pytestmark = [pytest.mark.endurance, pytest.mark.soak, pytest.mark.timeout(SOAK_S + 300.0)]


class Soak:
    """One run: what it does, and what must hold all the time."""

    def __init__(self, grader: Grader, rig: Rig) -> None:
        self.grader, self.rig = grader, rig
        self.random = random.Random(SEED)
        self.done: dict[str, int] = {}

    def scene(self) -> None:
        """Soil somewhere; where the machine is in automatic it turns there."""
        zone = self.random.choice(sorted(ANGLES))
        new_pass(self.grader, self.rig, zone, self.random.randrange(1000))
        self.grader.wait(f"soil {zone}", lambda s: abs(measured(s, "rotation") - ANGLES[zone]) <= 0.5, 30.0)

    def rig_fault(self, kind: str, name: str, seconds: float, **params: object) -> None:
        """One fault of a simulated device for a while."""
        self.rig.ask(kind, name=name, **params)
        time.sleep(seconds)
        self.rig.ask("clear_faults")

    def link_down(self) -> None:
        """Somebody takes the CAN interface down and up."""
        bus.ip("link", "set", CAN, "down")
        time.sleep(self.random.uniform(0.1, 1.5))
        bus.ip("link", "set", CAN, "up")

    def kill_worker(self) -> None:
        """The perception process dies."""
        unit_pid = self.grader.unit.pid
        for task in Path("/proc").glob("[0-9]*"):
            try:
                command = (task / "cmdline").read_bytes()
                parent = int((task / "stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[1])
            except (FileNotFoundError, ProcessLookupError):
                continue
            if parent == unit_pid and b"worker" in command:
                os.kill(int(task.name), 9)

    def clock_step(self) -> None:
        """The wall clock jumps."""
        real_s, mono_s = time.time(), time.monotonic()
        time.clock_settime(time.CLOCK_REALTIME, real_s + self.random.choice((-5000.0, 5000.0)))
        time.sleep(0.5)  # so long the clock is wrong
        time.clock_settime(time.CLOCK_REALTIME, real_s + time.monotonic() - mono_s)

    def stop_and_reset(self) -> None:
        """An operator stops it."""
        self.grader.client.stop()
        self.grader.wait("stopped", lambda s: s["mode"] == "stopped", 3.0)

    def settled(self) -> Status:
        """Wait until pictures come and neither mode nor faults have changed for a while: some faults show late."""
        seen: tuple[str, set[str]] | None = None
        since_s = 0.0

        def unchanged(status: Status) -> bool:
            nonlocal seen, since_s
            now = (status["mode"], faults(status))
            if now != seen:
                seen, since_s = now, time.monotonic()
            pictures = status["soil"]["age_s"] is not None and status["soil"]["age_s"] < FRESH_S
            return pictures and time.monotonic() - since_s >= SETTLED_S

        return self.grader.wait("settled", unchanged, 40.0)

    def recover(self) -> None:
        """What an operator does: wait until it is ready, arm, automatic."""
        state = self.settled()
        if state["mode"] == "stopped":
            self.grader.client.reset()
            state = self.grader.wait("reset", lambda s: s["mode"] == "disarmed", 5.0)
        if state["mode"] != "auto" or faults(state):
            self.grader.disarm()
            self.stands_while_disarmed()
            self.grader.wait_ready(40.0)
            self.grader.arm("auto")

    def stands_while_disarmed(self) -> None:
        """Disarmed, the blade stands and nothing enables motion."""
        listener = bus.RawBus("wire0")
        time.sleep(0.3)  # what was on its way when it was disarmed
        before = self.rig.ask("state")["blade_deg"]
        listener.drain()
        time.sleep(0.5)  # so long nothing may happen
        enabled = [f for f in listener.drain() if f.pgn == 0xEF00 and f.data[3] & 0x10]
        listener.close()
        assert not enabled
        assert abs(self.rig.ask("state")["blade_deg"] - before) < 0.05

    def actions(self) -> dict[str, Callable[[], None]]:
        """Everything that may happen, by name."""
        between = self.random.uniform
        return {
            "servo silent": lambda: self.rig_fault("servo_fault", "drop", between(0.1, 1.5)),
            "servo unplugged": lambda: self.rig_fault("servo_fault", "unplug", between(0.5, 2.0)),
            "servo power cut": lambda: self.rig_fault("servo_fault", "power_cut", between(0.5, 2.0)),
            "lift silent": lambda: self.rig_fault("actuator_fault", "silence", between(0.2, 1.5), device="lift_left"),
            "tilt restarts": lambda: self.rig_fault("actuator_fault", "restart", 0.5, device="tilt"),
            "camera freezes": lambda: self.rig_fault("camera_fault", "freeze", between(1.0, 3.0)),
            "camera unplugged": lambda: self.rig_fault("camera_fault", "unplug", between(0.5, 2.0)),
            "camera blocked": lambda: self.rig_fault("camera_fault", "blocked", between(0.5, 2.0)),
            "link down": self.link_down,
            "worker killed": self.kill_worker,
            "clock step": self.clock_step,
            "operator stop": self.stop_and_reset,
        }


def resident_mib(unit: Unit) -> float:
    """Resident memory of the main process."""
    for line in Path(f"/proc/{unit.pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise AssertionError("no VmRSS")


def test_soak(ready: Grader, rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    soak = Soak(ready, rig)
    pid, began_s = ready.unit.pid, time.monotonic()
    soak.scene()
    before_mib: float | None = None
    names = sorted(soak.actions())
    while time.monotonic() - began_s < SOAK_S:
        name = soak.random.choice(names)
        try:
            soak.actions()[name]()
            soak.recover()
            soak.scene()
        except AssertionError as error:
            raise AssertionError(f"after {name!r} ({soak.done}): {error}\n{brief(ready.status_or_none())}") from error
        soak.done[name] = soak.done.get(name, 0) + 1
        assert ready.unit.pid == pid, f"replaced after {name!r}"
        if before_mib is None and sum(soak.done.values()) >= 3:
            before_mib = resident_mib(ready.unit)
    ready.disarm()
    after_mib = resident_mib(ready.unit)
    grew = f"{before_mib or 0:.0f} -> {after_mib:.0f} MiB"
    report = f"soak: {SOAK_S:g} s, {sum(soak.done.values())} faults {soak.done}, {grew}"
    with capsys.disabled():
        print(f"\n{report}")  # noqa: T201  (part of the report of the run)
    assert before_mib is not None, "too few faults for the time"
    assert after_mib - before_mib < GROWTH_MIB, report
